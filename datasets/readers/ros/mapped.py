"""Channels made of messages of any type, by a column map: a column is a topic, a point and a field.

channels: {wheels: {left_rad: {column: /left_ticks.data, unit: rev, scale: 1/1024}, ...}}
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.conventions import apply
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros.layout import MessageBlock
from terrafusion.datasets.readers.ros.raw import BagContainer, BagError
from terrafusion.datasets.readers.ros.streams import Key, Stream, read_streams
from terrafusion.datasets.readers.ros.topics import BagTopic
from terrafusion.datasets.readers.text.column_map import ColumnMap, MappedColumn, read_column_map
from terrafusion.datasets.readers.text.table import TableReader, increments_note, odometry_track, table_of

MOST_SHOWN = 40
_STAMP = "header.stamp"
_ELEMENT = re.compile(r"\[(\d+)\]")


class MappedChannels:
    """The channels that the column map of a request describes; `notes` collects what was assumed.

    Raises:
        ConfigError: the map.
    """

    def __init__(self, request: Request) -> None:
        given = request.columns
        self._request = request
        self._map: ColumnMap | None = read_column_map(given, of_bag=True) if given is not None else None
        self.notes: list[str] = []
        self.kinds: tuple[str, ...] = ()
        if given is not None and self._map is not None:
            self.kinds = tuple(kind for kind, of in self._map.channels.items() if of)
            self.notes.append(f"{', '.join(self.kinds)}: fields as {given.name} says")

    def streams(self, container: BagContainer, there: Sequence[BagTopic]) -> dict[str, Stream]:
        """By channel its columns, a row for each message of the topic of the first one.

        Raises:
            DataError: a topic or a field that is not there.
        """
        if self._map is None:
            return {}
        columns = {kind: _columns(self._map.channels[kind]) for kind in self.kinds}
        places = {name: _place(name, there) for names in columns.values() for name in names}
        asked: dict[Key, tuple[str, ...]] = {}
        for key, path in places.values():
            asked[key] = (*asked.get(key, (_STAMP,)), path)
        streams = read_streams(container, asked)
        for name, (key, path) in places.items():
            if not streams[key].has(path):
                raise _no_field(container, key, name)
        return {
            kind: self._joined(kind, {name: (streams[places[name][0]], places[name][1]) for name in names})
            for kind, names in columns.items()
        }

    def _joined(self, kind: str, columns: dict[str, tuple[Stream, str]]) -> Stream:
        first = next(iter(columns.values()))[0]
        streams = {stream.topic: stream for stream, _ in columns.values()}
        kept, rows = np.ones(len(first), dtype=bool), {first.topic: np.arange(len(first))}
        for topic, stream in streams.items():
            if stream is not first:
                rows[topic], apart_ns = _nearest(first, stream)
                period_ns = float(np.median(np.diff(first.receipt_ns))) if len(first) > 1 else 0.0
                kept &= apart_ns <= 0.5 * period_ns
                far = f"{np.median(apart_ns) * 1e-6:.3g} ms apart (median)"
                lost = f", {int((~kept).sum())} without one left out" if not kept.all() else ""
                self.notes.append(f"{kind}: messages of {topic} beside those of {first.topic}, {far}{lost}")
        found = {name: stream.column(path)[rows[stream.topic]] for name, (stream, path) in columns.items()}
        stamp = (f"{_STAMP}.sec", f"{_STAMP}.nanosec")
        found |= {path: first.column(path) for path in stamp if first.has(path)}
        block = MessageBlock(np.arange(len(first)), found)
        return Stream(" + ".join(streams), first.msgtype, first.receipt_ns, (block,)).select(kept)

    def channel(self, kind: str, stream: Stream, t_ns: TimesNs, start_ns: int) -> Any:
        """A channel as `ChannelBuilder` makes it: wheels with a track, fixes a datum, truth a frame."""
        assert self._map is not None, "there are streams of it"
        fields, held = self._map.channels[kind], self._map.held.get(kind)
        track_m, notes = odometry_track(self._request, self._map)
        table = table_of(
            _BagColumns(stream), fields, slice(None), t_ns - start_ns, self._request.path, track_m, held
        )
        meta = dataclasses.replace(self._map.meta, start_ns=start_ns)
        reader = TableReader({kind: table}, meta, rig=self._request.rig)
        channel = reader.channel(kind)
        self.notes += reader.notes
        if kind == "wheels":
            self.notes += [*notes, *increments_note(channel, fields, held is not None)]
        beside = {"wheels": None, "gnss": reader.datum, "truth": "base"}
        return (channel, beside[kind]) if kind in beside else channel

    def applied(self, recording: Recording) -> Recording:
        """The recording with the geometry and the conventions of the map, and its notes."""
        if self._map is None:
            return recording
        known = {key: value for key, value in vars(self._map.meta.overrides()).items() if value is not None}
        overrides: Overrides = dataclasses.replace(recording.overrides, **known)
        whole = dataclasses.replace(recording, overrides=overrides).with_notes(*self.notes)
        return apply(whole, self._map.conventions())


@dataclasses.dataclass(frozen=True)
class _BagColumns:
    """Columns of a stream, as those of a table."""

    stream: Stream

    def numbers(self, name: str) -> Array:
        """A field of numbers (N,)."""
        values = self.stream.column(name)
        if values.dtype == object or values.ndim != 1:
            what = "texts" if values.dtype == object else f"{values.shape[1]} numbers a message"
            raise DataError(f"{name} holds {what}", remedy=f"give one number, such as {name}[0]")
        return values.astype(float)

    def texts(self, name: str) -> NDArray[Any]:
        """A field as texts (N,)."""
        return self.stream.column(name).astype(str).astype(object)


def _columns(fields: Mapping[str, MappedColumn]) -> list[str]:
    """The columns that a channel is made of, each once."""
    return list(dict.fromkeys(name for of in fields.values() for name in of.columns()))


def _place(column: str, there: Sequence[BagTopic]) -> tuple[Key, str]:
    """Topic and path of a column such as /wheels.speed[0]."""
    named = [topic for topic in there if column.startswith(f"{topic.name}.")]
    if not named:
        listed = ", ".join(f"{topic.name} ({topic.msgtype})" for topic in there[:MOST_SHOWN])
        remedy = f"give a topic, a point and a field, such as /left_ticks.data; topics here: {listed}"
        raise DataError(f"column '{column}' names no topic with messages", remedy=remedy)
    topic = max(named, key=lambda topic: len(topic.name))
    return (topic.name, topic.msgtype), _ELEMENT.sub(r".\1", column.removeprefix(f"{topic.name}."))


def numbers_in(container: BagContainer, topic: BagTopic) -> list[str]:
    """Columns for the numbers in the first message of a topic, but for its header; [] where it is broken."""
    key = topic.name, topic.msgtype
    try:
        blocks = read_streams(container, {key: ()}, 1)[key].blocks
    except BagError:
        return []
    found = []
    for path, values in blocks[0].columns.items() if blocks else ():
        if values.dtype != object and not path.startswith("header."):
            ends = [""] if values.ndim == 1 else [f"[{k}]" for k in range(values.shape[1])]
            found += [f"{topic.name}.{path}{end}" for end in ends]
    return found


def _no_field(container: BagContainer, key: Key, column: str) -> DataError:
    fields = ", ".join(numbers_in(container, BagTopic(*key, 1))[:MOST_SHOWN])
    return DataError(f"messages of {key[0]} have no '{column}'", remedy=f"they have {fields or 'no numbers'}")


def _nearest(first: Stream, other: Stream) -> tuple[NDArray[np.int64], TimesNs]:
    """For each message of a stream (N,) which one of another was received nearest to it, and how far (ns)."""
    order = np.argsort(other.receipt_ns, kind="stable")
    times = other.receipt_ns[order]
    after = np.searchsorted(times, first.receipt_ns).clip(1, max(len(times) - 1, 1))
    pair = np.stack([after - 1, after.clip(max=len(times) - 1)])
    apart = np.abs(times[pair] - first.receipt_ns)
    best = apart.argmin(axis=0)
    every = np.arange(len(first))
    return order[pair[best, every]], apart[best, every]
