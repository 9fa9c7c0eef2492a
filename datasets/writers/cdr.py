"""Messages of one size in CDR, the wire format of ROS 2, many at a time.

All messages of a topic whose texts and array lengths stay the same have the same layout: the bytes
that vary stand at fixed places, so that a block of messages is one structured array.
"""

import struct
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

_ENCAPSULATION = b"\x00\x01\x00\x00"
"""Plain CDR, little endian (OMG DDS-XTypes 1.3, sec. 7.6.3.1.2)."""


class CdrTemplate:
    """The layout of a message, built field after field in the order of its definition.

    CDR aligns each primitive to its own size, counted from behind the four bytes of encapsulation.
    """

    def __init__(self) -> None:
        self._bytes = bytearray(_ENCAPSULATION)
        self._fields: dict[str, tuple[Any, int]] = {}

    def _align(self, size: int) -> None:
        self._bytes.extend(bytes(-(len(self._bytes) - 4) % size))

    def constant(self, code: str, *values: float) -> Self:
        """Numbers that are the same in all messages; `code` as in `struct`."""
        self._align(struct.calcsize(code))
        self._bytes.extend(struct.pack(f"<{len(values)}{code}", *values))
        return self

    def string(self, text: str) -> Self:
        """A text that is the same in all messages."""
        data = text.encode() + b"\0"
        self.constant("I", len(data))
        self._bytes.extend(data)
        return self

    def strings(self, texts: Sequence[str]) -> Self:
        """A sequence of such texts."""
        self.constant("I", len(texts))
        for text in texts:
            self.string(text)
        return self

    def field(self, name: str, dtype: str = "<f8", count: int = 1) -> Self:
        """`count` numbers that vary, found under `name` in the rows."""
        kind = np.dtype(dtype)
        self._align(kind.itemsize)
        self._fields[name] = (kind if count == 1 else np.dtype((kind, (count,))), len(self._bytes))
        self._bytes.extend(bytes(kind.itemsize * count))
        return self

    def sequence(self, name: str, count: int) -> Self:
        """A sequence of `count` doubles that vary."""
        self.constant("I", count)
        return self.field(name, count=count) if count else self

    def header(self, frame_id: str) -> Self:
        """std_msgs/Header; see `stamp`."""
        return self.field("sec", "<i4").field("nanosec", "<u4").string(frame_id)

    def rows(self, n: int) -> NDArray[Any]:
        """`n` messages as a structured array (n,), their varying fields zero."""
        names = list(self._fields)
        dtype = np.dtype(
            {
                "names": names,
                "formats": [self._fields[name][0] for name in names],
                "offsets": [self._fields[name][1] for name in names],
                "itemsize": len(self._bytes),
            }
        )
        return np.frombuffer(self._bytes * n, dtype=dtype)

    def stamped(self, t_ns: NDArray[np.int64]) -> NDArray[Any]:
        """Messages with a header, stamped with the times (n,)."""
        rows = self.rows(len(t_ns))
        rows["sec"], rows["nanosec"] = np.divmod(t_ns, 1_000_000_000)
        return rows


def split(rows: NDArray[Any]) -> list[bytes]:
    """The messages of `CdrTemplate.rows` one by one."""
    data, size = rows.view(np.uint8).tobytes(), rows.dtype.itemsize  # as bytes: fields alone have gaps
    return [data[first : first + size] for first in range(0, len(data), size)]
