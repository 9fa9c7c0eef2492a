"""Fitting the weighting policy to drives of the twin.

What counts, ground by ground, and how it is measured against the truth:

- slip: 1 - v / (omega R) of half-second means while the wheels turn faster than
  0.15 m/s. A robot that spins on the spot has slip 1 for as long as it likes, so
  of every immobilised spell only the first second counts: its onset is what a
  policy must cover, its length is chance. A line over the grade (sine of the
  pitch) is fitted by least absolute deviations, the standard deviation is the rms
  about it; the correlation time is that of an Ornstein-Uhlenbeck process with this variance
  that moves as much in 2 s as slip did: tau = -2 s / ln(rho), rho the
  autocorrelation about the ground's line at a lag of 2 s.
  A rolling radius is known to about 1 %, which the twin's odometry is not subject
  to: that constant error is added to variance and autocorrelation alike.
- wheel sigma: speed over 0.1 s that slip, averaged over 1 s, leaves unexplained,
  in quadrature with the vehicle file's `speed_sigma_mps` (position error, backlash,
  uneven ground: the twin's encoders are only quantised).
- yaw scale: true over wheel yaw rate less one, half-second means, while the wheels turn the robot by more
  than 0.1 rad/s: the median, and the rms about it.
- side-slip: lateral over forward speed of the body origin, above 0.2 m/s, without the part that follows the
  yaw rate (a centre of rotation ahead of the origin is a state of its own).
- IMU: the mean error over tau less its 60 s running mean (the bias), rms over the
  axes, as a multiple of the data sheet's density / sqrt(tau). Vibration has a band:
  its mean falls faster than that of white noise, so the multiple falls with tau, and
  tau must be the time over which the estimator integrates the sensor before another
  corrects it: 2 s for the specific force (wheels and GNSS hold the speed), 5 s for
  the rate (heading is corrected slowly).
- GNSS: horizontal error over the reported sigma, rms, at least 1.

Every rms is of errors winsorised at their 0.5 and 99.5 % quantiles. `fixed` is
the same of all grounds pooled with equal weight, so that it is the best single
row for the very same drives. `unknown` is the moment match of the grounds, its
standard deviations (not the receiver's) `UNKNOWN_SPREAD` times wider.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.frames import GRAVITY_MPS2, quaternion_to_matrix
from terrafusion.datasets.recording import Fix, Recording
from terrafusion.datasets.sensors import ImuSpec
from terrafusion.fusion.terrain.drives import Grid, run_all, seconds, wheel_samples
from terrafusion.fusion.weights.policy import SCHEMA, Policy, SensorNoise
from terrafusion.twin.vehicle import VehicleParams, load_vehicle

Array = NDArray[np.float64]

SCENARIOS = ("staircase", "figure_eight")
SLOPES_DEG = (0.0, 3.0, 6.0)
PAYLOADS_KG = (0.0, 30.0)
SHORT_S, SLIP_S, LAG_S = 0.1, 0.5, 2.0
GYRO_S, ACCEL_S = 5.0, 2.0
TURNING_MPS, SIDE_SLIP_FROM_MPS, STUCK_MPS = 0.15, 0.2, 0.05
STUCK_COUNTS_S = 1.0
YAWING_RADPS = 0.1
UNSEEN_YAW_SCALE, LEAST_YAW_SCALE_SIGMA = (-0.4, 0.2), 0.02
"""For drives without turns: robots turn at 0.44 to 0.71 of what their track says (`docs/planar.md`)."""
BIAS_S = 60.0
TAIL = 0.005
GRADE_RIDGE, LAD_STEPS, LAD_FLOOR = 1e-5, 30, 5e-3
RADIUS_SIGMA = 0.01
UNKNOWN_SPREAD = 1.5
DIGITS = 4


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one drive, or many, say of a ground: (n,) samples of each quantity.

    `slip_pairs` and `grade_pairs` (n, 2) are slips and grades `LAG_S` apart; `gyro` and `accel` are errors
    over what the data sheet allows, `gnss` over the reported sigma.
    """

    slip: Array
    grade: Array
    slip_pairs: Array
    grade_pairs: Array
    wheel_mps: Array
    yaw_scale: Array
    side_slip: Array
    gyro: Array
    accel: Array
    gnss: Array

    @staticmethod
    def joined(parts: Iterable[Evidence]) -> Evidence:
        """All drives of a ground together."""
        listed = list(parts)
        names = [f.name for f in dataclasses.fields(Evidence)]
        return Evidence(**{n: np.concatenate([getattr(p, n) for p in listed]) for n in names})


