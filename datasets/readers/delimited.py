"""Columns of a delimited text file: strict about cells, exact about times, errors with line and time.

The parsing is pandas' C parser; the cells of every line are counted first, because that parser fills short
lines and cuts long ones silently.
"""

import csv
import gzip
import io
import math
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.decimals import NotADecimal, to_ns
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.quantity import shown

BLOCK = 1 << 20
BOM = b"\xef\xbb\xbf"
UTF_16 = (b"\xff\xfe", b"\xfe\xff")
"""Byte order marks of the "Unicode text" that Excel writes."""
BLANKS = r"\s+"
"""The separator that stands for any run of blanks and tabs."""

UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}

MISSING = (
    "",
    "NaN",
    "nan",
    "NAN",
    "-nan",
    "N/A",
    "n/a",
    "NA",
    "#N/A",
    "null",
    "NULL",
    "None",
    "-",
    "--",
    "---",
)
"""Cells of a numeric column that stand for no value."""

TRUTH_WORDS = (b"rue", b"RUE", b"alse", b"ALSE")
"""In words that pandas takes for 1 and 0."""


@dataclass(frozen=True)
class TextLayout:
    """How the rows of a text file are written.

    Attributes:
        names: columns in the order of the file.
        separator: one character, or `BLANKS`.
        first_line: number, from 1, of the first line that may hold a row.
        comment: character that begins lines without a row; "" for none.
        time: column of seconds, for the times in errors; "" for none.
        strict: a log folder's rules: only an empty cell is a missing value, blanks belong to the cell,
            times count from 0 instead of the first row.
    """

    names: tuple[str, ...]
    separator: str
    first_line: int
    comment: str = ""
    time: str = ""
    strict: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class Columns:
    """Columns of a table by name: `numbers` (N,) float, NaN where missing, and `texts` (N,) str; notes."""

    numbers: dict[str, Array]
    texts: dict[str, NDArray[Any]]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(next(iter([*self.numbers.values(), *self.texts.values()]), ()))

    def stack(self, names: Sequence[str]) -> Array:
        """Columns `names` side by side (N, k); a column the file does not have is NaN."""
        missing = np.full(len(self), np.nan)
        return np.stack([self.numbers.get(name, missing) for name in names], axis=1)

    def select(self, rows: Any) -> Self:
        """The rows of a boolean mask, slice or index array."""
        numbers = {name: column[rows] for name, column in self.numbers.items()}
        return replace(self, numbers=numbers, texts={name: c[rows] for name, c in self.texts.items()})


@dataclass(frozen=True, eq=False, kw_only=True)
class TextTable(Columns):
    """Columns read from the text of a file."""

    layout: TextLayout
    data: bytes

    def times_ns(self, name: str, unit: str = "s") -> TimesNs:
        """A text column of decimal times as nanoseconds (N,), also with MATLAB's " sec" behind them.

        Raises:
            DataError: a cell is no number; the message names the line.
        """
        try:
            return to_ns([text.removesuffix(" sec") for text in self.texts[name].tolist()], unit)
        except NotADecimal as bad:
            raise self.bad_cell(name, bad.row, f"every row needs its time, in {UNIT_NAMES[unit]}") from None

    def line(self, row: int) -> tuple[int, list[str]]:
        """Number, from 1, and cells of the line of a data row (from 0)."""
        return next(islice(_rows(self.data, self.layout), row, None), (0, []))

    def bad_cell(self, name: str, row: int, remedy: str) -> DataError:
        """The error for column `name` of data row `row` (from 0)."""
        line, cells = self.line(row)
        cell = dict(zip(self.layout.names, cells, strict=False)).get(name, "")
        what = f"line {line} has no '{name}'" if not cell.strip() else _cell_is(name, cell, line)
        return _line_error(self.data, self.layout, what, cells, remedy)


class CutText(bytes):
    """Text of a file that is cut off inside its last line."""


