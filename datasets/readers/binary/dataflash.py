"""Binary DataFlash logs (.bin) of ArduPilot's rovers: IMU, fixes and wheel encoders.

Each message begins with A3 95 and its type; FMT messages say how long a type is, and its fields with a format
character each (ArduPilot, libraries/AP_Logger/LogStructure.h).
"""

import math
import struct
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.gnss_time import WEEK_S, gps_to_unix_ns, leap_note
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.channel_tables import ACCEL, GYRO, ChannelReader
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.log_folder import CHANNELS, recording_of
from terrafusion.datasets.readers.log_meta import Meta
from terrafusion.datasets.readers.ros.raw import rows_at
from terrafusion.datasets.readers.text.fixes import FIX_OF_CODE, Fixes, gnss_channel
from terrafusion.datasets.readers.timed_tables import TimedTable, in_time

START, FMT, FMT_BYTES = b"\xa3\x95", 128, 89
"""First bytes of a message; type and length of the messages that describe the others."""
READ = {
    b"IMU": {"TimeUS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"},
    b"GPS": {"TimeUS", "Status", "GMS", "GWk", "Lat", "Lng", "Alt", "Spd", "GCrs", "VZ"},
    b"GPA": {"TimeUS", "HAcc", "VAcc", "SAcc"},
    b"WENC": {"TimeUS", "Dist0", "Dist1"},
    b"PARM": {"Name", "Value"},
}
"""Types that are read, and the fields they must have."""
CODES = {
    "b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8",
    "f": "<f4", "d": "<f8", "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4", "N": "S16",
}  # fmt: skip
SCALES = dict.fromkeys("cCeE", 0.01) | {"L": 1e-7}

Message = Mapping[str, NDArray[Any]]
"""Messages of one type (n,), by field, in the units that the format characters say."""


def claims(path: Path, head: bytes) -> bool:
    """Whether a file begins with a description of its messages."""
    return head.startswith(START + bytes([FMT]))


