"""Names that no terminal and no encoding likes, links to nothing, pipes in place of files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from terrafusion.datasets.core.printable import printable

MAIN = "from terrafusion.fusion.cli.main import main; main()"
ESC = "\x1b[31m"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\tb\n", "a\tb\n"),
        ("\x1b[31m", "\\x1b[31m"),
        ("é😀", "é😀"),
        ("\udcff", "\\udcff"),
        ("\u202e", "\\u202e"),
    ],
)
def test_what_a_terminal_would_obey_is_shown(text: str, shown: str) -> None:
    assert printable(text) == shown


def copied(log: Path, name: str, tmp_path: Path) -> Path:
    return Path(shutil.copytree(log, tmp_path / name))


@pytest.mark.parametrize("name", ["bad\udcff\udcfename", f"esc{ESC}red"])
def test_a_folder_of_odd_name_is_replayed(name: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    log, out = copied(good_log, name, tmp_path), tmp_path / f"out-{name}"
    done = terrafusion("replay", log, "--out", out)
    assert done.status == 0, done.err
    assert ESC not in done.out + done.err
    assert json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert (out / "report.html").is_file()
    done = terrafusion("inspect", tmp_path / f"none{ESC}")
    assert ESC not in done.refused("no such file", "\\x1b[31m")


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("name", ["sh\\eort\\e[31m", "sh\\uD800ort"])
def test_a_name_in_meta_is_printed_with_escapes(
    name: str, good_log: Path, tmp_path: Path, terrafusion
) -> None:
    log = copied(good_log, "log", tmp_path)
    meta = (log / "meta.yaml").read_text(encoding="utf-8").splitlines()
    meta = [f'name: "{name}"', *(line for line in meta if not line.startswith("name:"))]
    (log / "meta.yaml").write_text("\n".join(meta), encoding="utf-8")
    for words in (("inspect", log), ("replay", log, "--out", tmp_path / "out")):
        done = terrafusion(*words)
        assert done.status == 0, done.err
        assert "\x1b" not in done.out + done.err


def test_an_ascii_locale_will_do(good_log: Path, tmp_path: Path) -> None:
    log = copied(good_log, "café", tmp_path)
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
    for words in (["inspect", log], ["replay", log, "--out", tmp_path / "été"]):
        done = subprocess.run(
            [sys.executable, "-c", MAIN, *words], env=os.environ | plain, capture_output=True, timeout=120
        )
        assert done.returncode == 0, done.stderr


def test_a_link_to_nothing_is_no_absent_channel(good_log: Path, tmp_path: Path, terrafusion) -> None:
    log = copied(good_log, "log", tmp_path)
    (log / "gnss.csv").unlink()
    (log / "gnss.csv").symlink_to("/nowhere/gnss.csv")
    assert terrafusion("inspect", log).refused("gnss.csv", "link to nothing")


@pytest.mark.parametrize("name", ["gnss.csv", "strange"])
def test_a_pipe_in_a_log_is_not_waited_for(name: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    log = copied(good_log, "log", tmp_path)
    (log / name).unlink(missing_ok=True)
    os.mkfifo(log / name)
    assert terrafusion("inspect", log).refused(name, "neither a file nor a folder")