def read_text(path: Path, *, any_encoding: bool = False) -> bytes:
    """The bytes of a text file in UTF-8, unpacked where it is a .gz, without a byte order mark.

    Of a .gz that ends too early, and of a file with zeros for its end (as after a loss of power), it is the
    `CutText` that is there.

    Raises:
        DataError: unreadable, empty, over 512 MB, or no text in UTF-8 (in `any_encoding`, UTF-16 and that of
            Windows, too).
    """
    cut = False
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            packed = os.fstat(file.fileno()).st_size
            if path.suffix != ".gz" and packed > limits.TEXT_BYTES + len(BOM):
                raise _too_large()
            most = min(limits.FREE_BYTES + limits.EXPANSION * packed, limits.TEXT_BYTES) + 1
            read = bytearray()
            try:
                while len(read) < most and (block := file.read1(BLOCK)):
                    read += block
            except EOFError:
                cut = True
    except (OSError, zlib.error) as error:
        what = f"cannot be read: {getattr(error, 'strerror', '') or error}"
        raise DataError(what, remedy="is it complete?") from None
    data = bytes(read).removeprefix(BOM)
    if any_encoding and data.startswith(UTF_16):
        data = data.decode("utf-16", "replace").encode()
    _check_size(data, packed)
    if data.endswith(b"\0"):
        cut, data = True, data.rstrip(b"\0")
    if not data or data.isspace():
        raise DataError("the file is empty", remedy="copy it again; a table has at least a header")
    try:
        data.isascii() or data.decode("utf-8")
    except UnicodeDecodeError as error:
        if not any_encoding:
            raise DataError(f"not UTF-8 at byte {error.start}", remedy="save it as UTF-8") from None
        data = data.decode("cp1252", "replace").encode()
    if b"\0" in data:
        raise DataError("holds zero bytes: not a text file", remedy="copy it again")
    return CutText(data) if cut else data


def _too_large() -> DataError:
    return limits.too_much("MB", limits.TEXT_BYTES / 2**20, "split it, or convert it to Parquet")


def _check_size(data: bytes, packed: int) -> None:
    """Refuse more bytes, rows or bytes in a line than a text file may have."""
    if len(data) > limits.TEXT_BYTES:
        raise _too_large()
    limits.check_expansion(len(data), packed)
    if max(data.count(b"\n"), data.count(b"\r")) > limits.ROWS:
        raise limits.too_much("lines", limits.ROWS)
    check_lines(data)


def check_lines(data: bytes) -> None:
    """Refuse a line that is too long for one (DataError)."""
    begin = 0
    while len(data) - begin > limits.LINE_BYTES:
        end = data.rfind(b"\n", begin, begin + limits.LINE_BYTES) + 1
        if not end:
            line = data.count(b"\n", 0, begin) + 1
            raise limits.too_much(f"bytes in line {line}", limits.LINE_BYTES, "is it a text file?")
        begin = end


def head_lines(data: bytes, count: int = 1000) -> Iterator[tuple[int, str]]:
    """Number, from 1, and text of the first lines; one that is too long for a line of a table ends them."""
    begin = len(BOM) if data.startswith(BOM) else 0
    for number in range(1, count + 1):
        end = data.find(b"\n", begin, begin + limits.LINE_BYTES)
        if end < 0:
            if begin < len(data) <= begin + limits.LINE_BYTES:
                yield number, data[begin:].decode("utf-8", "replace").rstrip("\r")
            return
        yield number, data[begin:end].decode("utf-8", "replace").rstrip("\r")
        begin = end + 1


def separator_of(line: str) -> str:
    """The separator of a header line: tab, semicolon, comma, or blanks."""
    return next((mark for mark in "\t;," if mark in line), BLANKS)


def split(line: str, separator: str) -> list[str]:
    """The cells of a line."""
    if separator == BLANKS:
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator), [])
    except csv.Error:  # bytes that are no table
        cells = line.split(separator)
    return [cell.strip() for cell in cells]


