"""Columns of a plain table: of text, and where its header is; of Parquet, by pyarrow, which is optional."""

import dataclasses
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.decimals import NS_PER
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.readers.delimited import (
    BLANKS,
    BOM,
    MISSING,
    TextLayout,
    head_lines,
    number_in,
    read_columns,
    read_text,
    separator_of,
    split,
)
from terrafusion.datasets.readers.formats import HEAD_BYTES
from terrafusion.datasets.readers.text.column_map import ColumnMap
from terrafusion.datasets.readers.text.column_names import UNIT_OF
from terrafusion.datasets.readers.text.json_lines import is_json_lines, json_table

COMMENT = "#"
SAMPLE_ROWS = 200
"""Rows that tell a decimal comma."""
PREFACE_LINES = 60
"""So many lines may stand in front of a header."""
_EXCEL = re.compile(r"sep=.", re.IGNORECASE)
"""What may stand in front of a header for Excel."""
_THOUSANDS = re.compile(rb"[-+]?[1-9]\d{0,2}(?:,\d{3})+(?:\.\d*)?")
_QUOTED_COMMA = re.compile(rb'"([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)"')
_COMMA, _POINT = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?"), re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")


class NamedColumns(Protocol):
    """Columns (N,) of numbers and texts by name."""

    def numbers(self, name: str) -> NDArray[np.float64]: ...

    def texts(self, name: str) -> NDArray[Any]: ...


class TextColumns:
    """Columns of one file; errors name the file, the column and the line.

    Raises:
        DataError: no header, or one that is no line of a table.
    """

    def __init__(self, path: Path, column_map: ColumnMap | None) -> None:
        self.path = path
        text = read_text(path, any_encoding=True)
        self.units: list[str] = []
        self._preface = self._repeated = self._timeless = 0
        if is_json_lines(text[:HEAD_BYTES]):
            names, text, self._timeless = json_table(text)
            self._layout = TextLayout(tuple(names), ",", 1)
        else:
            headed = column_map is None or column_map.header != "none"
            self._preface = _preface(text) if headed else 0
            self._layout = _layout(text, column_map, self._preface)
            text, self._repeated = _headed_once(text, self._layout)
            self.units, row = _units_below(text, self._layout)
            self._layout = _as_wide_as_rows(text, dataclasses.replace(self._layout, first_line=row))
        self._text, self._commas = _with_points(text, self._layout)
        self.names = list(self._layout.names)
        self.notes: list[str] = []

    def read(self, column_map: ColumnMap) -> None:
        """Parse the mapped columns: times and words as text, all others as numbers."""
        texts = {*column_map.time.columns(), *column_map.words()}
        numbers = [name for name in column_map.columns() if name not in texts]
        self._table = read_columns(self.path, self._text, self._layout, numbers, sorted(texts))
        again = f"the header comes {self._repeated} more times, as of a logger that began anew; left out"
        self.notes = [*self._table.notes, *([self._commas] if self._commas else [])]
        self.notes += [again] if self._repeated else []
        self.notes += [f"{counted(self._timeless, 'line')} without a time left out"] if self._timeless else []
        self.notes += (
            [f"{counted(self._preface, 'line')} in front of the header left out"] if self._preface else []
        )
        self.notes += ["the line below the header holds units; left out"] if self.units else []

    def first_cells(self) -> list[str]:
        """The first value of each column, "" where none of the first rows has one; [] without rows."""
        rows = list(_sample(self._text, self._layout))
        columns = range(len(self.names)) if rows else ()
        return [next((r[k] for r in rows if k < len(r) and r[k] not in MISSING), "") for k in columns]

    def sample(self, name: str) -> list[float]:
        """The numbers of a column in the first rows."""
        k = self.names.index(name)
        cells = [number_in(row[k]) for row in _sample(self._text, self._layout) if len(row) > k]
        return [cell for cell in cells if cell is not None]

    def numbers(self, name: str) -> NDArray[np.float64]:
        """A column of numbers (N,), NaN where the cell is empty."""
        if name in self._table.texts:
            raise DataError(f"column '{name}' is mapped twice, as numbers and not")
        return self._table.numbers[name]

    def texts(self, name: str) -> NDArray[Any]:
        """A column of texts (N,)."""
        return self._table.texts[name]

    def times_ns(self, name: str, unit: str) -> NDArray[np.int64] | None:
        """A column of decimal times as ns (N,); None where they are dates."""
        return None if unit == "iso8601" else self._table.times_ns(name, unit)