def fit_policy(grid: Grid, tick: Callable[[], None] = lambda: None) -> Policy:
    """Simulate the drives of `grid` and fit a row to each ground; `tick` is called after each drive."""
    drives: dict[str, list[Evidence]] = {ground: [] for ground in grid.grounds}
    for condition, recording in run_all(grid.conditions(), tick):
        drives[condition.terrain].append(evidence_of(recording))
    grounds = {name: Evidence.joined(parts) for name, parts in drives.items()}
    rows = {name: _rounded(row_of([evidence])) for name, evidence in grounds.items()}
    matched = Policy(rows, next(iter(rows.values())), "").blend(np.full(len(rows), 1.0 / len(rows)))
    return Policy(
        classes={**rows, "unknown": _rounded(_spread(matched))},
        fixed=_rounded(row_of(list(grounds.values()))),
        inputs_sha256=fingerprint_of(grid),
    )


def default_grid(seeds: int) -> Grid:
    """The drives of the shipped policy, with seeds 0 to `seeds` - 1."""
    return Grid(SCENARIOS, SLOPES_DEG, PAYLOADS_KG, tuple(range(seeds)))


def evidence_of(recording: Recording) -> Evidence:
    """Everything one simulated drive says of its ground."""
    slip, grade, pairs, grade_pairs, wheel = _slip_evidence(recording)
    gyro, accel = _imu_evidence(recording)
    return Evidence(
        slip,
        grade,
        pairs,
        grade_pairs,
        wheel,
        _yaw_scales(recording),
        _side_slips(recording),
        gyro,
        accel,
        _gnss_evidence(recording),
    )


def row_of(grounds: list[Evidence]) -> SensorNoise:
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
        accel_inflation=max(_rms([e.accel for e in grounds]), 1.0),
        gnss_inflation=max(_rms([e.gnss for e in grounds]), 1.0),
    )


def _yaw_scale_of(found: list[Array]) -> tuple[float, float]:
    """Mean and 1 sigma of the yaw scale; `UNSEEN_YAW_SCALE` where no drive turned."""
    if not found:
        return UNSEEN_YAW_SCALE
    mean = float(np.mean([np.median(scales) for scales in found]))
    return mean, max(_rms([scales - mean for scales in found]), LEAST_YAW_SCALE_SIGMA)


def _slip_line(grounds: list[Evidence]) -> tuple[float, float]:
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


def _slip_evidence(recording: Recording) -> tuple[Array, Array, Array, Array, Array]:
    """Slips and grades (n,), pairs of both (m, 2), and speed errors (k,) m/s that slip leaves."""
    samples = wheel_samples(recording)
    wheel, forward = samples.sides_mps.mean(axis=1), samples.forward_mps
    step = float(np.median(np.diff(samples.t_s)))
    short = max(round(SHORT_S / step), 1)
    wheel, forward = _block_means(wheel, short), _block_means(forward, short)
    grade = _block_means(_grades(recording, samples.t_s), short)
    width = round(1.0 / SHORT_S)
    kernel = np.full(width, 1.0 / width)
    smooth_wheel, smooth = np.convolve(wheel, kernel, "same"), np.convolve(forward, kernel, "same")
    turning = np.abs(smooth_wheel) > TURNING_MPS
    share = np.divide(smooth, smooth_wheel, out=np.ones_like(smooth), where=turning)
    residual = (forward - share * wheel)[turning]

    blocks = round(SLIP_S / SHORT_S)
    wheel, forward = _block_means(wheel, blocks), _block_means(forward, blocks)
    grade = _block_means(grade, blocks)
    counted = np.abs(wheel) > TURNING_MPS
    counted &= _spell_age_s(counted & (np.abs(forward) < STUCK_MPS)) <= STUCK_COUNTS_S
    slip = np.full(len(wheel), np.nan)
    slip[counted] = np.clip(1.0 - forward[counted] / wheel[counted], -1.0, 1.0)
    lag = round(LAG_S / SLIP_S)
    pairs = np.stack([slip[:-lag], slip[lag:]], axis=1)
    grade_pairs = np.stack([grade[:-lag], grade[lag:]], axis=1)
    both = np.isfinite(pairs).all(axis=1)
    encoder = _vehicle(recording).sensors.wheels.speed_sigma_mps
    return slip[counted], grade[counted], pairs[both], grade_pairs[both], np.hypot(residual, encoder)