def read_columns(
    path: Path, text: bytes, layout: TextLayout, numbers: Sequence[str], texts: Sequence[str] = ()
) -> TextTable:
    """Parse the columns that are asked for; a last line that was cut off is left out with a note.

    Args:
        text: of the file, by `read_text`.
        numbers: columns of numbers; empty and NaN cells are missing values.

    Raises:
        DataError: too many columns, or two of one name; no rows, a line with too few or too many cells,
            a cell that is no finite number.
    """
    end, notes = _complete_end(path, text, layout)
    data = text[:end]
    limits.check_columns(len(layout.names))
    repeated = limits.repeated(name for name in layout.names if name)
    if repeated:
        raise DataError(f"column '{shown(repeated)}' comes twice", remedy="keep or rename one of them")
    if data.count(b"\n") * (len(numbers) + len(texts)) > limits.VALUES:
        raise limits.too_much("values", limits.VALUES)
    _check_counts(data, layout)
    table = _parse(data, layout, numbers, texts)
    if table is None and not layout.strict and layout.separator != BLANKS:  # pandas knows no "nan "
        mark = re.escape(layout.separator.encode())
        table = _parse(re.sub(rb" +(?=" + mark + rb"|[\r\n]|$)", b"", data), layout, numbers, texts)
    if table is None or _is_suspect(table, data, layout, numbers):
        _check_cells(data, layout, set(numbers))
    if table is None:
        raise DataError("cannot be read as a table", remedy="write plain separated numbers")
    columns = TextTable(
        layout=layout,
        data=data,
        notes=notes,
        numbers={n: table[n] for n in numbers},
        texts={n: table[n] for n in texts},
    )
    if not len(columns) and isinstance(text, CutText):
        raise DataError("cannot be read: it is cut off before its first row", remedy="is it complete?")
    if not len(columns) and not layout.strict:
        what = "holds a header but no rows" if layout.first_line > 1 else "holds no rows"
        raise DataError(what, remedy="record or copy it again")
    return columns


def _complete_end(path: Path, data: bytes, layout: TextLayout) -> tuple[int, tuple[str, ...]]:
    """Where complete lines end, and what to note of the last one."""
    cut = isinstance(data, CutText)
    if data.endswith((b"\n", b"\r")) and not cut:
        return len(data), ()
    begin = data.rfind(b"\n") + 1
    last = data[begin : begin + limits.LINE_BYTES].decode("utf-8", "replace")
    long = len(data) - begin > limits.LINE_BYTES
    first = data.count(b"\n", 0, begin) + 1 < layout.first_line
    whole = long or first or len(split(last, layout.separator)) >= len(layout.names)
    if not cut and whole:
        return len(data), (f"{path.name}: the last line has no line end; was it cut off?",)
    before = data[max(begin - limits.LINE_BYTES, 0) : begin].rstrip().rpartition(b"\n")[2]
    since_s = _since_s(data[:begin], layout, split(before.decode("utf-8", "replace"), layout.separator))
    until = "" if since_s is None else f", t = {since_s:.3f} s"
    end = data.count(b"\n", 0, begin)
    note = f"{path.name}: the last line was cut off and is left out; its data end in line {end}{until}"
    return begin, (note,)


def _since_s(data: bytes, layout: TextLayout, cells: Sequence[str]) -> float | None:
    """Seconds of a row since 0, or since the first row; None where a time cannot be read."""
    try:
        at = layout.names.index(layout.time)
        origin = 0.0 if layout.strict else float(next(_rows(data, layout), (0, []))[1][at])
        since = float(cells[at]) - origin
    except (ValueError, IndexError):
        return None
    return since if np.isfinite(since) else None


def _check_counts(data: bytes, layout: TextLayout) -> None:
    """Refuse the first line that has not as many cells as there are columns."""
    width = len(layout.names)
    for line, cells in _rows_of_other_width(data, layout, width):
        what = f"line {line} has {len(cells)} cells for {width} columns"
        remedy = "is it cut off, or of another table?"
        if layout.strict:
            remedy = "an unknown value is an empty cell between commas"
        raise _line_error(data, layout, what, cells, remedy)