def numbered(count: int) -> list[str]:
    """Names of the columns of a table without a header."""
    return [str(i) for i in range(1, count + 1)]


def _layout(data: bytes, column_map: ColumnMap | None, preface: int) -> TextLayout:
    """Names from the first line below the preface that is no comment, or from the comment before a first line
    of numbers; without a map, a first line of numbers is a row."""
    comment, header, number = "", "", 0
    for at, line in head_lines(data):
        if at <= preface:
            continue
        if line.startswith(COMMENT):
            comment = line.lstrip("# ")
        elif line.strip() and not _EXCEL.fullmatch(line):
            header, number = line, at
            break
    if not header:
        raise DataError("the first line is no header of a table", remedy="write names of columns")
    separator = (column_map.separator if column_map else "") or separator_of(header)
    cells = split(header, separator)
    first_line = number + 1
    numbers = [cell for cell in cells if number_in(cell) is not None]
    named, row = split(comment, separator) if comment else [], all(map(_is_value, cells))
    row = row or (column_map is None and cells[:1] == numbers[:1] and 2 * len(numbers) > len(cells))
    if column_map is not None and column_map.header == "none":
        cells, first_line = numbered(len(cells)), number
    elif row and len(named) == len(cells):
        cells, first_line = named, number
    elif row and column_map is None:
        cells, first_line = numbered(len(cells)), number
    limits.check_columns(len(cells))
    return TextLayout(tuple(cells), separator, first_line, COMMENT)


def _as_wide_as_rows(data: bytes, layout: TextLayout) -> TextLayout:
    """The layout with one nameless column more or less, where lines end in a separator but the header does
    not, or the other way round."""
    names, row = layout.names, next(_sample(data, layout), [])
    if len(row) == len(names) + 1 and not row[-1]:
        names = (*names, "")
    elif len(row) == len(names) - 1 and not names[-1]:
        names = names[:-1]
    return dataclasses.replace(layout, names=names)


def _preface(data: bytes) -> int:
    """Number of lines in front of the line of names, where they are of other lengths; else 0.

    The names are the first of the lines as long as the first two rows of numbers, right above these.
    """
    lines = [
        (at, line) for at, line in head_lines(data, PREFACE_LINES) if line.strip() and line[0] != COMMENT
    ]
    marks = [separator_of(line) for _, line in lines]
    cells = [
        split(line, mark) if mark != BLANKS else [] for (_, line), mark in zip(lines, marks, strict=True)
    ]
    numbers = [len(row) if sum(map(_is_number, row)) > 1 else 0 for row in cells]
    rows = (k for k in range(len(cells) - 1) if numbers[k] == numbers[k + 1] > 2)
    first = top = next(rows, 0)
    while top and len(cells[top - 1]) == len(cells[first]):
        top -= 1
    return lines[top][0] - 1 if 0 < top < first else 0


def _sample(data: bytes, layout: TextLayout) -> Iterator[list[str]]:
    """The cells of the first rows."""
    for number, line in head_lines(data, layout.first_line + SAMPLE_ROWS):
        if number >= layout.first_line and line.strip() and not line.startswith(COMMENT):
            yield split(line, layout.separator)


def _with_points(data: bytes, layout: TextLayout) -> tuple[bytes, str]:
    """The text with points for decimal commas, or without commas between thousands, and a note of that.

    Commas are decimal where no cell has a point; between commas as separators, numbers have them in quotes.
    """
    quoted = layout.separator == ","
    begin = _begin(data, layout.first_line)
    head, rows = data[:begin], data[begin:]
    if b"," not in rows or (quoted and b'"' not in rows):
        return data, ""
    cells = [cell for row in _sample(data, layout) for cell in row]
    points = any(map(_POINT.fullmatch, cells))
    commas = [cell for cell in cells if _COMMA.fullmatch(cell)]
    fractions = [cell for cell in commas if not _THOUSANDS.fullmatch(cell.encode())]
    if commas and not points and (fractions or not quoted):
        rows = _QUOTED_COMMA.sub(rb"\1.\2", rows) if quoted else rows.replace(b",", b".")
        return type(data)(head + rows), "numbers have decimal commas"
    mark = b"" if layout.separator == BLANKS else re.escape(layout.separator.encode())
    before, after = (b'(?<=")', b'(?=")') if quoted else (b"(?<![^\\s%b])" % mark, b"(?![^\\s%b])" % mark)
    grouped = re.compile(before + _THOUSANDS.pattern + after)
    found = grouped.findall(rows)
    if fractions or not (points or any(b"." in one or one.count(b",") > 1 for one in found)):
        return data, ""
    rows, count = grouped.subn(lambda cell: cell[0].replace(b",", b""), rows)
    return type(data)(head + rows), "numbers have commas between thousands" if count else ""


