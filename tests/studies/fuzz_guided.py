"""Fuzzing of the readers, guided by the lines that an input reaches: does any end in a defect?

    python -m tests.studies.fuzz_guided --cases 600 --out OUT

Half of the cases mutate samples; the other half mutate those inputs, too, that reached lines of the readers
which none before had reached. Each half counts its lines, so that the gain of the guidance shows. Inputs
that end in anything but a log or a known error of one line are kept in OUT.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from terrafusion import datasets
from tests.datasets.fuzz import examined, limit_memory, mutated
from tests.datasets.fuzz_samples import write_samples

HANG_S = 60.0
"""Processor time of a case, traced line by line."""
NEW_SHARE = 0.7
"""Share of guided cases that mutate an input which reached something new."""
FOLLOWED = tuple(str(Path(datasets.__file__).parent / part) for part in ("readers", "core"))
Line = tuple[str, int]


def lines_of(task: Callable[[], int]) -> tuple[int, set[Line]]:
    """What a task gives, and the lines of the readers that it ran."""
    seen: set[Line] = set()

    def in_frame(frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            seen.add((frame.f_code.co_filename, frame.f_lineno))
        return in_frame

    def called(frame: FrameType, *_: Any) -> Any:
        return in_frame if frame.f_code.co_filename.startswith(FOLLOWED) else None

    sys.settrace(called)
    try:
        return task(), seen
    finally:
        sys.settrace(None)


def outcome(path: Path) -> tuple[int, set[Line]]:
    """Status of a look at an input, as of `fuzz.OUTCOMES`, and the lines it reached; what hangs crashes."""

    def late(*_: Any) -> None:
        raise TimeoutError

    signal.signal(signal.SIGVTALRM, late)
    signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S)
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            return lines_of(lambda: examined(path, repair_clock=False))
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)


def fuzzed(cases: int, seed: int, out: Path, guided: bool) -> tuple[int, int, list[Path]]:
    """Lines reached, inputs that reached new ones, and inputs that end in a defect."""
    samples, seen = write_samples(out / "samples"), set[Line]()
    for _ in range(2):  # the first time also imports the readers
        seen = {line for sample in samples for line in outcome(sample / (sample / ".open").read_text())[1]}
    kept: list[Path] = []
    bad: list[Path] = []
    for i in range(cases):
        rng = np.random.default_rng([seed, i])
        pool = kept if guided and kept and rng.random() < NEW_SHARE else samples
        case = out / "cases" / str(i)
        status, lines = outcome(mutated(rng, pool[int(rng.integers(len(pool)))], case))
        (folder,) = case.iterdir()
        if status > 1:
            bad.append(folder)
        elif lines - seen:
            kept.append(folder)
        else:
            shutil.rmtree(case)
        seen |= lines
    return len(seen), len(kept), bad


def main() -> int:
    """Print the counts of both halves."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--cases", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    limit_memory()
    sys.path.insert(0, str(Path(__file__).parents[1] / "datasets"))
    defects: list[Path] = []
    for name in ("blind", "guided"):
        shutil.rmtree(given.out / name, ignore_errors=True)
        count = given.cases // 2
        lines, new, bad = fuzzed(count, given.seed, given.out / name, guided=name == "guided")
        print(f"{name:6s} {count} cases: {lines} lines reached, {new} inputs reached new ones", flush=True)
        defects += bad
    print(f"all {given.cases // 2 * 2} cases, defects {len(defects)}")
    for path in defects:
        print(f"- {path}")
    return int(bool(defects))


if __name__ == "__main__":
    sys.exit(main())
