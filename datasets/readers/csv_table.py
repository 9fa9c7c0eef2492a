"""One channel's CSV: strict header, times exact to the nanosecond, missing cells apart from bad ones."""

from __future__ import annotations

import csv
import difflib
import gzip
import io
import re
import warnings
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.config import shown
from terrafusion.datasets.core.errors import ClockError, DataError
from terrafusion.datasets.core.trajectory import seconds_to_ns

Array = NDArray[np.float64]

MAX_BYTES = 512 * 2**20
"""Of one channel, unpacked: a day at 100 Hz. What claims to be more may be a trap for the memory."""

MAX_T_S = 1e9
"""A |t_s| beyond this (32 years) is a Unix time, not seconds from the start."""

_EXACT_T_S = 1e6
"""Below this, rounding the double to nanoseconds gives the decimal that was written."""


@dataclass(frozen=True, eq=False)
class Table:
    """The rows of one CSV.

    Attributes:
        t_ns: (N,) int64, from the start of the recording, never decreasing unless asked for otherwise.
        numbers: (N,) float columns by name; an empty cell is NaN.
        texts: (N,) object columns by name; an empty cell is "".
        notes: what was odd about the file, in sentences.
    """

    t_ns: NDArray[np.int64]
    numbers: dict[str, Array]
    texts: dict[str, NDArray[Any]]
    notes: tuple[str, ...] = ()

    def stack(self, names: Sequence[str]) -> Array:
        """Columns `names` side by side (N, k); a column the file does not have is NaN."""
        missing = np.full(len(self.t_ns), np.nan)
        return np.stack([self.numbers.get(name, missing) for name in names], axis=1)

    def select(self, rows: NDArray[Any]) -> Table:
        """The rows of a boolean mask or index array."""
        return Table(
            self.t_ns[rows],
            {name: column[rows] for name, column in self.numbers.items()},
            {name: column[rows] for name, column in self.texts.items()},
            self.notes,
        )


def read_table(
    path: Path,
    known: Iterable[str],
    *,
    texts: Sequence[str] = (),
    prefixes: Sequence[str] = (),
    in_order: bool = True,
) -> Table:
    """Read one channel's `.csv` or `.csv.gz`.

    Args:
        path: the file; its first column set must hold `t_s`.
        known: names of the numeric columns the channel may have.
        texts: names of the text columns it may have.
        prefixes: numeric columns that start with one of these are known too.
        in_order: refuse times that run backwards.

    Raises:
        ClockError: a time runs backwards.
        DataError: unreadable or empty file, unknown or repeated column, a cell that is not a
            finite number, a line with too few or too many cells, a time that is missing
            or looks like Unix time. The message names file, column, line and time.
    """
    data = _read_bytes(path)
    header = _header(path, data, [*known], texts, prefixes)
    numeric = [name for name in header if name not in texts]
    table = _fast_parse(data, header, numeric)
    if table is None or _is_odd(table, header, numeric, data):
        _check_cells(path, data, header, numeric)
    if table is None:
        raise DataError("cannot be read as a table", file=path, remedy="write plain comma-separated numbers")
    seconds = table["t_s"]
    _check_times(path, seconds, in_order=in_order)
    notes = () if data.endswith(b"\n") else (f"{path.name}: the last line has no line end; was it cut off?",)
    return Table(
        _to_ns(path, data, header, seconds),
        {name: table[name] for name in numeric if name != "t_s"},
        {name: table[name] for name in header if name in texts},
        notes,
    )


def _read_bytes(path: Path) -> bytes:
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"cannot be read: {error}", file=path, remedy="is it complete?") from None
    if len(data) > MAX_BYTES:
        raise DataError(
            f"holds more than {MAX_BYTES // 2**20} MiB", file=path, remedy="split the drive into several logs"
        )
    data = data.removeprefix(b"\xef\xbb\xbf")
    if not data.strip():
        raise DataError("the file is empty", file=path, remedy="remove it, or write at least the header row")
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"not UTF-8 at byte {error.start}", file=path, remedy="save it as UTF-8") from None
    if b"\0" in data:
        raise DataError("holds zero bytes: not a text file", file=path, remedy="write a CSV")
    return data


def _header(
    path: Path, data: bytes, known: list[str], texts: Sequence[str], prefixes: Sequence[str]
) -> list[str]:
    header = [name.strip() for _, cells in _lines(path, data.split(b"\n", 1)[0] + b"\n") for name in cells]
    allowed = ["t_s", *known, *texts]
    for name in header:
        if name in allowed or any(name.startswith(p) and name != p for p in prefixes):
            continue
        close = difflib.get_close_matches(name[:100], allowed, n=1)
        meant = f"did you mean '{close[0]}'? " if close else ""
        listed = ", ".join([*allowed, *(f"{p}<name>" for p in prefixes)])
        raise DataError(f"unknown column '{shown(name)}'", file=path, remedy=f"{meant}allowed: {listed}")
    repeated = [name for i, name in enumerate(header) if name in header[:i]]
    if repeated:
        raise DataError(f"column '{repeated[0]}' comes twice", file=path, remedy="keep one of them")
    if "t_s" not in header:
        raise DataError("column 't_s' is missing", file=path, remedy="add it: seconds from start_ns")
    return header


