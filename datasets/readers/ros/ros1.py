"""ROS 1 bags (`.bag`), version 2.0 (wiki.ros.org/Bags/Format/2.0).

A bag is a sequence of records: length, header of `name=value` fields, length, data. Messages are in chunks,
themselves sequences of records, which are found by one walk over their lengths: rosbags makes an object of
every message, which takes 7 times as long.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros.bag import opened_bag, recording_of
from terrafusion.datasets.readers.ros.raw import (
    BagError,
    BagSource,
    Bytes,
    Groups,
    MessageBatch,
    Places,
    decompress,
    grouped,
    normal_type,
    numbers_at,
    rows_at,
)

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
MIN_HEADER_BYTES, MAX_HEADER_BYTES = 25, 1 << 20
"""Of a record: the fields op and conn, and one more."""
MAX_CONNECTIONS, MAX_HEADER_LAYOUTS = 1 << 16, 100
_length = struct.Struct("<I").unpack_from


REMEDY = "copy it again, or mend it with `rosbag reindex`"


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is named like a ROS 1 bag, or begins as one."""
    return path.is_file() and (path.suffix == ".bag" or head.startswith(b"#ROSBAG V2.0"))


def read(request: Request) -> list[Recording]:
    """The one recording of a ROS 1 bag."""
    with opened_bag(request.path, Ros1File, REMEDY) as container:
        return [recording_of(container, request)]


class _Chunk(NamedTuple):
    start: int
    size: int
    compression: str
    unpacked: int
    counts: dict[int, int]
    """Messages by connection, of the index records behind the chunk."""