def _units_below(data: bytes, layout: TextLayout) -> tuple[list[str], int]:
    """The cells of a line of units below the header, without brackets, and the line after it.

    [] and the first line where that one is a row.
    """
    below = ((at, line) for at, line in head_lines(data) if at >= layout.first_line and line.strip())
    at, line = next(below, (0, ""))
    cells = [cell.strip("[]() ") for cell in split(line, layout.separator)] if at > 1 else []
    rows = any(number_in(cell) is not None or re.search(r"\d\d", cell) for cell in cells)
    known = any(cell.replace(" ", "").lower() in UNIT_OF for cell in cells)
    found = known and not rows and len(cells) == len(layout.names)
    return (cells, at + 1) if found else ([], layout.first_line)


def _begin(data: bytes, line: int) -> int:
    """Where a line, from 1, begins."""
    begin = 0
    for _ in range(line - 1):
        begin = data.find(b"\n", begin) + 1
    return begin


def _headed_once(data: bytes, layout: TextLayout) -> tuple[bytes, int]:
    """The text with blank lines for repetitions of its header, and their number."""
    end = _begin(data, layout.first_line)
    header = data[_begin(data, max(layout.first_line - 1, 1)) : end].strip(b"\r\n").removeprefix(BOM)
    if split(header.decode("utf-8"), layout.separator) != list(layout.names) or data.find(header, end) < 0:
        return data, 0
    rows, count = re.subn(rb"(?<=\n)" + re.escape(header) + rb"\r?(?=\n)", b"", data[end - 1 :])
    return (type(data)(data[: end - 1] + rows), count) if count else (data, 0)


def _is_number(cell: str) -> bool:
    return number_in(cell.replace(",", ".")) is not None


def _is_value(cell: str) -> bool:
    return cell in MISSING or number_in(cell) is not None


