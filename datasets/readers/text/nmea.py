"""NMEA 0183 logs: GGA, RMC, GST, VTG and ZDA of any talker, also between other lines and bytes.

Sentences are checked, and grouped by epoch.
"""

import dataclasses
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.decimals import DAY_NS
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import assumed_sigma
from terrafusion.datasets.readers.delimited import check_lines
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.text.fixes import FIX_OF_CODE, Fixes, gnss_recording
from terrafusion.datasets.readers.timed_tables import row_times

CHECKED_SENTENCE = re.compile(
    r"\$(([A-Z]{2})(GGA|RMC|GST|ZDA|VTG),([\x20-\x23\x25-\x29\x2b-\x7e]{0,200}))(\*([0-9A-Fa-f]{2}))?"
)
"""Body, talker, kind, fields and checksum: a sentence holds printable characters but $ and *."""

STAMP_CHARACTERS = 100
UNIX_STAMP = re.compile(r"(?<![\d.])(\d{10}(?:\.\d+)?)(?![\d.])")
ISO_STAMP = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?")

KNOT_MPS = 1852.0 / 3600.0
FIX_OF_QUALITY = FIX_OF_CODE["nmea"]
NO_FIX = (6, 7, 8)
"""Qualities of GGA: estimated, manual, simulated."""
FIX_OF_MODE = dict.fromkeys(("A", "P", ""), Fix.SINGLE) | {"D": Fix.DGPS, "R": Fix.FIXED, "F": Fix.FLOAT}
"""RMC, from NMEA 2.3 on; E, M, S and N are no fixes."""
NEAR_EPOCHS = 3
"""Sentences of an epoch may come this many epochs late."""
CENTURY, CENTURIES_END = 80, 2200
"""Two-digit years from the first on are of the 1900s; GPS begins in 1980, 64 bits of ns end in 2262."""
UNKNOWN = (math.nan, math.nan, math.nan)
SENTENCE = re.compile(rb"\$(?:G[PNLABQI]|BD|QZ|IN)(?:GGA|RMC|GST|ZDA|VTG|GLL|GSA|GSV),")
WEEKS_1024_DAYS = 1024 * 7
UNKNOWN_HDOP = 99.0
"""Receivers write 99.99 where they have none."""


def claims(path: Path, head: bytes) -> bool:
    """Whether the name ends in .nmea, or a sentence of a GNSS receiver stands in the first bytes."""
    return (path.suffix.lower() == ".nmea" and bool(head)) or bool(SENTENCE.search(head))


def read(request: Request) -> list[Recording]:
    """The one recording of a log: its GNSS channel."""
    path = request.path
    if path.stat().st_size > limits.TEXT_BYTES:
        raise limits.too_much("MB", limits.TEXT_BYTES / 2**20)
    data = path.read_bytes()
    check_lines(data)
    epochs, notes = collect(data.decode("latin-1"))
    t_ns, date_notes = _dated(epochs)
    times = row_times(request, "gnss", t_ns)
    fixes, more = _fixes(request, epochs, t_ns)
    fixes = dataclasses.replace(fixes.select(times.order), t_ns=times.t_ns)
    notes += [*date_notes, *times.notes, *more]
    return [gnss_recording(request, fixes, None, "NMEA 0183 log", notes, times)]


class _NoTimeError(Exception):
    """A valid sentence of a receiver that does not know the time yet."""


@dataclass
class Epoch:
    """One epoch; NaN where unknown.

    Attributes:
        of_day_ns: nanoseconds of the day.
        day: midnights since the log's first epoch.
        receipt_s: Unix time in front of the sentence.
        date: days since 1970 where a sentence gives it.
        llh: latitude deg, longitude deg, height m; None where no sentence has a position.
        fix: a `Fix` value.
        sigma_enu_m, velocity_enu_mps: east, north, up.
        from_gga: whether a GGA gave the position.
    """

    of_day_ns: int
    day: int
    receipt_s: float = np.nan
    date: float = np.nan
    llh: tuple[float, float, float] | None = None
    fix: int = Fix.NONE
    hdop: float = np.nan
    sigma_enu_m: tuple[float, float, float] = UNKNOWN
    velocity_enu_mps: tuple[float, float, float] = UNKNOWN
    from_gga: bool = False


