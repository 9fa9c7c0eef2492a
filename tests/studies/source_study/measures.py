"""What the study's Figs. 4 to 9 show, as numbers of a run."""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array, Mask
from terrafusion.twin.analysis.speeds import MOVING_MPS, mean_percent
from tests.studies.source_study.cases import CaseRun, between, set_off_s, stopped_s
from tests.studies.source_study.profiles import Profiles

RAMP_S = 4.0  # after a stop the robot needs this long to reach the command within its limit of acceleration
SINKING_S = 10.0  # before it stops for good on mud, the robot follows the command until this long before
ONSET, HALF = 0.10, 0.50
"""Slip proxy at which sinkage is called set in, and at which half of the wheels' distance is lost."""
SLOW_MPS, FAST_MPS = 0.75, 1.25  # the lower and the upper quarter of the profile's speeds
STALLED_MPS = 0.05


def stopped_after_s(run: CaseRun) -> float:
    """From setting off to the stop for good, s; NaN where there is none."""
    at = run.summary.immobilised_at_s
    return math.nan if at is None else at - set_off_s(run)


def follows_until_stop(run: CaseRun) -> dict[str, float]:
    """Percent by which odometry misses the truth, and the truth the command, before sinkage sets in."""
    p = run.profiles
    window = between(run, set_off_s(run) + RAMP_S, stopped_s(run) - SINKING_S)
    command = np.where(window & (p.command > MOVING_MPS), p.command, math.nan)
    return {
        "odometry": mean_percent(p.error(p.odometry)[window]),
        "command": mean_percent(np.abs(p.truth - command) / command),
    }


def speed_after_stop_mps(run: CaseRun) -> dict[str, float]:
    """Largest true and odometry speed from 2 s after the stop for good, m/s; NaN where there is none."""
    p, late = run.profiles, between(run, stopped_s(run) + 2.0, math.inf)
    if not late.any():
        return {"truth": math.nan, "odometry": math.nan}
    return {"truth": float(np.abs(p.truth[late]).max()), "odometry": float(np.abs(p.odometry[late]).max())}


def slip_rise_s(run: CaseRun) -> float:
    """From the last time the slip proxy passes 10 % to when it first passes 50 %, s; NaN if it does not."""
    t_s, slip = run.profiles.t_s, np.nan_to_num(np.abs(run.profiles.slip()))
    late = np.flatnonzero((slip > HALF) & (t_s > set_off_s(run) + RAMP_S))
    if not late.size:
        return math.nan
    calm = np.flatnonzero(slip[: late[0]] < ONSET)
    return float(t_s[late[0]] - t_s[calm[-1]]) if calm.size else math.nan


def slip_swings(run: CaseRun) -> float:
    """How often the slip proxy turns by at least 10 points between its onset and the end of motion."""
    p = run.profiles
    slip = p.slip()
    window = between(run, stopped_s(run) - SINKING_S, stopped_s(run) + SINKING_S) & np.isfinite(slip)
    turns, extreme, rising = 0, math.nan, True
    for value in slip[window].tolist():
        if math.isnan(extreme) or (value > extreme) == rising:
            extreme = value
        elif abs(value - extreme) >= ONSET:
            turns, extreme, rising = turns + 1, value, not rising
    return float(turns)


def yaw_rates_radps(run: CaseRun) -> dict[str, float]:
    """Standard deviations of the yaw rate, rad/s: a constant bias of the gyro is not counted.

    `driving` and `after` the stop for good: of the gyro, low-passed. While
    driving also of the `body` itself, and of the `gyro` as measured.
    """
    p = run.profiles
    driving = p.moving() & between(run, set_off_s(run), stopped_s(run))
    after = between(run, stopped_s(run) + 2.0, math.inf)
    return {
        "driving": _deviation(p.yaw_rate[driving]),
        "after": _deviation(p.yaw_rate[after]),
        "body": _deviation(p.true_yaw_rate[driving]),
        "gyro": _deviation(p.gyro[driving]),
    }


def steady(profiles: Profiles) -> Mask:
    """Where the robot has been commanded to drive for longer than its ramp takes."""
    going = profiles.command > MOVING_MPS
    ramp = round(RAMP_S / float(profiles.t_s[1] - profiles.t_s[0]))
    since = np.arange(len(going)) - np.maximum.accumulate(np.where(going, -1, np.arange(len(going))))
    return np.asarray(going & (since > ramp))


def phases(profiles: Profiles) -> dict[str, list[Mask]]:
    """The stretches of steady driving in which the command rises, and in which it falls."""
    rate = np.gradient(profiles.command)
    found: dict[str, list[Mask]] = {}
    for name, mask in (
        ("rising", steady(profiles) & (rate > 0.0)),
        ("falling", steady(profiles) & (rate < 0.0)),
    ):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
        rows = np.arange(len(mask))
        found[name] = [(rows >= a) & (rows < b) for a, b in edges.reshape(-1, 2) if b - a > 50 * RAMP_S]
    return found