def read(request: Request) -> list[Recording]:
    """The one recording of a log, which begins with the autopilot's clock."""
    if request.path.stat().st_size > limits.TEXT_BYTES:
        raise limits.too_much("MB", limits.TEXT_BYTES / 2**20)
    notes = list[str]()
    held = _messages(request.path.read_bytes(), notes)
    imu, gps, wheels, geometry = held.get(b"IMU"), held.get(b"GPS"), *_wheels(held, notes)
    fields = zip((*GYRO, *ACCEL), ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"), strict=True)
    in_body = {} if imu is None else {name: imu[of] * (1 if of.endswith("X") else -1) for name, of in fields}
    numbers = {"imu": (imu, in_body), "wheels": (held.get(b"WENC"), wheels), "gnss": (gps, dict(gps or {}))}
    tables, jumps, clock = in_time(
        {
            name: TimedTable(
                t_ns=timed["TimeUS"].astype(np.int64) * 1000, path=request.path, numbers=of, texts={}
            )
            for name, (timed, of) in numbers.items()
            if timed is not None and of
        },
        repair_clock=request.repair_clock,
    )
    if not tables:
        raise DataError("holds neither IMU, GPS nor WENC messages", remedy="set LOG_BITMASK to log them")
    boot_ns = _boot_ns(gps, notes)
    gnss, datum = None, None
    if "gnss" in tables:
        fixes = _fixes(tables.pop("gnss"), held.get(b"GPA"), boot_ns)
        gnss, datum, more = gnss_channel(request.rig, fixes, rows="GPS messages")
        notes += more
    meta = Meta(start_ns=boot_ns, datum=datum, source="DataFlash log of ArduPilot", **geometry)
    reader = ChannelReader(tables, meta, rig=request.rig)
    channels = {name: reader.channel(name) for name in CHANNELS} | {"gnss": gnss}
    recording = recording_of(channels, meta, request.path.stem, [*notes, *reader.notes, *clock])
    return [replace(recording, clock_jumps=tuple(replace(j, t_ns=j.t_ns + boot_ns) for j in jumps))]


def _messages(raw: bytes, notes: list[str]) -> dict[bytes, Message]:
    """The messages of `READ` by the name of their type; bytes between messages are passed over."""
    starts, at, whole = defaultdict[int, list[int]](list), 0, 0
    kinds = {FMT: (b"FMT", FMT_BYTES, b"", b"")}
    while (at := raw.find(START, at)) >= 0 and at + 3 <= len(raw):
        kind = kinds.get(raw[at + 2])
        if kind is None or at + kind[1] > len(raw):
            at += 2
            continue
        if raw[at + 2] == FMT:
            described, size, *texts = struct.unpack_from("<BB4s16s64s", raw, at + 3)
            name, form, fields = (text.rstrip(b"\0") for text in texts)
            if size > 3 and described != FMT:
                kinds[described] = name, size, form, fields
        elif kind[0] in READ:
            starts[raw[at + 2]].append(at)
        at, whole = at + kind[1], whole + kind[1]
    if whole < len(raw):
        notes.append(f"{len(raw) - whole} of {len(raw)} bytes are of no complete message; left out")
    data, found = np.frombuffer(raw, dtype=np.uint8), dict[bytes, Message]()
    for key, places in starts.items():
        name, size, form, fields = kinds[key]
        rows = rows_at(data, np.array(places), size)[:, 3:]
        found[name] = _fields(rows, form.decode("latin-1"), fields.decode("latin-1").split(","), READ[name])
    return found


def _fields(rows: NDArray[np.uint8], form: str, names: list[str], needed: set[str]) -> Message:
    """The fields of messages (n, bytes) of one type, of its first sensor."""
    known = len(set(names)) == len(form) == len(names) and set(form) <= CODES.keys() and needed <= set(names)
    dtype = np.dtype([(name, CODES[code]) for name, code in zip(names, form, strict=True)] if known else "V")
    if dtype.itemsize != rows.shape[1]:
        what = f"messages of fields {shown(','.join(names))} do not fit their format"
        raise DataError(what, remedy="is it damaged, or of a firmware before 2015?")
    table = np.ascontiguousarray(rows).view(dtype)[:, 0]
    own = table[table["I"] == table["I"].min()] if "I" in names else table
    return {
        name: own[name] * SCALES[code] if code in SCALES else own[name]
        for name, code in zip(names, form, strict=True)
    }


def _wheels(held: Mapping[bytes, Message], notes: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Angles of both wheels (rad) of the distances that encoders count, and the geometry they are for."""
    names, values = (held.get(b"PARM", {}).get(key, np.zeros(0)).tolist() for key in ("Name", "Value"))
    known, wenc = dict(zip(names, values, strict=True)), held.get(b"WENC")
    radii, sides = (
        [known.get(f"WENC{k}_{of}".encode(), math.nan) for k in ("", "2")] for of in ("RADIUS", "POS_Y")
    )
    track_m = abs(sides[1] - sides[0])
    if wenc is None or not (all(radius > 0.0 for radius in radii) and track_m > 0.0):
        what = "WENC_RADIUS and WENC_POS_Y, and those of WENC2, give no left and right wheel"
        notes.append(f"wheels: {what if wenc is not None else 'no encoders are in the log (messages WENC)'}")
        return {}, {}
    left = int(sides[1] < sides[0])  # y is to the right
    notes.append(f"wheels: track {track_m:.3g} m and radius {radii[0]:.3g} m as the parameters WENC say")
    angles = {f"{name}_rad": wenc[f"Dist{k}"] / radii[k] for name, k in (("left", left), ("right", 1 - left))}
    return angles, {"track_m": track_m, "wheel_radius_m": radii[0]}


def _boot_ns(gps: Message | None, notes: list[str]) -> int:
    """Unix time at which the autopilot's clock was zero, by the first message with a GPS week; 0 without."""
    timed = np.flatnonzero(gps["GWk"]) if gps is not None else np.zeros(0, dtype=np.int64)
    if gps is None or not timed.size:
        notes.append("times have no calendar")
        return 0
    week, ms, us = (int(gps[name][timed[0]]) for name in ("GWk", "GMS", "TimeUS"))
    unix_ns = gps_to_unix_ns(np.array([week * WEEK_S * 10**9 + ms * 10**6]))
    notes.append(leap_note(unix_ns))
    return max(int(unix_ns[0]) - us * 1000, 0)


def _fixes(gps: TimedTable, gpa: Message | None, boot_ns: int) -> Fixes:
    """Fixes of the first receiver, with the accuracies (GPA) that are logged at the same time."""
    of, sigma = gps.numbers, np.full((len(gps), 4), np.nan)
    if gpa is not None:
        own = gpa["TimeUS"].astype(np.int64) * 1000
        at = np.minimum(np.searchsorted(own, gps.t_ns), len(own) - 1)
        same = own[at] == gps.t_ns
        sigma[same] = np.stack([gpa[name] for name in ("HAcc", "HAcc", "VAcc", "SAcc")], axis=1)[at[same]]
    sigma[sigma <= 0.0] = np.nan
    course = np.radians(of["GCrs"])
    velocity = np.stack([of["Spd"] * np.sin(course), of["Spd"] * np.cos(course), -of["VZ"]], axis=1)
    fix = [FIX_OF_CODE["mavlink"].get(code, Fix.NONE) for code in of["Status"].tolist()]
    llh = np.stack([of["Lat"], of["Lng"], of["Alt"]], axis=1)
    return Fixes(gps.t_ns + boot_ns, llh, np.array(fix, dtype=np.uint8), sigma[:, :3], velocity, sigma[:, 3])
