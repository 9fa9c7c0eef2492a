"""How results show themselves in a notebook."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

CLOCK_COLUMNS = ("channel", "rows", "rate, Hz", "from, s", "to, s")


def clock_rows(clocks: Mapping[str, NDArray[np.int64]], start_ns: int) -> list[tuple[str, ...]]:
    """The cells of `CLOCK_COLUMNS` for each clock, by name of its channel."""
    rows = []
    for name, t_ns in clocks.items():
        first, last = (int(t) for t in t_ns[[0, -1]])
        rate = f"{(len(t_ns) - 1) / ((last - first) * 1e-9):.1f}" if last > first else "-"
        rows.append((name, str(len(t_ns)), rate, *(f"{(t - start_ns) * 1e-9:.1f}" for t in (first, last))))
    return rows


def clock_line(row: tuple[str, ...]) -> str:
    """One of `clock_rows` as a line of text."""
    name, count, rate, first, last = row
    return f"  {name:13s}{count:>9s} rows {rate:>8s} Hz  {first} to {last} s"


def table_html(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A title and a table as HTML; every cell is escaped."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<p>{escape(title)}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def text_html(text: str) -> str:
    """Lines of text as HTML, as they stand."""
    return f"<pre>{escape(text)}</pre>"
