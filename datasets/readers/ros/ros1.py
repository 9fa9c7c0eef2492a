"""ROS 1 bags (`.bag`), version 2.0 (wiki.ros.org/Bags/Format/2.0).

A bag is a sequence of records: length, header of `name=value` fields, length, data. Messages are in chunks,
and the index records behind a chunk have time and place of each: rosbags makes an object of every message,
which takes 5 times as long.
"""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.formats import MAP_SUFFIX, Request
from terrafusion.datasets.readers.ros.bag import opened_bag, recording_of
from terrafusion.datasets.readers.ros.raw import (
    BagContainer,
    BagError,
    BagSource,
    Bytes,
    Groups,
    JoinedFiles,
    MessageBatch,
    decompress,
    normal_type,
    numbers_at,
)
from terrafusion.datasets.readers.ros.streams import broken_bag_on_error

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CONNECTION = 2, 3, 4, 5, 7
MIN_HEADER_BYTES, MAX_HEADER_BYTES = 25, 1 << 20
"""Of a record: the fields op and conn, and one more."""
PLACE = np.dtype([("sec", "<u4"), ("nanosec", "<u4"), ("at", "<u4")])
"""Entry of an index: receipt time of a message, and where its record begins in the chunk."""
_length = struct.Struct("<I").unpack_from
REMEDY = "copy it again, or mend it with `rosbag reindex`"
PARTS_OVERLAP_S, PARTS_APART_S = 1.0, 60.0
"""A part of a bag begins at most so long before and after the one before it ends: others are other drives."""


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is named like a ROS 1 bag, or begins as one, or is a folder of the parts of one."""
    if path.is_dir():
        described = (path / "meta.yaml").is_file() or any(path.glob(f"*{MAP_SUFFIX}"))
        return not described and len(_parts(path)) > 1
    return path.is_file() and (path.suffix == ".bag" or head.startswith(b"#ROSBAG V2.0"))


def read(request: Request) -> list[Recording]:
    """The one recording of a ROS 1 bag."""
    with opened_bag(request.path, open_container, REMEDY) as container:
        recording = recording_of(container, request)
    if not request.path.is_dir():
        return [recording]
    return [recording.with_notes(f"read as one: {', '.join(p.name for p in _parts(request.path))}")]


def open_container(path: Path) -> BagContainer:
    """The container of a bag, or of the parts of one; BagError where it is broken."""
    return Ros1Folder(path) if path.is_dir() else Ros1File(path)


def _parts(folder: Path) -> list[Path]:
    """The bags of a folder where their names end in _0, _1, ..., as `rosbag record --split` numbers them."""
    bags = [path for path in folder.iterdir() if path.suffix == ".bag" and path.is_file()]
    numbers = {path: path.stem.rpartition("_")[2] for path in bags}
    if not all(number.isdecimal() for number in numbers.values()):
        return []
    parts = sorted(bags, key=lambda path: int(numbers[path]))
    first = int(numbers[parts[0]]) if parts else 0
    return parts if [int(numbers[path]) for path in parts] == [*range(first, first + len(parts))] else []


class Ros1Folder(JoinedFiles):
    """An open bag that was split into numbered parts.

    Raises:
        BagError: a part breaks the format.
        DataError: one does not begin where the one before it ends.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        end_ns, before = None, ""
        try:
            for path in _parts(folder):
                part = Ros1File(path)
                self.add(part)
                first_ns, last_ns = part.span_ns()
                gap_s = (first_ns - (first_ns if end_ns is None else end_ns)) * 1e-9
                if not -PARTS_OVERLAP_S <= gap_s <= PARTS_APART_S:
                    what = f"begins {gap_s:.3f} s after {before} ends: they are no parts of one recording"
                    raise DataError(what, file=path, remedy="give one of them itself")
                end_ns, before = last_ns, path.name
        except BaseException:
            self.close()
            raise


class _Chunk(NamedTuple):
    start: int
    size: int
    compression: str
    unpacked: int
    places: dict[int, NDArray[Any]]
    """Of the messages (n,) by connection, by the index records behind the chunk."""


