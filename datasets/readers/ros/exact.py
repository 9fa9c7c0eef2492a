"""What a bag written by this library carries beside its standard messages, and how it is read back.

`/terrafusion/meta` (std_msgs/String, once) holds the keys of `meta.yaml` as JSON, the columns of the
`tables` below and the `words` that some of their numbers stand for. `/terrafusion/<channel>`
(std_msgs/Float64MultiArray) holds the rows of that channel's table where the standard messages
cannot hold it to the bit: its stamp (seconds, nanoseconds), then the columns of the log folder.
"""

import dataclasses
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.channels import Wheels
from terrafusion.datasets.core.conventions import Conventions
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.channel_tables import COLUMNS, ChannelReader, Layouts, wheel_columns
from terrafusion.datasets.readers.log_folder import CHANNELS, recording_of
from terrafusion.datasets.readers.log_meta import Meta, parse_meta
from terrafusion.datasets.readers.ros import topics
from terrafusion.datasets.readers.ros.channels import ChannelBuilder
from terrafusion.datasets.readers.ros.streams import Key, Stream, wanted_fields
from terrafusion.datasets.readers.timed_tables import TimedTable

PREFIX = "/terrafusion/"
META: Key = (f"{PREFIX}meta", topics.STRING)
ROW = "std_msgs/msg/Float64MultiArray"
STAMP = ("sec", "nanosec")
"""What stands before the columns in a row."""

STANDARD: dict[str, Key] = {
    "command": ("/cmd_vel", topics.TWIST_STAMPED),
    "wheels": ("/joint_states", topics.JOINTS),
    "imu": ("/imu/data", topics.IMU),
    "barometer": ("/pressure", topics.PRESSURE),
    "magnetometer": ("/imu/mag", topics.FIELD),
    "steering": ("/steering/joint_states", topics.JOINTS),
    "truth": ("/ground_truth/odom", topics.ODOMETRY),
}
"""Topics whose standard messages hold a channel to the bit, unless it has a table."""

LAYOUTS: Layouts = tuple((names, unit) for names in Wheels.LAYOUTS for unit in ("radps", "mps"))
"""A bag holds wheels of any layout, also those that the log folder has no columns for."""

REMEDY = "write the bag again, or choose its topics with --topic"


@dataclass(frozen=True)
class SavedChannels:
    """The content of `/terrafusion/meta`: the columns of each table, texts by column, lateness of stamps."""

    meta: Meta
    tables: dict[str, list[str]]
    words: dict[str, list[str]]
    shift_ns: int


def restore(
    read: Callable[[Mapping[Key, tuple[str, ...]]], Mapping[Key, Stream]], there: Collection[Key], file: Path
) -> Recording:
    """The recording that was written into a bag with the topics `there`; `read` gives streams of fields.

    Raises:
        DataError, ConfigError: the bag is not as this library writes it.
    """
    saved = _parse(read({META: ("data",)})[META], file)
    keys = STANDARD | {name: (f"{PREFIX}{name}", ROW) for name in saved.tables}
    asked = {
        key: ("data",) if key[1] == ROW else wanted_fields(name, key[1])
        for name, key in keys.items()
        if key in there
    }
    found = read(asked)
    streams = {name: found[key] for name, key in keys.items() if key in there}
    names = [name for name in CHANNELS if name in saved.tables]
    tables = {name: _table(saved, name, streams.get(name), file) for name in names}
    reader = ChannelReader(tables, saved.meta, LAYOUTS)
    builder = ChannelBuilder(file, None, Conventions(), saved.meta.start_ns, {}, as_written=True)
    channels = {
        name: reader.channel(name)
        if name in tables
        else _standard(builder, name, streams.get(name), saved.shift_ns)
        for name in CHANNELS
    }
    return recording_of(channels, saved.meta, file.stem, reader.notes)


def _parse(stream: Stream, file: Path) -> SavedChannels:
    try:
        content = json.loads(stream.column("data")[0])
        tables, words, shift_ns = (content.pop(key) for key in ("tables", "words", "shift_ns"))
        metadata = dict(content.pop("metadata", {}))
        for lists in (tables, words):
            if not all(isinstance(text, str) for key, texts in lists.items() for text in [key, *texts]):
                raise TypeError("tables and words are lists of texts")
        if not 0 <= int(shift_ns) < 2**62:
            raise ValueError("not a time")
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError):
        raise DataError("is not what this library writes", channel=META[0], remedy=REMEDY) from None
    meta = parse_meta(content, file)
    if meta.metadata:
        raise DataError(f"unknown keys {', '.join(meta.metadata)}", channel=META[0], remedy=REMEDY)
    meta = dataclasses.replace(meta, keep_empty=True, metadata=metadata)
    return SavedChannels(meta, tables, words, int(shift_ns))


def _standard(builder: ChannelBuilder, name: str, stream: Stream | None, shift_ns: int) -> Any:
    """A channel from its standard messages, whose stamps are its times."""
    if stream is None or not len(stream) or stream.header_ns is None:
        return None
    t_ns = stream.header_ns - shift_ns
    if name == "wheels":
        return builder.wheels(stream, t_ns, None)[0]
    if name == "truth":
        return builder.truth(stream, t_ns)[0]
    return getattr(builder, name)(stream, t_ns)


def _table(saved: SavedChannels, channel: str, stream: Stream | None, file: Path) -> TimedTable:
    columns, known = saved.tables[channel], COLUMNS[channel]
    names = {*known.numbers, *known.texts} | ({*wheel_columns(LAYOUTS)} if channel == "wheels" else set())
    strange = [c for c in columns if c not in names and not c.startswith(known.prefixes)]
    if strange or len(set(columns)) != len(columns):
        raise _error(channel, f"the columns {', '.join(columns)}")
    shape = (len(stream) if stream is not None else 0, len(STAMP) + len(columns))
    rows = stream.column("data") if stream is not None and len(stream) else np.zeros(shape)
    if rows.shape != shape:
        raise _error(channel, f"{rows.shape[1:]} numbers a row for {shape[1:]}")
    stamps = rows[:, : len(STAMP)]
    if not ((np.abs(stamps) < 2**32) & (stamps == np.rint(stamps))).all():
        raise _error(channel, "stamps that are no times")
    seconds, nanoseconds = stamps.astype(np.int64).T
    t_ns = seconds * 10**9 + nanoseconds - saved.shift_ns - saved.meta.start_ns
    if (np.diff(t_ns) < 0).any():
        raise _error(channel, "stamps that run backwards")
    numbers = {name: rows[:, len(STAMP) + k].astype(float) for k, name in enumerate(columns)}
    texts = {}
    for name in (name for name in known.texts if name in numbers):
        codes, words = numbers.pop(name), saved.words.get(name, [])
        if not ((codes >= 0) & (codes < len(words)) & (codes == np.rint(codes))).all():
            raise _error(channel, f"a {name} that stands for no word")
        texts[name] = np.array([*words, None], dtype=object)[codes.astype(np.int64)]
    return TimedTable(t_ns=t_ns, path=file, numbers=numbers, texts=texts)


def _error(channel: str, what: str) -> DataError:
    return DataError(f"the table has {what}", channel=f"{PREFIX}{channel}", remedy=REMEDY)
