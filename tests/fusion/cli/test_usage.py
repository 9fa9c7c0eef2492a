"""Habits of a command line: `-h`, one line with the nearest match, a fast `--help`."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("reply x", ("no command 'reply'", "did you mean replay?", "terrafusion --help")),
        ("zzz", ("no command 'zzz'", "one of", "inspect")),
        ("policy fitt", ("no command 'fitt'", "did you mean fit?")),
        ("replay x --ot y", ("no option --ot", "did you mean --out?", "terrafusion replay --help")),
        ("inspect x --jsn", ("no option --jsn", "did you mean --json?")),
        ("--versoin", ("no option --versoin", "did you mean --version?")),
        ("replay x --out y --mode magic", ("--mode", "'magic'", "adaptive")),
        ("--quiet inspect x", ("--quiet stands behind the command",)),
        ("inspect", ("LOG", "terrafusion inspect --help")),
    ],
)
def test_wrong_usage_is_one_line_with_the_nearest_match(
    words: str, told: tuple[str, ...], terrafusion
) -> None:
    outcome = terrafusion(*words.split())
    assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1), outcome
    assert outcome.err.startswith("error: ")
    for word in told:
        assert word in outcome.err


@pytest.mark.parametrize("words", ["-h", "replay -h", "terrain -h", "policy fit -h", "", "policy"])
def test_help(words: str, terrafusion) -> None:
    outcome = terrafusion(*words.split())
    assert (outcome.status, outcome.err) == (0, "")
    assert "Usage: terrafusion" in outcome.out
    assert "-h" in outcome.out


def test_help_loads_no_heavy_package() -> None:
    code = (
        "import sys; from terrafusion.fusion.cli.main import main; sys.argv = ['terrafusion', '--help']\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print(sorted({'numpy', 'gtsam', 'casadi', 'pandas', 'matplotlib', 'joblib'} & set(sys.modules)))"
    )
    begun = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert time.monotonic() - begun < 5.0, "0.2 s on an idle machine"
