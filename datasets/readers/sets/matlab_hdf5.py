"""MATLAB v7.3 files, which are HDF5: numeric variables and the columns of MATLAB tables, within bounds.

A file may claim any shape, fill it from a few bytes, or point to other files: whatever is larger than
`limits.HDF5_VALUES`, stored elsewhere or a link is refused before it is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError

LARGEST = 1e30
"""No number of a log is larger; squares of these are still numbers."""
MAGIC = b"\x89HDF\r\n\x1a\n"
USER_BLOCK = 512
"""Bytes of text that MATLAB puts before the HDF5."""
_BROKEN = (
    OSError,
    RuntimeError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    MemoryError,
    OverflowError,
)


def is_hdf5(head: bytes) -> bool:
    """Whether the first bytes of a file are those of HDF5, with or without MATLAB's text before it."""
    return head.startswith(MAGIC) or head[USER_BLOCK : USER_BLOCK + len(MAGIC)] == MAGIC


def variables(path: Path) -> set[str] | None:
    """Names of the variables, or None where the file cannot be opened."""
    try:
        with _file(path) as file:
            return set(file)
    except _BROKEN:
        return None


@contextmanager
def opened(path: Path) -> Iterator[MatlabFile]:
    """The file, open for reading.

    Raises:
        DataError: it cannot be opened or read, here or while it is open.
    """
    try:
        with _file(path) as file:
            yield MatlabFile(file)
    except _BROKEN as error:
        why = str(error).rpartition("(")[2].split("\n")[0].split(",")[0].rstrip(")")[:100]
        raise DataError(f"the HDF5 cannot be read: {why}", remedy="copy it again; is it complete?") from None


def _file(path: Path) -> Any:
    import h5py

    return h5py.File(path, "r", rdcc_nbytes=0, locking=False)


class MatlabFile:
    """Variables of an open file by name."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def has(self, name: str) -> bool:
        """Whether there is a variable of that name."""
        return name in self._file

    def vector(self, name: str) -> Array:
        """A variable (N,) that is one row or one column."""
        values = self._numbers(name)
        if values.size != max(values.shape, default=0):
            raise self._wrong(name, f"has the shape {values.shape}, not one row or column")
        return values.ravel()

    def rows(self, name: str, width: int) -> Array:
        """A variable (N, width), stored in either orientation."""
        values = self._numbers(name)
        if values.ndim != 2 or width not in values.shape:
            raise self._wrong(name, f"has the shape {values.shape}, not N x {width}")
        return values if values.shape[1] == width else values.T

    def _numbers(self, name: str) -> Array:
        import h5py

        if not self.has(name):
            raise self._wrong(name, "is missing")
        link = self._file.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink) or not isinstance(self._file[name], h5py.Dataset):
            raise self._wrong(name, "is no variable of numbers")
        return self._values(self._file[name], name)

    def _values(self, data: Any, name: str) -> Array:
        """The numbers of a dataset, after its claims were checked."""
        largest = max(math.prod(data.shape or ()), math.prod(data.chunks or ()))
        if data.dtype.kind not in "fiu" or data.dtype.itemsize > 8 or data.dtype.subdtype is not None:
            raise self._wrong(name, f"holds {data.dtype}, not numbers")
        if largest > limits.HDF5_VALUES or data.external or data.is_virtual:
            raise self._wrong(name, f"claims {largest} values, or keeps them in other files")
        values = np.asarray(data[()], dtype=float)
        values[np.isnan(values)] = np.nan  # a signalling NaN, which only broken files have, warns when used
        if (np.abs(values) > LARGEST).any():
            raise self._wrong(name, f"holds numbers beyond {LARGEST:g}")
        return values

    def _wrong(self, name: str, what: str) -> DataError:
        return DataError(what, channel=name, remedy="give the variable as it was published")

    def tables(self) -> Iterator[dict[str, Array]]:
        """Columns (N,) by name of every MATLAB `table` of numbers in the file.

        MATLAB keeps objects in `#subsystem#/MCOS`, a list of references: a table's columns are one
        cell array there and their names another, of the same length.
        """
        cells = [cell for cell in self._cells() if len(cell) > 0]
        names = [texts for texts in map(self._texts, cells) if texts]
        for cell in cells:
            columns = self._columns(cell)
            for texts in names if columns else ():
                if len(texts) == len(columns):
                    yield dict(zip(texts, columns, strict=True))

    def _cells(self) -> Iterator[list[Any]]:
        """Every cell array of datasets among the objects' data."""
        import h5py

        for item in self._referenced(self._file.get("#subsystem#/MCOS")):
            if isinstance(item, h5py.Dataset) and item.dtype.kind == "O":
                yield [part for part in self._referenced(item) if isinstance(part, h5py.Dataset)]

    def _referenced(self, data: Any) -> list[Any]:
        import h5py

        if not isinstance(data, h5py.Dataset) or h5py.check_ref_dtype(data.dtype) is not h5py.Reference:
            return []
        if math.prod(data.shape) > limits.HDF5_REFERENCES or data.external or data.is_virtual:
            return []
        return [self._file[reference] for reference in data[()].ravel() if reference]

    def _texts(self, cell: list[Any]) -> list[str]:
        """The cell's texts, or nothing where one is no text."""
        if any(self._kind(part) != b"char" or math.prod(part.shape) > 100 for part in cell):
            return []
        return ["".join(map(chr, self._values(part, "a table").astype(int).ravel())) for part in cell]

    def _columns(self, cell: list[Any]) -> list[Array]:
        """The cell's numeric columns, or nothing where it is no table."""
        if any(self._kind(part) not in (b"double", b"single") for part in cell):
            return []
        columns = [self._values(part, "a table").ravel() for part in cell]
        return columns if len({len(column) for column in columns}) == 1 else []

    @staticmethod
    def _kind(part: Any) -> Any:
        return part.attrs.get("MATLAB_class")
