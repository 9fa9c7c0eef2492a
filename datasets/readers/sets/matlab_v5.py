"""MATLAB v5 files: arrays of structures whose fields are numbers, within bounds.

The format is MathWorks' "MAT-File Level 5"; only what such structures need is read. A few bytes can
claim any number of values or inflate to gigabytes: every count is compared with the bytes that are there,
and inflating ends at `limits.MATLAB_BYTES`. scipy.io is not safe here: it recurses into nested cells
without a limit, so that a file of 1 MB crashes the interpreter.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError

HEADER_BYTES, BEGINNING_BYTES = 128, 1 << 14
MATRIX, COMPRESSED = 14, 15
STRUCTURE_CLASS, NUMERIC_CLASSES = 2, range(6, 16)
STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Number types by their code; a double may be stored in a smaller type where that keeps its values."""
_BROKEN = (ValueError, struct.error, zlib.error, OSError, MemoryError, OverflowError, IndexError)


@dataclass(frozen=True)
class _Layout:
    """The beginning of an array of structures: where its fields' values start."""

    count: int
    fields: tuple[str, ...]
    values_at: int


def is_v5(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a little-endian MATLAB v5 file."""
    return head[:10] == b"MATLAB 5.0" and head[124:HEADER_BYTES] == b"\x00\x01IM"


def structures_with(path: Path, fields: set[str]) -> bool:
    """Whether the file holds an array of structures with these fields, as far as it can be read."""
    try:
        for payload in _variables(path, BEGINNING_BYTES):
            layout = _layout(payload)
            if layout is not None and fields <= set(layout.fields):
                return True
    except _BROKEN:
        pass
    return False


def read_structures(path: Path, fields: set[str]) -> dict[str, list[Array]]:
    """The fields of the first array of structures that has all of `fields`: by name, one array a structure.

    Raises:
        DataError: it cannot be read or is too large, or there is none.
    """
    try:
        for payload in _variables(path, limits.MATLAB_BYTES):
            layout = _layout(payload)
            if layout is not None and fields <= set(layout.fields):
                return _values(payload, layout)
    except _BROKEN as error:
        raise DataError(
            f"the MATLAB file cannot be read: {str(error)[:100]}", remedy="copy it again"
        ) from None
    raise DataError(
        f"holds no structures with {', '.join(sorted(fields))}", remedy="give the file as published"
    )


def _variables(path: Path, limit: int) -> Iterator[memoryview]:
    """Payloads of the variables: whole, together of limited size, or the first `limit` bytes of each."""
    if path.stat().st_size > limits.MATLAB_BYTES:
        raise ValueError(f"more than {limits.MATLAB_BYTES >> 20} MiB")
    data, at, whole = memoryview(path.read_bytes()), HEADER_BYTES, limit == limits.MATLAB_BYTES
    for _ in range(limits.MATLAB_VARIABLES):
        if at >= len(data):
            return
        kind, payload, after = _element(data, at)
        if kind == COMPRESSED:
            after = at + 8 + len(payload)  # these are not padded
            inflated = memoryview(zlib.decompressobj().decompress(payload, limit))
            kind, size = struct.unpack_from("<II", inflated)
            if whole and size > len(inflated) - 8:
                raise ValueError(
                    f"a variable is cut off, or there is more than {limits.MATLAB_BYTES >> 20} MiB"
                )
            if whole:
                limit = max(limit - len(inflated), 1)
            payload = inflated[8:]
        if kind == MATRIX:
            yield payload
        at = after
    raise ValueError(f"more than {limits.MATLAB_VARIABLES} variables")


def _element(data: memoryview, at: int) -> tuple[int, memoryview, int]:
    """Type, payload and end of the element at `at`; up to 4 bytes stand inside the tag itself."""
    kind, size = struct.unpack_from("<II", data, at)
    if kind >> 16:
        kind, size, start, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
    else:
        start, after = at + 8, at + 8 + (size + 7) // 8 * 8
    payload = data[start : start + size]
    if len(payload) != size:
        raise ValueError("it is cut off")
    return kind, payload, after


def _shape(matrix: memoryview) -> tuple[int, int, int]:
    """Class, number of values, and where the name ends, of a matrix."""
    _, flags, at = _element(matrix, 0)
    _, dimensions, at = _element(matrix, at)
    _, _, at = _element(matrix, at)
    sizes = np.frombuffer(dimensions, "<i4").tolist()
    if min(sizes, default=0) < 0:
        raise ValueError(f"an array of the shape {sizes}")
    return flags[0], math.prod(sizes), at


def _layout(matrix: memoryview) -> _Layout | None:
    """The beginning of an array of structures, None where the matrix is something else."""
    kind, count, at = _shape(matrix)
    if kind != STRUCTURE_CLASS:
        return None
    _, length, at = _element(matrix, at)
    _, names, at = _element(matrix, at)
    (width,) = struct.unpack("<i", length)
    if not 0 < width <= 64 or count > limits.MATLAB_STRUCTURES:
        raise ValueError(f"{count} structures with names of {width} letters")
    if len(names) > width * limits.MATLAB_FIELDS:
        raise ValueError(f"structures of {len(names) // width} fields")
    texts = [bytes(names[i : i + width]).split(b"\0")[0] for i in range(0, len(names), width)]
    return _Layout(count, tuple(text.decode("ascii", "replace") for text in texts), at)


def _values(matrix: memoryview, layout: _Layout) -> dict[str, list[Array]]:
    values: dict[str, list[Any]] = {name: [] for name in layout.fields}
    at = layout.values_at
    for _ in range(layout.count):
        for name in layout.fields:
            kind, payload, at = _element(matrix, at)
            if kind != MATRIX:
                raise ValueError(f"field {name} is no array")
            values[name].append(_numbers(payload))
    return values


def _numbers(matrix: memoryview) -> Array:
    """The real numbers (N,) of a matrix; none where it holds something else."""
    if not len(matrix):
        return np.zeros(0)
    kind, count, at = _shape(matrix)
    if kind not in NUMERIC_CLASSES:
        return np.zeros(0)
    stored, payload, _ = _element(matrix, at)
    if stored not in STORED:
        raise ValueError(f"numbers of type {stored}")
    numbers = np.frombuffer(payload, f"<{STORED[stored]}").astype(float)
    if len(numbers) != count:
        raise ValueError(f"an array with {len(numbers)} of {count} values")
    return numbers
