"""The library's files, what each imports, and the drawing of it in docs/explanation/architecture.md.

`python -m tests.architecture --write` draws anew.
"""

from __future__ import annotations

import ast
import re
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("datasets", "twin", "fusion")
PAGE = ROOT / "docs" / "explanation" / "architecture.md"
DRAWING = re.compile(r"(<!-- drawing:start -->\n).*?(<!-- drawing:end -->)", re.DOTALL)


@cache
def modules() -> dict[str, Path]:
    """Files of the library by module name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if parts[:2] == ("fusion", "_root"):
                parts = parts[2:]
            name = ".".join(("terrafusion", *(p for p in parts if p != "__init__")))
            found[name] = path
    return found


@cache
def tree(path: Path) -> ast.Module:
    """A file as parsed."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path: Path) -> frozenset[str]:
    """Modules of the library that a file imports anywhere: at its top, in a function or for types only."""
    known, found = modules(), set[str]()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name in known}
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inside & known.keys() or {node.module}
    return frozenset(found)


def room(module: str) -> str:
    """The folder of a module below its package; files beside the folders are rooms of their own."""
    parts = module.removeprefix("terrafusion").lstrip(".").split(".")
    return ".".join(parts[:2]) if parts[0] in PACKAGES else "terrafusion"


def rooms() -> dict[str, set[str]]:
    """Each room, and the rooms that it imports; the package files that hold nothing are left out."""
    graph: dict[str, set[str]] = {}
    for name, path in modules().items():
        if room(name) in PACKAGES:
            continue
        others = {room(other) for other in imports(path)} - {room(name), *PACKAGES}
        graph.setdefault(room(name), set()).update(others)
    return graph


def reduced(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The arrows that no longer path replaces (transitive reduction)."""
    below: dict[str, set[str]] = {}
    for name in TopologicalSorter(graph).static_order():
        below[name] = set().union(*({other} | below[other] for other in graph.get(name, ())))
    return {
        name: {one for one in others if not any(one in below[other] for other in others)}
        for name, others in graph.items()
    }


def mermaid() -> str:
    """The rooms and their arrows as a Mermaid drawing: an arrow points at what is used."""
    lines = ["```mermaid", "flowchart BT"]
    for package in PACKAGES:
        lines.append(f"    subgraph {package}")
        lines += [
            f"        {name.replace('.', '_')}[{name.split('.')[1]}]"
            for name in sorted(rooms())
            if name.startswith(f"{package}.")
        ]
        lines.append("    end")
    for name, others in sorted(reduced(rooms()).items()):
        lines += [f"    {name.replace('.', '_')} --> {other.replace('.', '_')}" for other in sorted(others)]
    return "\n".join([*lines, "```", ""])


def drawn(text: str) -> str:
    """The page with the drawing of today's imports."""
    return DRAWING.sub(lambda match: match[1] + mermaid() + match[2], text)


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        raise SystemExit(__doc__)
    PAGE.write_text(drawn(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