class ParquetColumns:
    """Columns of one file; errors name the file and the column.

    Raises:
        DataError: pyarrow is not installed, or the file is damaged.
    """

    def __init__(self, path: Path) -> None:
        try:
            import pyarrow.parquet
        except ImportError:
            raise DataError(
                "Parquet needs pyarrow, which is not installed",
                remedy='install it with: pip install "terrafusion[parquet]"',
            ) from None
        self.path = path
        self._refused = (pyarrow.ArrowException, OSError, ValueError, OverflowError)
        try:
            self._file = pyarrow.parquet.ParquetFile(path)
        except self._refused as error:
            raise self._damaged(error) from None
        self.names: list[str] = list(self._file.schema_arrow.names)
        self.units: list[str] = []
        limits.check_columns(len(self.names))
        if not self.names or len(set(self.names)) < len(self.names):
            raise DataError("has no columns, or two of one name", remedy="name each column once")
        self.notes: list[str] = []
        self._table: Any = None

    def first_cells(self) -> list[str]:
        """The first value of each column as text, "" where none of the first rows has one."""
        found = (next((cell for cell in self._first(name) if cell is not None), "") for name in self.names)
        return [str(cell) for cell in found]

    def sample(self, name: str) -> list[float]:
        """The numbers of a column in the first rows."""
        cells = (cell for cell in self._first(name) if isinstance(cell, (int, float)))
        return [float(cell) for cell in cells if math.isfinite(cell)]

    def _first(self, name: str) -> list[Any]:
        """A column in the first rows, None where it is null, [] of lists."""
        import pyarrow as pa

        if pa.types.is_nested(self._file.schema_arrow.field(name).type):
            return []
        try:
            batch = next(self._file.iter_batches(SAMPLE_ROWS, columns=[name]), None)
        except self._refused as error:
            raise self._damaged(error) from None
        return [] if batch is None else batch.column(0).to_pylist()

    def read(self, column_map: ColumnMap) -> None:
        """Read the mapped columns; texts stay packed until they are asked for."""
        names, size = column_map.columns(), self.path.stat().st_size
        limits.check_table(self._file.metadata.num_rows, len(names), size)
        limits.check_expansion(self._stored_bytes(names), size)
        self._check_kinds(names)
        try:
            self._table = self._reopened(names).read(columns=names)
        except self._refused as error:
            raise self._damaged(error) from None

    def _check_kinds(self, names: list[str]) -> None:
        """Refuse columns of lists: rows say nothing about how much they hold."""
        import pyarrow as pa

        for name in names:
            kind = self._file.schema_arrow.field(name).type
            if pa.types.is_nested(kind):
                what = f"column '{shown(name)}' holds {shown(str(kind))}, no numbers or texts"
                raise DataError(what, remedy="write it as double or string")

    def _stored_bytes(self, names: list[str]) -> int:
        """Bytes of the columns' pages when unpacked, by the file's own account."""
        about, asked = self._file.metadata, set(names)
        return sum(
            column.total_uncompressed_size
            for group in map(about.row_group, range(about.num_row_groups))
            for column in map(group.column, range(group.num_columns))
            if column.path_in_schema in asked
        )

    def _reopened(self, names: list[str]) -> Any:
        """The file with equal texts kept once: a text that many rows repeat takes a few bytes in the file."""
        import pyarrow as pa
        import pyarrow.parquet

        kinds = {name: self._file.schema_arrow.field(name).type for name in names}
        texts = [n for n, kind in kinds.items() if pa.types.is_string(kind) or pa.types.is_large_string(kind)]
        return pyarrow.parquet.ParquetFile(self.path, read_dictionary=texts)

    def numbers(self, name: str) -> NDArray[np.float64]:
        """A column of numbers (N,), NaN where it is null."""
        import pyarrow as pa

        column = self._table.column(name)
        kind = column.type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
            raise DataError(f"column '{name}' holds {kind}, no numbers", remedy="write it as double")
        values = np.asarray(column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False), dtype=float)
        if np.isinf(values).any():
            row = int(np.flatnonzero(np.isinf(values))[0])
            raise DataError(f"column '{name}' is infinite in row {row + 1}", remedy="leave it null")
        return values

    def texts(self, name: str) -> NDArray[Any]:
        """A column as texts (N,), "" where it is null."""
        coded = self._table.column(name).dictionary_encode()
        parts = [np.zeros(0, dtype=object)]
        for chunk in coded.chunks:
            words = ["" if x is None else str(x) for x in [*chunk.dictionary.to_pylist(), None]]
            places = chunk.indices.fill_null(len(words) - 1).to_numpy(zero_copy_only=False)
            parts.append(np.array(words, dtype=object)[places])
        return np.concatenate(parts)

    def times_ns(self, name: str, unit: str) -> NDArray[np.int64] | None:
        """A column of times in ns (N,); None where it holds texts, or numbers that are dates.

        Numbers are in `unit`; typed time stamps and differences of them carry their own, in UTC.
        """
        import pyarrow as pa

        column = self._table.column(name)
        kind = column.type
        if column.null_count:
            raise DataError(f"{column.null_count} rows have no '{name}'", remedy="remove them")
        try:
            if pa.types.is_timestamp(kind):
                return np.asarray(column.cast(pa.timestamp("ns", kind.tz)).cast(pa.int64()).to_numpy())
            if pa.types.is_duration(kind):
                return np.asarray(column.cast(pa.duration("ns")).cast(pa.int64()).to_numpy())
            if unit == "iso8601":
                return None
            if pa.types.is_integer(kind):
                whole = column.cast(pa.int64()).to_numpy()
                if max(int(whole.max(initial=0)), -int(whole.min(initial=0))) < 2**63 // NS_PER.get(unit, 1):
                    return np.asarray(whole * NS_PER.get(unit, 1))
                raise OverflowError
        except self._refused:
            raise self._no_time(name, unit) from None
        if not pa.types.is_floating(kind):
            return None
        with np.errstate(over="ignore"):
            ns = self.numbers(name) * NS_PER.get(unit, 1)
        if not (np.abs(ns) < 9e18).all():
            raise self._no_time(name, unit)
        return np.rint(ns).astype(np.int64)

    def _no_time(self, name: str, unit: str) -> DataError:
        return DataError(
            f"column '{name}' holds times that do not fit into 64 bits of ns",
            remedy=f"is the unit {unit}?",
        )  # fmt: skip

    def _damaged(self, error: BaseException) -> DataError:
        return DataError(f"no readable Parquet: {error}"[:200], remedy="write it again")
