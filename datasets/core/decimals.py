"""Exact conversion of decimal and ISO 8601 times to integer nanoseconds."""

import re
from collections.abc import Sequence
from decimal import ROUND_HALF_EVEN, Decimal

import numpy as np
from numpy.typing import NDArray

NS_PER = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds in each unit of time."""

MAX_CHARACTERS = 40
_LIMIT_NS = 2**63 - 1
FIRST_YEAR, LAST_YEAR = 1900, 2200
DAY_NS = 86_400 * 10**9
OF_DAY = re.compile(r"\d{1,2}:\d\d:\d\d(\.\d+)?")
"""A time of day alone."""
OF_CLOCK = re.compile(r"(\d{1,2})([0-5]\d)([0-5]\d(?:\.\d*)?)")
"""A time of day without colons, as in NMEA: 93015.2 is 9:30:15.2."""
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(?!\d)")
_SLASHED = re.compile(r"(\d{1,2})[/-](\d{1,2})[/-](\d{4})(?!\d)")
_NAMED = re.compile(r"(\d{1,2})[- ]([A-Za-z]{3})[- ](\d{4})(?!\d)")
_MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
_HALF_DAY = re.compile(r"(?<!\d)(\d{1,2})(:\d\d(?::\d\d(?:\.\d+)?)?) ?([ap])\.?m\.?$", re.IGNORECASE)
_ZONE = re.compile(r" (?:UTC|GMT|([+-]\d\d:?\d\d))$")


class NotADecimal(ValueError):  # noqa: N818
    """The text at `row` is no decimal number or date that fits into int64 nanoseconds."""

    def __init__(self, row: int) -> None:
        super().__init__(f"row {row}")
        self.row = row


def to_ns(texts: Sequence[str], unit: str = "s") -> NDArray[np.int64]:
    """Decimal times as nanoseconds (N,) int64, without passing through a float.

    Args:
        texts: N decimal numbers; surrounding blanks are ignored.
        unit: "s", "ms", "us" or "ns"; fractions of a nanosecond are rounded half to even.

    Raises:
        NotADecimal: a text is no finite decimal number, or beyond int64.
    """
    ns = NS_PER[unit]
    places = len(str(ns)) - 1
    return np.array([_one_to_ns(text, ns, places, row) for row, text in enumerate(texts)], dtype=np.int64)


def _one_to_ns(text: str, ns: int, places: int, row: int) -> int:
    if len(text) > MAX_CHARACTERS or "_" in text or not text.isascii():
        raise NotADecimal(row)
    whole = _plain_to_ns(text, places)
    if whole is None:
        whole = _any_to_ns(text, ns, row)
    if abs(whole) > _LIMIT_NS:
        raise NotADecimal(row)
    return whole


def _plain_to_ns(text: str, places: int) -> int | None:
    """A number without exponent that is whole nanoseconds, as most are; None for any other text."""
    before, _, after = text.partition(".")
    if len(after) > places or not (after or before[-1:]).isdigit():
        return None
    try:
        return int(before + after.ljust(places, "0"))
    except ValueError:
        return None


def _any_to_ns(text: str, ns: int, row: int) -> int:
    try:
        number = Decimal(text)
        if not number.is_finite() or number.adjusted() > 20:
            raise NotADecimal(row)
        return int((number * ns).to_integral_value(rounding=ROUND_HALF_EVEN))
    except ArithmeticError:
        raise NotADecimal(row) from None


def dates_to_ns(texts: Sequence[str]) -> NDArray[np.int64]:
    """Instants in ISO 8601 (or with / between year, month and day) as Unix nanoseconds (N,) int64.

    Those without an offset are in UTC.

    Raises:
        NotADecimal: a text is no date, or none of the years 1900 to 2200.
    """
    import pandas as pd

    stamps = pd.to_datetime(pd.Series(texts, dtype=object), format="ISO8601", errors="coerce", utc=True)
    bad = np.flatnonzero(stamps.isna() | ~stamps.dt.year.between(FIRST_YEAR, LAST_YEAR))
    if bad.size:
        raise NotADecimal(int(bad[0]))
    return np.asarray(stamps.dt.as_unit("ns").astype("int64").to_numpy())


def iso_dates(texts: Sequence[str]) -> list[str]:
    """Dates and times without blanks around as in ISO 8601, where one of them tells how they are meant.

    3.9.2020 has the day first, 3-Sep-2020 names the month; with slashes that shows in a date of the column
    such as 9/13/2020; else the month is first where times are of half days (assumed). A date that is not
    understood stays as it is.
    """
    plain = [text.strip().replace(",", ".") for text in texts]
    half_days = any(map(_HALF_DAY.search, plain))
    if half_days:
        plain = [_HALF_DAY.sub(_of_24_hours, text) for text in plain]
    if any(map(_ZONE.search, plain)):
        plain = [_ZONE.sub(lambda zone: zone[1] or "Z", text) for text in plain]
    pairs = _slashed(plain)
    months, days = {first for first, _ in pairs}, {second for _, second in pairs}
    clear = max(days, default=0) > 12 or half_days or all(a == b for a, b in pairs)
    month_first = max(months, default=13) <= 12 and clear
    if month_first or (max(days, default=13) <= 12 < max(months)):
        month, day = (1, 2) if month_first else (2, 1)
        plain = [
            _SLASHED.sub(lambda d: f"{d[3]}-{d[month]:0>2}-{d[day]:0>2}", text, count=1) for text in plain
        ]
    return [_NAMED.sub(_of_named, _DAY_FIRST.sub(_of_day_first, text, count=1), count=1) for text in plain]


def month_is_assumed(texts: Sequence[str]) -> bool:
    """Whether nothing but their half days tells `iso_dates` that the month of slashed dates is first."""
    pairs = _slashed([text.strip() for text in texts])
    return (
        any(map(_HALF_DAY.search, texts))
        and max(map(max, pairs), default=13) <= 12
        and any(month != day for month, day in pairs)
    )


def _slashed(texts: Sequence[str]) -> set[tuple[int, int]]:
    """The first two numbers of dates such as 9/13/2020."""
    return {(int(date[1]), int(date[2])) for date in map(_SLASHED.match, texts) if date}


def _of_day_first(date: re.Match[str]) -> str:
    return f"{date[3]}-{date[2]:0>2}-{date[1]:0>2}"


def _of_named(date: re.Match[str]) -> str:
    name = date[2].lower()
    return f"{date[3]}-{_MONTHS.index(name) + 1:02}-{date[1]:0>2}" if name in _MONTHS else date[0]


def _of_24_hours(time: re.Match[str]) -> str:
    return f"{int(time[1]) % 12 + 12 * (time[3] in 'pP'):02}{time[2]}"
