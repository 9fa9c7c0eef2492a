"""Text exports of Xsens MT Manager: one file a device, a row a packet.

Column names and units are those of the MT Manager manual (Acc m/s2, Gyr rad/s, SampleTimeFine in
ticks of 10 kHz that wrap at 32 bits). The position is the device's own, fused with its IMU; its
attitude is left out: the output of a filter is not ground truth.
"""

import dataclasses
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs, distinct
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.delimited import (
    TextLayout,
    TextTable,
    head_lines,
    read_columns,
    read_text,
    separator_of,
    split,
)
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.text.fixes import Fixes, gnss_channel
from terrafusion.datasets.readers.text.xsens_motion import (
    ACC,
    ATTITUDES,
    GYR,
    INCREMENTS,
    UTC,
    clock_of,
    inertial,
)
from terrafusion.datasets.readers.timed_tables import row_times

COUNTERS = ("PacketCounter", "Counter")
TICKS = "SampleTimeFine"
POSITION = ("Latitude", "Longitude", "Altitude")
VELOCITIES = (("Vel_X", "Vel_Y", "Vel_Z"), ("Vel_E", "Vel_N", "Vel_U"))
STATUS = ("StatusWord", "Status")
OTHER_DEVICES = ("Euler_X", "dq_W", "dv[1]")
"""Columns of Xsens DOT exports, whose units differ (us, deg/s)."""

ENU_OF = {"ENU": (0, 1, 2), "NED": (1, 0, 2), "NWU": (1, 0, 2)}
ENU_SIGNS = {"ENU": (1, 1, 1), "NED": (1, 1, -1), "NWU": (-1, 1, 1)}

GNSS_FIX_BIT, RTK_SHIFT = 0x4, 27
"""StatusWord: bit 2 is the GNSS fix, bits 27 and 28 the RTK state (1 float, 2 fixed)."""
UNUSED_BITS = 1 << 7 | 1 << 17 | 0xE0000000


def claims(path: Path, head: bytes) -> bool:
    """Whether the first line that is no `//` line names columns of an MTi."""
    found = _header(head)
    if found is None:
        return False
    _, line, settings = found
    names = set(map(_bare, split(line, separator_of(line))))
    counted = names & {*COUNTERS, TICKS, "UTC_Year"}
    measured = names & {*ACC, *GYR, *POSITION, *INCREMENTS[0], *INCREMENTS[1]}
    return bool(counted and measured and (settings or not names & set(OTHER_DEVICES)))


def read(request: Request) -> list[Recording]:
    """The one recording of an export: IMU, and GNSS where the device has it."""
    columns, settings, notes = _columns(request.path)
    clock = clock_of(columns, settings)
    times = row_times(request, "imu", clock.t_ns)
    columns = columns.select(clock.order).select(times.order)
    notes += [*columns.notes, *clock.notes, *times.notes]
    imu, more = inertial(columns, times.t_ns, settings)
    gnss, datum, of_gnss = _gnss(request, columns, times.t_ns, settings)
    if imu is None and gnss is None:
        raise DataError("no row holds an IMU sample or a fix", remedy="export it again")
    start_ns = int(times.t_ns[0])
    recording = Recording(
        name=request.path.stem,
        start_ns=start_ns,
        imu=imu,
        gnss=gnss,
        datum=datum,
        source=_device(settings),
        notes=(*notes, *more, *of_gnss),
    )
    return [dataclasses.replace(recording, clock_jumps=times.jumps_of(recording.channels()))]


def _header(data: bytes) -> tuple[int, str, dict[str, str]] | None:
    """Line number and text of the column names, and what the `//` lines before them set."""
    settings: dict[str, str] = {}
    for number, line in head_lines(data, 100):
        if line.startswith("//"):
            key, colon, value = line[2:].partition(":")
            if colon:
                settings[key.strip().lower()] = value.strip()
        elif line.strip():
            return number, line, settings
    return None


def _bare(name: str) -> str:
    """A column's name without a unit behind it, such as in `Gyr_X [deg/s]`."""
    return re.sub(r"\s*[\[(](?:rad/s|deg/s|m/s2|m/s\^2|deg|m|m/s)[\])]$", "", name)


def _columns(path: Path) -> tuple[TextTable, dict[str, str], list[str]]:
    data = read_text(path)
    found = _header(data)
    if found is None:
        raise DataError("no line of column names", remedy="export it again, with the header")
    number, line, settings = found
    separator = separator_of(line)
    raw = split(line, separator)
    if raw and not raw[-1]:
        raw.pop()
    names = [_bare(name) for name in raw]
    for full, name in zip(raw, names, strict=True):
        if full != name:
            settings[f"unit of {name}"] = full[len(name) :].strip(" []()")
    layout = TextLayout((*names, *_unnamed(data, number, separator, len(names))), separator, number + 1)
    attitudes = [name for group in ATTITUDES for name in group]
    wanted = {*COUNTERS, TICKS, *ACC, *GYR, *INCREMENTS[0], *INCREMENTS[1], *attitudes, *POSITION, *UTC}
    wanted |= {name for group in VELOCITIES for name in group}
    numbers = [name for name in names if name in wanted]
    texts = [name for name in names if name in STATUS]
    columns = read_columns(path, data, layout, numbers, texts)
    attitude = [name for name in names if name in {*attitudes, *INCREMENTS[1]} or name.startswith("Mat[")]
    left = [name for name in names if name not in (*numbers, *texts, *attitude)]
    notes = []
    if attitude:
        notes.append("the device's attitude is the output of its filter, not ground truth: left out")
    if left:
        notes.append(f"columns left out: {', '.join(left)}")
    return columns, settings, notes


