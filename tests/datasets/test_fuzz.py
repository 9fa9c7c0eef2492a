"""A small fixed part of the fuzzing: `python -m tests.studies run fuzz` is the whole."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CASES = {"readers": 96, "yaml": 30, "live": 0, "cli": 12}


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the fuzzer limits memory as Linux does")
def test_damaged_input_is_used_or_refused(tmp_path: Path) -> None:
    counts = [word for kind, count in CASES.items() for word in (f"--{kind}", str(count))]
    done = subprocess.run(
        [sys.executable, "-m", "tests.studies.fuzz", *counts, "--seed", "7", "--out", str(tmp_path)],
        cwd=ROOT, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f"all {sum(CASES.values())} cases, defects 0" in done.stdout, done.stdout + done.stderr
    (worked,) = map(int, re.findall(r"readers .*worked (\d+)", done.stdout))
    assert 5 < worked < 86, done.stdout  # neither all that harmless nor all refused at the door
