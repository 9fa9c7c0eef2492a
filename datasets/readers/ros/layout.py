"""Messages of one kind as arrays, many at a time.

Where all strings and sequences of two messages have the same lengths, their numbers are at the same places.
Such a `MessageLayout` is derived once, from one message and its definition; all messages that share it are
then read by one structured dtype, bit for bit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.ros.raw import BagError, Bytes, MessageBatch, rows_at

Fields = Sequence[tuple[str, Any]]
"""Name and descriptor of each field of a type, as rosbags' type system has them."""
Place = tuple[int, int]
"""Offset and length in a message."""

MAX_LAYOUTS, MAX_LAYOUTS_OF_A_SIZE = 20_000, 100
MAX_DEPTH = 32
CODES = {
    "bool": "?", "byte": "i1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class MessageLayout:
    """Where things lie in messages of `size` bytes.

    Attributes:
        dtype: of the wanted numbers, named by their paths ("twist.linear.x"); arrays have a shape.
        fixed: places and bytes that all messages of this layout share: the lengths.
        words: places of strings by path, and whether it is a list of them.
    """

    size: int
    dtype: np.dtype[Any]
    fixed: tuple[tuple[int, bytes], ...]
    words: Mapping[str, tuple[tuple[Place, ...], bool]]

    def holds(self, rows: Bytes) -> NDArray[np.bool_]:
        """Mask (n,) of the messages (n, size) that are laid out so."""
        same = np.ones(len(rows), dtype=bool)
        for at, value in self.fixed:
            same &= (rows[:, at : at + len(value)] == np.frombuffer(value, dtype=np.uint8)).all(axis=1)
        return same


class _Walk:
    """Goes through one message along its definition."""

    def __init__(self, raw: bytes, types: Mapping[str, Fields], wanted: Sequence[str], cdr: bool) -> None:
        self.raw, self.types, self.wanted, self.cdr = raw, types, wanted, cdr
        self.order, self.position, self.origin = "<", 0, 0
        self.numbers: dict[str, tuple[str, int, tuple[int, ...]]] = {}
        self.fixed: list[Place] = []
        self.words: dict[str, tuple[tuple[Place, ...], bool]] = {}
        if cdr:
            if raw[:2] not in (b"\0\0", b"\0\1") or len(raw) < 4:
                packed = raw.startswith(b"\x28\xb5\x2f\xfd")  # by zstd
                remedy = ": packed one by one; give the folder of the bag, whose metadata.yaml says so"
                raise BagError(f"messages are not in plain CDR{remedy if packed else ''}")
            self.order = "<" if raw[1] else ">"
            self.position = self.origin = 4
            self.fixed.append((0, 2))

    def layout(self, msgtype: str) -> MessageLayout:
        self.message("", msgtype, 0)
        surplus = len(self.raw) - self.position
        if surplus < 0 or surplus > (3 if self.cdr else 0):
            raise BagError(f"a message has {len(self.raw)} bytes where its definition takes {self.position}")
        names = list(self.numbers)
        dtype = np.dtype(
            {
                "names": names,
                "formats": [(code, shape) for code, _, shape in self.numbers.values()],
                "offsets": [offset for _, offset, _ in self.numbers.values()],
                "itemsize": len(self.raw),
            }
        )
        fixed = tuple((at, self.raw[at : at + size]) for at, size in self.fixed)
        return MessageLayout(len(self.raw), dtype, fixed, self.words)

    def message(self, path: str, msgtype: str, depth: int) -> None:
        if msgtype not in self.types:
            raise BagError(f"the definition of {msgtype} is missing")
        if depth > MAX_DEPTH:
            raise BagError(f"the definition of {msgtype} holds itself")
        for name, (kind, desc) in self.types[msgtype]:
            inner = f"{path}.{name}" if path else name
            if kind.name in ("BASE", "NAME"):
                self.field(inner, (kind, desc), None, depth)
            else:
                self.field(inner, desc[0], desc[1] if kind.name == "ARRAY" else self.length(), depth)

    def field(self, path: str, kind_desc: tuple[Any, Any], count: int | None, depth: int) -> None:
        """One value (count None) or a list of them: numbers, strings or messages."""
        kind, desc = kind_desc
        if kind.name == "BASE" and desc[0] != "string":
            self.array(path, desc[0], count)
            return
        if count is not None and count > len(self.raw) - self.position:
            raise BagError(f"a sequence claims {count} entries")
        if kind.name == "NAME":
            for inner in [path] if count is None else [f"{path}.{i}" for i in range(count)]:
                self.message(inner, desc, depth + 1)
            return
        places = tuple(self.string() for _ in range(1 if count is None else count))
        if self.wants(path):
            self.words[path] = places, count is not None

    def array(self, path: str, base: str, count: int | None) -> None:
        """A number (count None) or an array of numbers."""
        if base not in CODES:
            raise BagError(f"fields of type {base} are not supported")
        code = self.order + CODES[base]
        size = np.dtype(code).itemsize
        if count != 0:
            self.align(size)
        start = self.position
        self.position += size * (1 if count is None else count)
        if self.position > len(self.raw):
            raise BagError("a message ends before its last field")
        if self.wants(path):
            self.numbers[path] = code, start, () if count is None else (count,)
        elif count is not None:
            for i in range(count) if any(w.startswith(path + ".") for w in self.wanted) else ():
                if self.wants(f"{path}.{i}"):
                    self.numbers[f"{path}.{i}"] = code, start + i * size, ()

    def string(self) -> Place:
        size = self.length()
        start = self.position
        self.position += size
        if self.position > len(self.raw):
            raise BagError(f"a string claims {size} bytes")
        if not self.cdr:
            return start, size
        if not size or self.raw[self.position - 1]:
            raise BagError("a string has no end")
        self.fixed.append((self.position - 1, 1))
        return start, size - 1

    def length(self) -> int:
        self.align(4)
        value = self.raw[self.position : self.position + 4]
        if len(value) < 4:
            raise BagError("a message ends before its last field")
        self.fixed.append((self.position, 4))
        self.position += 4
        return int.from_bytes(value, "little" if self.order == "<" else "big")

    def align(self, size: int) -> None:
        if self.cdr:
            self.position += (self.origin - self.position) % size

    def wants(self, path: str) -> bool:
        return not self.wanted or any(path == w or path.startswith(w + ".") for w in self.wanted)


Columns = dict[str, NDArray[Any]]


@dataclass
class MessageBlock:
    """Messages whose columns have one shape.

    Attributes:
        rows: (n,) their places among the messages of the topic.
        columns: (n, ...) by path: numbers in the machine's byte order, strings as objects.
    """

    rows: NDArray[np.int64]
    columns: Columns


@dataclass
class MessageDecoder:
    """Gathers the messages of one topic as arrays.

    Attributes:
        types: fields of that type and of those it is made of.
        wanted: paths of the fields to keep, with all below them; () for all.
        cdr: whether messages are in CDR, not in ROS 1's serialisation.
        topic: its name, for errors.
    """

    msgtype: str
    types: Mapping[str, Fields]
    wanted: Sequence[str]
    cdr: bool
    topic: str = ""
    count: int = 0
    _layouts: dict[int, list[MessageLayout]] = field(default_factory=dict)
    _pieces: dict[Any, list[MessageBlock]] = field(default_factory=dict)
    _receipts: list[NDArray[np.int64]] = field(default_factory=list)

    def add(self, batch: MessageBatch) -> None:
        """Take in messages.

        Raises:
            BagError: a message that does not fit its definition.
            DataError: too many different layouts.
        """
        first = int(batch.sizes[0])
        sizes = [first] if (batch.sizes == first).all() else np.unique(batch.sizes).tolist()
        for size in sizes:
            mine = np.flatnonzero(batch.sizes == size)
            self._add_rows(rows_at(batch.data, batch.starts[mine], size), mine + self.count)
        self._receipts.append(batch.receipt_ns)
        self.count += len(batch.starts)

    def _add_rows(self, raw: Bytes, rows: NDArray[np.int64]) -> None:
        layouts = self._layouts.setdefault(raw.shape[1], [])
        tried = 0
        while len(raw):
            if tried == len(layouts):
                layouts.append(
                    _Walk(raw[0].tobytes(), self.types, self.wanted, self.cdr).layout(self.msgtype)
                )
                self._refuse_too_many_layouts(layouts)
            same = layouts[tried].holds(raw)
            if same.all():
                self._keep(layouts[tried], raw, rows)
                return
            if same.any():
                self._keep(layouts[tried], raw[same], rows[same])
                raw, rows = raw[~same], rows[~same]
            tried += 1

    def _refuse_too_many_layouts(self, layouts: list[MessageLayout]) -> None:
        of_a_size = len(layouts) > MAX_LAYOUTS_OF_A_SIZE
        if of_a_size or sum(map(len, self._layouts.values())) > MAX_LAYOUTS:
            most = f"{MAX_LAYOUTS_OF_A_SIZE} (in messages of one size)" if of_a_size else f"{MAX_LAYOUTS}"
            raise DataError(
                f"its texts and lists have more than {most} combinations of lengths",
                channel=self.topic or None,
                remedy="leave the topic out of the bag, or publish texts and lists of the same lengths",
            )

    def _keep(self, layout: MessageLayout, raw: Bytes, rows: NDArray[np.int64]) -> None:
        records: NDArray[Any] = raw.view(layout.dtype)[:, 0] if layout.dtype.names else raw
        columns: Columns = {}
        for name in layout.dtype.names or ():
            column = records[name]
            columns[name] = column.astype(column.dtype.newbyteorder("="), order="C")
        for path, (places, listed) in layout.words.items():
            words = [_texts(raw[:, at : at + size]) for at, size in places]
            none = np.empty((len(raw), 0), dtype=object)
            columns[path] = (np.stack(words, axis=1) if words else none) if listed else words[0]
        shape = tuple((path, column.dtype, column.shape[1:]) for path, column in columns.items())
        self._pieces.setdefault(shape, []).append(MessageBlock(rows, columns))

    def result(self) -> tuple[NDArray[np.int64], tuple[MessageBlock, ...]]:
        """Receipt times (N,) of all messages, and blocks that together hold them; empties the decoder."""
        receipt_ns = np.concatenate([np.zeros(0, dtype=np.int64), *self._receipts])
        blocks = tuple(_joined(self._pieces.pop(shape)) for shape in list(self._pieces))
        self._receipts.clear()
        self.count = 0
        return receipt_ns, blocks


def _texts(raw: Bytes) -> NDArray[Any]:
    """Strings (n,) of their bytes (n, size)."""
    out = np.empty(len(raw), dtype=object)
    if not raw.shape[1] or (raw == raw[0]).all():
        out[:] = _text(raw[0].tobytes())
    else:
        packed = np.ascontiguousarray(raw).view(f"V{raw.shape[1]}")[:, 0]
        out[:] = [_text(word) for word in packed.tolist()]
    return out


@lru_cache(maxsize=10_000)
def _text(word: bytes) -> str:
    try:
        return word.decode()
    except UnicodeDecodeError:
        raise BagError("a string is not valid UTF-8") from None


def _joined(pieces: list[MessageBlock]) -> MessageBlock:
    """One block of many; column by column, so that no more than one column exists twice."""
    rows = np.concatenate([piece.rows for piece in pieces])
    columns: Columns = {}
    for path in list(pieces[0].columns):
        columns[path] = np.concatenate([piece.columns.pop(path) for piece in pieces])
    return MessageBlock(rows, columns)
