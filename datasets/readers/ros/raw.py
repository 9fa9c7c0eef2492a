"""Raw messages of a bag, whatever its container: their sources, and where their bytes are.

A container (in `ros1`, `mcap_file`, `ros2`) lists its `BagSource`s and yields `MessageBatch`es: the bytes
of a chunk and the places of one source's messages in it. No message becomes a Python object.
"""

import dataclasses
import sys
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits

Bytes = NDArray[np.uint8]
Places = NDArray[np.int64]

Groups = Sequence[Collection[int]]
"""Ids of sources whose messages are wanted together."""
ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
"""Python's own module, before 3.14 its backport, which rosbags brings."""
DECODERS = {
    "lz4": ("lz4.frame", "LZ4FrameDecompressor"),
    "bz2": ("bz2", "BZ2Decompressor"),
    "zstd": (ZSTD, "ZstdDecompressor"),
}


class BagError(Exception):
    """A bag that breaks its format; `topic` where it is known."""

    def __init__(self, what: str, topic: str | None = None) -> None:
        super().__init__(what)
        self.topic = topic


@dataclass(frozen=True)
class BagSource:
    """Who sent messages of one kind: a connection (ROS 1) or a channel (MCAP).

    Attributes:
        id: as batches name it.
        topic: its name.
        msgtype: type, as `package/msg/Type`.
        definition: text of the type's definition, "" where the bag has none.
        language: of the definition: "msg" or "idl".
        encoding: of the messages: "ros1" or "cdr".
        count: number of messages.
    """

    id: int
    topic: str
    msgtype: str
    definition: str
    language: str
    encoding: str
    count: int


class MessageBatch(NamedTuple):
    """Some messages of a group of sources, in the order of the file.

    Attributes:
        group: place of the group among those that were asked for.
        data: bytes that hold the messages, among others.
        starts, sizes: (n,) where in `data` each message begins, and its length.
        receipt_ns: (n,) when the recorder got it.
    """

    group: int
    data: Bytes
    starts: Places
    sizes: Places
    receipt_ns: NDArray[np.int64]


class BagContainer(Protocol):
    """An open bag file."""

    @property
    def cut(self) -> str:
        """In which way the file is cut off, "" where it is whole; what is there can be read."""

    @property
    def sources(self) -> list[BagSource]:
        """Who sent its messages."""

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of sources."""

    def close(self) -> None:
        """Give the file back."""


class JoinedFiles:
    """Files of one bag, one after the other, as one container."""

    def __init__(self) -> None:
        self._files: list[tuple[BagContainer, dict[int, int]]] = []  # and the ids here by those of the file
        self.sources: list[BagSource] = []
        self.cut = ""

    def add(self, file: BagContainer) -> None:
        """Take the next file; it is closed with this container."""
        ids = {source.id: len(self.sources) + k for k, source in enumerate(file.sources)}
        self.sources += [dataclasses.replace(source, id=ids[source.id]) for source in file.sources]
        self._files.append((file, ids))
        self.cut = file.cut or self.cut

    def close(self) -> None:
        """Give the files back."""
        for file, _ in self._files:
            file.close()

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of sources, file by file."""
        for file, ids in self._files:
            mine = [[own for own, number in ids.items() if number in group] for group in wanted]
            here = [group for group, own in enumerate(mine) if own]
            for batch in file.batches([mine[group] for group in here]) if here else ():
                yield batch._replace(group=here[batch.group])


def grouped(numbers: NDArray[Any], wanted: Groups) -> Iterator[tuple[int, Places]]:
    """The rows of each group that has some, by the number (n,) of each row's source."""
    for group, ids in enumerate(wanted):
        rows = np.flatnonzero(np.isin(numbers, list(ids)) if len(ids) > 1 else numbers == next(iter(ids)))
        if rows.size:
            yield group, rows


def batches_of(messages: Sequence[tuple[int, int, bytes]], wanted: Groups) -> Iterator[MessageBatch]:
    """Messages, each as the number of its source, receipt time (ns) and bytes, by group."""
    numbers, times, blobs = zip(*messages, strict=True)
    receipt_ns = np.array(times, dtype=np.int64)
    sizes = np.fromiter(map(len, blobs), dtype=np.int64, count=len(blobs))
    starts = np.cumsum(sizes) - sizes
    data = np.frombuffer(b"".join(blobs), dtype=np.uint8)
    for group, rows in grouped(np.array(numbers, dtype=np.int64), wanted):
        yield MessageBatch(group, data, starts[rows], sizes[rows], receipt_ns[rows])


def normal_type(name: str) -> str:
    """`package/msg/Type` of a type's name in either ROS."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


def numbers_at(data: Bytes, places: Places, dtype: str) -> NDArray[Any]:
    """Numbers of a dtype at any places (n,), also uneven ones; a BagError for a place outside the data."""
    kind = np.dtype(dtype)
    inside = len(data) - kind.itemsize + 1
    if places.size and (int(places.min()) < 0 or int(places.max()) >= inside):
        raise BagError("a record reaches past its chunk")
    return np.asarray(np.ndarray((max(inside, 0),), kind, data, strides=(1,))[places])


def rows_at(data: Bytes, starts: Places, size: int) -> Bytes:
    """The bytes (n, size) of messages of one size."""
    if not size:
        return np.zeros((len(starts), 0), dtype=np.uint8)
    return numbers_at(data, starts, f"V{size}").view(np.uint8).reshape(len(starts), size)


def decompress(data: bytes, compression: str, size: int) -> bytes:
    """The `size` bytes of a chunk; never more memory than it claims and may claim.

    Raises:
        BagError: too large, of another size than claimed, or compressed in an unknown way.
    """
    if size > limits.CHUNK_BYTES:
        raise BagError(f"a chunk claims to hold {size} bytes")
    out = data
    if compression not in ("", "none"):
        parts: list[bytes] = []
        while data and sum(map(len, parts)) <= size:
            decoder = _decoder(compression)
            parts.append(decoder.decompress(data, max_length=size + 1 - sum(map(len, parts))))
            data = decoder.unused_data if decoder.eof else b""
        out = b"".join(parts)
    if len(out) != size:
        raise BagError(f"a chunk claims {size} bytes and holds {len(out) if len(out) < size else 'more'}")
    return out


def _decoder(compression: str) -> Any:
    if compression not in DECODERS:
        raise BagError(f"chunks are compressed by '{compression[:20]}', which is not supported")
    module, name = DECODERS[compression]
    return getattr(import_module(module), name)()


def zstd() -> Any:
    """The zstd module."""
    return import_module(ZSTD)
