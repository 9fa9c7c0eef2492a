"""Exact, vectorised conversion of decimal and ISO 8601 times to integer nanoseconds."""

from collections.abc import Sequence
from decimal import ROUND_HALF_EVEN, Decimal, InvalidOperation

import numpy as np
from numpy.typing import NDArray

NS_PER = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds in each unit of time."""

MAX_CHARACTERS = 40
_LIMIT_NS = 2**63 - 1
FIRST_YEAR, LAST_YEAR = 1900, 2200


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
    cells = [text.strip() for text in texts]
    width = max(map(len, cells), default=0)
    if width > MAX_CHARACTERS:
        raise NotADecimal(next(i for i, cell in enumerate(cells) if len(cell) == width))
    try:
        padded = np.array(cells, dtype=f"S{width or 1}").view(np.uint8).reshape(len(cells), width or 1)
    except UnicodeEncodeError:
        raise NotADecimal(next(i for i, cell in enumerate(cells) if not cell.isascii())) from None
    value, plain = _plain_to_ns(np.ascontiguousarray(padded.T), len(str(NS_PER[unit])) - 1)
    for i in np.flatnonzero(~plain).tolist():
        value[i] = _one_to_ns(cells[i], NS_PER[unit], i)
    return value


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


def _plain_to_ns(characters: NDArray[np.uint8], places: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Nanoseconds of texts like -12.345, given as (width, N) characters, and which texts have that form."""
    n = characters.shape[1]
    value, digits, decimals = (np.zeros(n, dtype=np.int64) for _ in range(3))
    seen_dot, ended, plain = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool), np.ones(n, dtype=bool)
    negative = characters[0] == ord("-")
    for k, c in enumerate(characters):
        digit, dot, end = (c >= 48) & (c <= 57), c == ord("."), c == 0
        sign = negative | (c == ord("+")) if k == 0 else np.zeros(n, dtype=bool)
        plain &= (digit | (dot & ~seen_dot) | end | sign) & (end | ~ended)
        value = np.where(digit, value * 10 + (c.astype(np.int64) - 48), value)
        digits += digit
        decimals += digit & seen_dot
        seen_dot |= dot
        ended |= end
    size = digits - decimals + places  # digits of the nanoseconds; int64 holds 19 beginning with 8 or less
    signed = negative | (characters[0] == ord("+"))
    first = np.where(signed, characters[min(1, len(characters) - 1)], characters[0])
    plain &= (digits > 0) & (decimals <= places) & ((size <= 18) | ((size == 19) & (first <= ord("8"))))
    shift = np.where(plain, places - decimals, 0)
    value = np.where(plain, value, 0) * 10**shift
    return np.where(negative, -value, value), plain


def _one_to_ns(cell: str, ns: int, row: int) -> int:
    """Any other decimal notation: exponents, more decimals than nanoseconds."""
    try:
        number = Decimal(cell)
        if "_" in cell or not number.is_finite() or number.adjusted() > 20:
            raise NotADecimal(row)
        whole = int((number * ns).to_integral_value(rounding=ROUND_HALF_EVEN))
    except (InvalidOperation, ArithmeticError):
        raise NotADecimal(row) from None
    if abs(whole) > _LIMIT_NS:
        raise NotADecimal(row)
    return whole