def _grades(recording: Recording, t_s: Array) -> Array:
    """Sine of the true pitch (n,), uphill positive."""
    truth = recording.truth
    assert truth is not None
    assert truth.quaternion is not None
    up = quaternion_to_matrix(truth.quaternion)[:, 2, 0]
    return np.interp(t_s, seconds(truth.t_ns, recording), up)


def _spell_age_s(stuck: NDArray[np.bool_]) -> Array:
    """How long (n,), s, the robot has spun on the spot at each half second; 0 where it does not."""
    age, out = 0.0, np.zeros(len(stuck))
    for i, now in enumerate(stuck.tolist()):
        age = age + SLIP_S if now else 0.0
        out[i] = age
    return out


def _yaw_scales(recording: Recording) -> Array:
    """True over wheel yaw rate, less one, of half-second means while the wheels turn the robot."""
    samples, truth = wheel_samples(recording), recording.truth
    assert truth is not None
    assert truth.twist_body is not None
    count = max(round(SLIP_S / float(np.median(np.diff(samples.t_s)))), 1)
    left, right = _block_means(samples.sides_mps, count).T
    wheel = (right - left) / _vehicle(recording).rig().track_m
    true = _block_means(np.interp(samples.t_s, seconds(truth.t_ns, recording), truth.twist_body[:, 5]), count)
    turning = np.abs(wheel) > YAWING_RADPS
    return np.asarray(np.clip(true[turning] / wheel[turning] - 1.0, -1.0, 1.0))


def _side_slips(recording: Recording) -> Array:
    """Lateral over forward speed (n,), without what turning about another point than the body origin does."""
    truth = recording.truth
    assert truth is not None
    assert truth.twist_body is not None
    forward, lateral, rate = truth.twist_body[:, 0], truth.twist_body[:, 1], truth.twist_body[:, 5]
    icr = -float(lateral @ rate) / max(float(rate @ rate), 1e-9)
    moving = np.abs(forward) > SIDE_SLIP_FROM_MPS
    return np.asarray((lateral + icr * rate)[moving] / forward[moving])


