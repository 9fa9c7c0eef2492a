"""The structure that docs/explanation/architecture.md draws: imports flow one way, files stay small."""

from __future__ import annotations

import ast
import statistics
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from tests.architecture import PAGE, ROOT, drawn, imports, modules, tree


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
            node.module or "" for node in ast.walk(tree(path)) if isinstance(node, ast.ImportFrom)
        )


def test_the_drawing_is_of_these_imports() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert text == drawn(text), "run: python -m tests.architecture --write"


def test_no_two_public_classes_share_a_name() -> None:
    homes: dict[str, list[str]] = {}
    for name, path in modules().items():
        for node in tree(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(name)
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}
