"""Solutions of RTKLIB (`.pos`): a header of `%` lines, then a row a fix.

Positions come as latitude/longitude/height (degrees, or degrees, minutes and seconds), as ECEF, or
as a baseline east/north/up of the base station; times as calendar or as GPS week and seconds.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.clock import RowTimes
from terrafusion.datasets.core.decimals import NS_PER, NotADecimal, dates_to_ns
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import enu_from_ecef
from terrafusion.datasets.core.gnss_time import FULL_WEEK_MIN, WEEK_S, gps_to_unix_ns, leap_note
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.delimited import (
    BLANKS,
    TextLayout,
    TextTable,
    head_lines,
    number_in,
    read_columns,
    read_text,
    split,
)
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.text.fixes import FIX_OF_CODE, Datum, Fixes, gnss_recording
from terrafusion.datasets.readers.timed_tables import row_times

DEGREES, DMS, ECEF, BASELINE = "latitude(deg)", "latitude(d'\")", "x-ecef(m)", "e-baseline(m)"
POSITIONS = {
    DEGREES: (DEGREES, "longitude(deg)", "height(m)"),
    DMS: (DMS, "longitude(d'\")", "height(m)"),
    ECEF: (ECEF, "y-ecef(m)", "z-ecef(m)"),
    BASELINE: (BASELINE, "n-baseline(m)", "u-baseline(m)"),
}
TIME_SYSTEMS = ("GPST", "UTC", "JST")
JST_AHEAD_NS = 9 * 3600 * 10**9

FIX_OF_Q = FIX_OF_CODE["rtklib"]


@dataclass(frozen=True)
class PosHeader:
    """The `%` lines: names of the columns, their line, and the base station."""

    line: int
    names: tuple[str, ...]
    kind: str
    separator: str
    time_system: str
    base: tuple[float | None, ...]


def claims(path: Path, head: bytes) -> bool:
    """Whether a `%` line names columns of a position, or the name ends in .pos and the text is RTKLIB's."""
    if any(word.encode() in head for word in POSITIONS) and head.lstrip().startswith(b"%"):
        return True
    return path.suffix.lower() == ".pos" and (head.lstrip().startswith(b"%") or _is_row(head))


def read(request: Request) -> list[Recording]:
    """The one recording of a solution file: its GNSS channel."""
    path, data = request.path, read_text(request.path)
    header = _header(data)
    columns = _columns(path, data, header)
    t_ns, notes = _times(columns, header)
    times = row_times(request, "gnss", t_ns)
    notes += [*columns.notes, *times.notes]
    if b"/geodetic" in data[:4096] and header.kind != BASELINE:
        notes.append("gnss: heights are above the geoid; taken as they are")
    fix, columns = _fix(columns, notes)[times.order], columns.select(times.order)
    fixes = _ecef(columns, fix, times) if header.kind == ECEF else _local(columns, fix, times, header.kind)
    base = _base(header, notes) if header.kind == BASELINE else None
    return [gnss_recording(request, fixes, base, "RTKLIB solution", notes, times)]


def _is_row(head: bytes) -> bool:
    words = head.split(b"\n", 1)[0].split()
    return len(words) >= 7 and (words[0].count(b"/") == 2 or words[0].isdigit())


def _header(data: bytes) -> PosHeader:
    base: tuple[float | None, ...] = ()
    found: PosHeader | None = None
    for number, line in head_lines(data):
        if not line.startswith("%"):
            if line.strip():
                break
            continue
        if "ref pos" in line:
            base = tuple(map(number_in, line.partition(":")[2].replace(",", " ").split()))
        kind = next((kind for kind in POSITIONS if kind in line), None)
        if kind is None:
            continue
        mark = line[line.index(kind) + len(kind) :][:1]
        separator = mark if mark and not mark.isspace() else ("\t" if mark == "\t" else BLANKS)
        time_system, *names = split(line[1:].strip(), separator)
        found = PosHeader(number, tuple(names), kind, separator, time_system, base)
    if found is None:
        raise DataError(
            "no `%` line names the columns, so neither time system nor position is known",
            remedy="write the solution with its header (out-outhead = on)",
        )
    if found.time_system not in TIME_SYSTEMS:
        raise DataError(
            f"unknown time system '{found.time_system[:20]}'", remedy=f"known are {', '.join(TIME_SYSTEMS)}"
        )
    return found


