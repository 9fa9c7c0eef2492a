"""Judging predictions of the single-wheel trials: splits, rival models, scores with intervals, regions."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector
from terrafusion.twin.physics.layout import SOIL_PARAMETERS
from tests.studies.twin_field.resampled_groups import resampled_groups
from tests.studies.twin_field.single_wheel_fit import (
    EXPONENT,
    FREE,
    OUTPUTS,
    conditions,
    fit,
    measured,
    predict,
)
from tests.studies.twin_field.wheel_trials import WheelTrials

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Model = Callable[[WheelTrials, Mask], Array]
"""(trials, rows to fit) -> outputs (N, 3) of all trials; NaN where a model has none."""

RESAMPLES = 2000
HALVES = 20
"""Splits into halves over which the luck of one split is judged."""
PUBLISHED = "pavlov:direct_90_sand"


def half_split(trials: WheelTrials, seed: int) -> Mask:
    """Rows (N,) to fit: half of the conditions, drawn by the seed; repeats of one stay together."""
    group = conditions(trials)
    count = int(group.max()) + 1
    return np.isin(group, np.random.default_rng(seed).permutation(count)[: count // 2])


def angle_split(trials: WheelTrials, seed: int) -> Mask:
    """Rows (N,) to fit: side-slips asked for up to 45 deg; the larger ones are left to extrapolate to."""
    return np.asarray(trials.commanded_side_slip_rad < np.radians(50.0))


SPLITS: Mapping[str, Callable[[WheelTrials, int], Mask]] = {"half": half_split, "angle": angle_split}


def fitted(trials: WheelTrials, rows: Mask) -> Array:
    """The wheel model with its soil numbers fitted."""
    return predict(fit(trials, rows).values, trials)


def published(trials: WheelTrials, rows: Mask) -> Array:
    """The wheel model with the published numbers of the same sand: nothing is fitted."""
    soil = dict(zip(SOIL_PARAMETERS, soil_vector(load_soil(PUBLISHED)).tolist(), strict=True))
    fixed = {name: soil[name] for name in ("exponent", "cohesion_pa", "unit_weight_n_per_m3")}
    assert fixed["exponent"] == EXPONENT
    return predict(np.array([soil[name] for name in FREE]), trials, **fixed)


def coulomb(trials: WheelTrials, rows: Mask) -> Array:
    """Dry friction mu W against the sliding of the rim: one number, no sinkage."""
    u, v = np.cos(trials.side_slip_rad), np.sin(trials.side_slip_rad)
    slide = np.stack([trials.rim_speed_mps / trials.travel_speed_mps - u, v], axis=1)
    speed = np.linalg.norm(slide, axis=1, keepdims=True)
    unit = trials.load_n[:, None] * np.where(speed > 1e-3, slide / np.maximum(speed, 1e-3), 0.0)
    known = measured(trials)[:, :2]
    mu = float(np.sum(unit[rows] * known[rows]) / np.sum(unit[rows] ** 2))
    return np.column_stack([mu * unit, np.full(len(trials), np.nan)])


def linear(trials: WheelTrials, rows: Mask) -> Array:
    """Forces over load, and sinkage, linear in slip and side-slip: nine numbers."""
    basis = np.stack([np.ones(len(trials)), trials.slip, trials.side_slip_rad], axis=1)
    target = measured(trials)
    target[:, :2] /= trials.load_n[:, None]
    out = basis @ np.linalg.lstsq(basis[rows], target[rows], rcond=None)[0]
    out[:, :2] *= trials.load_n[:, None]
    return np.asarray(out)


MODELS: Mapping[str, Model] = {
    "fitted": fitted, "published": published, "coulomb": coulomb, "linear": linear
}  # fmt: skip


def noise_floor(trials: WheelTrials) -> Array:
    """Scatter (3,) of the repeats about their condition's mean, in their units; NaN without repeats."""
    group, target = conditions(trials), measured(trials)
    means = np.stack([target[group == g].mean(axis=0) for g in range(int(group.max()) + 1)])
    free = len(trials) - len(means)
    if free == 0:
        return np.full(len(OUTPUTS), np.nan)
    return np.asarray(np.sqrt(np.sum((target - means[group]) ** 2, axis=0) / free))


