"""The frame of every `report.html`: one file, nothing in it points outside, there is no script.

Plots are SVG inside the file. Callers escape what comes from a log or from a user.
"""

from __future__ import annotations

import base64
import io
import platform
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING

from terrafusion.datasets.core.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_page(path: Path, title: str, body: Sequence[str]) -> Path:
    """Write the sections of a report to `path`.

    Raises:
        TerrafusionError: the file cannot be written.
    """
    page = _PAGE.format(title=escape(title), css=_stylesheet(), body="\n".join(body))
    return write_atomically(path, lambda part: part.write_text(page, encoding="utf-8"))


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of Python, of this library and of the packages that the numbers depend on."""
    found = {"Python": platform.python_version()}
    for name in ("terrafusion", *packages):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{css}
</style>
</head>
<body>
{body}
</body>
</html>
"""


def where_from(lines: Mapping[str, object], packages: Sequence[str] = ("gtsam", "numpy", "scipy")) -> str:
    """The last section: what the numbers were made of, and the versions they depend on."""
    told = dict(lines)
    told["versions"] = ", ".join(f"{name} {version}" for name, version in versions(packages).items())
    pairs = "".join(
        f"<dt>{escape(str(label))}</dt><dd><code>{escape(str(text))}</code></dd>"
        for label, text in told.items()
    )
    return f"<h2>Where this comes from</h2>\n<dl>{pairs}</dl>"


def bullets(items: Iterable[str]) -> str:
    """A list of items that are HTML already."""
    return f"<ul>{''.join(f'<li>{item}</li>' for item in items)}</ul>"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Collection[int] = ()) -> str:
    """A table with a head a row and a column.

    Args:
        heads: of the columns, plain text.
        rows: cells that are HTML already; the first of a row is its head.
        numbers: columns that are aligned as numbers.
    """

    def line(cells: Sequence[str], tag: str) -> str:
        kinds = [' class="n"' if column in numbers else "" for column in range(len(cells))]
        tags = ["th", *[tag] * (len(cells) - 1)]
        told = (f"<{t}{kind}>{cell}</{t}>" for t, kind, cell in zip(tags, kinds, cells, strict=True))
        return f"<tr>{''.join(told)}</tr>"

    top = line([escape(head) for head in heads], "th")
    body = "".join(line(row, "td") for row in rows)
    return f'<div class="scroll"><table><thead>{top}</thead><tbody>{body}</tbody></table></div>'


def figure(fig: Figure, caption: str) -> str:
    """The figure inside the page; the caption serves as its description too."""
    source = base64.b64encode(_svg(fig)).decode("ascii")
    text = escape(caption)
    return (
        f'<figure><div class="scroll"><img alt="{text}" src="data:image/svg+xml;base64,{source}"></div>'
        f"<figcaption>{text}</figcaption></figure>"
    )


_PATH_DATA = re.compile(rb' d="[^"]*"')
_LONG_NUMBER = re.compile(rb"(\.\d\d)\d+")


def _svg(fig: Figure) -> bytes:
    """The figure as SVG, the same bytes each time, with paths to a hundredth of a point."""
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "terrafusion", "svg.fonttype": "path"}):
        fig.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return _PATH_DATA.sub(lambda found: _LONG_NUMBER.sub(rb"\1", found[0]), buffer.getvalue())


def _stylesheet() -> str:
    return (resources.files("terrafusion.fusion.reports") / "report.css").read_text(encoding="utf-8")
