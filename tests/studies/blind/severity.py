"""Half-power points of the blind check's shapes, by an observer that is independent of the diagnosis.

    python -m tests.studies.blind.severity --seed 0

writes `severity.yaml` of the package (about 3 minutes of one core). The observer is a chi-square test on
channel means (and spreads) over half seconds, with the covariance of null runs of the same drive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.blind import severity
from terrafusion.twin.gap.blind.drives import KINDS, drive
from terrafusion.twin.gap.blind.plant.run import record
from terrafusion.twin.gap.blind.plant.spec import RunSpec
from terrafusion.twin.gap.blind.shapes import shapes
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle

Array = NDArray[np.float64]

BIN_S, GRID_HZ = 0.5, 50.0
FACTORS = 30
NULL_RUNS = 120
RUNS = 3
"""Runs of a trial: the observer sees so many."""
NEEDED = 3.6
"""Distance over sigma at which a chi-square test of 24 directions at 5 % has a power of one half."""
FLOORS = {"wheels": 0.1, "yaw_rate": 0.01, "accel": 0.1, "position": 0.05, "velocity": 0.05, "current": 0.2}
"""What a model of the robot leaves open in a mean over half a second (1 sigma, rad/s, m/s2, m, m/s, A;
assumed)."""
SPREAD_FLOOR = 0.2
"""The same of the logarithm of a spread."""
SOILS = ("medium_sand", "loose_sand")
START = (0.3, 1.0, 3.0)


def features(recording: Recording) -> tuple[Array, Array]:
    """Channel means and log spreads over half seconds (F,), and the floor (F,) of each."""
    end_s = min(recording.duration_s(), 60.0)
    grid = np.arange(0.0, end_s, 1.0 / GRID_HZ)
    per_bin = round(BIN_S * GRID_HZ)
    grid = grid[: len(grid) // per_bin * per_bin]
    means, floors = [], []
    for name, floor, series in _series(recording, grid):
        bins = series.reshape(-1, per_bin)
        means.append(bins.mean(axis=1))
        floors.append(np.full(len(bins), floor))
        if name in ("wheels", "yaw_rate", "accel"):
            means.append(np.log(bins.std(axis=1) + floor))
            floors.append(np.full(len(bins), SPREAD_FLOOR))
    return np.concatenate(means), np.concatenate(floors)


def _series(recording: Recording, grid: Array) -> list[tuple[str, float, Array]]:
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
        (name, FLOORS[name], np.interp(grid, (t_ns - recording.start_ns) * 1e-9, values))
        for name, t_ns, values in columns
    ]


@dataclass(frozen=True, eq=False)
class Observer:
    """Null runs (N, F) as factors (K, F) and what remains of each feature, as variances (F,)."""

    factors: Array
    variances: Array

    @classmethod
    def of(cls, null: Array, floors: Array) -> Observer:
        centred = (null - null.mean(axis=0)) / np.sqrt(len(null) - 1.0)
        _, values, rows = np.linalg.svd(centred, full_matrices=False)
        factors = values[:FACTORS, None] * rows[:FACTORS]
        rest = np.maximum((centred**2).sum(axis=0) - (factors**2).sum(axis=0), 0.0)
        return cls(factors, rest + floors**2)

    def distance(self, difference: Array) -> float:
        """Mahalanobis distance of `difference` (F,): the covariance is factors' factors + variances."""
        scaled = self.factors / self.variances
        inner = np.eye(len(self.factors)) + scaled @ self.factors.T
        told = scaled @ difference
        square = float(difference @ (difference / self.variances) - told @ np.linalg.solve(inner, told))
        return math.sqrt(max(square, 0.0))


def size_for(known: Sequence[tuple[float, float]], wanted: float, most: float) -> float:
    """Size whose distance is `wanted`, by the straight line through the logarithms of the two nearest.

    `known` holds sizes and their distances.
    """
    sizes, distances = np.asarray(known, dtype=float).T
    x, y = np.log(sizes), np.log(np.maximum(distances, 1e-12))
    order = np.argsort(np.abs(y - np.log(wanted)))[:2]
    (x0, x1), (y0, y1) = x[order], y[order]
    slope = (y1 - y0) / (x1 - x0) if abs(x1 - x0) > 1e-9 else 1.0
    slope = min(max(float(slope), 0.5), 3.0)
    return float(min(np.exp(x0 + (np.log(wanted) - y0) / slope), most))


def measure(kind: str, seed: int, *, null_runs: int = NULL_RUNS, rounds: int = 2) -> dict[str, float]:
    """Half-power points of all shapes on one kind of drive."""
    by_soil = [_measure(kind, soil, seed, null_runs, rounds) for soil in SOILS]
    return {key: float(np.exp(np.mean([np.log(points[key]) for points in by_soil]))) for key in shapes()}


def _measure(kind: str, soil: str, seed: int, null_runs: int, rounds: int) -> dict[str, float]:
    base = _base(kind, soil, seed)
    null = _features([base(seed + 1 + i, {}) for i in range(null_runs)])
    observer = Observer.of(null[0], null[1])
    wanted = NEEDED / np.sqrt(RUNS)
    known: dict[str, list[tuple[float, float]]] = {key: [] for key in shapes()}
    sizes = {key: [min(s * shape.typical, shape.most) for s in START] for key, shape in shapes().items()}
    for _ in range(rounds):
        jobs = [(key, size) for key, many in sizes.items() for size in many]
        turned = [shapes()[key].turned(size, np.random.default_rng([seed, 9])) for key, size in jobs]
        # Without noise: the same noise, shifted by an effect, would count as one.
        rows, _ = _features([base(seed, changes, True) for changes in ({}, *turned)])
        for (key, size), row in zip(jobs, rows[1:], strict=True):
            known[key].append((size, observer.distance(row - rows[0])))
        sizes = {key: [size_for(known[key], wanted, shapes()[key].most)] for key in known}
    return {key: found[0] for key, found in sizes.items()}


def _base(kind: str, soil: str, seed: int) -> Any:
    """Makes specs of one drive and heading with given seed, changes and noise."""
    vehicle, ground = load_vehicle("elevate"), load_soil(soil)
    segments = drive(kind, np.random.default_rng([seed, 8]))
    return lambda run_seed, changes, noiseless=False: RunSpec(
        vehicle, ground, segments, 0.4, run_seed, seed, changes, noiseless=noiseless
    )


def _features(specs: Sequence[Any]) -> tuple[Array, Array]:
    found = [features(recording) for recording in record(specs)]
    return np.stack([f[0] for f in found]), found[0][1]


def write(path: Path, seed: int) -> None:
    """Measures all points and writes them."""
    points = {kind: measure(kind, seed) for kind in KINDS}
    lines = [
        "# Half-power points of the blind check's shapes, in the unit of each change (see shapes.py).",
        f"# Points made by: python -m tests.studies.blind.severity --seed {seed}",
        "# Scale made by: python -m tests.studies.blind.power --shapes 24",
        "scale: {" + ", ".join(f"{kind}: {severity.stored_points()['scale'][kind]}" for kind in KINDS) + "}",
        "points:",
    ]
    for key in points[KINDS[0]]:
        told = ", ".join(f"{kind}: {points[kind][key]:.4g}" for kind in KINDS)
        lines.append(f"  {key}: {{{told}}}")
    write_atomically(path, lambda part: part.write_text("\n".join(lines) + "\n", encoding="utf-8"))


if __name__ == "__main__":
    import argparse

    parser = argparse.ArgumentParser(description="Measure the half-power points of the blind check.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(severity.__file__).with_name("severity.yaml"))
    given = parser.parse_args()
    write(given.out, given.seed)