def _columns(path: Path, data: bytes, header: PosHeader) -> TextTable:
    """All columns; dates take one cell or two, angles in degrees, minutes and seconds three each."""
    names: list[str] = []
    for name in header.names:
        names += [f"{name} {part}" for part in "dms"] if name in POSITIONS[DMS][:2] else [name]
    if not set(POSITIONS[header.kind][1:]) <= set(header.names):
        raise DataError("the line of column names is damaged", remedy="write the solution again")
    row = next((x for n, x in head_lines(data) if n > header.line and x.strip() and x[0] != "%"), "")
    cells = split(row, header.separator)
    one_cell = bool(cells) and "/" in cells[0] and ":" in cells[0]
    time = ["date"] if one_cell else ["date", "clock"] if "/" in row[:11] else ["week", "tow"]
    layout = TextLayout((*time, *names), header.separator, header.line + 1, "%")
    return read_columns(path, data, layout, names, time)


def _times(columns: TextTable, header: PosHeader) -> tuple[TimesNs, list[str]]:
    """Unix nanoseconds of the rows in the order of the file, and notes on UTC."""
    gps_epoch_ns = np.datetime64("1980-01-06", "ns").astype(np.int64)
    if "week" in columns.texts:
        weeks = columns.times_ns("week", "ns")
        tow = columns.times_ns("tow", "s")
        bad = np.flatnonzero((weeks < 0) | (weeks > 10_000) | (tow < 0) | (tow >= WEEK_S * NS_PER["s"]))
        if bad.size:
            raise columns.bad_cell("week", int(bad[0]), "give GPS week and seconds of the week")
        if weeks.min() < FULL_WEEK_MIN:
            raise columns.bad_cell(
                "week", int(np.argmin(weeks)), "a week before August 1999 looks like one counted modulo 1024"
            )
        since_gps = weeks * WEEK_S * NS_PER["s"] + tow
    else:
        since_gps = _calendar_ns(columns) - gps_epoch_ns
    if header.time_system == "GPST":
        t_ns = gps_to_unix_ns(since_gps)
        return t_ns, [leap_note(t_ns)]
    t_ns = since_gps + gps_epoch_ns
    if header.time_system == "JST":
        return t_ns - JST_AHEAD_NS, ["gnss: times are in JST; 9 h taken off"]
    return t_ns, []


def _calendar_ns(columns: TextTable) -> TimesNs:
    text = columns.texts["date"]
    if "clock" in columns.texts:
        text = text + " " + columns.texts["clock"]
    try:
        return dates_to_ns(text.tolist())
    except NotADecimal as bad:
        raise columns.bad_cell("date", bad.row, "give YYYY/MM/DD HH:MM:SS.SSS") from None


def _fix(columns: TextTable, notes: list[str]) -> NDArray[np.uint8]:
    """Classes (N,) of the fixes."""
    if "Q" not in columns.numbers:
        notes.append("gnss: the solution has no Q; all fixes are taken as 'single'")
        return np.full(len(columns), Fix.SINGLE, dtype=np.uint8)
    q = columns.numbers["Q"]
    strange = np.flatnonzero(~np.isin(q, list(FIX_OF_Q)))
    if strange.size:
        known = "known are 1 fix, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP"
        raise columns.bad_cell("Q", int(strange[0]), known)
    if (q == 6).any():
        notes.append(f"gnss: {int((q == 6).sum())} PPP fixes are taken as 'float'")
    return np.array([*FIX_OF_Q.values()], dtype=np.uint8)[q.astype(np.int64)]


