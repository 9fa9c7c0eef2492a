"""`completion`: the script of each shell, and what it makes bash offer."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

ENTRY = "from terrafusion.fusion.cli.main import main; main()"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_for_each_shell(shell: str, terrafusion) -> None:
    done = terrafusion("completion", shell)
    assert (done.status, done.err) == (0, "")
    assert "_TERRAFUSION_COMPLETE=complete_" + shell in done.out
    shell_at = shutil.which(shell)
    if shell_at is not None:
        subprocess.run([shell_at, "-n"], input=done.out, text=True, check=True)


def test_another_shell_is_wrong_usage(terrafusion) -> None:
    assert terrafusion("completion", "tcsh").status == 2


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("terrafusion rep", {"replay"}),
        ("terrafusion terrain tr", {"train"}),
        ("terrafusion replay log --gn", {"--gnss-outage"}),
        ("terrafusion replay log --qu", {"--quiet"}),
    ],
)
def test_what_bash_offers(line: str, offered: set[str]) -> None:
    asked = {
        "COMP_WORDS": line, "COMP_CWORD": str(line.count(" ")), "_TERRAFUSION_COMPLETE": "complete_bash",
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", ENTRY], capture_output=True, text=True, check=True, env=os.environ | asked
    )
    assert set(done.stdout.split()) == offered