class Ros1File:
    """An open ROS 1 bag; a BagError where it breaks the format."""

    def __init__(self, path: Path) -> None:
        self._file, self._end, self.cut = path.open("rb"), path.stat().st_size, ""
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
        """Go over all records of the file; the chunks are read where it is cut off, else only their index."""
        header, position = self._header()
        index_at = _number(header, "index_pos")
        if not index_at:
            self.cut = "its recorder did not close it"
        elif index_at > self._end:
            self.cut = f"{self._end} of more than {index_at} bytes are there"
        try:
            while position < self._end:
                position = self._take(position)
            promised = _number(header, "conn_count"), _number(header, "chunk_count")
            if not self.cut and (len(self._connections), len(self._chunks)) != promised:
                raise BagError(f"the bag ends after {len(self._chunks)} of {promised[1]} chunks")
        except BagError as error:
            if not self.cut and position < index_at:
                raise
            self.cut = self.cut or str(error)
        if self.cut:
            self._index_chunks()

    def _header(self) -> tuple[dict[str, bytes], int]:
        """Fields of the bag's header, and where the record behind it begins."""
        if self._file.read(len(MAGIC)) != MAGIC:
            raise BagError("it does not begin as a ROS 1 bag, version 2.0")
        fields, start, size = _record(self._read, len(MAGIC))
        if _number(fields, "op") != BAG:
            raise BagError("the first record is not the bag's header")
        if fields.get("encryptor"):
            raise BagError("the bag is encrypted")
        return fields, start + size

    def _take(self, position: int) -> int:
        """Keep what a record says; returns where the next one begins."""
        fields, start, size = _record(self._read, position)
        kind, end = _number(fields, "op"), start + size
        if kind == CHUNK:
            compression, unpacked = fields.get("compression", b"").decode(), _number(fields, "size")
            if self.cut and compression == "none" and (not size or end > self._end):
                # its size is written when the chunk is full
                size = unpacked = self._end - start
                end = self._end
            self._chunks.append(_Chunk(start, size, compression, unpacked, {}))
        if end > self._end:
            raise BagError(f"the file ends at {self._end} of {end} bytes")
        if kind == INDEX and self._chunks:
            known, number = self._chunks[-1].places, _number(fields, "conn")
            if _number(fields, "count") * PLACE.itemsize != size:
                raise BagError(f"an index has {size} bytes for {_number(fields, 'count')} messages")
            places = np.frombuffer(self._read(start, size), PLACE)
            known[number] = np.concatenate([known[number], places]) if number in known else places
        elif kind == CONNECTION:
            self._connections[_number(fields, "conn")] = fields, _fields(self._read(start, size))
        return end

    def _index_chunks(self) -> None:
        """Find the messages of each chunk in its own records; what is broken ends the bag."""
        chunks, self._chunks, unpacked, count = self._chunks, [], 0, 0
        for chunk in chunks:
            try:
                with broken_bag_on_error():
                    data = self._unpacked(chunk)
            except BagError:
                break
            unpacked += len(data)
            limits.check_expansion(unpacked, self._end)
            places = self._places(data)
            count += sum(map(len, places.values()))
            if count > limits.ROWS:
                raise limits.too_much("messages", limits.ROWS)
            self._chunks.append(chunk._replace(places=places))

    def _places(self, data: bytes) -> dict[int, NDArray[Any]]:
        """Places of the complete messages of a chunk, by connection; its connections become known."""

        def read(position: int, size: int) -> bytes:
            if position + size > len(data):
                raise BagError("a record reaches past its chunk")
            return data[position : position + size]

        found: dict[int, list[tuple[int, int, int]]] = {}
        position = 0
        while position < len(data):
            try:
                fields, start, size = _record(read, position)
                content = read(start, size)
                kind = _number(fields, "op")
                if kind == CONNECTION:
                    self._connections[_number(fields, "conn")] = fields, _fields(content)
                elif kind == MESSAGE:
                    nanosec, sec = divmod(_number(fields, "time"), 1 << 32)
                    found.setdefault(_number(fields, "conn"), []).append((sec, nanosec, position))
            except BagError:
                break
            position = start + size
        return {number: np.array(places, dtype=PLACE) for number, places in found.items()}

    def _unpacked(self, chunk: _Chunk) -> bytes:
        if chunk.size > limits.CHUNK_BYTES:
            raise BagError(f"a chunk claims {chunk.size} bytes")
        return decompress(self._read(chunk.start, chunk.size), chunk.compression, chunk.unpacked)

    def _read(self, position: int, size: int) -> bytes:
        if position + size > self._end:
            raise BagError(f"the file ends at {self._end} of {position + size} bytes")
        self._file.seek(position)
        return self._file.read(size)

    def span_ns(self) -> tuple[int, int]:
        """Receipt times of the first and the last message; a BagError without any."""
        places = [p for chunk in self._chunks for p in chunk.places.values() if len(p)]
        if not places:
            raise BagError("a part holds no message")
        times = [p["sec"].astype(np.int64) * 10**9 + p["nanosec"] for p in places]
        return min(int(t.min()) for t in times), max(int(t.max()) for t in times)

    def _source(self, number: int) -> BagSource:
        fields, details = self._connections[number]
        return BagSource(
            number,
            _topic(fields.get("topic", b"").decode()),
            normal_type(details.get("type", b"").decode()),
            details.get("message_definition", b"").decode(errors="replace"),
            "msg",
            "ros1",
            sum(len(chunk.places.get(number, ())) for chunk in self._chunks),
        )

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of connections, chunk by chunk."""
        unpacked = 0
        for chunk in self._chunks:
            if all(chunk.places.keys().isdisjoint(ids) for ids in wanted):
                continue
            data = self._unpacked(chunk)
            unpacked += len(data)
            limits.check_expansion(unpacked, self._end)
            for group, ids in enumerate(wanted):
                places = [chunk.places[number] for number in ids if number in chunk.places]
                if places:
                    yield _batch(group, np.frombuffer(data, dtype=np.uint8), np.concatenate(places))


def _batch(group: int, data: Bytes, places: NDArray[Any]) -> MessageBatch:
    """The messages at the places of an index, in the order of the file."""
    places = places[np.argsort(places["at"], kind="stable")]
    at = places["at"].astype(np.int64)
    headers = numbers_at(data, at, "<u4").astype(np.int64)
    if (headers < MIN_HEADER_BYTES).any():
        raise BagError("a record's header is broken")
    sizes = numbers_at(data, at + 4 + headers, "<u4").astype(np.int64)
    if int(sizes.sum()) > len(data):
        raise BagError("the messages of a chunk are larger than the chunk")
    receipt_ns = places["sec"].astype(np.int64) * 1_000_000_000 + places["nanosec"]
    return MessageBatch(group, data, at + 8 + headers, sizes, receipt_ns)


def _record(read: Callable[[int, int], bytes], position: int) -> tuple[dict[str, bytes], int, int]:
    """Header fields of a record, and where its data begin and how long they are."""
    (size,) = _length(read(position, 4))
    if size > MAX_HEADER_BYTES:
        raise BagError(f"a record's header claims {size} bytes")
    header = read(position + 4, size + 4)
    return _fields(header[:size]), position + 8 + size, int(_length(header, size)[0])


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