def _base(header: PosHeader, notes: list[str]) -> Datum | None:
    """Position of the base station of a baseline, where the file has it."""
    base = [number for number in header.base if number is not None]
    if len(base) == len(header.base) == 3 and abs(base[0]) <= 90 and abs(base[1]) <= 180:
        return base[0], base[1], base[2]
    notes.append("gnss: baselines of a base station whose position is not in the file")
    return None


def _local(columns: TextTable, fix: NDArray[np.uint8], times: RowTimes, kind: str) -> Fixes:
    """Fixes in latitude and longitude, or of a baseline; sigmas and velocities are east, north, up."""
    place = columns.stack(POSITIONS[kind])
    if kind == DMS:
        *angles, height = POSITIONS[kind]
        place = np.column_stack([*(_degrees(columns, name) for name in angles), columns.numbers[height]])
    sigma = columns.stack(("sde(m)", "sdn(m)", "sdu(m)"))
    velocity = columns.stack(("ve(m/s)", "vn(m/s)", "vu(m/s)"))
    sigma_v = _horizontal(columns.stack(("sdve", "sdvn")))
    return Fixes(times.t_ns, place, fix, sigma, velocity, sigma_v, local=kind == BASELINE)


def _degrees(columns: TextTable, name: str) -> Array:
    """An angle (N,) of its degrees, minutes and seconds; -0 degrees are south or west too."""
    degrees, minutes, seconds = columns.stack([f"{name} {part}" for part in "dms"]).T
    return np.asarray(np.copysign(np.abs(degrees) + minutes / 60.0 + seconds / 3600.0, degrees))


def _ecef(columns: TextTable, fix: NDArray[np.uint8], times: RowTimes) -> Fixes:
    """Fixes of ECEF positions, whose sigmas and velocities are turned to east, north and up."""
    import pymap3d

    xyz = columns.stack(POSITIONS[ECEF])
    far = np.flatnonzero(~(np.abs(np.linalg.norm(xyz, axis=1) - 6.37e6) < 1e5))
    if far.size:
        i = int(far[0])
        raise DataError(
            f"the ECEF position {xyz[i, 0]:g}, {xyz[i, 1]:g}, {xyz[i, 2]:g} m is not near the ground",
            channel="gnss",
            time_s=float(times.t_ns[i] - times.t_ns[0]) * 1e-9,
            remedy="process the observations again",
        )
    llh = np.stack(pymap3d.ecef2geodetic(*xyz.T), axis=1)
    _, R, _ = enu_from_ecef(xyz[:1])  # one rotation: a robot stays near its first fix
    velocity = columns.stack(("vx(m/s)", "vy(m/s)", "vz(m/s)")) @ R.T
    P = _covariances(columns, ("sdx(m)", "sdy(m)", "sdz(m)"), ("sdxy(m)", "sdyz(m)", "sdzx(m)"))
    V = _covariances(columns, ("sdvx", "sdvy", "sdvz"), ("sdvxy", "sdvyz", "sdvzx"))
    sigma, sigma_v = _sigmas(R @ P @ R.T), _horizontal(_sigmas(R @ V @ R.T)[:, :2])
    return Fixes(times.t_ns, llh, fix, sigma, velocity, sigma_v)


def _horizontal(sigma: Array) -> Array:
    """One sigma (N,) for both horizontal axes of (N, 2)."""
    return np.asarray(np.sqrt((sigma**2).mean(axis=1)))


def _covariances(columns: TextTable, sigmas: tuple[str, ...], crosses: tuple[str, ...]) -> Array:
    """Matrices (N, 3, 3) of sigmas and of RTKLIB's xy, yz, zx: the root of a covariance, signed."""
    P = np.zeros((len(columns), 3, 3))
    P[:, range(3), range(3)] = columns.stack(sigmas) ** 2
    for (i, j), cross in zip(((0, 1), (1, 2), (2, 0)), columns.stack(crosses).T, strict=True):
        P[:, i, j] = P[:, j, i] = np.sign(cross) * cross**2
    return P


def _sigmas(P: Array) -> Array:
    """Sigmas (N, 3) of matrices (N, 3, 3)."""
    return np.asarray(np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0)))
