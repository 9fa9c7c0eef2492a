"""A folder of tables, one or more a sensor, which share a clock: one recording of them.

Tables have their column maps beside them; NMEA logs, RTKLIB solutions, text of Xsens MT Manager and TUM
trajectories in the folder join them.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.readers.formats import MAP_SUFFIX, Request, append_parts, format_of
from terrafusion.datasets.readers.log_folder import META

JOINED = ("table", "nmea", "rtklib_pos", "xsens_text", "tum")
"""Formats whose files are joined."""
NEAR_NS = 60 * 10**9
"""Time by which files of one clock may lie apart, however short they are (assumed)."""
STATED = ("vehicle", "datum", "description", "terrain_name", "licence", "source", "imu_frame_id")
"""What files may say of the whole drive, but not differently."""


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is a folder without meta.yaml in which a table has a column map beside it."""
    if not path.is_dir() or (path / META).exists():
        return False
    maps = path.glob(f"*{MAP_SUFFIX}")
    return any(path.joinpath(found.name.removesuffix(MAP_SUFFIX)).is_file() for found in maps)


def read(request: Request) -> list[Recording]:
    """The one recording of a folder, named after it; each channel is that of one file.

    Raises:
        DataError: two files have the same channel, contradict each other, or share no clock.
    """
    parts, notes = dict[str, Recording](), list[str]()
    for path in sorted(request.path.iterdir()):
        if path.is_dir() or path.name.endswith(MAP_SUFFIX):
            continue
        found = _part(dataclasses.replace(request, path=path, columns=None))
        if isinstance(found, Recording):
            parts[path.name] = found
        else:
            notes.append(f"{path.name} was not read: {found}")
    return [_joined(request.path, parts).with_notes(*notes)]


def _part(request: Request) -> Recording | str:
    """What a file of the folder gives, or why it was not read."""
    path = request.path
    try:
        form = format_of(path)
    except DataError:
        return "it is of no format that can be joined"
    if form.name not in JOINED:
        return f"it is {form.description}, a log of its own"
    try:
        (found,) = form.read(request)
    except DataError:
        if form.name != "table" or path.with_name(path.name + MAP_SUFFIX).is_file():
            raise
        return f"it has no column map (`terrafusion inspect {path}` proposes one)"
    return found


def _joined(folder: Path, parts: Mapping[str, Recording]) -> Recording:
    owner = dict[str, str]()
    for name, part in parts.items():
        for channel in part.clocks():
            if channel in owner:
                what = f"{owner[channel]} and {name} both have it"
                remedy = "remove one from its column map, or give one of the files itself"
                if advice := append_parts([owner[channel], name]):
                    remedy += f"; if they are parts of one drive, {advice}"
                raise DataError(what, file=folder, channel=channel, remedy=remedy)
            owner[channel] = name
    _check_clock(folder, parts)
    stated = {name: _stated(name, part) for name, part in parts.items()}
    for (a, said), (b, other) in itertools.combinations(stated.items(), 2):
        for key in sorted(said.keys() & other.keys()):
            if said[key] != other[key]:
                what = f"{a} says {said[key]}, {b} {other[key]}"
                raise DataError(what, file=folder, channel=key, remedy="give it in one column map")
    meta = {key: value for own in stated.values() for key, value in own.items()}
    geometry = {key: meta.pop(key) for key in [f.name for f in dataclasses.fields(Overrides)] if key in meta}
    channels = {channel: getattr(parts[name], channel) for channel, name in owner.items()}
    every = parts.values()
    return Recording(
        name=meta.pop("name", folder.resolve().name),
        start_ns=min(part.start_ns for part in every),
        **meta,
        **channels,
        overrides=Overrides(**geometry),
        unturned=tuple(channel for part in every for channel in part.unturned),
        notes=tuple(f"{name}: {note}" for name, part in parts.items() for note in part.notes),
        clock_jumps=tuple(jump for part in every for jump in part.clock_jumps),
        metadata={key: value for part in every for key, value in part.metadata.items()},
    )


def _stated(file: str, part: Recording) -> dict[str, Any]:
    """What a file says of the drive and the robot, by key, where it does."""
    own = {key: getattr(part, key) for key in STATED} | dataclasses.asdict(part.overrides)
    if part.name != Path(file).stem:
        own["name"] = part.name
    if part.truth is not None:
        own |= {"truth_channels": part.truth_channels, "truth_frame": part.truth_frame}
    return {key: value for key, value in own.items() if value not in (None, "")}


def _check_clock(folder: Path, parts: Mapping[str, Recording]) -> None:
    """DataError where a file is further away in time from the others than these are long."""
    for name, part in parts.items():
        others = [other for other in parts.values() if other is not part]
        start, end = min(r.start_ns for r in others or [part]), max(r.end_ns() for r in others or [part])
        apart = max(part.start_ns - end, start - part.end_ns())
        if apart > max(end - start, NEAR_NS):
            what = f"{name} begins at {_date(part.start_ns)}, the other files at {_date(start)}"
            remedy = "give each column map the epoch of its times, or remove the file of another drive"
            raise DataError(f"files share no clock: {what}", file=folder, remedy=remedy)


def _date(t_ns: int) -> str:
    return str(np.datetime64(t_ns, "ns").astype("datetime64[ms]"))
