"""The log folder: `meta.yaml` and one CSV a channel (the format is stated in docs/reference/conventions.md).

An absent file is an absent channel, an empty cell a missing value. Anything
else that is not a number is an error: this reader never guesses.
"""

import dataclasses
import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.files import expanded
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.datasets.readers.channel_tables import COLUMNS, ChannelReader, read_table
from terrafusion.datasets.readers.formats import HEAD_BYTES, Request, append_parts, logs_in
from terrafusion.datasets.readers.log_meta import Meta, parse_meta
from terrafusion.datasets.readers.timed_tables import in_time

META = "meta.yaml"
CHANNELS = (*Recording.CHANNELS, "truth")


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is a log folder: any folder, once those of other formats are claimed."""
    return path.is_dir()


def read(request: Request) -> list[Recording]:
    """The one recording of a log folder: named after it, times in ns from `start_ns`.

    Raises:
        ConfigError: meta.yaml is wrong. DataError: meta.yaml is missing or a CSV is wrong; the
            message names file, column, line or time, and the remedy.
    """
    folder = request.path
    meta = _meta(folder)
    paths = {name: path for name in CHANNELS if (path := _csv_of(folder, name)) is not None}
    tables = {name: read_table(path, COLUMNS[name]) for name, path in paths.items()}
    tables, jumps, clock = in_time(tables, repair_clock=request.repair_clock)
    reader, channels = ChannelReader(tables, meta, rig=request.rig), {}
    for name in CHANNELS:
        with errors_of(paths.get(name, folder)):
            channels[name] = reader.channel(name)
    if not any(channel is not None and len(channel) for channel in channels.values()):
        names = ", ".join(f"{name}.csv" for name in CHANNELS)
        raise DataError("no channel holds a sample", file=folder, remedy=f"add at least one of {names}")
    notes = [*reader.notes, *clock, *_unknown_files(folder)]
    recording = recording_of(channels, meta, folder.resolve().name, notes)
    moved = (dataclasses.replace(jump, t_ns=jump.t_ns + meta.start_ns) for jump in jumps)
    return [dataclasses.replace(recording, clock_jumps=(*recording.clock_jumps, *moved))]


def _as_one(logs: Sequence[str]) -> str:
    """How the logs of a folder become one."""
    if len(logs) < 2:
        return ""
    if all(name.endswith((".mcap", ".db3")) for name in logs):
        return "; if they are one bag, `ros2 bag reindex` writes its metadata.yaml"
    if all(name.endswith(".bag") for name in logs):
        return "; parts of one drive have names that end in _0.bag, _1.bag, ..."
    if advice := append_parts(logs):
        return f"; if they are parts of one drive, {advice}"
    return "; for one drive, write a column map beside each table: `terrafusion inspect TABLE` proposes it"


def _is_channel(path: Path) -> bool:
    """Whether a file has the time column of a log folder's tables."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    return path.suffix == ".gz" or b"t_s" in head.split(b"\n", 1)[0]


def _meta(folder: Path) -> Meta:
    """`meta.yaml`, with the path of a vehicle file that lies in the folder."""
    if not (folder / META).is_file():
        is_log = any(_is_channel(folder / f"{name}.csv{gz}") for name in CHANNELS for gz in ("", ".gz"))
        logs = [] if is_log else logs_in(folder)
        remedy = "give a log folder, a ROS bag, or write meta.yaml with start_ns and vehicle"
        if logs:
            remedy = f"give one of its logs itself: {', '.join(logs[:5])}{' ...' if len(logs) > 5 else ''}"
            remedy += _as_one(logs)
        raise DataError("no meta.yaml in this folder", file=folder, remedy=remedy)
    meta = parse_meta(read_yaml(folder / META), folder / META)
    vehicle = folder / expanded(meta.vehicle or "")
    if vehicle.suffix in (".yaml", ".yml") and vehicle.is_file():
        return dataclasses.replace(meta, vehicle=str(vehicle.resolve()))
    return meta


def recording_of(channels: Mapping[str, Any], meta: Meta, name: str, notes: Sequence[str]) -> Recording:
    """The recording of its channels and `meta`.

    Args:
        channels: by field of `Recording`, the truth among them.
        name: of the recording where `meta` gives none.
        notes: of the reader; those that the log already has are not repeated.
    """
    contents = meta.truth_channels
    if contents is None:
        contents = truth_contents(channels["truth"])
    same = ("start_ns", "vehicle", "datum", "truth_frame", "metadata")
    stated: dict[str, Any] = {key: getattr(meta, key) for key in same}
    stated |= {key: getattr(meta, key) or "" for key in ("description", "licence", "source", "imu_frame_id")}
    return Recording(
        name=name if meta.name is None else meta.name,
        **channels,
        **stated,
        terrain_name=meta.terrain or "",
        truth_channels=contents,
        unturned=tuple(n for n in meta.unturned if channels[n] is not None),
        overrides=meta.overrides(),
        notes=(*meta.notes, *(note for note in notes if note not in meta.notes)),
        clock_jumps=meta.clock_jumps,
    )


def _csv_of(folder: Path, channel: str) -> Path | None:
    """The file of a channel, None where there is none."""
    plain, packed = folder / f"{channel}.csv", folder / f"{channel}.csv.gz"
    if plain.exists() and packed.exists():
        raise DataError(f"both {plain.name} and {packed.name} exist", file=folder, remedy="keep one of them")
    for path in (plain, packed):
        if path.is_symlink() and not path.exists():
            raise DataError("is a link to nothing", file=path, remedy="mend the link, or remove it")
        if path.exists() and not path.is_file():
            raise DataError("is no file", file=path, remedy="give a CSV file, or remove it")
    return plain if plain.exists() else packed if packed.exists() else None


def _unknown_files(folder: Path) -> Iterator[str]:
    """A note for each CSV that is no channel, and each channel that is no CSV: they are not read."""
    for path in sorted(folder.iterdir()):
        stem = path.name.removesuffix(".gz").removesuffix(".csv")
        if stem == path.name or not path.name.endswith((".csv", ".csv.gz")):
            if path.stem in CHANNELS and path.is_file():
                yield f"{path.name} was not read: a log folder has {path.stem}.csv or {path.stem}.csv.gz"
            continue
        if stem in CHANNELS:
            continue
        close = difflib.get_close_matches(stem, CHANNELS, n=1)
        meant = f" (did you mean {close[0]}.csv?)" if close else ""
        yield f"{path.name} is not a channel of the format and was not read{meant}"


def truth_contents(truth: Trajectory | None) -> tuple[str, ...]:
    """Names of what a trajectory holds: position, yaw, orientation (more than yaw), velocity."""
    if truth is None:
        return ()
    found = ["position"]
    if truth.quaternion is not None:
        tilted = np.nanmax(np.abs(truth.quaternion[:, :2]), initial=0.0) > 0.0
        found += ["yaw", "orientation"] if tilted else ["yaw"]
    if truth.twist_body is not None and not np.isnan(truth.twist_body[:, :2]).all():
        found.append("velocity")
    return tuple(found)
