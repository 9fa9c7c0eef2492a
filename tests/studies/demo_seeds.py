"""Adaptive against fixed weights on four drives of the twin: medians over seeds that fitted no policy.

The ratio is the geometric mean over seeds of adaptive over fixed error at the end of the outage, with a 95 %
interval (bootstrap over seeds).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median

import numpy as np

from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import replay
from terrafusion.twin.simulate import simulate
from tests.studies.parts import TaskWorkers, add_options, answers

DRIVES = {
    "demo": ((75.0, 60.0), {}),
    "mixed_terrain": ((60.0, 60.0), {}),
    "paper_profile": ((120.0, 60.0), {"terrain": "loose_sand", "slope_deg": 5.0}),
    "figure_eight": ((60.0, 30.0), {"terrain": "asphalt"}),
}
"""Scenario: outage (start, length) in s, and what else is given to `simulate`."""
FIRST_SEED = 100
MODES = ("fixed", "adaptive")
DRAWS = 4000


def errors_m(trial: tuple[str, str, int]) -> tuple[float, float, float]:
    """Error of the whole drive (RMS), median in the outage, and at its end, m: scenario, mode and seed."""
    scenario, mode, seed = trial
    outage, options = DRIVES[scenario]
    log = simulate(scenario, seed=seed, **options)
    scores = replay(log, mode=mode, outages=[Outage(*outage)], findings=()).scores
    lost = scores.outages[0]
    assert scores.ate_m is not None
    assert lost.median_m is not None
    assert lost.end_error_m is not None
    return scores.ate_m, lost.median_m, lost.end_error_m


def ratio(fixed: list[tuple[float, float, float]], adaptive: list[tuple[float, float, float]]) -> str:
    """Ratio of the errors at the end of the outage, with its interval."""
    logs = np.array([np.log(a[2] / f[2]) for f, a in zip(fixed, adaptive, strict=True)])
    draws = np.random.default_rng(0).choice(logs, (DRAWS, len(logs))).mean(axis=1)
    low, high = percentile_interval(np.exp(draws))
    return f"{np.exp(logs.mean()):.2f} [{low:.2f}, {high:.2f}]"


def main() -> None:
    """Print one line a drive and mode: medians over seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--drive", choices=tuple(DRIVES), action="append", help="this one alone")
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    print(f"{'drive':14s} {'mode':9s} whole drive, m   median in outage, m   end of outage, m   drives won")
    seeds = range(FIRST_SEED, FIRST_SEED + given.seeds)
    for scenario in given.drive or DRIVES:
        trials = [(scenario, mode, seed) for mode in MODES for seed in seeds]
        errors = answers(trials, errors_m, TaskWorkers.of(given), given.out)
        found = {mode: errors[i * given.seeds :][: given.seeds] for i, mode in enumerate(MODES)}
        for mode in MODES:
            whole, inside, end = (median(column) for column in zip(*found[mode], strict=True))
            other = found[MODES[1 - MODES.index(mode)]]
            won = sum(a[2] < b[2] for a, b in zip(found[mode], other, strict=True))
            print(f"{scenario:14s} {mode:9s} {whole:14.2f} {inside:21.2f} {end:18.2f} {won:12d}", flush=True)
        print(
            f"{scenario}, adaptive over fixed at the end: {ratio(*(found[mode] for mode in MODES))}",
            flush=True,
        )


if __name__ == "__main__":
    from tests.studies import demo_seeds

    demo_seeds.main()  # workers know the trials by the module's own name
