"""Tables as text and as Markdown, and numbers in them. Cells are strings."""

import math
from collections.abc import Collection, Sequence

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
