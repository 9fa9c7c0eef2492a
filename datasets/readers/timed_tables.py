"""Tables whose rows have times, and their order: refused where time runs backwards, or repaired."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Mask, TimesNs
from terrafusion.datasets.core.clock import RowTimes, repaired_rows
from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.core.recording import ClockJump
from terrafusion.datasets.readers.delimited import (
    BLANKS,
    Columns,
    TextLayout,
    TextTable,
    head_lines,
    number_in,
    read_columns,
    read_text,
    split,
)
from terrafusion.datasets.readers.formats import Request

REPAIR = "sort the rows, split the log there, or have the clock repaired (--repair-clock)"


@dataclass(frozen=True, eq=False, kw_only=True)
class TimedTable(Columns):
    """Columns of a file whose rows have times.

    Attributes:
        t_ns: (N,) int64, as written, in the order of the lines until they are brought `in_time`.
        text, rows: what was read, and which of its rows these are (N,); None where the file is no text.
        start_ns: from which the times in errors count.
    """

    t_ns: TimesNs
    path: Path
    text: TextTable | None = None
    rows: NDArray[np.int64] | None = None
    start_ns: int = 0

    def __len__(self) -> int:
        return len(self.t_ns)

    def select(self, rows: Any) -> Self:
        """The rows of a boolean mask, slice or index array."""
        kept = None if self.rows is None else self.rows[rows]
        return replace(super().select(rows), t_ns=self.t_ns[rows], rows=kept)

    def error(self, row: int, what: str, remedy: str, channel: str | None = None) -> DataError:
        """An error at a row, with its line and time."""
        time_s = (int(self.t_ns[row]) - self.start_ns) * 1e-9
        place = f"row {row + 1}"
        if self.text is not None and self.rows is not None:
            place = f"line {self.text.line(int(self.rows[row]))[0]}"
        return DataError(f"{place}: {what}", file=self.path, channel=channel, time_s=time_s, remedy=remedy)


def read_timed(
    path: Path, data: bytes, layout: TextLayout, numbers: Sequence[str], words: Sequence[str] = ()
) -> TimedTable:
    """As `read_columns`, with the times of the column `layout.time`, in seconds."""
    text = read_columns(path, data, layout, numbers, [layout.time, *words])
    t_ns = text.times_ns(layout.time)
    return TimedTable(
        numbers=text.numbers,
        texts={name: text.texts[name] for name in words},
        notes=text.notes,
        t_ns=t_ns,
        path=path,
        text=text,
        rows=np.arange(len(t_ns)),
        start_ns=0 if layout.strict else int(t_ns[0]),
    )


def read_rows(
    path: Path, columns: Sequence[str], *, separator: str = BLANKS, header: bool = False, comment: str = ""
) -> TimedTable:
    """Read a file of nothing but finite numbers, whose first column is time in seconds.

    Args:
        columns: names of all its columns, the time first.
        header: whether the first line names the columns, in any order.
        comment: character that begins lines without a row; "" for none.

    Raises:
        DataError: unreadable, too large, no rows, a wrong header, a line that has too few or too
            many numbers, a cell that is no finite number, with its line and, where that can be read,
            its time. Times are not checked for order: `in_time` does that.
    """
    with errors_of(path):
        data = read_text(path)
        names = _header(data, columns, separator) if header else tuple(columns)
        layout = TextLayout(names, separator, 2 if header else 1, comment, columns[0])
        table = read_timed(path, data, layout, columns[1:])
        missing = np.argwhere(np.isnan(table.stack(columns[1:])))
        if missing.size:
            assert table.text is not None, "it was read from a text"
            row, k = missing[0].tolist()
            raise table.text.bad_cell(columns[k + 1], row, "give a finite number")
    return table


def _header(data: bytes, columns: Sequence[str], separator: str) -> tuple[str, ...]:
    line = next((line for _, line in head_lines(data, 1)), "")
    names = tuple(split(line, separator))
    if sorted(names) != sorted(columns):
        raise DataError(f"the header is '{shown(line)}'", remedy=f"give {', '.join(columns)}")
    return names


def are_numbers(head: bytes) -> bool:
    """Whether the first line of a file is numbers between blanks."""
    cells = next((line.split() for _, line in head_lines(head, 1)), [])
    return bool(cells) and all(number_in(cell) is not None for cell in cells)


def in_time(
    tables: Mapping[str, TimedTable], *, repair_clock: bool
) -> tuple[dict[str, TimedTable], tuple[ClockJump, ...], list[str]]:
    """Tables of channels that may share a clock, brought into order of time.

    Returns:
        The tables by channel, the steps of the clock that were taken out, and notes.

    Raises:
        DataError: a time runs backwards, and `repair_clock` is not asked for.
    """
    if not repair_clock:
        for name, table in tables.items():
            row = _backwards(table.t_ns)
            if row is not None:
                raise table.error(row, _runs_back(table.t_ns, row), REPAIR, name)
        return dict(tables), (), []
    found = repaired_rows({name: table.t_ns for name, table in tables.items()})
    out = {name: replace(tables[name].select(own.order), t_ns=own.t_ns) for name, own in found.items()}
    jumps = tuple(jump for own in found.values() for jump in own.jumps)
    return out, jumps, [note for own in found.values() for note in own.notes]


def new_times(t_ns: TimesNs) -> Mask:
    """Mask (N,) of the rows that do not repeat the time of the row before."""
    return np.diff(t_ns, prepend=t_ns[:1] - 1) > 0


def row_times(request: Request, channel: str, t_ns: TimesNs) -> RowTimes:
    """The times of a file's rows (N,), in their order, as a recording needs them; errors name the channel.

    Raises:
        DataError: time runs backwards, and no repair was asked for or none is possible.
    """
    row = _backwards(t_ns)
    if row is None:
        return RowTimes(t_ns)
    if not request.repair_clock:
        what = f"{_runs_back(t_ns, row)} after row {row}"
        time_s = (int(t_ns[row - 1]) - int(t_ns[0])) * 1e-9
        raise DataError(what, channel=channel, time_s=time_s, remedy=REPAIR)
    return repaired_rows({channel: t_ns})[channel]


def _backwards(t_ns: TimesNs) -> int | None:
    """The first row whose time is before that of the row above; None where all are in order."""
    back = np.flatnonzero(t_ns[1:] < t_ns[:-1])  # a difference could overflow
    return int(back[0]) + 1 if back.size else None


def _runs_back(t_ns: TimesNs, row: int) -> str:
    return f"time runs backwards by {(int(t_ns[row - 1]) - int(t_ns[row])) * 1e-9:.6f} s"
