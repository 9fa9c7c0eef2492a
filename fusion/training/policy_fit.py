"""Fits the sensor noise of each ground to simulated runs and labelled logs.

From the samples of `ground_samples`; every rms is of samples winsorised at 0.5 and 99.5 %. `fixed` is fitted
to all grounds pooled with equal weight, the best single noise for the same runs. `unknown`, for any other
ground, is the moment match of the grounds with standard deviations (but the receiver's) `UNKNOWN_SPREAD`
times larger.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.yaml_file import dump_yaml
from terrafusion.fusion.noise.policy import SCHEMA, Policy, SensorNoise, within_ranges
from terrafusion.fusion.training.ground_samples import (
    ACCEL_S,
    BIAS_S,
    GYRO_S,
    LAG_S,
    SHORT_S,
    SIDE_SLIP_FROM_MPS,
    SLIP_S,
    STUCK_COUNTS_S,
    STUCK_MPS,
    TURNING_MPS,
    YAWING_RADPS,
    GroundSamples,
    samples_of,
)
from terrafusion.fusion.training.simulated_runs import (
    GROUNDS,
    PAYLOADS_KG,
    SCENARIOS,
    SLOPES_DEG,
    Grid,
    run_all,
)

UNSEEN_YAW_SCALE, LEAST_YAW_SCALE_SIGMA = (-0.4, 0.2), 0.02
"""Mean and sigma without turns: robots turn at 0.44 to 0.71 of the rate by their track."""
TAIL = 0.005
GRADE_RIDGE, LAD_STEPS, LAD_FLOOR = 1e-5, 30, 5e-3
RADIUS_SIGMA = 0.01
UNKNOWN_SPREAD = 1.5
HILLY = 0.05
"""Standard deviation of the grade (sine of the pitch) from which logs identify slip over grade."""
DIGITS = 4


@dataclass(frozen=True, eq=False)
class LoggedSamples:
    """Samples by ground from labelled logs, of means over `mean_s`; `inputs` is file name -> SHA-256."""

    grounds: Mapping[str, GroundSamples] = dataclasses.field(default_factory=dict)
    inputs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    mean_s: float = 0.0


def fit_policy(
    grid: Grid, tick: Callable[[], None] = lambda: None, logged: LoggedSamples = LoggedSamples()
) -> Policy:
    """Simulate the runs of `grid` and fit the sensor noise of each ground; `tick` is called after each run.

    Logs update the twin's noise of their ground, or of all grounds pooled if the twin has no such ground.
    With logs, `fixed` is the moment match of the updated noise.

    Raises:
        TerrafusionError: on a ground the wheels hardly turned.
    """
    drives: dict[str, list[GroundSamples]] = {ground: [] for ground in grid.grounds}
    for condition, recording in run_all(grid.conditions(), tick):
        drives[condition.terrain].append(samples_of(recording))
    grounds = {name: GroundSamples.joined(parts) for name, parts in drives.items()}
    by_ground = {name: _noise_on(name, samples) for name, samples in grounds.items()}
    fixed = noise_of(list(grounds.values()))
    by_ground |= {
        name: informed(by_ground.get(name, fixed), samples)
        for name, samples in sorted(logged.grounds.items())
    }
    noise_by_class = {name: _rounded(noise) for name, noise in by_ground.items()}
    equal = np.full(len(noise_by_class), 1.0 / len(noise_by_class))
    matched = Policy(noise_by_class, fixed, "").blend(equal)
    return Policy(
        classes={**noise_by_class, "unknown": _rounded(_spread(matched))},
        fixed=_rounded(matched if logged.grounds else fixed),
        inputs_sha256=fingerprint_of(grid, logged),
    )


def informed(noise: SensorNoise, logged: GroundSamples) -> SensorNoise:
    """Noise of the twin updated by logs: means are replaced, standard deviations may only grow.

    Logs are few and their samples means over seconds. They give the slip over grade only if they are hilly.
    """
    hilly = len(logged.grade) > 0 and float(np.std(logged.grade)) > HILLY
    level, slope = _slip_line([logged]) if hilly else (0.0, noise.slip_per_grade)
    level = level if hilly else float(np.median(logged.slip - slope * logged.grade))
    left = logged.slip - level - slope * logged.grade
    scatter = float(np.hypot(_rms([left]), RADIUS_SIGMA))
    slip = dataclasses.replace(
        noise, slip_mean=level, slip_per_grade=slope, slip_sigma=max(noise.slip_sigma, scatter)
    )
    if not len(logged.yaw_scale):
        return slip  # without turns, yaw scale and side-slip stay the twin's
    scale, scatter = _yaw_scale_of([logged.yaw_scale])
    return dataclasses.replace(
        slip,
        yaw_scale_mean=scale,
        yaw_scale_sigma=max(noise.yaw_scale_sigma, scatter),
        side_slip_sigma=max(noise.side_slip_sigma, _rms([logged.side_slip])),
    )


def default_grid(seeds: int, grounds: tuple[str, ...] = GROUNDS, vehicle: str = "elevate") -> Grid:
    """The runs of a policy, by default of the shipped one, with seeds 0 to `seeds` - 1."""
    return Grid(SCENARIOS, SLOPES_DEG, PAYLOADS_KG, tuple(range(seeds)), grounds, vehicle)


def _noise_on(ground: str, samples: GroundSamples) -> SensorNoise:
    try:
        return noise_of([samples])
    except ValueError as error:
        raise TerrafusionError(
            str(error), channel=ground, remedy="leave the ground out, or drive another vehicle"
        ) from None


def noise_of(grounds: list[GroundSamples]) -> SensorNoise:
    """Sensor noise of one ground, or of several with equal weight; ValueError: the wheels never turned."""
    if any(len(e.slip_pairs) < 2 for e in grounds):
        raise ValueError("the wheels never turned long enough to estimate the slip")
    mean, per_grade = _slip_line(grounds)
    left = [e.slip - mean - per_grade * e.grade for e in grounds]
    variance = float(np.mean([np.mean(x**2) for x in left])) + RADIUS_SIGMA**2
    paired = [e.slip_pairs - mean - per_grade * e.grade_pairs for e in grounds]
    power = float(np.mean([np.mean(p**2) for p in paired])) + RADIUS_SIGMA**2
    rho = (float(np.mean([np.mean(p[:, 0] * p[:, 1]) for p in paired])) + RADIUS_SIGMA**2) / power
    scale, scatter = _yaw_scale_of([e.yaw_scale for e in grounds if len(e.yaw_scale)])
    return SensorNoise(
        slip_mean=mean,
        slip_per_grade=per_grade,
        slip_sigma=float(np.sqrt(variance)),
        slip_time_s=float(np.clip(-LAG_S / np.log(np.clip(rho, 1e-3, 0.999)), 0.2, 300.0)),
        wheel_sigma_mps=max(_rms([e.wheel_mps for e in grounds]), 1e-3),
        yaw_scale_mean=scale,
        yaw_scale_sigma=scatter,
        side_slip_sigma=max(_rms([e.side_slip for e in grounds]), 1e-3),
        gyro_inflation=max(_rms([e.gyro for e in grounds]), 1.0),
        gyro_yaw_inflation=max(_rms([e.gyro_yaw for e in grounds]), 1.0),
        accel_inflation=max(_rms([e.accel for e in grounds]), 1.0),
        gnss_inflation=max(_rms([e.gnss for e in grounds]), 1.0),
    )


def _yaw_scale_of(found: list[Array]) -> tuple[float, float]:
    """Mean and 1 sigma of the yaw scale; `UNSEEN_YAW_SCALE` without turns."""
    if not found:
        return UNSEEN_YAW_SCALE
    mean = float(np.mean([np.median(scales) for scales in found]))
    return mean, max(_rms([scales - mean for scales in found]), LEAST_YAW_SCALE_SIGMA)


def _slip_line(grounds: list[GroundSamples]) -> tuple[float, float]:
    """Slip on the level and its slope over the grade, means of the grounds' lines.

    Least absolute deviations by reweighted least squares: the line stands for steady driving, and bursts of
    slip (long tails) are seen by the IMU. A constant grade leaves the slope at zero.
    """
    lines = []
    for e in grounds:
        rows = np.stack([np.ones_like(e.grade), e.grade], axis=1)
        weight: Array = np.ones(len(rows))
        line: Array = np.zeros(2)
        for _ in range(LAD_STEPS):
            ridge = np.diag([0.0, GRADE_RIDGE * weight.sum()])
            weighted = weight[:, None] * rows
            line = np.asarray(np.linalg.solve(rows.T @ weighted + ridge, weighted.T @ e.slip))
            weight = np.asarray(1.0 / np.maximum(np.abs(e.slip - rows @ line), LAD_FLOOR))
        lines.append(line)
    level, per_grade = np.mean(lines, axis=0)
    return float(level), float(per_grade)


def _rms(grounds: list[Array]) -> float:
    """Root of the mean over grounds of their winsorised mean squares."""
    squares = []
    for x in grounds:
        if len(x):
            low, high = np.quantile(x, [TAIL, 1.0 - TAIL])
            squares.append(float(np.mean(np.clip(x, low, high) ** 2)))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def _spread(row: SensorNoise) -> SensorNoise:
    changes = {
        name: value * UNKNOWN_SPREAD
        for name, value in dataclasses.asdict(row).items()
        if name not in ("slip_mean", "slip_per_grade", "slip_time_s", "yaw_scale_mean", "gnss_inflation")
    }
    # Neither is the axis known about which an unknown ground shakes most.
    worst = max(changes["gyro_inflation"], changes["gyro_yaw_inflation"])
    return dataclasses.replace(row, **changes | {"gyro_yaw_inflation": worst})


def _rounded(row: SensorNoise) -> SensorNoise:
    """Rounded to `DIGITS` digits, equal on every machine, and limited to the ranges of the file."""
    digits = (float(f"{value:.{DIGITS}g}") for value in dataclasses.astuple(row))
    return within_ranges(SensorNoise(*digits))


def fingerprint_of(grid: Grid, logged: LoggedSamples = LoggedSamples()) -> str:
    """SHA-256 of the parameter files, logs and settings that a policy depends on."""
    settings = {
        "schema": SCHEMA,
        "short_s": SHORT_S, "slip_s": SLIP_S, "lag_s": LAG_S, "turning_mps": TURNING_MPS,
        "side_slip_from_mps": SIDE_SLIP_FROM_MPS, "stuck_mps": STUCK_MPS, "stuck_counts_s": STUCK_COUNTS_S,
        "yawing_radps": YAWING_RADPS, "bias_s": BIAS_S, "gyro_s": GYRO_S, "accel_s": ACCEL_S,
        "tail": TAIL, "line": [GRADE_RIDGE, LAD_STEPS, LAD_FLOOR],
        "radius_sigma": RADIUS_SIGMA, "unknown_spread": UNKNOWN_SPREAD,
    }  # fmt: skip
    if not logged.inputs:
        return grid.fingerprint(policy=settings)
    logs = {"files": dict(logged.inputs), "mean_s": logged.mean_s, "hilly": HILLY}
    return grid.fingerprint(policy=settings, logs=logs)


def write_policy(policy: Policy, path: Path, made_by: str) -> None:
    """Write a policy file, byte for byte repeatable."""
    content = {
        "schema": SCHEMA,
        "made_by": made_by,
        "inputs_sha256": policy.inputs_sha256,
        "classes": {name: dataclasses.asdict(row) for name, row in policy.classes.items()},
        "fixed": dataclasses.asdict(policy.fixed),
    }
    dump_yaml(path, content, default_flow_style=False)
