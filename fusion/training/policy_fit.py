"""Fitting the weighting policy to drives of the twin, and to labelled logs.

`policy_evidence` tells what is measured; here its samples become rows. Every rms is
of errors winsorised at their 0.5 and 99.5 % quantiles. `fixed` is the same of all
grounds pooled with equal weight, so that it is the best single row for the very same
drives. `unknown` is the moment match of the grounds, its standard deviations (not the
receiver's) `UNKNOWN_SPREAD` times wider: the row of any ground that has none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import TerrafusionError
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
from terrafusion.fusion.training.simulated_runs import GROUNDS, Grid, run_all

Array = NDArray[np.float64]

SCENARIOS = ("staircase", "figure_eight")
"""0.3 to 1.5 m/s straight ahead in steps, with stops; 0.8 m/s in circles to both sides."""
SLOPES_DEG = (0.0, 3.0, 6.0)
PAYLOADS_KG = (0.0, 30.0)
UNSEEN_YAW_SCALE, LEAST_YAW_SCALE_SIGMA = (-0.4, 0.2), 0.02
"""For drives without turns: robots turn at 0.44 to 0.71 of what their track says (`docs/planar.md`)."""
TAIL = 0.005
GRADE_RIDGE, LAD_STEPS, LAD_FLOOR = 1e-5, 30, 5e-3
RADIUS_SIGMA = 0.01
UNKNOWN_SPREAD = 1.5
HILLY = 0.05
"""Standard deviation of the grade (sine of the pitch) from which logs tell how slip follows it."""
DIGITS = 4


@dataclass(frozen=True, eq=False)
class LoggedSamples:
    """What labelled logs say: evidence by ground, from means of `mean_s`.

    `inputs` is file name -> SHA-256 of what was read.
    """

    grounds: Mapping[str, GroundSamples] = dataclasses.field(default_factory=dict)
    inputs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    mean_s: float = 0.0


def fit_policy(
    grid: Grid, tick: Callable[[], None] = lambda: None, logged: LoggedSamples = LoggedSamples()
) -> Policy:
    """Simulate the drives of `grid` and fit a row to each ground; `tick` is called after each drive.

    What logs say of a ground goes into the twin's row of it, or into the row of all grounds together where
    the twin has none. With logs, `fixed` is the moment match of the rows so informed.

    Raises:
        TerrafusionError: on some ground the wheels hardly turned.
    """
    drives: dict[str, list[GroundSamples]] = {ground: [] for ground in grid.grounds}
    for condition, recording in run_all(grid.conditions(), tick):
        drives[condition.terrain].append(samples_of(recording))
    grounds = {name: GroundSamples.joined(parts) for name, parts in drives.items()}
    found = {name: _row_on(name, evidence) for name, evidence in grounds.items()}
    fixed = row_of(list(grounds.values()))
    found |= {name: informed(found.get(name, fixed), told) for name, told in sorted(logged.grounds.items())}
    rows = {name: _rounded(row) for name, row in found.items()}
    matched = Policy(rows, fixed, "").blend(np.full(len(rows), 1.0 / len(rows)))
    return Policy(
        classes={**rows, "unknown": _rounded(_spread(matched))},
        fixed=_rounded(matched if logged.grounds else fixed),
        inputs_sha256=fingerprint_of(grid, logged),
    )


def informed(row: SensorNoise, told: GroundSamples) -> SensorNoise:
    """A row of the twin with what logs tell: they move its means; a scatter they may widen, not narrow.

    Logs are few, and their means are long. The slope over the grade is theirs only where they were in hills.
    """
    hilly = len(told.grade) > 0 and float(np.std(told.grade)) > HILLY
    level, slope = _slip_line([told]) if hilly else (0.0, row.slip_per_grade)
    level = level if hilly else float(np.median(told.slip - slope * told.grade))
    left = told.slip - level - slope * told.grade
    scatter = float(np.hypot(_rms([left]), RADIUS_SIGMA))
    told_slip = dataclasses.replace(
        row, slip_mean=level, slip_per_grade=slope, slip_sigma=max(row.slip_sigma, scatter)
    )
    if not len(told.yaw_scale):
        return told_slip  # a drive straight ahead tells nothing of turning, nor of skidding in it
    scale, scatter = _yaw_scale_of([told.yaw_scale])
    return dataclasses.replace(
        told_slip,
        yaw_scale_mean=scale,
        yaw_scale_sigma=max(row.yaw_scale_sigma, scatter),
        side_slip_sigma=max(row.side_slip_sigma, _rms([told.side_slip])),
    )


def default_grid(seeds: int, grounds: tuple[str, ...] = GROUNDS, vehicle: str = "elevate") -> Grid:
    """The drives of a policy, by default of the shipped one, with seeds 0 to `seeds` - 1."""
    return Grid(SCENARIOS, SLOPES_DEG, PAYLOADS_KG, tuple(range(seeds)), grounds, vehicle)


def _row_on(ground: str, evidence: GroundSamples) -> SensorNoise:
    try:
        return row_of([evidence])
    except ValueError as error:
        raise TerrafusionError(
            str(error), channel=ground, remedy="leave the ground out, or drive another vehicle"
        ) from None


def row_of(grounds: list[GroundSamples]) -> SensorNoise:
    """The row of one ground, or of several with equal weight.

    Raises:
        ValueError: a ground never moved its wheels.
    """
    if any(len(e.slip_pairs) < 2 for e in grounds):
        raise ValueError("the wheels never turned long enough to tell the slip")
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
    """Mean and 1 sigma of the yaw scale; `UNSEEN_YAW_SCALE` where no drive turned."""
    if not found:
        return UNSEEN_YAW_SCALE
    mean = float(np.mean([np.median(scales) for scales in found]))
    return mean, max(_rms([scales - mean for scales in found]), LEAST_YAW_SCALE_SIGMA)


def _slip_line(grounds: list[GroundSamples]) -> tuple[float, float]:
    """Slip on the level and its slope over the grade: the mean of the grounds' own lines.

    Least absolute deviations, by reweighted least squares: slip has a long tail
    of bursts and of wheels digging in, which the IMU shows as they happen; the
    line is to stand for steady driving. Grades all alike leave the slope at zero.
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
    """Root of the mean over grounds of the mean square, each winsorised at its tails; NaN-free by making."""
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
    # About which axis strange ground shakes most is not known either.
    worst = max(changes["gyro_inflation"], changes["gyro_yaw_inflation"])
    return dataclasses.replace(row, **changes | {"gyro_yaw_inflation": worst})


def _rounded(row: SensorNoise) -> SensorNoise:
    """Four significant digits: the last bits of a sum differ from machine to machine, the file must not.

    And inside the ranges of the file: a robot that does not turn at all in mud has a yaw scale of -1.
    """
    digits = (float(f"{value:.{DIGITS}g}") for value in dataclasses.astuple(row))
    return within_ranges(SensorNoise(*digits))


def fingerprint_of(grid: Grid, logged: LoggedSamples = LoggedSamples()) -> str:
    """SHA-256 of what a policy fitted on `grid` and logs depends on: parameter files, logs and settings."""
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
    """Write a policy file: same policy, same bytes."""
    from ruamel.yaml import YAML

    content = {
        "schema": SCHEMA,
        "made_by": made_by,
        "inputs_sha256": policy.inputs_sha256,
        "classes": {name: dataclasses.asdict(row) for name, row in policy.classes.items()},
        "fixed": dataclasses.asdict(policy.fixed),
    }
    yaml = YAML()
    yaml.default_flow_style = False
    with path.open("w", encoding="utf-8") as out:
        yaml.dump(content, out)