class Ros1File:
    """An open ROS 1 bag.

    Raises:
        BagError: the file is cut off, was not closed by its recorder, or breaks the format.
    """

    def __init__(self, path: Path) -> None:
        self._file, self._end = path.open("rb"), path.stat().st_size
        self._chunks: list[_Chunk] = []
        self._connections: dict[int, tuple[dict[str, bytes], dict[str, bytes]]] = {}
        try:
            self._walk()
            self.sources = [self._source(number) for number in sorted(self._connections)]
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._file.close()

    def _walk(self) -> None:
        """Go over all records of the file, without reading the chunks."""
        if self._file.read(len(MAGIC)) != MAGIC:
            raise BagError("it does not begin as a ROS 1 bag, version 2.0")
        position, promised = len(MAGIC), None
        while position < self._end:
            fields, start, size = self._record(position)
            kind = _number(fields, "op")
            if position == len(MAGIC):
                promised = self._promised(kind, fields)
            elif kind == CHUNK:
                compression = fields.get("compression", b"").decode()
                self._chunks.append(_Chunk(start, size, compression, _number(fields, "size"), {}))
            elif kind == INDEX and self._chunks:
                counts = self._chunks[-1].counts
                number = _number(fields, "conn")
                counts[number] = counts.get(number, 0) + _number(fields, "count")
            elif kind == CONNECTION:
                self._connections[_number(fields, "conn")] = fields, _fields(self._read(start, size))
            position = start + size
        if promised is None or (len(self._connections), len(self._chunks)) != promised:
            whole = f" of {promised[1]}" if promised else ""
            raise BagError(f"the bag ends after {len(self._chunks)}{whole} chunks")

    def _promised(self, kind: int, fields: dict[str, bytes]) -> tuple[int, int]:
        """Numbers of connections and chunks, by the bag's header."""
        if kind != BAG:
            raise BagError("the first record is not the bag's header")
        if fields.get("encryptor"):
            raise BagError("the bag is encrypted")
        if not _number(fields, "index_pos"):
            raise BagError("the bag has no index: its recorder did not close it")
        return _number(fields, "conn_count"), _number(fields, "chunk_count")

    def _record(self, position: int) -> tuple[dict[str, bytes], int, int]:
        """Header fields of a record, and where its data begin and how long they are."""
        (size,) = _length(self._read(position, 4))
        if size > MAX_HEADER_BYTES:
            raise BagError(f"a record's header claims {size} bytes")
        header = self._read(position + 4, size + 4)
        start, data = position + 8 + size, int(_length(header, size)[0])
        if start + data > self._end:
            raise BagError(f"the file ends at {self._end} of {start + data} bytes")
        return _fields(header[:size]), start, data

    def _read(self, position: int, size: int) -> bytes:
        if position + size > self._end:
            raise BagError(f"the file ends at {self._end} of {position + size} bytes")
        self._file.seek(position)
        return self._file.read(size)

    def _source(self, number: int) -> BagSource:
        fields, details = self._connections[number]
        return BagSource(
            number,
            _topic(fields.get("topic", b"").decode()),
            normal_type(details.get("type", b"").decode()),
            details.get("message_definition", b"").decode(errors="replace"),
            "msg",
            "ros1",
            sum(chunk.counts.get(number, 0) for chunk in self._chunks),
        )

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of connections, chunk by chunk."""
        for data in limits.within(self._unpacked(wanted), self._end):
            yield from _messages(data, wanted)

    def _unpacked(self, wanted: Groups) -> Iterator[bytes]:
        """The chunks that hold messages of these connections."""
        for chunk in self._chunks:
            if all(chunk.counts.keys().isdisjoint(ids) for ids in wanted):
                continue
            if chunk.size > limits.CHUNK_BYTES:
                raise BagError(f"a chunk claims {chunk.size} bytes")
            packed = self._read(chunk.start, chunk.size)
            yield decompress(packed, chunk.compression, chunk.unpacked)


def _messages(chunk: bytes, wanted: Groups) -> Iterator[MessageBatch]:
    data = np.frombuffer(chunk, dtype=np.uint8)
    left = np.array(_records(chunk), dtype=np.int64)
    others = layouts = 0
    while others < len(left):
        record = int(left[others])
        header_size = int(_length(chunk, record)[0])
        header = chunk[record + 4 : record + 4 + header_size]
        if _number(_fields(header), "op") != MESSAGE:
            others += 1
            if others > MAX_CONNECTIONS:
                raise BagError("a chunk holds too many records that are no messages")
            continue
        layouts += 1
        if layouts > MAX_HEADER_LAYOUTS:
            raise BagError("the headers of a chunk's messages are all different")
        left, others = left[others:], 0
        conn_at, time_at = header.index(b"conn=") + 5, header.index(b"time=") + 5
        alike = _alike(data, left, header, (conn_at, conn_at + 4), (time_at, time_at + 8))
        records, left = left[alike], left[~alike]
        numbers = numbers_at(data, records + 4 + conn_at, "<u4")
        seconds = numbers_at(data, records + 4 + time_at, "<u4").astype(np.int64)
        receipt_ns = seconds * 1_000_000_000 + numbers_at(data, records + 8 + time_at, "<u4")
        starts = records + 8 + header_size
        sizes = numbers_at(data, starts - 4, "<u4").astype(np.int64)
        for group, rows in grouped(numbers, wanted):
            yield MessageBatch(group, data, starts[rows], sizes[rows], receipt_ns[rows])


def _records(chunk: bytes) -> list[int]:
    """Where the records of a chunk begin."""
    position, end, starts = 0, len(chunk), []
    header, lengths = 0, struct.Struct("<II").unpack_from
    try:
        while position < end:
            starts.append(position)
            size, data = lengths(chunk, position)
            if size < MIN_HEADER_BYTES:
                raise BagError("a record's header is broken")
            if size != header:  # both lengths in one go as long as headers are alike
                header, lengths = size, struct.Struct(f"<I{size}xI").unpack_from
                size, data = lengths(chunk, position)
            position += 8 + size + data
    except struct.error:
        position = -1
    if position != end:
        raise BagError("the records of a chunk do not fill it")
    return starts


def _alike(data: Bytes, records: Places, header: bytes, *holes: tuple[int, int]) -> Bytes:
    """Mask of the records whose header is `header` but for the holes."""
    alike = numbers_at(data, records, "<u4") == len(header)
    rows = rows_at(data, records[alike] + 4, len(header))
    same = rows == np.frombuffer(header, dtype=np.uint8)
    for begin, end in holes:
        same[:, begin:end] = True
    alike[alike] = same.all(axis=1)
    return alike


def _fields(header: bytes) -> dict[str, bytes]:
    fields, position = {}, 0
    while position < len(header):
        if position + 4 > len(header):
            raise BagError("a record's header is broken")
        (size,) = _length(header, position)
        name, sign, value = header[position + 4 : position + 4 + size].partition(b"=")
        if not sign or position + 4 + size > len(header):
            raise BagError("a record's header is broken")
        fields[name.decode()] = value
        position += 4 + size
    return fields


def _number(fields: dict[str, bytes], name: str) -> int:
    if name not in fields or len(fields[name]) not in (1, 4, 8):
        raise BagError(f"a record's header has no number '{name}'")
    return int.from_bytes(fields[name], "little")


def _topic(name: str) -> str:
    return "/" * name.startswith("/") + "/".join(part for part in name.split("/") if part)