def _imu_evidence(recording: Recording) -> tuple[Array, Array]:
    """Errors of means of gyro and accelerometer over the data sheet's, all axes, (n,) and (m,).

    Each sample is compared with the rotation and the change of velocity over
    the interval before it. Only while the wheels turn.
    """
    imu, truth = recording.imu, recording.truth
    assert imu is not None
    assert truth is not None
    assert truth.twist_body is not None
    assert truth.quaternion is not None
    spec = _vehicle(recording).sensors.imu
    imu_t, truth_t = seconds(imu.t_ns, recording), seconds(truth.t_ns, recording)
    step = float(np.median(np.diff(imu_t)))
    rows = np.searchsorted(truth_t, np.append(imu_t[0] - step, imu_t) - 0.5 * step)
    rows = np.minimum(rows, len(truth_t) - 1)
    R = quaternion_to_matrix(truth.quaternion[rows])
    velocity = _imu_velocity(truth.twist_body[rows], R, spec)
    change = np.diff(velocity, axis=0) / step + np.array([0.0, 0.0, GRAVITY_MPS2])
    gyro = imu.gyro_radps - _rotation_vectors(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / step
    accel = imu.accel_mps2 - np.einsum("nji,nj->ni", R[:-1], change)
    samples = wheel_samples(recording)
    speed = np.interp(imu_t, samples.t_s, np.abs(samples.sides_mps).mean(axis=1))
    return (
        _relative(gyro, speed, step, GYRO_S, spec.gyro_noise_radps_sqrthz),
        _relative(accel, speed, step, ACCEL_S, spec.accel_noise_mps2_sqrthz),
    )


def _relative(error: Array, speed_mps: Array, step_s: float, tau_s: float, density: float) -> Array:
    """Means over `tau_s` of errors (n, 3) less bias, over density / sqrt(tau): (m,), while wheels turn."""
    count = max(round(tau_s / step_s), 1)
    means = _unbiased(_block_means(error, count), count * step_s)
    rolling = _block_means(speed_mps, count) > TURNING_MPS
    return np.asarray((means[rolling] * np.sqrt(count * step_s) / density).ravel())


def _imu_velocity(twist: Array, R: Array, spec: ImuSpec) -> Array:
    """World velocity (n, 3) of the IMU's place."""
    return np.asarray(np.einsum("nij,nj->ni", R, twist[:, :3] + np.cross(twist[:, 3:], spec.position_m)))


def _rotation_vectors(R: Array) -> Array:
    """Rotation vectors (n, 3), rad, of rotations (n, 3, 3) by less than a quarter turn."""
    twice = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.maximum(0.5 * np.linalg.norm(twice, axis=1, keepdims=True), 1e-12)
    return np.asarray(0.5 * twice * np.arcsin(np.minimum(sine, 1.0)) / sine)


def _unbiased(error: Array, tau_s: float) -> Array:
    """Errors (n, 3) less their running mean over `BIAS_S`."""
    width = min(max(round(BIAS_S / tau_s), 1), len(error))
    count = np.convolve(np.ones(len(error)), np.ones(width), "same")
    slow = np.stack([np.convolve(e, np.ones(width), "same") / count for e in error.T], axis=1)
    return np.asarray(error - slow)


def _gnss_evidence(recording: Recording) -> Array:
    """Horizontal errors of the fixes over their reported sigma, east and north together (n,)."""
    gnss, truth = recording.gnss, recording.truth
    if gnss is None or truth is None:
        return np.empty(0)
    antenna = _vehicle(recording).sensors.gnss.antenna_m
    error = (gnss.enu_m - truth.points_at(gnss.t_ns, antenna))[:, :2] / gnss.sigma_enu_m[:, :2]
    return np.asarray(error[(gnss.fix > Fix.NONE) & np.isfinite(error).all(axis=1)].ravel())


def _vehicle(recording: Recording) -> VehicleParams:
    return load_vehicle(recording.vehicle or "elevate")


def _block_means(x: Array, count: int) -> Array:
    """Means of `count` rows each, the rest left out."""
    blocks = len(x) // count
    return np.asarray(x[: blocks * count].reshape(blocks, count, *x.shape[1:]).mean(axis=1))


def _spread(row: SensorNoise) -> SensorNoise:
    changes = {
        name: value * UNKNOWN_SPREAD
        for name, value in dataclasses.asdict(row).items()
        if name not in ("slip_mean", "slip_per_grade", "slip_time_s", "yaw_scale_mean", "gnss_inflation")
    }
    return dataclasses.replace(row, **{**changes, "slip_sigma": min(changes["slip_sigma"], 1.0)})


def _rounded(row: SensorNoise) -> SensorNoise:
    """Four significant digits: the last bits of a sum differ from machine to machine, the file must not."""
    return SensorNoise(*(float(f"{value:.{DIGITS}g}") for value in dataclasses.astuple(row)))


def fingerprint_of(grid: Grid) -> str:
    """SHA-256 of what a policy fitted on `grid` depends on: parameter files and settings."""
    settings = {
        "short_s": SHORT_S, "slip_s": SLIP_S, "lag_s": LAG_S, "turning_mps": TURNING_MPS,
        "side_slip_from_mps": SIDE_SLIP_FROM_MPS, "stuck_mps": STUCK_MPS, "stuck_counts_s": STUCK_COUNTS_S,
        "yawing_radps": YAWING_RADPS, "bias_s": BIAS_S, "gyro_s": GYRO_S, "accel_s": ACCEL_S,
        "tail": TAIL, "line": [GRADE_RIDGE, LAD_STEPS, LAD_FLOOR],
        "radius_sigma": RADIUS_SIGMA, "unknown_spread": UNKNOWN_SPREAD,
    }  # fmt: skip
    return grid.fingerprint(policy=settings)


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
