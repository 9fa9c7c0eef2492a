"""What the diagnosis itself detects, at multiples of the observer's half-power points.

    python -m tests.studies.blind.power --shapes 12

draws shapes of the catalogue, makes trials at several multiples of their points, and prints the multiple at
which half of them are detected, for each kind of drive. It is `scale` in `severity.yaml`, one number a kind
of drive: the observer says how effects compare, the diagnosis how large they must be. All trials of a drive
share one set of references, which saves most of the time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.vehicle import VehicleParams

Array = NDArray[np.float64]

MULTIPLES = (1.5, 5.0, 15.0)
REFERENCES, RUNS = 14, 3
SOIL = "medium_sand"


def detections(
    groups: Sequence[Sequence[Recording]], references: Sequence[Recording], vehicle: VehicleParams
) -> list[float]:
    """P-value of each group of runs against the references, as `diagnose` has it."""
    from terrafusion.twin.gap.data.candidates import Candidates
    from terrafusion.twin.gap.infer.detect import detect
    from terrafusion.twin.gap.null.evidence import gather_evidence
    from terrafusion.twin.gap.null.score import learn_state_sigma, score
    from terrafusion.twin.gap.rollout.residuals import initial_state_sigma

    candidates = Candidates.of(None)
    evidence = gather_evidence(
        [run for group in groups for run in group], references, vehicle, None, candidates, jobs=1
    )
    sigma = learn_state_sigma(evidence.references, initial_state_sigma(candidates))
    normal = [score(run, sigma) for run in evidence.references]
    scores = iter([score(run, sigma) for run in evidence.runs])
    return [detect([next(scores) for _ in group], normal, candidates, 0).p_value for group in groups]


def half_power_multiple(multiples: Sequence[float], detected: Sequence[bool]) -> float:
    """Multiple at which half are detected: logistic regression on the logarithm, slope from 0.3 to 5."""
    x, y = np.log(np.asarray(multiples, dtype=float)), np.asarray(detected, dtype=float)
    centres, slopes = np.linspace(x.min() - 1.0, x.max() + 1.0, 201), np.linspace(0.3, 5.0, 48)
    logit = slopes[:, None, None] * (x - centres[:, None])
    likelihood = (y * logit - np.logaddexp(0.0, logit)).sum(axis=-1)
    return float(np.exp(centres[np.unravel_index(likelihood.argmax(), likelihood.shape)[1]]))


def measure(kind: str, count: int, seed: int) -> tuple[float, list[tuple[str, float, float]]]:
    """Half-power multiple of a kind of drive, and (shape, multiple, p-value) of every trial."""
    from terrafusion.twin.gap.blind.drives import drive
    from terrafusion.twin.gap.blind.plan import VEHICLE
    from terrafusion.twin.gap.blind.plant.run import record
    from terrafusion.twin.gap.blind.plant.spec import RunSpec
    from terrafusion.twin.gap.blind.severity import observed
    from terrafusion.twin.gap.blind.shapes import IN_CATALOGUE
    from terrafusion.twin.model.soil import load_soil
    from terrafusion.twin.model.vehicle import load_vehicle

    vehicle, soil, rng = load_vehicle(VEHICLE), load_soil(SOIL), np.random.default_rng([seed, 7])
    chosen = [IN_CATALOGUE[i] for i in rng.permutation(len(IN_CATALOGUE))[:count]]
    trials = [(s, m) for s in chosen for m in MULTIPLES if m * observed(s.key, kind) <= s.most]
    changes = [s.turned(m * observed(s.key, kind), rng) for s, m in trials]
    runs = [own for own in changes for _ in range(RUNS)] + [{}] * REFERENCES

    def spec(own: dict[str, float]) -> RunSpec:
        heading = rng.uniform(-np.pi, np.pi)
        return RunSpec(vehicle, soil, drive(kind, rng), heading, int(rng.integers(2**31)), seed, own)

    made = record([spec(own) for own in runs])
    groups = [made[RUNS * i : RUNS * (i + 1)] for i in range(len(trials))]
    p_values = detections(groups, made[RUNS * len(trials) :], vehicle)
    table = [(shape.key, multiple, p) for (shape, multiple), p in zip(trials, p_values, strict=True)]
    return half_power_multiple([m for _, m, _ in table], [p <= 0.05 for *_, p in table]), table


if __name__ == "__main__":
    import argparse

    parser = argparse.ArgumentParser(description="Measure the half-power multiple of the diagnosis.")
    parser.add_argument("--shapes", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drive", choices=("exciting", "gentle"), action="append")
    given = parser.parse_args()
    for name in given.drive or ("exciting", "gentle"):
        found, rows = measure(name, given.shapes, given.seed)
        for key, multiple, p_value in rows:
            print(f"{name} {key} x{multiple:g} p {p_value:.3f}")
        print(f"scale {name}: {found:.3g}", flush=True)