def repeated_halves(trials: WheelTrials, seed: int) -> dict[str, dict[str, list[float] | None]]:
    """R2 of each model and output on the other half: median, lowest and highest of `HALVES` splits."""
    target = measured(trials)
    found: dict[str, list[list[float]]] = {model: [] for model in MODELS}
    for rows in (half_split(trials, seed + k) for k in range(HALVES)):
        rest = np.flatnonzero(~rows)
        for model, function in MODELS.items():
            out = function(trials, rows)
            found[model].append([_r2_rmse(target[:, k], out[:, k], rest)[0] for k in range(len(OUTPUTS))])
    return {model: {name: _spread(r2) for name, r2 in zip(OUTPUTS, zip(*rows, strict=True), strict=True)}
            for model, rows in found.items()}  # fmt: skip


def _spread(values: tuple[float, ...]) -> list[float] | None:
    if not np.isfinite(values).all():
        return None
    return [float(np.median(values)), min(values), max(values)]


def score(trials: WheelTrials, predicted: Array, rows: Mask, seed: int) -> dict[str, dict[str, object]]:
    """R2 and root-mean-square error of each output over `rows`, with 95 % intervals.

    Intervals are percentiles over resamples of conditions (repeats of one are not independent); the
    spread that R2 is held against is taken about the mean of the same resample.
    """
    target, group = measured(trials), conditions(trials)
    whole = np.flatnonzero(rows)
    drawn = [whole[at] for at in resampled_groups(group[whole], RESAMPLES, seed)]
    out: dict[str, dict[str, object]] = {}
    for k, name in enumerate(OUTPUTS):
        if not np.isfinite(predicted[:, k]).all():
            out[name] = {"r2": None, "r2_ci": None, "rmse": None, "rmse_ci": None}
            continue
        pair = target[:, k], predicted[:, k]
        samples = np.array([_r2_rmse(*pair, at) for at in drawn])
        r2, rmse = _r2_rmse(*pair, whole)
        r2_ci, rmse_ci = (list(percentile_interval(column)) for column in samples.T)
        out[name] = {"r2": r2, "r2_ci": r2_ci, "rmse": rmse, "rmse_ci": rmse_ci}
    return out


def _r2_rmse(target: Array, predicted: Array, at: NDArray[np.int64]) -> tuple[float, float]:
    error = predicted[at] - target[at]
    spread = np.sum((target[at] - target[at].mean()) ** 2)
    return float(1.0 - np.sum(error**2) / spread), float(np.sqrt(np.mean(error**2)))


def regions(trials: WheelTrials) -> dict[str, Mask]:
    """Parts of the trials where a model may fail, as rows (N,)."""
    slip, side = trials.slip, np.degrees(trials.commanded_side_slip_rad)
    return {
        "locked or braked hard, slip below -0.6": slip < -0.6,
        "braked, -0.6 to -0.1": (slip >= -0.6) & (slip < -0.1),
        "near free rolling, -0.1 to 0.1": np.abs(slip) <= 0.1,
        "driven, 0.1 to 0.6": (slip > 0.1) & (slip <= 0.6),
        "spinning, above 0.6": slip > 0.6,
        "straight ahead, 0 deg": side < 1.0,
        "side-slip 15 to 45 deg": (side > 1.0) & (side < 50.0),
        "side-slip 60 to 75 deg": (side > 50.0) & (side < 80.0),
        "pushed sideways, 90 deg": side > 80.0,
    }


def errors_by_region(trials: WheelTrials, predicted: Array, rows: Mask) -> list[dict[str, object]]:
    """Mean and root-mean-square error of each output in each region, over `rows`."""
    error = predicted - measured(trials)
    out: list[dict[str, object]] = []
    for name, inside in regions(trials).items():
        at = inside & rows
        row: dict[str, object] = {"region": name, "trials": int(at.sum())}
        for k, output in enumerate(OUTPUTS):
            there = error[at, k]
            row[f"{output}_bias"] = float(there.mean()) if at.any() else None
            row[f"{output}_rmse"] = float(np.sqrt(np.mean(there**2))) if at.any() else None
        out.append(row)
    return out