def _unnamed(data: bytes, header: int, separator: str, count: int) -> list[str]:
    """A nameless last column where the rows end with a separator and the header does not."""
    row = next((line for n, line in head_lines(data, header + 20) if n > header and line.strip()), "")
    return [""] if row.endswith(separator) and row.count(separator) == count else []


def _device(settings: dict[str, str]) -> str:
    keys = ("deviceid", "device id", "productcode", "firmware version", "filter profile")
    given = [f"{key} {settings[key]}" for key in keys if settings.get(key)]
    return f"Xsens MT Manager export ({', '.join(given)})" if given else "Xsens MT Manager export"


def _gnss(
    request: Request, columns: TextTable, t_ns: TimesNs, settings: dict[str, str]
) -> tuple[Gnss | None, tuple[float, float, float] | None, list[str]]:
    if not {"Latitude", "Longitude"} <= columns.numbers.keys():
        return None, None, []
    llh = columns.stack(POSITION)
    rows = np.asarray(np.isfinite(llh[:, :2]).all(axis=1))
    if not rows.any():
        return None, None, ["gnss: no row holds a position; the channel is absent"]
    notes = ["gnss: the position is the device's own, fused with its IMU: errors of near fixes go together"]
    fix, fix_notes = _fix(columns)
    velocity, more = _velocity(columns, settings)
    fixes = Fixes(t_ns, llh, fix, velocity_enu_mps=velocity).select(rows)
    gnss, datum, rest = gnss_channel(request.rig, fixes)
    return gnss, datum, [*notes, *fix_notes, *more, *rest]


def _fix(columns: TextTable) -> tuple[NDArray[np.uint8], list[str]]:
    name = next((name for name in STATUS if name in columns.texts), None)
    if name is None:
        note = "gnss: the export has no StatusWord; all fixes are taken as 'single'"
        return np.full(len(columns), Fix.SINGLE, dtype=np.uint8), [note]
    words, inverse = distinct(columns.texts[name])
    codes = np.array([_class_of(status) for status in _status_words(name, words)], dtype=np.uint8)
    fix = codes[inverse]
    if "" in words:  # the status may come at a lower rate than the position
        last = np.maximum.accumulate(np.where(inverse != words.index(""), np.arange(len(fix)), 0))
        fix = fix[last]
    return fix, []


def _status_words(name: str, words: list[str]) -> list[int]:
    """Status words written as 32 binary digits, in hexadecimal, or in decimal."""
    cells = [word.strip() for word in words]
    given = [cell for cell in cells if cell]
    base = _base_of(given)
    try:
        return [int(cell, base) if cell else 0 for cell in cells]
    except ValueError:
        pattern = r"[+-]?[0-9]+" if base == 10 else r"(0[xX])?[0-9a-fA-F]+"
        bad = next((cell for cell in given if not re.fullmatch(pattern, cell)), given[0])
        raise DataError(
            f"column '{name}' holds '{bad[:40]}'", remedy="it must be a number or hexadecimal"
        ) from None


def _base_of(given: list[str]) -> int:
    if given and all(len(cell) == 32 and set(cell) <= {"0", "1"} for cell in given):
        return 2
    if any(re.search("[xXa-fA-F]", cell) for cell in given):
        return 16
    if given and all(len(cell) == 8 and cell.isdigit() for cell in given):  # either, but for unused bits
        padded = any(cell[0] == "0" for cell in given)
        decimal, other = (any(int(cell, base) & UNUSED_BITS for cell in given) for base in (10, 16))
        return 16 if padded or (decimal and not other) else 10
    return 10


def _class_of(status: int) -> Fix:
    rtk = status >> RTK_SHIFT & 3
    if not status & GNSS_FIX_BIT:
        return Fix.NONE
    return {1: Fix.FLOAT, 2: Fix.FIXED}.get(rtk, Fix.SINGLE)


def _velocity(columns: TextTable, settings: dict[str, str]) -> tuple[Array | None, list[str]]:
    if all(name in columns.numbers for name in VELOCITIES[1][:2]):
        return columns.stack(VELOCITIES[1]), []
    if not all(name in columns.numbers for name in VELOCITIES[0]):
        return None, []
    setting = settings.get("coordinate system", "").upper()
    frame = setting if setting in ENU_OF else "ENU"
    velocity = columns.stack(VELOCITIES[0])[:, ENU_OF[frame]] * ENU_SIGNS[frame]
    origin = "as in the header" if setting in ENU_OF else "which the header does not state"
    return velocity, [f"gnss: velocity columns are taken as {frame}, {origin}"]
