"""Adaptive against fixed weights on four drives of the twin: medians over seeds that fitted no policy."""

from __future__ import annotations

import argparse
from statistics import median

import terrafusion as tf

DRIVES = {
    "demo": ((75.0, 60.0), {}),
    "mixed_terrain": ((60.0, 60.0), {}),
    "paper_profile": ((120.0, 60.0), {"terrain": "loose_sand", "slope_deg": 5.0}),
    "figure_eight": ((60.0, 30.0), {"terrain": "asphalt"}),
}
"""Scenario: outage (start, length) in s, and what else is given to `simulate`."""
FIRST_SEED = 100
MODES = ("fixed", "adaptive")


def errors_m(scenario: str, mode: str, seed: int) -> tuple[float, float, float]:
    """Error of the whole drive (RMS), median in the outage, and at its end, m."""
    outage, options = DRIVES[scenario]
    log = tf.simulate(scenario, seed=seed, **options)
    scores = tf.replay(log, mode=mode, outages=[outage]).scores
    lost = scores.outages[0]
    assert scores.ate_m is not None
    assert lost.median_m is not None
    assert lost.end_error_m is not None
    return scores.ate_m, lost.median_m, lost.end_error_m


def main() -> None:
    """Print one line a drive and mode: medians over seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    given = parser.parse_args()
    print(f"{'drive':14s} {'mode':9s} whole drive, m   median in outage, m   end of outage, m   drives won")
    for scenario in DRIVES:
        found = {
            mode: [errors_m(scenario, mode, FIRST_SEED + i) for i in range(given.seeds)] for mode in MODES
        }
        for mode in MODES:
            whole, inside, end = (median(column) for column in zip(*found[mode], strict=True))
            other = found[MODES[1 - MODES.index(mode)]]
            won = sum(a[2] < b[2] for a, b in zip(found[mode], other, strict=True))
            print(f"{scenario:14s} {mode:9s} {whole:14.2f} {inside:21.2f} {end:18.2f} {won:12d}", flush=True)


if __name__ == "__main__":
    main()
