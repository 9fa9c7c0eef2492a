"""The log folder: `meta.yaml` and one CSV a channel (the format is stated in docs/conventions.md).

An absent file is an absent channel, an empty cell a missing value. Anything
else that is not a number is an error: this reader never guesses.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.errors import DataError
from terrafusion.datasets.readers.channel_tables import ChannelReader
from terrafusion.datasets.readers.csv_table import Table, read_table
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.log_meta import Meta, read_meta
from terrafusion.datasets.recording import Recording
from terrafusion.datasets.trajectory import Trajectory

META = "meta.yaml"
CHANNELS = ("command", "wheels", "imu", "gnss", "motor", "terrain", "truth")


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is a log folder: any folder that is not a ROS 2 bag."""
    return path.is_dir() and ((path / META).is_file() or not (path / "metadata.yaml").is_file())


def read(request: Request) -> list[Recording]:
    """The one recording of a log folder."""
    return [read_log_folder(request.path)]


def read_log_folder(folder: Path) -> Recording:
    """Read a log folder.

    Returns:
        Recording named after the folder, times in ns from `start_ns`; its notes tell what was
        left out or assumed.

    Raises:
        ConfigError: meta.yaml is wrong. DataError: meta.yaml is missing or a CSV is wrong; the
            message names file, column, line or time, and the remedy.
    """
    meta_path = folder / META
    if not meta_path.is_file():
        bags = sorted(p.name for p in folder.iterdir() if p.suffix in (".bag", ".mcap", ".db3"))
        remedy = "give a log folder, a ROS bag, or write meta.yaml with start_ns and vehicle"
        if bags:
            remedy = f"give the bag itself: {', '.join(bags[:5])}{' ...' if len(bags) > 5 else ''}"
        raise DataError("no meta.yaml in this folder", file=folder, remedy=remedy)
    meta = read_meta(meta_path)
    source = _Folder(folder)
    reader = ChannelReader(source, meta)
    channels = {name: getattr(reader, name)() for name in CHANNELS}
    if not any(channel is not None and len(channel) for channel in channels.values()):
        names = ", ".join(f"{name}.csv" for name in CHANNELS)
        raise DataError("no channel holds a sample", file=folder, remedy=f"add at least one of {names}")
    return recording_of(channels, meta, folder.resolve().name, [*reader.notes, *source.strangers()])


def recording_of(channels: Mapping[str, Any], meta: Meta, name: str, notes: Sequence[str]) -> Recording:
    """The recording of its channels and `meta`.

    Args:
        channels: by field of `Recording`, the truth among them.
        name: of the recording where `meta` gives none.
        notes: of the reader; those that the log already has are not repeated.
    """
    return Recording(
        name=meta.texts.get("name", name),
        start_ns=meta.start_ns,
        vehicle=meta.texts.get("vehicle"),
        **channels,
        datum=meta.datum,
        truth_channels=_truth_channels(meta, channels["truth"]),
        truth_frame=meta.truth_frame,
        overrides=meta.overrides,
        description=meta.texts.get("description", ""),
        terrain_name=meta.texts.get("terrain", ""),
        licence=meta.texts.get("licence", ""),
        source=meta.texts.get("source", ""),
        notes=(*meta.notes, *(note for note in notes if note not in meta.notes)),
        clock_jumps=meta.clock_jumps,
        imu_frame_id=meta.texts.get("imu_frame_id", ""),
    )


class _Folder:
    """The tables of one folder, each read from its CSV."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def table(
        self, channel: str, known: Sequence[str], texts: Sequence[str], prefixes: Sequence[str]
    ) -> Table | None:
        path = self._path(channel)
        return None if path is None else read_table(path, known, texts=texts, prefixes=prefixes)

    def place(self, channel: str) -> Path:
        return self._path(channel) or self.folder

    def _path(self, channel: str) -> Path | None:
        plain, packed = self.folder / f"{channel}.csv", self.folder / f"{channel}.csv.gz"
        if plain.exists() and packed.exists():
            raise DataError(
                f"both {plain.name} and {packed.name} exist", file=self.folder, remedy="keep one of them"
            )
        return plain if plain.exists() else packed if packed.exists() else None

    def strangers(self) -> Iterator[str]:
        """A note for each CSV that is no channel: a misspelt name would otherwise go unseen."""
        for path in sorted(self.folder.iterdir()):
            stem = path.name.removesuffix(".gz").removesuffix(".csv")
            if stem == path.name or not path.name.endswith((".csv", ".csv.gz")) or stem in CHANNELS:
                continue
            close = difflib.get_close_matches(stem, CHANNELS, n=1)
            meant = f" (did you mean {close[0]}.csv?)" if close else ""
            yield f"{path.name} is not a channel of the format and was not read{meant}"


def _truth_channels(meta: Meta, truth: Trajectory | None) -> tuple[str, ...]:
    """What meta.yaml says the truth holds, else what its columns hold."""
    if meta.truth_channels is not None:
        return meta.truth_channels
    return () if truth is None else truth_contents(truth)


def truth_contents(truth: Trajectory) -> tuple[str, ...]:
    """Names of what a trajectory holds: position, yaw, orientation (more than yaw), velocity."""
    found = ["position"]
    if truth.quaternion is not None:
        found.append("yaw")
        if np.nanmax(np.abs(truth.quaternion[:, :2]), initial=0.0) > 0.0:
            found.append("orientation")
    if truth.twist_body is not None and not np.isnan(truth.twist_body[:, :2]).all():
        found.append("velocity")
    return tuple(found)
