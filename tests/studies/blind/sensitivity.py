"""How large each effect must be for an oracle's d' of 5, 10 and 25: the severity scale of the blind check.

    python -m tests.studies.blind.sensitivity --seed 0

writes `sensitivity.yaml` of the package (about 3 minutes of one core). The oracle knows the effect, its shape
and the drive, and nothing of twin or diagnosis. It takes channel means (and log spreads) over half seconds
through a matched filter. Its covariance (shrunk, Ledoit and Wolf 2004) comes from one half of 100 null runs
of the plant, the scatter of its output from the other half, and the halves are exchanged. To both is added
what no model of a robot tells (`FLOORS`): the plant repeats a drive to the microsecond.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.blind import sensitivity
from terrafusion.twin.gap.blind.drives import KINDS, drive
from terrafusion.twin.gap.blind.plan import RUNS, VEHICLE
from terrafusion.twin.gap.blind.plant.run import record
from terrafusion.twin.gap.blind.plant.spec import RunSpec
from terrafusion.twin.gap.blind.sensitivity import D_PRIMES
from terrafusion.twin.gap.blind.shapes import shapes
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle

Array = NDArray[np.float64]

BIN_S, GRID_HZ = 0.5, 50.0
NULL_RUNS, SOIL = 100, "medium_sand"
FIRST = (0.1, 1.0)  # first sizes tried, in typical ones
FLOORS = {"wheels": 0.1, "yaw_rate": 0.01, "accel": 0.1, "position": 0.05, "velocity": 0.05, "current": 0.2}
"""What a model leaves open in a mean over half a second (1 sigma; rad/s, m/s2, m, m/s, A; assumed)."""
SPREADS, SPREAD_FLOOR = (
    ("wheels", "yaw_rate", "accel"),
    0.2,
)  # channels with spreads; floor of their logarithm
SUBSTEPS = 2  # of the plant's integrator, half of what trials have: d' needs no more

Known = Sequence[tuple[float, float]]  # sizes and their d'


def features(recording: Recording) -> tuple[Array, Array]:
    """Channel means, and log spreads of the fast ones, over half seconds (F,), and their floors (F,)."""
    grid = np.arange(0.0, min(recording.duration_s(), 60.0), 1.0 / GRID_HZ)
    per_bin = round(BIN_S * GRID_HZ)
    grid = grid[: len(grid) // per_bin * per_bin]
    out, floors = [], list[float]()
    for name, series in _series(recording, grid):
        bins = series.reshape(-1, per_bin)
        out.append(bins.mean(axis=1))
        floors += [FLOORS[name]] * len(bins)
        if name in SPREADS:
            out.append(np.log(bins.std(axis=1) + FLOORS[name]))
            floors += [SPREAD_FLOOR] * len(bins)
    return np.concatenate(out), np.array(floors)


def _series(recording: Recording, grid: Array) -> list[tuple[str, Array]]:
    wheels, imu, gnss, motor = recording.wheels, recording.imu, recording.gnss, recording.motor
    if wheels is None or imu is None or gnss is None or motor is None or gnss.velocity_enu_mps is None:
        raise DataError("a channel is missing", file=recording.name, remedy="take a recording of the plant")
    columns = [
        *(("wheels", wheels.t_ns, side) for side in wheels.side_speeds_mps(1.0).T),
        ("yaw_rate", imu.t_ns, imu.gyro_radps[:, 2]),
        *(("accel", imu.t_ns, imu.accel_mps2[:, axis]) for axis in (0, 1)),
        *(("position", gnss.t_ns, gnss.enu_m[:, axis]) for axis in (0, 1)),
        *(("velocity", gnss.t_ns, gnss.velocity_enu_mps[:, axis]) for axis in (0, 1)),
        *(("current", motor.t_ns, side) for side in motor.current_a.T),
    ]
    return [
        (name, np.interp(grid, (t_ns - recording.start_ns) * 1e-9, values)) for name, t_ns, values in columns
    ]


class Oracle:
    """Matched filters from null runs (N, F) of one drive and floors (F,)."""

    def __init__(self, null: Array, floors: Array) -> None:
        from sklearn.covariance import ledoit_wolf

        self.floors = floors
        white = null / floors
        half, one = len(white) // 2, np.eye(len(floors))
        self.halves = [
            (np.linalg.inv(ledoit_wolf(own)[0] + one), other - other.mean(axis=0))
            for own, other in ((white[:half], white[half:]), (white[half:], white[:half]))
        ]

    def d_prime(self, shift: Array) -> float:
        """Of a shift (F,) of the features in one run, mean of both halves."""
        step, found = shift / self.floors, []
        for precision, null in self.halves:
            weights = precision @ step
            variance = float((null @ weights).var(ddof=1) + weights @ weights)
            found.append(float(weights @ step) / math.sqrt(max(variance, 1e-24)))
        return float(np.mean(found)) if step.any() else 0.0


def size_for(known: Known, wanted: float, most: float) -> float:
    """Size whose d' is `wanted`, at most `most`: by straight lines through the logarithms of `known`, beyond
    them with the slope of the last, between 0.5 and 3."""
    x, y = np.log(np.maximum(np.array(sorted(known)), 1e-9)).T
    y = np.maximum.accumulate(y) + 1e-6 * np.arange(len(y))
    goal = math.log(wanted)
    last = 0 if goal < y[0] else len(y) - 2
    slope = float(np.clip((y[last + 1] - y[last]) / max(x[last + 1] - x[last], 1e-9), 0.5, 3.0))
    inside = float(np.interp(goal, y, x))
    return min(math.exp(inside + (goal - min(max(goal, y[0]), y[-1])) / slope), most)


def measure(
    kind: str, soil: str, seed: int, *, null_runs: int = NULL_RUNS, keys: Iterable[str] | None = None
) -> dict[str, list[float | None]]:
    """Sizes of shapes at `D_PRIMES` on one drive of a kind and soil; None: more than the plant is asked for.

    d' counts all runs of a trial.
    """
    some = {key: shapes()[key] for key in keys or shapes()}
    base = _base(kind, soil, seed)
    oracle = Oracle(*_features([base(seed + 1 + i, {}, False) for i in range(null_runs)]))
    known: dict[str, list[tuple[float, float]]] = {key: [] for key in some}
    sizes = {key: [min(s * shape.typical, shape.most) for s in FIRST] for key, shape in some.items()}
    for _ in range(2):
        jobs = [(key, size) for key, many in sizes.items() for size in many]
        turned = [some[key].turned(size, np.random.default_rng([seed, 9])) for key, size in jobs]
        # Without noise: the same noise, shifted by an effect, would count as one.
        rows, _ = _features([base(seed, changes, True) for changes in ({}, *turned)])
        for (key, size), row in zip(jobs, rows[1:], strict=True):
            known[key].append((size, math.sqrt(RUNS) * oracle.d_prime(row - rows[0])))
        sizes = {key: [size_for(known[key], D_PRIMES[1], some[key].most)] for key in some}
    found = {key: [size_for(known[key], d, some[key].most) for d in D_PRIMES] for key in some}
    return {key: [None if size >= some[key].most else size for size in many] for key, many in found.items()}


def _base(kind: str, soil: str, seed: int) -> Callable[[int, Mapping[str, float], bool], RunSpec]:
    """Makes runs of one drive and heading with given seed, changes and noise."""
    vehicle, ground = load_vehicle(VEHICLE), load_soil(soil)
    segments = drive(kind, np.random.default_rng([seed, 8]))
    return lambda run_seed, changes, noiseless: RunSpec(
        vehicle, ground, segments, 0.4, run_seed, seed, changes, noiseless=noiseless
    )


def _features(specs: Sequence[RunSpec]) -> tuple[Array, Array]:
    rows, floors = zip(*(features(recording) for recording in record(specs, substeps=SUBSTEPS)), strict=True)
    return np.stack(rows), floors[0]


def write(path: Path, seed: int, jobs: int) -> None:
    """Measures all sizes and writes them."""
    from joblib import Parallel, delayed

    lines = [
        "# Sizes of the blind check's shapes at d' 5, 10 and 25 of the oracle, in the unit of each change",
        "# (see shapes.py); null: more than the plant is asked for.",
        f"# Made by: python -m tests.studies.blind.sensitivity --seed {seed}",
        "sizes:",
    ]
    tables = Parallel(jobs)(delayed(measure)(kind, SOIL, seed) for kind in KINDS)
    for key in shapes():
        rows = [
            f"{kind}: [" + ", ".join("null" if s is None else f"{s:.4g}" for s in table[key]) + "]"
            for kind, table in zip(KINDS, tables, strict=True)
        ]
        lines.append(f"  {key}: {{" + ", ".join(rows) + "}")
    write_atomically(path, lambda part: part.write_text("\n".join(lines) + "\n", encoding="utf-8"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure the severity scale of the blind check.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(sensitivity.__file__).with_name("sensitivity.yaml"))
    given = parser.parse_args()
    write(given.out, given.seed, given.jobs)
