"""A small fixed part of the fuzzing: `python tests/datasets/fuzz.py --count 2000` is the whole."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the fuzzer limits memory as Linux does")
def test_mutated_files_are_read_or_refused() -> None:
    script = Path(__file__).parent / "fuzz.py"
    done = subprocess.run(
        [sys.executable, str(script), "--count", "112", "--seed", "7"],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    read, defects = map(int, re.findall(r"(\d+) read, (\d+) defects", done.stdout)[0])
    assert defects == 0
    assert 5 < read < 100  # neither all that harmless nor all refused at the door
