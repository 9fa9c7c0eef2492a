"""Columns of a plain text table: where its header stands, and the columns that are asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.delimited import (
    TextLayout,
    TextTable,
    head_lines,
    read_columns,
    read_text,
    separator_of,
    split,
)
from terrafusion.datasets.readers.text.column_map import TEXT_FIELDS, ColumnMap

COMMENT = "#"


class TextColumns:
    """Columns of one file; errors name the file, the column and the line.

    Raises:
        DataError: no header, or one that is no line of a table.
    """

    def __init__(self, path: Path, found: ColumnMap | None) -> None:
        self.path = path
        self._found = found
        self._data = read_text(path)
        self._layout = _layout(path, self._data, found)
        self.names = list(self._layout.names)
        self._columns: TextTable | None = None
        self.notes: tuple[str, ...] = ()

    def read(self, names: list[str]) -> None:
        """Parse these columns: as text the times and words, as numbers all others."""
        texts = {self._found.time.column} if self._found else {"t_s"}
        channels = self._found.channels.values() if self._found else ()
        texts |= {of.column for fields in channels for name, of in fields.items() if name in TEXT_FIELDS}
        if self._found is None:
            texts |= set(TEXT_FIELDS) & set(names)
        self._columns = read_columns(
            self.path, self._data, self._layout, [n for n in names if n not in texts], sorted(texts)
        )
        self.notes = self._columns.notes

    def numbers(self, name: str) -> NDArray[np.float64]:
        """A column of numbers (N,), NaN where the cell is empty."""
        assert self._columns is not None
        if name in self._columns.texts:
            raise DataError(f"column '{name}' is mapped twice, as numbers and not", file=self.path)
        return self._columns.numbers[name]

    def texts(self, name: str) -> NDArray[Any]:
        """A column of texts (N,)."""
        assert self._columns is not None
        return self._columns.texts[name]

    def times_ns(self, name: str, unit: str) -> NDArray[np.int64]:
        """A column of decimal times as ns (N,)."""
        assert self._columns is not None
        return self._columns.times_ns(name, unit)


def _layout(path: Path, data: bytes, found: ColumnMap | None) -> TextLayout:
    """Names from the first line that is no comment, or from the comment before a first line of numbers."""
    comment, header, number = "", "", 0
    for at, line in head_lines(data):
        if line.startswith(COMMENT):
            comment = line.lstrip("# ")
        elif line.strip():
            header, number = line, at
            break
    if not header:
        raise DataError("the first line is no header of a table", file=path, remedy="write names of columns")
    separator = (found.separator if found else "") or separator_of(header)
    cells = split(header, separator)
    first_line = number + 1
    if found is not None and found.header == "none":
        cells, first_line = [str(i) for i in range(1, len(cells) + 1)], number
    elif comment and len(split(comment, separator)) == len(cells) and _is_row(cells):
        cells, first_line = split(comment, separator), number
    repeated = [name for i, name in enumerate(cells) if name in cells[:i] and name]
    if repeated:
        raise DataError(f"column '{repeated[0]}' comes twice", file=path, remedy="rename one of them")
    return TextLayout(tuple(cells), separator, first_line, COMMENT)


def _is_row(cells: list[str]) -> bool:
    try:
        [float(cell) for cell in cells if cell]
    except ValueError:
        return False
    return True