@dataclass
class _Log:
    epochs: list[Epoch] = field(default_factory=list)
    day: int = 0
    left_out: int = 0

    def at(self, text: str) -> Epoch:
        """The epoch of a time of day: one of the newest, or a new one."""
        of_day = _time_of_day(text)
        same = next((e for e in reversed(self.epochs[-NEAR_EPOCHS:]) if e.of_day_ns == of_day), None)
        if same is not None:
            return same
        last = self.epochs[-1] if self.epochs else None
        if last is not None and of_day < last.of_day_ns - DAY_NS // 2:
            self.day += 1
        elif last is not None and self.day and of_day > last.of_day_ns + DAY_NS // 2:
            self.day -= 1  # a late sentence of before midnight
        self.epochs.append(Epoch(of_day, self.day))
        return self.epochs[-1]


def collect(text: str) -> tuple[list[Epoch], list[str]]:
    """All epochs of a log with a position, and what was wrong with its sentences.

    Raises:
        DataError: no sentence, more than half of them damaged, or none with a position.
    """
    log, damaged, unchecked, timeless, total = _Log(), 0, 0, 0, 0
    summed = re.search(r"\*[0-9A-Fa-f]{2}\r?(\n|$)", text) is not None
    for match in CHECKED_SENTENCE.finditer(text):
        total += 1
        body, _, kind, fields, _, checksum = match.groups()
        if checksum is None and (summed or text[match.end() : match.end() + 1] not in ("", "\r", "\n")):
            damaged += 1
            continue
        unchecked += checksum is None
        if checksum is not None and reduce(xor, body.encode("latin-1"), 0) != int(checksum, 16):
            damaged += 1
            continue
        try:
            epoch = _PARSERS[kind](log, fields.split(","))
        except _NoTimeError:
            timeless += 1
            continue
        except (ValueError, IndexError, OverflowError):
            damaged += 1
            continue
        if epoch is not None and math.isnan(epoch.receipt_s):
            epoch.receipt_s = _receipt_s(text, match.start())
    if damaged * 2 > total or not total:
        what = f"{damaged} of {total} sentences are damaged" if total else "no sentence of a receiver"
        raise DataError(what, remedy="check the cable and the baud rate, and record it again")
    remarks = (
        (damaged, f"of {total} sentences are damaged (checksum or fields); left out"),
        (timeless, "sentences of a receiver without time yet; left out"),
        (unchecked, "sentences have no checksum; taken as they are"),
        (log.left_out, "estimated, manual or simulated positions left out"),
    )
    notes = [f"gnss: {count} {what}" for count, what in remarks if count]
    epochs = [epoch for epoch in log.epochs if epoch.llh is not None]
    if not epochs:
        raise DataError("no GGA or RMC sentence has a position", remedy="record GGA or RMC")
    # RMC repeats the position of a GGA with fewer digits, without height and quality.
    full = [epoch for epoch in epochs if epoch.from_gga]
    if without := sum(epoch.fix != Fix.NONE and not epoch.from_gga for epoch in epochs) if full else 0:
        notes.append(f"gnss: {without} of {len(epochs)} epochs have an RMC and no GGA; left out")
    return full or epochs, notes


def _gga(log: _Log, f: list[str]) -> Epoch:
    quality = int(f[5] or 0)
    if quality not in FIX_OF_QUALITY and quality not in NO_FIX:
        raise ValueError(quality)
    position = UNKNOWN
    if quality and quality not in NO_FIX:
        height = _float(f[8]) + (_float(f[10]) if f[10] else 0.0)  # above the geoid, and that above WGS-84
        position = (_angle(f[1], f[2], "NS"), _angle(f[3], f[4], "EW"), height)
    hdop, epoch = _float(f[7]), log.at(f[0])
    if epoch.from_gga:
        return epoch  # a second talker repeats the epoch
    log.left_out += quality in NO_FIX
    epoch.llh, epoch.hdop, epoch.from_gga = position, hdop, True
    epoch.fix = FIX_OF_QUALITY.get(quality, Fix.NONE)
    return epoch


