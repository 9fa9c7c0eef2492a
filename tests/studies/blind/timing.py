"""How long a diagnosis takes: trials of a development site, each diagnosed from nothing.

    python -m tests.studies.blind.timing --site 8 --trials 1 4 8 13 19 --jobs 2

Three runs and 20 references of 60 s, a drive of its own each, as in a full blind check. The first trial is
diagnosed once more before, for the graphs that are compiled and loaded then.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.blind.plan import VEHICLE
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from tests.studies.blind.development import RUNS, site, specs

REFERENCES = 20
"""As many as a trial of the blind check has."""

Judge = Callable[[Sequence[Recording], Sequence[Recording], VehicleParams], Any]


def trials_of(
    number: int, trials: Sequence[int], references: int = REFERENCES
) -> tuple[list[list[Recording]], list[Recording]]:
    """Runs of some trials of a site, and its references."""
    from terrafusion.twin.gap.blind.plant.run import record

    every = specs(number, references)
    wanted = [every[RUNS * t + i] for t in trials for i in range(RUNS)]
    recordings = record(wanted + every[len(every) - references :])
    split = len(wanted)
    return [recordings[i : i + RUNS] for i in range(0, split, RUNS)], recordings[split:]


def timed(
    judge: Judge, runs: Sequence[Sequence[Recording]], references: Sequence[Recording]
) -> Iterator[tuple[float, float, Any]]:
    """Seconds on the clock and of the processor that each trial takes, and its answer."""
    vehicle = load_vehicle(VEHICLE)
    for some in runs:
        clock, processor = time.perf_counter(), time.process_time()
        found = judge(some, references, vehicle)
        yield time.perf_counter() - clock, time.process_time() - processor, found


def main() -> None:
    """Print a line a trial."""
    from terrafusion.twin.gap.diagnose import diagnose

    parser = argparse.ArgumentParser(description="How long a diagnosis takes.")
    parser.add_argument("--site", type=int, required=True)
    parser.add_argument("--trials", type=int, nargs="+", default=[0])
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    runs, references = trials_of(given.site, given.trials)
    judge = functools.partial(diagnose, jobs=given.jobs)
    kind, soil, shapes = site(given.site)
    print(f"{kind} drives on {soil}, {RUNS} runs, {len(references)} references")
    list(timed(judge, runs[:1], references))
    for trial, (clock, processor, found) in zip(given.trials, timed(judge, runs, references), strict=True):
        shape, severity = shapes[trial]
        what = "null" if shape is None else f"{shape.key} {severity:g}"
        named = " ".join(found.verdict.named)
        print(f"{what}: {clock:.1f} s, processor {processor:.1f} s: {found.verdict.kind} {named}", flush=True)


if __name__ == "__main__":
    main()
