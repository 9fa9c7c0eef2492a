"""The container MCAP, with chunks or without, indexed or not.

Schemas, channels and chunks are parsed by the `mcap` library; message records, whose library reader takes
one at a time, are found by one walk over their lengths. An index is used to skip chunks, where there is one.
"""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from terrafusion.datasets.core import limits
from terrafusion.datasets.readers.ros.raw import (
    BagError,
    BagSource,
    Groups,
    MessageBatch,
    Places,
    decompress,
    grouped,
    normal_type,
    numbers_at,
)

MESSAGE = int(Opcode.MESSAGE)
RECORD_HEAD = 9
"""Kind and length, before a record's content."""
MESSAGE_HEAD = 31
"""Kind, length, channel, sequence number and two times, before a message's own bytes."""
MIN_CHANNEL_BYTES = 14
"""Of a schema or channel: its number, and the lengths of its parts."""
BLOCK_BYTES = 1 << 20
LANGUAGES = {"ros2msg": "msg", "ros2idl": "idl", "omgidl": "idl", "ros1msg": "msg"}
_head = struct.Struct("<BQ").unpack_from


class _ChunkPlace(NamedTuple):
    start: int
    size: int
    channels: set[int]
    """Those of the index records behind the chunk; empty without them."""


class McapFile:
    """An open MCAP file.

    Raises:
        BagError: the file is cut off, was not closed by its recorder, or breaks the format.
    """

    def __init__(self, path: Path) -> None:
        self._file, self._end = path.open("rb"), path.stat().st_size
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[_ChunkPlace] = []
        self._loose = np.zeros(0, dtype=np.int64)  # where the messages outside of chunks begin
        self._counts: dict[int, int] = {}
        try:
            self._walk()
            if not self._is_summed_up():
                self._count()
            self.sources = [self._source(number) for number in sorted(self._channels)]
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._file.close()

    def _is_summed_up(self) -> bool:
        """Whether the summary has the messages of every channel and, where it has one, its schema."""
        counted = bool(self._counts) and self._counts.keys() <= self._channels.keys()
        return counted and all(
            not channel.schema_id or channel.schema_id in self._schemas for channel in self._channels.values()
        )

    def _walk(self) -> None:
        """Go over all records of the file, without unpacking chunks."""
        if self._read(0, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise BagError("it does not begin as MCAP")
        kind, loose = 0, []
        for kind, start, size in self._records():
            if kind == MESSAGE:
                loose.append(start - RECORD_HEAD)
            elif kind == Opcode.CHUNK:
                self._chunks.append(_ChunkPlace(start, size, set()))
            elif kind == Opcode.MESSAGE_INDEX and self._chunks and size >= 6:
                number, length = struct.unpack("<HI", self._read(start, 6))
                if length:
                    self._chunks[-1].channels.add(number)
            elif kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
                self._learn(kind, self._read(start, size))
            elif kind == Opcode.FOOTER:
                break
        self._loose = np.array(loose, dtype=np.int64)
        if kind != Opcode.FOOTER or self._read(self._end - len(MCAP0_MAGIC), len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise BagError("the file breaks off: it has no footer")

    def _records(self) -> Iterator[tuple[int, int, int]]:
        """Kind, place and length of the content of each record of the file."""
        position, base, block = len(MCAP0_MAGIC), 0, b""
        while position < self._end:
            at = position - base
            if at + RECORD_HEAD > len(block):
                self._file.seek(position)
                base, at, block = position, 0, self._file.read(BLOCK_BYTES)
            if at + RECORD_HEAD > len(block):
                break
            kind, size = _head(block, at)
            position += RECORD_HEAD + size
            if position > self._end:
                raise BagError(f"the file ends at {self._end} of {position} bytes")
            yield kind, position - size, size

    def _read(self, position: int, size: int) -> bytes:
        if size > limits.CHUNK_BYTES:
            raise BagError(f"a record claims {size} bytes")
        self._file.seek(max(position, 0))
        return self._file.read(size)

    def _learn(self, kind: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        if kind == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif kind == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._channels[channel.id] = channel
        elif kind == Opcode.STATISTICS:
            self._counts = Statistics.read(stream).channel_message_counts

    def _count(self) -> None:
        """Learn channels and the numbers of their messages from the messages themselves."""
        for data in self._unpacked(()):
            self._messages(data, learn=True)
        channels = sorted(self._channels)
        self._counts = dict.fromkeys(channels, 0)
        for batch in self.batches([[number] for number in channels]):
            self._counts[channels[batch.group]] += len(batch.starts)

    def _source(self, number: int) -> BagSource:
        channel = self._channels[number]
        schema = self._schemas.get(channel.schema_id, Schema(0, b"", "", ""))
        definition, language = schema.data.decode(errors="replace"), LANGUAGES.get(schema.encoding, "msg")
        count, msgtype = self._counts.get(number, 0), normal_type(schema.name)
        return BagSource(
            number, channel.topic, msgtype, definition, language, channel.message_encoding, count
        )

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of channels, block by block."""
        for data in self._unpacked(wanted):
            yield from _split(data, np.array(self._messages(data), dtype=np.int64), wanted)
        first = 0
        while first < len(self._loose):
            begin = int(self._loose[first])
            last = max(int(np.searchsorted(self._loose, begin + BLOCK_BYTES)) - 1, first)
            _, size = _head(self._read(int(self._loose[last]), RECORD_HEAD), 0)
            end = int(self._loose[last]) + RECORD_HEAD + int(size)
            yield from _split(self._read(begin, end - begin), self._loose[first : last + 1] - begin, wanted)
            first = last + 1

    def _unpacked(self, wanted: Groups) -> Iterator[bytes]:
        """The chunks that may hold messages of these channels; all where none are named."""
        chunks = (
            self._unpack(chunk)
            for chunk in self._chunks
            if not (wanted and chunk.channels) or not all(chunk.channels.isdisjoint(ids) for ids in wanted)
        )
        return limits.within(chunks, self._end)

    def _unpack(self, place: _ChunkPlace) -> bytes:
        chunk = Chunk.read(ReadDataStream(BytesIO(self._read(place.start, place.size))))
        data = decompress(chunk.data, chunk.compression, chunk.uncompressed_size)
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise BagError("a chunk's checksum does not match")
        return data

    def _messages(self, chunk: bytes, *, learn: bool = False) -> list[int]:
        """Where the message records of a chunk begin."""
        position, end, starts = 0, len(chunk), []
        try:
            while position < end:
                kind, size = _head(chunk, position)
                if kind == MESSAGE:
                    if size < MESSAGE_HEAD - RECORD_HEAD:
                        raise BagError("a message record is broken")
                    starts.append(position)
                elif kind not in (Opcode.SCHEMA, Opcode.CHANNEL) or size < MIN_CHANNEL_BYTES:
                    raise BagError("a chunk holds what is neither message, channel nor schema")
                elif learn:
                    self._learn(kind, chunk[position + RECORD_HEAD :][:size])
                position += RECORD_HEAD + size
        except struct.error:
            position = -1
        if position != end:
            raise BagError("the records of a chunk do not fill it")
        return starts


def _split(block: bytes, places: Places, wanted: Groups) -> Iterator[MessageBatch]:
    """The messages of a block, whose records begin at `places`, by channel."""
    data = np.frombuffer(block, dtype=np.uint8)
    sizes = numbers_at(data, places + 1, "<u8").astype(np.int64) - (MESSAGE_HEAD - RECORD_HEAD)
    channels = numbers_at(data, places + 9, "<u2")
    receipt_ns = numbers_at(data, places + 15, "<u8").astype(np.int64)
    if (sizes < 0).any() or (receipt_ns < 0).any():
        raise BagError("a message record is broken")
    for group, rows in grouped(channels, wanted):
        yield MessageBatch(group, data, places[rows] + MESSAGE_HEAD, sizes[rows], receipt_ns[rows])
