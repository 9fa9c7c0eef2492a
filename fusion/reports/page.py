"""Reports as HTML: each is one file, and nothing in it points outside.

`templates/` holds the text of the reports. Jinja escapes every value that a template shows; figures are drawn
by Bokeh's script, which is inside the file. The same values give the same bytes.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.tables import number

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

LIBRARIES = ("gtsam", "numpy", "scipy")
TWIN_LIBRARIES = ("casadi", "numpy", "scipy")


@dataclass(frozen=True)
class VerdictBox:
    """What a report opens with: `value` is "good", "doubtful" or "not_to_be_used", each reason a sentence."""

    value: str
    title: str
    reasons: Sequence[str]


@dataclass(frozen=True)
class Tile:
    """One of the numbers below the verdict, three at most."""

    label: str
    value: str
    about: str


def write_page(
    path: Path,
    template: str | Path,
    title: str,
    *,
    provenance: Mapping[str, object] | None = None,
    packages: Sequence[str] = LIBRARIES,
    **values: Any,
) -> Path:
    """Write the report that `template` makes of `values` to `path`.

    Args:
        template: name of a file of `templates/`, or the path of another.
        provenance: lines of the last section, which also lists the versions of `packages`.

    Raises:
        TerrafusionError: the file cannot be written.
    """
    versions = ", ".join(f"{name} {version}" for name, version in versions_of(packages).items())
    made_by = dict(provenance or {}) | {"versions": versions}
    pages = _environment()
    if isinstance(template, Path):
        found = pages.from_string(template.read_text("utf-8"))
    else:
        found = pages.get_template(template)
    page = found.render(title=title, provenance=made_by, **values)
    return write_text(path, page)


def write_text(path: Path, text: str) -> Path:
    """Write a text file, which appears when it is whole; a TerrafusionError where that fails."""
    return write_atomically(path, lambda part: part.write_text(text, "utf-8", "backslashreplace"))


def versions_of(packages: Sequence[str]) -> dict[str, str]:
    """Versions of Python, of this library and of `packages`."""
    versions = {"Python": platform.python_version()}
    for name in ("terrafusion", *packages):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("terrafusion.fusion.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "code": _code}
    return environment


def _code(text: str) -> Markup:
    """A sentence whose commands stand in back quotes, as HTML."""
    from markupsafe import Markup, escape

    parts = [escape(part) for part in text.split("`")]
    marked = (Markup("<code>{}</code>").format(part) if i % 2 else part for i, part in enumerate(parts))
    return Markup("").join(marked)
