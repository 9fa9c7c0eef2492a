"""The page on log checks lists every code that a check can give, and quotes the thresholds of the code."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from terrafusion.datasets import checks

TEXT = (Path(__file__).parents[3] / "docs" / "reference" / "log-checks.md").read_text(encoding="utf-8")
MODULES = [f"{checks.__name__}.{module.name}" for module in pkgutil.iter_modules(checks.__path__)]


def codes_of(module_name: str) -> Iterator[tuple[str, int]]:
    """First arguments of every `Finding(...)` in a module; those of a table are all its values."""
    module = importlib.import_module(module_name)
    assert module.__file__ is not None
    for node in ast.walk(ast.parse(Path(module.__file__).read_text(encoding="utf-8"))):
        if not (isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding"):
            continue
        code = node.args[0]
        if isinstance(code, ast.Constant):
            yield code.value, node.lineno
        else:
            assert isinstance(code, ast.Subscript), f"{module_name}, line {node.lineno}: no code to read"
            assert isinstance(code.value, ast.Name)
            for value in getattr(module, code.value.id).values():
                yield value, node.lineno


def test_every_code_is_listed_and_no_other() -> None:
    given = {code for name in MODULES for code, _ in codes_of(name)}
    listed = re.findall(r"^\| `([a-z-]+)` (?:error|warning)", TEXT, re.MULTILINE)
    assert len(listed) == len(set(listed))
    assert set(listed) == given


QUOTED = re.findall(r"`(\w+)\.([A-Z][A-Z0-9_]*)`(?: (-?[\d.]+(?:e-?\d+)?))?", TEXT)


@pytest.mark.parametrize(("module", "name", "value"), QUOTED)
def test_thresholds_are_those_of_the_code(module: str, name: str, value: str) -> None:
    found = getattr(importlib.import_module(f"{checks.__name__}.{module}"), name)
    if value:
        assert float(value) == pytest.approx(float(found))