def _rows_of_other_width(data: bytes, layout: TextLayout, width: int) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of the rows that have not so many cells."""
    mark = None if layout.separator == BLANKS else layout.separator.encode()
    if mark is not None and b'"' in data:
        yield from ((line, cells) for line, cells in _rows(data, layout) if len(cells) != width)
        return
    for number, line in enumerate(io.BytesIO(data), 1):
        count = len(line.split()) if mark is None else line.count(mark) + 1
        if count == width or number < layout.first_line or not line.strip():
            continue
        if not (layout.comment and line.startswith(layout.comment.encode())):
            yield number, [cell.decode("utf-8", "replace") for cell in line.split(mark)]


def _line_error(data: bytes, layout: TextLayout, what: str, cells: Sequence[str], remedy: str) -> DataError:
    """An error about a line of these cells, with its time where that can be read."""
    return DataError(what, time_s=_since_s(data, layout, cells), remedy=remedy)


def _parse(
    data: bytes, layout: TextLayout, numbers: Sequence[str], texts: Sequence[str]
) -> dict[str, NDArray[Any]] | None:
    """The columns by pandas' C parser, bit-exact; None when a cell does not parse."""
    import pandas as pd

    positions = {name: i for i, name in enumerate(layout.names)}
    asked = [*numbers, *texts]
    # pandas before 3.1 rounds its default floats; from 3.1 on they are exact and the option is deprecated.
    old = tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1)
    options: dict[str, Any] = {"float_precision": "round_trip"} if old else {}
    options["dtype"] = {positions[name]: "float64" if name in numbers else "object" for name in asked}
    options["na_values"] = {positions[name]: [""] if layout.strict else list(MISSING) for name in numbers}
    if layout.comment:  # whole lines only: pandas would also cut a cell there
        data = re.sub(rb"(?m)^" + re.escape(layout.comment.encode()) + rb"[^\n]*", b"", data)
    try:
        frame = pd.read_csv(
            io.BytesIO(data),
            engine="c",
            sep=layout.separator,
            header=None,
            skiprows=layout.first_line - 1,
            usecols=sorted(positions[name] for name in asked),
            keep_default_na=False,
            skipinitialspace=not layout.strict,
            **options,
        )
    except pd.errors.EmptyDataError:
        return {name: np.zeros(0, dtype=float if name in numbers else object) for name in asked}
    except (ValueError, OverflowError, pd.errors.ParserError):
        return None
    return {name: frame[positions[name]].to_numpy() for name in asked}


def _is_suspect(
    table: dict[str, NDArray[Any]], data: bytes, layout: TextLayout, numbers: Sequence[str]
) -> bool:
    """Whether a number may not be what the file says: infinite, a truth value, in a log folder "nan"."""
    if any(np.isinf(table[name]).any() for name in numbers) or any(word in data for word in TRUTH_WORDS):
        return True
    if not layout.strict or not any(np.isnan(table[name]).any() for name in numbers):
        return False
    lower = data.lower()
    return any(word in lower for word in (b"nan", b", ", b" ,", b",\t", b"\t,"))


def _check_cells(data: bytes, layout: TextLayout, numbers: set[str]) -> None:
    """Raise for the first cell of a numeric column that is neither finite nor missing."""
    remedy = "give a finite number, or leave the cell empty where the value is missing"
    for line, cells in _rows(data, layout):
        for name, cell in zip(layout.names, cells, strict=False):
            missing = not cell if layout.strict else cell.strip() in MISSING
            if name in numbers and not missing and number_in(cell) is None:
                raise _line_error(data, layout, _cell_is(name, cell, line), cells, remedy)


def _rows(data: bytes, layout: TextLayout) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every row."""
    text = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", newline="")
    if layout.separator == BLANKS:
        for number, line in enumerate(text, 1):
            if number >= layout.first_line and line.strip() and line[0] != layout.comment:
                yield number, line.split()
        return
    for _ in range(layout.first_line - 1):
        text.readline()
    lines = ("\n" if layout.comment and line.startswith(layout.comment) else line for line in text)
    reader = csv.reader(lines, delimiter=layout.separator, skipinitialspace=not layout.strict)
    at = layout.first_line
    try:
        for cells in reader:
            at = reader.line_num + layout.first_line
            if len(cells) > 1 or "".join(cells).strip():
                yield at - 1, cells
    except csv.Error as error:
        raise not_a_table(at, error) from None


def not_a_table(line: int, error: csv.Error) -> DataError:
    """The error for a line that the csv module refuses."""
    what = f"line {line} is not a line of a table: {error}"
    return DataError(what, remedy="write plain separated numbers, without quotes")


def number_in(cell: str) -> float | None:
    """The finite number that a text is; None where it is none."""
    try:
        number = float(cell)
    except ValueError:
        return None
    return number if math.isfinite(number) and "_" not in cell else None


def _cell_is(name: str, cell: str, line: int) -> str:
    return f"column '{name}' is '{shown(cell.strip())}' at line {line}"
