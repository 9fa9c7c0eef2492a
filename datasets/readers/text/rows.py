"""Files of nothing but numbers, one row a time, of known columns; times in order, repaired, or refused."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimeRows, TimesNs
from terrafusion.datasets.core.clock import RowTimes, repaired_rows
from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.core.recording import ClockJump
from terrafusion.datasets.readers.delimited import (
    BLANKS,
    TextLayout,
    head_lines,
    read_columns,
    read_text,
    split,
)
from terrafusion.datasets.readers.formats import Request

REPAIR = "sort the rows, split the log there, or have the clock repaired (--repair-clock)"
MAX_T_NS = 4 * 10**18
"""A time beyond this (year 2096) is none of a recording, and differences of times stay within 64 bits."""


@dataclass(frozen=True, eq=False)
class NumberRows(TimeRows):
    """What a file holds.

    Attributes:
        t_ns: (N,) int64, as written, in the order of the lines.
        values: (N, k) of the other columns, all finite.
        lines: (N,) line numbers where no line is blank or a comment.
        notes: what was odd about the file, in sentences.
    """

    path: Path
    t_ns: TimesNs
    values: Array
    lines: NDArray[np.int64]
    notes: tuple[str, ...] = ()

    def error(self, row: int, what: str, remedy: str) -> DataError:
        """An error at a row, with its line and the seconds since the first row."""
        time_s = (int(self.t_ns[row]) - int(self.t_ns[0])) * 1e-9
        return DataError(f"line {self.lines[row]}: {what}", file=self.path, time_s=time_s, remedy=remedy)


def read_rows(
    path: Path, columns: Sequence[str], *, separator: str = BLANKS, header: bool = False, comment: str = ""
) -> NumberRows:
    """Read a file whose first column is time in seconds.

    Args:
        columns: names of all its columns, the time first.
        header: whether the first line names the columns, in any order.
        comment: character that begins lines without a row; "" for none.

    Raises:
        DataError: unreadable, too large, no rows, a wrong header, a line that has too few or too
            many numbers, a cell that is no finite number, with its line and, where that can be read,
            its time. Times are not checked for order: `put_in_time` does that.
    """
    with errors_of(path):
        data = read_text(path)
        names = _header(data, columns, separator) if header else tuple(columns)
        layout = TextLayout(names, separator, 2 if header else 1, comment, columns[0])
        table = read_columns(path, data, layout, columns[1:], texts=columns[:1])
        t_ns = table.times_ns(columns[0])
        values = table.stack(columns[1:])
        missing = np.argwhere(np.isnan(values))
        if missing.size:
            raise table.bad_cell(columns[int(missing[0, 1]) + 1], int(missing[0, 0]), "give a finite number")
    return NumberRows(path, t_ns, values, np.arange(len(t_ns)) + layout.first_line, table.notes)


def put_in_time(
    parts: Mapping[str, NumberRows], *, repair_clock: bool
) -> tuple[dict[str, NumberRows], tuple[ClockJump, ...], tuple[str, ...]]:
    """NumberRows of channels that may share a clock, brought into order of time.

    Returns:
        The rows by channel, the steps of the clock that were taken out, and notes.

    Raises:
        DataError: a time runs backwards, and `repair_clock` is not asked for.
    """
    for rows in parts.values():
        far = np.flatnonzero(np.abs(rows.t_ns) > MAX_T_NS)
        if far.size:
            what = f"the time is {rows.t_ns[far[0]] * 1e-9:.9g} s"
            raise rows.error(int(far[0]), what, "give a time in seconds")
    if not repair_clock:
        for name, rows in parts.items():
            back = np.flatnonzero(np.diff(rows.t_ns) < 0)
            if back.size:
                by_s = (rows.t_ns[back[0]] - rows.t_ns[back[0] + 1]) * 1e-9
                what = f"the time of {name} runs backwards by {by_s:.6f} s"
                raise rows.error(int(back[0]) + 1, what, REPAIR)
        return dict(parts), (), ()
    found = repaired_rows({name: rows.t_ns for name, rows in parts.items()})
    out = {n: dataclasses.replace(parts[n].select(own.order), t_ns=own.t_ns) for n, own in found.items()}
    jumps = tuple(jump for own in found.values() for jump in own.jumps)
    return out, jumps, tuple(note for own in found.values() for note in own.notes)


def are_numbers(head: bytes) -> bool:
    """Whether the first line of a file is numbers between blanks."""
    cells = next((line.split() for _, line in head_lines(head, 1)), [])
    try:
        return bool(np.isfinite([float(cell) for cell in cells]).all()) and bool(cells)
    except ValueError:
        return False


def _header(data: bytes, columns: Sequence[str], separator: str) -> tuple[str, ...]:
    line = next((line for _, line in head_lines(data, 1)), "")
    names = tuple(split(line, separator))
    if sorted(names) != sorted(columns):
        raise DataError(f"the header is '{shown(line)}'", remedy=f"give {', '.join(columns)}")
    return names


def row_times(request: Request, channel: str, t_ns: TimesNs) -> RowTimes:
    """The times of a file's rows (N,), in their order, as a recording needs them; errors name the channel.

    Raises:
        DataError: time runs backwards, and no repair was asked for or none is possible.
    """
    back = np.flatnonzero(t_ns[1:] < t_ns[:-1])
    if not back.size:
        return RowTimes(t_ns)
    if not request.repair_clock:
        i = int(back[0])
        what = f"time runs backwards by {(int(t_ns[i]) - int(t_ns[i + 1])) * 1e-9:.6f} s after row {i + 1}"
        raise DataError(what, channel=channel, time_s=(int(t_ns[i]) - int(t_ns[0])) * 1e-9, remedy=REPAIR)
    return repaired_rows({channel: t_ns})[channel]