def lags_percent(run: CaseRun) -> list[float]:
    """How far the truth stays behind the command in each acceleration, mean percent of the command."""
    p = run.profiles
    return [mean_percent((p.command - p.truth)[m] / p.command[m]) for m in phases(p)["rising"]]


def accelerations_mps2(run: CaseRun) -> float:
    """Mean acceleration over the first 2 s of motion, from the start and after each stop, m/s2."""
    p = run.profiles
    dt_s = float(p.t_s[1] - p.t_s[0])
    starts = np.flatnonzero(p.moving()[1:] & ~p.moving()[:-1])
    ends = starts + round(2.0 / dt_s)
    inside = ends < len(p.t_s)
    return float(np.mean((p.truth[ends[inside]] - p.truth[starts[inside]]) / 2.0))


def keeps_moving_percent(run: CaseRun) -> float:
    """Share of steady driving in which the robot moves."""
    p = run.profiles
    return mean_percent(p.moving()[steady(p)].astype(float))


def linearity(run: CaseRun) -> dict[str, float]:
    """Gain and coefficient of determination of true against commanded speed in steady driving."""
    p = run.profiles
    rows = steady(p)
    gain, offset = np.polyfit(p.command[rows], p.truth[rows], 1)
    residual = p.truth[rows] - gain * p.command[rows] - offset
    return {"gain": float(gain), "r2": float(1.0 - residual.var() / p.truth[rows].var())}


def gnss_quality(profiles: Profiles) -> dict[str, float]:
    """Where GNSS speed is poor: ratios of its errors, slow over fast and near stops over steady; and its fit.

    `slow_over_fast` is of relative errors, `stops_over_steady` of absolute ones
    (standing still included), `correlation` that with the true speed.
    """
    p = profiles
    relative, absolute = p.error(p.gnss), np.abs(p.gnss - np.abs(p.truth))
    seen = np.isfinite(p.gnss) & np.isfinite(p.truth)
    slow, fast = p.moving() & (p.truth < SLOW_MPS), p.truth > FAST_MPS
    calm = steady(p)
    return {
        "slow_over_fast": mean_percent(relative[slow]) / mean_percent(relative[fast]),
        "stops_over_steady": mean_percent(absolute[~calm]) / mean_percent(absolute[calm]),
        "correlation": float(np.corrcoef(p.gnss[seen & calm], p.truth[seen & calm])[0, 1]),
    }


def slope_adds(sloped: CaseRun, flat: CaseRun) -> dict[str, float]:
    """Points of |slip| that the slope adds while the command rises, and while it falls."""
    added = {}
    for name in ("rising", "falling"):
        means = []
        for run in (sloped, flat):
            rows = np.any(phases(run.profiles)[name], axis=0)
            means.append(mean_percent(np.abs(run.profiles.slip()[rows])))
        added[name] = means[0] - means[1]
    return added


def short_stalls(run: CaseRun) -> float:
    """How often the robot stands although it is commanded to drive, and gets going again."""
    p = run.profiles
    stands = steady(p) & (np.abs(p.truth) < STALLED_MPS) & (p.t_s < stopped_s(run))
    return float(np.sum(stands[1:] & ~stands[:-1]))


def imu_drift_mps(run: CaseRun) -> dict[str, float]:
    """Mean absolute error of IMU speed in the first and in the last minute, m/s."""
    p = run.profiles
    error = np.abs(p.imu - p.truth)
    first = between(run, set_off_s(run), set_off_s(run) + 60.0)
    last = between(run, float(p.t_s[-1]) - 60.0, math.inf)
    return {"first": float(np.nanmean(error[first])), "last": float(np.nanmean(error[last]))}


def imu_sees_stop(run: CaseRun) -> float:
    """Change of IMU speed over that of the true speed, from 4 s before to 2 s after the stop for good."""
    p, at = run.profiles, stopped_s(run)
    before, after = np.searchsorted(p.t_s, [at - 4.0, min(at + 2.0, float(p.t_s[-1]))])
    return float((p.imu[after] - p.imu[before]) / (p.truth[after] - p.truth[before]))


def path_errors_percent(run: CaseRun) -> dict[str, float]:
    """Error at the end of the run, percent of the true distance: of GNSS positions, and of odometry."""
    p = run.profiles
    dt_s = float(p.t_s[1] - p.t_s[0])
    true_m, odometry_m = float(np.abs(p.truth).sum()) * dt_s, float(np.abs(p.odometry).sum()) * dt_s
    made = (run.gnss_enu_m[-1] - run.gnss_enu_m[0]) - (run.truth_enu_m[-1] - run.truth_enu_m[0])
    return {
        "gnss": 100.0 * float(np.hypot(*made)) / true_m,
        "odometry": 100.0 * abs(odometry_m - true_m) / true_m,
    }


def _deviation(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.std()) if known.size else math.nan
