"""Parameter files as YAML 1.2: what is read, and what is refused before it can hang a reader."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.yaml_file import read_yaml

ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 30)
)
MERGES = "m0: &m0 {k0: 0}\n" + "".join(
    f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 9)}]}}\n" for k in range(1, 20)
)


def read(folder: Path, text: str) -> dict[str, Any]:
    (folder / "p.yaml").write_text(text, encoding="utf-8")
    return read_yaml(folder / "p.yaml")


def test_values_are_those_of_yaml_1_2(tmp_path: Path) -> None:
    text = "a: 1e-3\nb: 0x10\nc: 0o17\nd: yes\ne: ~\nf: -.inf\ng: 2024-05-01\nh: '5'\n"
    text += "i: [1, 2.5, true]\nj: &x {k: 1}\nl: *x\n"
    assert read(tmp_path, text) == {
        "a": 0.001, "b": 16, "c": 15, "d": "yes", "e": None, "f": float("-inf"), "g": "2024-05-01", "h": "5",
        "i": [1, 2.5, True], "j": {"k": 1}, "l": {"k": 1},
    }  # fmt: skip
    assert read(tmp_path, "") == read(tmp_path, "# nothing\n") == {}
    assert read(tmp_path, "'<<': 1\na: !!str 5\n") == {"<<": 1, "a": "5"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2\n", "line 2: the key 'a' is there twice"),
        ("a: &a {b: 1}\nc: {<<: *a}\n", "line 2: merge keys '<<' are not allowed; write the keys out"),
        (MERGES, "merge keys"),
        (ALIASES, "more than 50000 values; aliases count as what they stand for"),
        ("a: &a [*a]\n", "nested more than 32 deep, or inside itself"),
        ("a: *b\n", "undefined alias"),
        ("a: " + "[" * 100 + "]" * 100, "nested more than 32 deep"),
        ("a: " + "{a: " * 100 + "}" * 100, "nested more than 32 deep"),
        ("a: !!python/name:os.system\n", "the tag .* is not known here"),
        ("a: !my 5\n", "the tag !my is not known here"),
        ("a: !my [5]\n", "the tag !my is not known here"),
        ("? [1, 2]\n: 3\n", "a key must be a plain value"),
        ("a: 1\n---\nb: 2\n", "found another document"),
        ("a: [1\n", "not valid YAML"),
        ("a: !!int x\n", "not valid YAML"),
        ("a: " + "1" * 5000, "not valid YAML"),
        ("- 1\n", "the top level must be a mapping"),
        ("5: x\n", "the top level must be a mapping"),
        ("a: " + "x" * 300_000, "more than 256 KiB"),
    ],
)
def test_what_is_refused_is_refused_soon_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    begun = time.process_time()
    with pytest.raises(ConfigError, match=message) as caught:
        read(tmp_path, text)
    assert time.process_time() - begun < 2.0
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / "p.yaml"))


def test_all_yaml_is_read_by_this_reader() -> None:
    """Others write YAML with the library, but read it here, where it is bounded."""
    root = Path(__file__).parents[3]
    files = [file for name in ("datasets", "twin", "fusion") for file in (root / name).rglob("*.py")]
    texts = {file.name: file.read_text(encoding="utf-8") for file in files}
    users = {
        name for name, text in texts.items() if "import YAML" in text and re.search(r"\.load(_all)?\(", text)
    }
    assert len(files) > 300
    assert users <= {"yaml_file.py"}
