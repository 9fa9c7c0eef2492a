"""Tables as text, Markdown and HTML, and numbers in them. Cells are strings."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line imports this file first
    from terrafusion.datasets.core.arrays import TimesNs

Rows = Sequence[Sequence[str]]


def number(value: float | None, digits: int = 3) -> str:
    """`value` with `digits` significant digits, without an exponent where possible; a dash for None."""
    if value is None:
        return "–"
    if isinstance(value, int) or value == 0.0:
        return f"{value:,.0f}".replace(",", "\u202f")
    if not 1e-5 <= abs(value) < 1e7:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{decimals}f}".replace(",", "\u202f")


def text_table(heads: Sequence[str], rows: Rows, *, right: Collection[int] = (), gap: int = 2) -> list[str]:
    """Lines of aligned columns below `heads`; the columns `right` are aligned to the right."""
    lines = [heads, *rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(heads))]
    return [
        (" " * gap)
        .join(
            cell.rjust(width) if k in right else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        .rstrip()
        for line in lines
    ]


def markdown_table(heads: Sequence[str], rows: Rows) -> list[str]:
    """Lines of a Markdown table; bars in cells are escaped."""
    top, *body = [
        "| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in [heads, *rows]
    ]
    return [top, "|" + " --- |" * len(heads), *body]


CLOCK_COLUMNS = ("channel", "rows", "rate, Hz", "from, s", "to, s")


def clock_rows(clocks: Mapping[str, TimesNs], start_ns: int) -> list[tuple[str, ...]]:
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


def clock_table_html(title: str, rows: Iterable[Sequence[str]]) -> str:
    """A title and `clock_rows` as HTML; every cell is escaped."""
    head = "".join(f"<th>{escape(text)}</th>" for text in CLOCK_COLUMNS)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<p>{escape(title)}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def text_html(text: str) -> str:
    """Lines of text as HTML, as they stand."""
    return f"<pre>{escape(text)}</pre>"
