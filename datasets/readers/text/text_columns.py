"""Columns of a plain text table, and where its header is."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.delimited import (
    TextLayout,
    head_lines,
    read_columns,
    read_text,
    separator_of,
    split,
)
from terrafusion.datasets.readers.text.column_map import TEXT_FIELDS, ColumnMap

COMMENT = "#"
SAMPLE_ROWS = 200
"""Rows that tell a decimal comma."""
_COMMA, _POINT = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?"), re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")


class TextColumns:
    """Columns of one file; errors name the file, the column and the line.

    Raises:
        DataError: no header, or one that is no line of a table.
    """

    def __init__(self, path: Path, column_map: ColumnMap | None) -> None:
        self.path = path
        self._map = column_map
        self._data = read_text(path)
        self._layout = _layout(self._data, column_map)
        self.names = list(self._layout.names)
        self._data, self._commas = _with_points(self._data, self._layout)
        self.notes: tuple[str, ...] = ()

    def read(self, names: list[str]) -> None:
        """Parse these columns: times and words as text, all others as numbers."""
        texts = {self._map.time.column} if self._map else {"t_s", *(set(TEXT_FIELDS) & set(names))}
        channels = self._map.channels.values() if self._map else ()
        texts |= {of.column for fields in channels for name, of in fields.items() if name in TEXT_FIELDS}
        numbers = [name for name in names if name not in texts]
        self._table = read_columns(self.path, self._data, self._layout, numbers, sorted(texts))
        self.notes = (*self._table.notes, *(["numbers have decimal commas"] if self._commas else []))

    def first_cells(self) -> list[str]:
        """The cells of the first row; [] where there is none."""
        return next(_sample(self._data, self._layout), [])

    def numbers(self, name: str) -> NDArray[np.float64]:
        """A column of numbers (N,), NaN where the cell is empty."""
        if name in self._table.texts:
            raise DataError(f"column '{name}' is mapped twice, as numbers and not")
        return self._table.numbers[name]

    def texts(self, name: str) -> NDArray[Any]:
        """A column of texts (N,)."""
        return self._table.texts[name]

    def times_ns(self, name: str, unit: str) -> NDArray[np.int64]:
        """A column of decimal times as ns (N,)."""
        return self._table.times_ns(name, unit)


def _layout(data: bytes, column_map: ColumnMap | None) -> TextLayout:
    """Names from the first line that is no comment, or from the comment before a first line of numbers."""
    comment, header, number = "", "", 0
    for at, line in head_lines(data):
        if line.startswith(COMMENT):
            comment = line.lstrip("# ")
        elif line.strip():
            header, number = line, at
            break
    if not header:
        raise DataError("the first line is no header of a table", remedy="write names of columns")
    separator = (column_map.separator if column_map else "") or separator_of(header)
    cells = split(header, separator)
    first_line = number + 1
    if column_map is not None and column_map.header == "none":
        cells, first_line = [str(i) for i in range(1, len(cells) + 1)], number
    elif comment and len(split(comment, separator)) == len(cells) and _is_row(cells):
        cells, first_line = split(comment, separator), number
    limits.check_columns(len(cells))
    repeated = limits.repeated(name for name in cells if name)
    if repeated:
        raise DataError(f"column '{repeated}' comes twice", remedy="rename one of them")
    return TextLayout(tuple(cells), separator, first_line, COMMENT)


def _sample(data: bytes, layout: TextLayout) -> Iterator[list[str]]:
    """The cells of the first rows."""
    for number, line in head_lines(data, layout.first_line + SAMPLE_ROWS):
        if number >= layout.first_line and line.strip() and not line.startswith(COMMENT):
            yield split(line, layout.separator)


def _with_points(data: bytes, layout: TextLayout) -> tuple[bytes, bool]:
    """The text with points for decimal commas, and whether it had any: no cell may have a decimal point."""
    if layout.separator == ",":
        return data, False
    cells = [cell for row in _sample(data, layout) for cell in row]
    if not any(map(_COMMA.fullmatch, cells)) or any(map(_POINT.fullmatch, cells)):
        return data, False
    begin = 0
    for _ in range(layout.first_line - 1):
        begin = data.find(b"\n", begin) + 1
    return data[:begin] + data[begin:].replace(b",", b"."), True


def _is_row(cells: list[str]) -> bool:
    try:
        [float(cell) for cell in cells if cell]
    except ValueError:
        return False
    return True