def _fast_parse(data: bytes, header: list[str], numeric: list[str]) -> dict[str, NDArray[Any]] | None:
    """The columns by pandas' C parser, bit-exact; None when a cell or a line does not parse."""
    import pandas as pd

    dtypes: dict[str, Any] = {name: "float64" if name in numeric else "object" for name in header}
    # pandas before 3.1 rounds its default floats; from 3.1 on they are exact and the option is deprecated.
    old = tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1)
    exact: dict[str, Any] = {"float_precision": "round_trip"} if old else {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            frame = pd.read_csv(
                io.BytesIO(data),
                engine="c",
                header=0,
                names=header,
                index_col=False,
                dtype=dtypes,
                keep_default_na=False,
                na_values={name: [""] for name in numeric},
                skip_blank_lines=True,
                **exact,
            )
    except (ValueError, OverflowError, pd.errors.ParserError, pd.errors.ParserWarning):
        return None
    return {name: frame[name].to_numpy() for name in header}


def _is_odd(table: dict[str, NDArray[Any]], header: list[str], numeric: list[str], data: bytes) -> bool:
    """Whether cells are missing, or may have been made up by the parser: a short line's last text, a truth
    value taken for a number."""
    last = header[-1]
    missing = not all(np.isfinite(table[name]).all() for name in numeric)
    cut = last not in numeric and bool((table[last] == "").any())
    return missing or cut or bool(re.search(rb"(?i)true|false", data))


def _check_cells(path: Path, data: bytes, header: list[str], numeric: list[str]) -> None:
    """Raise for the first line or cell that is neither a finite number nor empty."""
    rows = _lines(path, data)
    next(rows)
    for line, cells in rows:
        if len(cells) != len(header):
            raise DataError(
                f"line {line} has {len(cells)} cells for {len(header)} columns",
                file=path,
                remedy="an unknown value is an empty cell between commas",
            )
        for name, cell in zip(header, cells, strict=True):
            if name in numeric and (cell or name == "t_s") and not _is_finite(cell):
                time_s = cells[header.index("t_s")]
                _bad_cell(path, name, cell, line, float(time_s) if _is_finite(time_s) else None)


def _lines(path: Path, data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every line that is not blank, the header among them."""
    reader = csv.reader(io.StringIO(data.decode("utf-8"), newline=""))
    begun = 1
    try:
        for cells in reader:
            if len(cells) > 1 or "".join(cells).strip(" \t"):
                yield reader.line_num, cells
            begun = reader.line_num + 1
    except csv.Error as error:
        raise DataError(
            f"line {begun} is not a line of a table: {error}",
            file=path,
            remedy="write plain comma-separated numbers, without quotes",
        ) from None


def _is_finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell))) and "_" not in cell
    except ValueError:
        return False


def _bad_cell(path: Path, name: str, cell: str, line: int, time_s: float | None) -> NoReturn:
    cell = shown(cell)
    if name == "t_s" and not cell.strip():
        what, remedy = f"line {line} has no t_s", "every row needs its time"
    elif name == "t_s":
        what, remedy = f"t_s is '{cell}' at line {line}", "give seconds from start_ns"
    else:
        what = f"column '{name}' is '{cell}' at line {line}"
        remedy = "give a finite number, or leave the cell empty where the value is missing"
    raise DataError(what, file=path, time_s=time_s, remedy=remedy)


def read_times(path: Path) -> NDArray[np.int64]:
    """The times of a table as they stand there, in any order; errors as in `read_table`."""
    return read_table(path, (), texts=("fix", "label"), prefixes=("",), in_order=False).t_ns


def _check_times(path: Path, seconds: Array, *, in_order: bool) -> None:
    far = np.flatnonzero(np.abs(seconds) > MAX_T_S)
    if far.size:
        raise DataError(
            f"t_s is {seconds[far[0]]:.9g}, which looks like Unix time",
            file=path,
            remedy="t_s must be seconds from start_ns of meta.yaml",
        )
    back = np.flatnonzero(np.diff(seconds) < 0)
    if back.size and in_order:
        i = int(back[0])
        raise ClockError(
            f"time runs backwards from {seconds[i]:.9f} to {seconds[i + 1]:.9f} s at data row {i + 2}",
            file=path,
            channel="t_s",
            time_s=float(seconds[i]),
            remedy="sort the rows, split the log there, or have the clock repaired (--repair-clock)",
        )


def _to_ns(path: Path, data: bytes, header: list[str], seconds: Array) -> NDArray[np.int64]:
    if not seconds.size or np.abs(seconds).max() < _EXACT_T_S:
        return np.rint(seconds * 1e9).astype(np.int64)
    rows = _lines(path, data)
    next(rows)
    column = header.index("t_s")
    return np.array([seconds_to_ns(cells[column].strip()) for _, cells in rows], dtype=np.int64)
