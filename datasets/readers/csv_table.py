"""One channel's CSV of a log folder: strict header, times exact to the nanosecond."""

import csv
import dataclasses
import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.readers.delimited import Columns, TextLayout, not_a_table, read_columns, read_text

MAX_T_S = 1e9
"""A |t_s| beyond this (32 years) is a Unix time, not seconds from the start."""


@dataclass(frozen=True)
class ChannelColumns:
    """Columns that the table of a channel may have, beside `t_s`.

    Attributes:
        numbers, texts: names of numeric columns and of texts.
        prefixes: numeric columns that start with one of these are known, too.
        required: those that must be there.
    """

    numbers: tuple[str, ...]
    texts: tuple[str, ...] = ()
    prefixes: tuple[str, ...] = ()
    required: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class CsvTable(Columns):
    """The rows of one CSV.

    Attributes:
        t_ns: (N,) int64, from the start of the recording, never decreasing unless asked for otherwise.
        file: name of the file, for notes.
        numbers: (N,) float columns by name; an empty cell is NaN.
        texts: (N,) object columns by name; an empty cell is "".
        notes: what was odd about the file, in sentences.
    """

    t_ns: TimesNs
    file: str

    def __len__(self) -> int:
        return len(self.t_ns)

    def select(self, rows: Any) -> Self:
        """The rows of a boolean mask or index array."""
        return dataclasses.replace(super().select(rows), t_ns=self.t_ns[rows])


def read_table(path: Path, known: ChannelColumns, *, in_order: bool = True) -> CsvTable:
    """Read one channel's `.csv` or `.csv.gz`.

    Args:
        path: the file; its first column set must hold `t_s`.
        in_order: refuse times that run backwards.

    Raises:
        DataError: unreadable or empty file, unknown or repeated column, a cell that is not a
            finite number, a line with too few or too many cells, a time that is missing, runs backwards
            or looks like Unix time. The message names file, column, line and time.
    """
    with errors_of(path):
        return _read(path, known, in_order)


def _read(path: Path, known: ChannelColumns, in_order: bool) -> CsvTable:
    data = read_text(path)
    header = _header(data, known)
    layout = TextLayout(tuple(header), ",", 2, time="t_s", strict=True)
    words = [name for name in header if name in known.texts]
    table = read_columns(path, data, layout, [n for n in header if n not in (*words, "t_s")], ["t_s", *words])
    t_ns = table.times_ns("t_s", remedy="every row needs its time, in seconds from start_ns")
    _check_times(t_ns, in_order=in_order)
    texts = {name: table.texts[name] for name in words}
    return CsvTable(t_ns=t_ns, numbers=table.numbers, texts=texts, file=path.name, notes=table.notes)


def _header(data: bytes, known: ChannelColumns) -> list[str]:
    try:
        header = [name.strip() for name in next(csv.reader([data.split(b"\n", 1)[0].decode()]), [])]
    except csv.Error as error:
        raise not_a_table(1, error) from None
    limits.check_columns(len(header))
    allowed = ["t_s", *known.numbers, *known.texts]
    for name in header:
        if name in allowed or any(name.startswith(p) and name != p for p in known.prefixes):
            continue
        close = difflib.get_close_matches(name[:100], allowed, n=1)
        meant = f"did you mean '{close[0]}'? " if close else ""
        listed = ", ".join([*allowed, *(f"{p}<name>" for p in known.prefixes)])
        raise DataError(f"unknown column '{shown(name)}'", remedy=f"{meant}allowed: {listed}")
    repeated = limits.repeated(header)
    if repeated:
        raise DataError(f"column '{shown(repeated)}' comes twice", remedy="keep one of them")
    if "t_s" not in header:
        raise DataError("column 't_s' is missing", remedy="add it: seconds from start_ns")
    return header


def _check_times(t_ns: TimesNs, *, in_order: bool) -> None:
    far = np.flatnonzero(np.abs(t_ns) > int(MAX_T_S) * 10**9)
    if far.size:
        raise DataError(
            f"t_s is {t_ns[far[0]] * 1e-9:.9g}, which looks like Unix time",
            remedy="t_s must be seconds from start_ns of meta.yaml",
        )
    back = np.flatnonzero(np.diff(t_ns) < 0)
    if back.size and in_order:
        i = int(back[0])
        raise DataError(
            f"time runs backwards from {t_ns[i] * 1e-9:.9f} to {t_ns[i + 1] * 1e-9:.9f} s at row {i + 2}",
            channel="t_s",
            time_s=float(t_ns[i]) * 1e-9,
            remedy="sort the rows, split the log there, or have the clock repaired (--repair-clock)",
        )