def _rmc(log: _Log, f: list[str]) -> Epoch:
    position, velocity, fix = UNKNOWN, UNKNOWN, Fix.NONE
    if f[1] == "A":
        position = (_angle(f[2], f[3], "NS"), _angle(f[4], f[5], "EW"), math.nan)
        velocity = _velocity(f[6], f[7])
        fix = FIX_OF_MODE.get(f[11] if len(f) > 11 else "", Fix.NONE)
    day = _date(int(f[8][4:6]), f[8][2:4], f[8][:2]) if f[8] else math.nan
    epoch = log.at(f[0])
    if math.isnan(epoch.date):
        epoch.date = day
    epoch.velocity_enu_mps = velocity
    if epoch.llh is None:
        epoch.llh, epoch.fix = position, fix
    return epoch


def _gst(log: _Log, f: list[str]) -> Epoch:
    north, east, up = (_float(word) for word in f[5:8])
    epoch = log.at(f[0])
    epoch.sigma_enu_m = (east, north, up)
    return epoch


def _zda(log: _Log, f: list[str]) -> Epoch:
    if f[3] and not 1980 <= int(f[3]) < CENTURIES_END:
        raise ValueError(f[3])
    day = _date(int(f[3]), f[2], f[1]) if f[3] else np.nan
    epoch = log.at(f[0])
    epoch.date = day
    return epoch


def _vtg(log: _Log, f: list[str]) -> None:
    """Course and speed of the epoch before it, where no RMC has them."""
    velocity = _velocity(f[4], f[0])
    if log.epochs and np.isnan(log.epochs[-1].velocity_enu_mps[0]):
        log.epochs[-1].velocity_enu_mps = velocity


_PARSERS: dict[str, Callable[[_Log, list[str]], Epoch | None]] = {
    "GGA": _gga, "RMC": _rmc, "GST": _gst, "ZDA": _zda, "VTG": _vtg,
}  # fmt: skip


def _float(text: str) -> float:
    """A number, NaN where the field is empty."""
    if not text:
        return math.nan
    number = float(text)
    if not math.isfinite(number) or "_" in text:
        raise ValueError(text)
    return number


def _time_of_day(text: str) -> int:
    """Nanoseconds of hhmmss.sss; second 60 is a leap second and counts as the next one."""
    if not text:
        raise _NoTimeError
    if not re.fullmatch(r"\d{6}(\.\d*)?", text):
        raise ValueError(text)
    hour, minute, second = int(text[:2]), int(text[2:4]), int(text[4:6])
    if hour > 23 or minute > 59 or second > 60:
        raise ValueError(text)
    return ((hour * 60 + minute) * 60 + second) * 10**9 + int(text[7:16].ljust(9, "0"))


def _angle(text: str, side: str, sides: str) -> float:
    """Degrees of (d)ddmm.mmm and N, S, E or W."""
    number = _float(text)
    degrees = number // 100
    minutes = number - 100 * degrees
    if side not in (*sides,) or number < 0 or minutes >= 60 or degrees > (90 if "N" in sides else 180):
        raise ValueError(text)
    angle = float(degrees + minutes / 60)
    return -angle if side == sides[1] else angle


def _velocity(knots: str, course: str) -> tuple[float, float, float]:
    """East and north, m/s, and an unknown up; a receiver at rest gives no course."""
    speed = _float(knots) * KNOT_MPS
    if speed == 0.0:
        return 0.0, 0.0, math.nan
    heading = math.radians(_float(course))
    return speed * math.sin(heading), speed * math.cos(heading), math.nan


def _date(year: int, month: str, day: str) -> float:
    full = year if year > 99 else year + (1900 if year >= CENTURY else 2000)
    return float(date(full, int(month), int(day)).toordinal() - date(1970, 1, 1).toordinal())


