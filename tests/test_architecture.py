"""The structure that docs/explanation/architecture.md draws: imports flow one way, files stay small."""

from __future__ import annotations

import ast
import statistics
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("datasets", "twin", "fusion")


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


def imports(path: Path) -> set[str]:
    """Modules of the library that a file imports anywhere: at its top, in a function or for types only."""
    known, found = modules(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name in known}
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inside & known.keys() or {node.module}
    return found


def assert_no_circle(graph: dict[str, set[str]]) -> None:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        raise AssertionError(" -> ".join(error.args[1])) from None


def test_no_file_imports_one_that_imports_it() -> None:
    assert_no_circle({name: imports(path) - {name} for name, path in modules().items()})


def test_no_folder_imports_one_that_imports_it() -> None:
    folder = {name: path.parent.relative_to(ROOT).as_posix() for name, path in modules().items()}
    graph: dict[str, set[str]] = {}
    for name, path in modules().items():
        others = {folder[other] for other in imports(path)} - {folder[name]}
        graph.setdefault(folder[name], set()).update(others)
    assert_no_circle(graph)


def test_the_import_contracts_hold() -> None:
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_files_are_small() -> None:
    lines = {p: p.read_text(encoding="utf-8").count("\n") for p in modules().values()}
    assert {str(p): n for p, n in lines.items() if n > 450} == {}
    assert statistics.median(n for p, n in lines.items() if p.name != "__init__.py") <= 200


def test_nothing_shipped_imports_a_test_or_a_study() -> None:
    for path in modules().values():
        assert "tests." not in "".join(
            node.module or ""
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom)
        )
