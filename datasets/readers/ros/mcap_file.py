"""The container MCAP, with chunks or without, indexed or not.

The `mcap` library reads the summary, and goes over the records of a file without an index of chunks, also of
one that is cut off, up to its last complete record. Message records in a chunk, whose library reader takes
one at a time, are found by one walk over their lengths.
"""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from terrafusion.datasets.core import limits
from terrafusion.datasets.readers.ros import raw
from terrafusion.datasets.readers.ros.raw import BagError, BagSource, Groups, MessageBatch, decompress

MESSAGE = int(Opcode.MESSAGE)
RECORD_HEAD = 9
"""Kind and length, before a record's content."""
MESSAGE_HEAD = 31
"""Kind, length, channel, sequence number and two times, before a message's own bytes."""
MIN_CHANNEL_BYTES = 14
"""Of a schema or channel: its number, and the lengths of its parts."""
LOOSE_AT_ONCE = 2048
"""Messages outside of chunks that make a batch."""
LANGUAGES = {"ros2msg": "msg", "ros2idl": "idl", "omgidl": "idl", "ros1msg": "msg"}
_head = struct.Struct("<BQ").unpack_from


class McapFile:
    """An open MCAP file; a BagError where it breaks the format."""

    def __init__(self, path: Path) -> None:
        self._file, self._end = path.open("rb"), path.stat().st_size
        self._complete: int | None = None  # records that can be read, of a file that is cut off
        try:
            self.cut = "" if self._has_footer() else "it has no footer"
            reader = SeekingReader(self._file, record_size_limit=limits.CHUNK_BYTES)
            summary = (None if self.cut else reader.get_summary()) or Summary()
            self._schemas, self._channels = summary.schemas, summary.channels
            self._chunks = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
            counts = summary.statistics.channel_message_counts if summary.statistics is not None else {}
            self._counts = counts if self._is_known(counts) else self._counted()
            self.sources = [self._source(number) for number in sorted(self._channels)]
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._file.close()

    def _has_footer(self) -> bool:
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise BagError("it does not begin as MCAP")
        self._file.seek(max(self._end - len(MCAP0_MAGIC), len(MCAP0_MAGIC)))
        footer = self._file.read()
        self._file.seek(0)
        return footer == MCAP0_MAGIC

    def _is_known(self, counts: dict[int, int]) -> bool:
        """Whether the summary has the channels of these messages and, where they have one, their schemas."""
        schemas = {channel.schema_id for channel in self._channels.values()} - {0}
        return bool(counts) and counts.keys() <= self._channels.keys() and schemas <= self._schemas.keys()

    def _counted(self) -> dict[int, int]:
        """Learn channels and the numbers of their messages from the records themselves."""
        self._chunks = []
        complete = 0
        try:
            for record in self._records():
                for inner in _inside(record) if isinstance(record, Chunk) else (record,):
                    if isinstance(inner, Schema):
                        self._schemas[inner.id] = inner
                    elif isinstance(inner, Channel):
                        self._channels[inner.id] = inner
                complete += 1
        except Exception:  # the library has many for a record that breaks off
            if not self.cut:
                raise
            self._complete = complete
        channels = sorted(self._channels)
        counts = dict.fromkeys(channels, 0)
        for batch in self.batches([[number] for number in channels]):
            counts[channels[batch.group]] += len(batch.starts)
        return counts

    def _source(self, number: int) -> BagSource:
        channel = self._channels[number]
        schema = self._schemas.get(channel.schema_id, Schema(0, b"", "", ""))
        definition, language = schema.data.decode(errors="replace"), LANGUAGES.get(schema.encoding, "msg")
        count, msgtype = self._counts.get(number, 0), raw.normal_type(schema.name)
        return BagSource(
            number, channel.topic, msgtype, definition, language, channel.message_encoding, count
        )

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of channels, block by block."""
        unpacked, loose = 0, []
        for record in self._indexed(wanted) if self._chunks else self._records():
            if isinstance(record, Chunk):
                data = _unpacked(record)
                unpacked += len(data)
                limits.check_expansion(unpacked, self._end)
                yield from _split(data, wanted)
            elif isinstance(record, Message):
                loose.append((record.channel_id, record.log_time, record.data))
                if len(loose) == LOOSE_AT_ONCE:
                    yield from raw.batches_of(loose, wanted)
                    loose = []
        if loose:
            yield from raw.batches_of(loose, wanted)

    def _records(self) -> Iterator[McapRecord]:
        """All records of the file that can be read, chunks as they are."""
        self._file.seek(0)
        reader = StreamReader(self._file, emit_chunks=True, record_size_limit=limits.CHUNK_BYTES)
        return islice(reader.records, self._complete)

    def _indexed(self, wanted: Groups) -> Iterator[Chunk]:
        """The chunks that may hold messages of these channels."""
        for index in self._chunks:
            known = index.message_index_offsets.keys()
            if not known or not all(known.isdisjoint(ids) for ids in wanted):
                yield self._chunk(index)

    def _chunk(self, index: ChunkIndex) -> Chunk:
        if index.chunk_length > limits.CHUNK_BYTES:
            raise BagError(f"a chunk claims {index.chunk_length} bytes")
        self._file.seek(index.chunk_start_offset)
        record = self._file.read(index.chunk_length)
        if len(record) < RECORD_HEAD or record[0] != Opcode.CHUNK:
            raise BagError("the index of chunks points to none")
        return Chunk.read(ReadDataStream(BytesIO(record[RECORD_HEAD:])))


def _unpacked(chunk: Chunk) -> bytes:
    data = decompress(chunk.data, chunk.compression, chunk.uncompressed_size)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise BagError("a chunk's checksum does not match")
    return data


def _inside(chunk: Chunk) -> Iterator[McapRecord]:
    """Schemas and channels that a chunk holds."""
    data = _unpacked(chunk)
    for kind, start in _walk(data):
        if kind != MESSAGE:
            stream = ReadDataStream(BytesIO(data[start + RECORD_HEAD :]))
            yield Schema.read(stream) if kind == Opcode.SCHEMA else Channel.read(stream)


def _walk(chunk: bytes) -> Iterator[tuple[int, int]]:
    """Kind and beginning of the records of a chunk."""
    position, end = 0, len(chunk)
    try:
        while position < end:
            kind, size = _head(chunk, position)
            if kind == MESSAGE:
                if size < MESSAGE_HEAD - RECORD_HEAD:
                    raise BagError("a message record is broken")
            elif kind not in (Opcode.SCHEMA, Opcode.CHANNEL) or size < MIN_CHANNEL_BYTES:
                raise BagError("a chunk holds what is neither message, channel nor schema")
            yield kind, position
            position += RECORD_HEAD + size
    except struct.error:
        position = -1
    if position != end:
        raise BagError("the records of a chunk do not fill it")


def _split(chunk: bytes, wanted: Groups) -> Iterator[MessageBatch]:
    """The messages of a chunk by channel."""
    data = np.frombuffer(chunk, dtype=np.uint8)
    places = np.array([start for kind, start in _walk(chunk) if kind == MESSAGE], dtype=np.int64)
    sizes = raw.numbers_at(data, places + 1, "<u8").astype(np.int64) - (MESSAGE_HEAD - RECORD_HEAD)
    channels = raw.numbers_at(data, places + 9, "<u2")
    receipt_ns = raw.numbers_at(data, places + 15, "<u8").astype(np.int64)
    if (sizes < 0).any() or (receipt_ns < 0).any():
        raise BagError("a message record is broken")
    for group, rows in raw.grouped(channels, wanted):
        yield MessageBatch(group, data, places[rows] + MESSAGE_HEAD, sizes[rows], receipt_ns[rows])