def _receipt_s(text: str, at: int) -> float:
    """Unix time in front of a sentence on its line, NaN where there is none."""
    begin = max(text.rfind("\n", max(at - STAMP_CHARACTERS, 0), at) + 1, at - STAMP_CHARACTERS, 0)
    unix, iso = UNIX_STAMP.search(text, begin, at), ISO_STAMP.search(text, begin, at)
    if unix:
        return float(unix[1])
    try:
        return datetime.fromisoformat(iso[0]).replace(tzinfo=UTC).timestamp() if iso else math.nan
    except ValueError:
        return math.nan


def _column(epochs: list[Epoch], name: str) -> NDArray[Any]:
    """A field of all epochs, (N,) or (N, 3)."""
    return np.array([getattr(epoch, name) for epoch in epochs])


def _dated(epochs: list[Epoch]) -> tuple[NDArray[np.int64], list[str]]:
    """Unix nanoseconds of the epochs: and notes on the source of their date."""
    day, date = _column(epochs, "day"), _column(epochs, "date")
    if np.isfinite(date).any():
        first_days = date - day  # the date of the log's first day, as each dated epoch has it
        known = np.flatnonzero(np.isfinite(first_days))
        nearest = known[np.clip(np.searchsorted(known, np.arange(len(day)), side="right") - 1, 0, None)]
        first, changes = first_days[nearest], int((np.diff(first_days[known]) != 0).sum())
        notes = [f"gnss: the date jumps {changes} times beyond midnights"] if changes else []
        off = first[0] - _receipt_days(epochs)
        weeks = round(off / WEEKS_1024_DAYS) if np.isfinite(off) else 0
        if weeks and abs(off - weeks * WEEKS_1024_DAYS) <= 1.0:
            first = first - weeks * WEEKS_1024_DAYS
            notes.append(
                f"gnss: dates are {weeks * 1024} GPS weeks off the log's own time stamps "
                "(the receiver's week counter rolled over); corrected"
            )
        elif abs(off) > 1.0:
            notes.append(f"gnss: dates are {off:.0f} days off the log's own time stamps; not corrected")
    elif np.isfinite(_column(epochs, "receipt_s")).any():
        first = np.full(len(day), _receipt_days(epochs))
        notes = ["gnss: no sentence has a date; that of the log's own time stamps is taken"]
    else:
        first = np.zeros(len(day))
        notes = ["gnss: no sentence has a date: times are those of day 0, 1970-01-01"]
    return (day + first).astype(np.int64) * DAY_NS + _column(epochs, "of_day_ns"), notes


def _receipt_days(epochs: list[Epoch]) -> float:
    """Date of the log's first day by the time stamps in front of the sentences, days since 1970."""
    first = next((epoch for epoch in epochs if math.isfinite(epoch.receipt_s)), None)
    if first is None:
        return math.nan
    return float(np.rint((first.receipt_s - first.of_day_ns * 1e-9) / 86400.0) - first.day)


def _fixes(request: Request, epochs: list[Epoch], t_ns: TimesNs) -> tuple[Fixes, list[str]]:
    """The fixes, with HDOP for the sigmas that no GST gives."""
    notes = []
    fix, hdop = _column(epochs, "fix").astype(np.uint8), _column(epochs, "hdop")
    sigma = _column(epochs, "sigma_enu_m")
    counted = np.isnan(sigma[:, :2]).any(axis=1) & (fix > Fix.NONE) & (hdop < UNKNOWN_HDOP)
    if counted.any():
        at_one, origin = assumed_sigma(request.rig, fix[counted], fix[fix > Fix.NONE])
        sigma[counted] = hdop[counted, None] * at_one
        notes.append(f"gnss: {int(counted.sum())} fixes without GST: sigma is HDOP times that of {origin}")
    velocity = _column(epochs, "velocity_enu_mps")
    return Fixes(t_ns, _column(epochs, "llh"), fix, sigma, velocity), notes
