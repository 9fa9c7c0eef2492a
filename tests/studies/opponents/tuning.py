"""Tunes the opponents: one noise for all logs, by a grid over the tuning half of them.

    python -m tests.studies.opponents.tuning --split     writes split.json, before anything is fitted
    python -m tests.studies.opponents.tuning --out DIR   writes tuned.json; goes on where it was stopped

Score of a noise: geometric mean over drives of the median error in outages of 30 s, or 10 s on short drives.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from terrafusion.fusion.benchmark.outage_plan import until
from tests.studies.opponents.drives import Drive, default_logs, drives_of, longest, vehicle_of
from tests.studies.opponents.estimators import TUNED, TUNED_OPPONENTS, grid, noise_of, rows_of
from tests.studies.opponents.inertial import Inertial
from tests.studies.parts import Task, TaskWorkers, code_of, result_of, run_all

SPLIT = Path(__file__).with_name("split.json")
LENGTHS_S = (30.0, 10.0)
MOST_S = 120.0
"""Of each drive, for the time that a grid takes."""
LEAST_M = 0.01
"""Smaller medians count as this: no noise is chosen for millimetres."""


def split(names: list[str]) -> dict[str, list[str]]:
    """Every second log of a set is for tuning, the first of them where a set has one log."""
    halves: dict[str, list[str]] = {"tuning": [], "held_out": []}
    for set_name in sorted({name.partition("/")[0] for name in names}):
        mine = sorted(name for name in names if name.startswith(f"{set_name}/"))
        halves["tuning"] += mine[::2]
        halves["held_out"] += mine[1::2]
    return halves


_DRIVES: list[tuple[Drive, Inertial]] = []


def score(work: tuple[str, dict[str, float]]) -> float:
    """Geometric mean over drives of an opponent's median error with one noise, m."""
    name, values = work
    logs: list[float] = []
    for _, inputs in _DRIVES:
        for seconds in LENGTHS_S:
            rows = rows_of(name, inputs, seconds, noise_of(name, values))
            if rows:
                logs.append(float(np.log(max(LEAST_M, np.median([r.error_m for r in rows])))))
                break
    return float(np.exp(np.mean(logs)))


def tune(folder: Path, jobs: int) -> dict[str, dict[str, object]]:
    """Best noise of each opponent, and how it compares with the others; results are kept in a folder."""
    for name in json.loads(SPLIT.read_text(encoding="utf-8"))["tuning"]:
        for drive in longest(drives_of(name), 1):
            recording = until(drive.recording, MOST_S)
            inputs = Inertial.of(recording, vehicle_of(recording, None))
            if inputs is not None:
                _DRIVES.append((drive, inputs))
    code = code_of(
        *(SPLIT.with_name(f"{n}.py") for n in ("ekf", "smoother", "ins", "inertial", "drives")), SPLIT
    )
    tasks = [
        Task(f"{name} {values}", code, (name, values)) for name in TUNED_OPPONENTS for values in grid(name)
    ]
    run_all(tasks, score, folder, TaskWorkers(jobs))
    best: dict[str, dict[str, object]] = {}
    for name in TUNED_OPPONENTS:
        scores = sorted(
            (result_of(t, folder), list(grid(name)).index(t.what[1])) for t in tasks if t.what[0] == name
        )
        best[name] = {
            "noise": list(grid(name))[scores[0][1]],
            "score_m": round(scores[0][0], 3),
            "worst_m": round(scores[-1][0], 3),
            "tried": len(scores),
        }
    return best


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.opponents.tuning",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--split", action="store_true", help="write the split alone")
    parser.add_argument("--out", type=Path, default=Path("studies-work/tuning"), help="folder for parts")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    if given.split:
        SPLIT.write_text(json.dumps(split(default_logs()), indent=1) + "\n", encoding="utf-8")
        return 0
    best = tune(given.out, given.jobs)
    TUNED.write_text(json.dumps({"opponents": best}, indent=1) + "\n", encoding="utf-8")
    for name, found in best.items():
        print(f"{name}: {found}")
    return 0


if __name__ == "__main__":
    from tests.studies.opponents import tuning

    sys.exit(tuning.main())
