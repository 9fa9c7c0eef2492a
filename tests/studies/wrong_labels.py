"""What do right and wrong labels of the ground cost, where wheels and IMU check them?

    python -m tests.studies.wrong_labels [--seeds N]

Mixed ground of the benchmark, 60 s without fixes, by the twin's laws and by others: error inside the outage
with true, shuffled and adversarial labels over that of mode "fixed", paired by drive. "unseen": the same of
robots that no terrain model knows, on drives of `found_grounds` over mixed ground. Development used the
development's seeds of both.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.fusion.benchmark.methods import METHODS, true_labels
from terrafusion.fusion.benchmark.run_score import score_run
from terrafusion.fusion.benchmark.twin_runs import FIRST_SEED, BenchmarkCase, BenchmarkRun, simulate_case
from tests.studies import found_grounds
from tests.studies.parts import TaskWorkers, add_options, answers

PLANTS = ("twin", "second")
LABELS = {"true": "oracle", "shuffled": "shuffled", "adversarial": "adversarial"}
DRAWS = 4000


def run_of(driver: str, seed: int) -> BenchmarkRun:
    """A drive of the policy's robot on a plant, or of a robot that no terrain model knows."""
    if driver in PLANTS:
        return simulate_case(BenchmarkCase("mixed", driver, seed))
    log, outage = found_grounds.drive_of(found_grounds.SETTINGS["mixed"], driver, seed)
    return BenchmarkRun("mixed", "twin", driver, f"seed {seed}", log, outage, true_labels(log), seed)


def errors_m(trial: tuple[str, int]) -> dict[str, float]:
    """Error inside the outage by method, m: plant or robot, and seed."""
    run, found = run_of(*trial), {}
    for method in METHODS:
        if method.name in ("fixed", *LABELS.values()):
            score = score_run(run, method)
            assert score is not None
            assert score.error_m is not None
            found[method.name] = score.error_m
    return found


def main() -> None:
    """Print a line for each group of drives and kind of labels."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.wrong_labels", description=__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    n, first = given.seeds, found_grounds.JUDGE
    trials = [(plant, seed) for plant in PLANTS for seed in range(FIRST_SEED, FIRST_SEED + n)]
    known = len(trials)
    trials += [(robot, seed) for robot in found_grounds.ROBOTS for seed in range(first, first + n // 2)]
    errors = answers(trials, errors_m, TaskWorkers.of(given), given.out)
    groups = {plant: errors[i * n :][:n] for i, plant in enumerate(PLANTS)}
    for plant, drives in {**groups, "all": errors[:known], "unseen": errors[known:]}.items():
        for labels, method in LABELS.items():
            ratios = np.array([e[method] / e["fixed"] for e in drives])
            draws = np.random.default_rng(0).choice(ratios, (DRAWS, len(ratios)))
            low, high = percentile_interval(np.median(draws, axis=1))
            print(f"{plant}, {labels} labels over fixed: {np.median(ratios):.2f} [{low:.2f}, {high:.2f}]")


if __name__ == "__main__":
    from tests.studies import wrong_labels

    wrong_labels.main()  # workers know the trials by the module's own name
