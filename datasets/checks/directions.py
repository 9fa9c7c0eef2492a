"""Which way the wheels run: their sides against each other, and all of them against the drive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.mounting import gravity, heading, wheels_turn_backwards
from terrafusion.datasets.checks.path import ANY_RADIUS_M, places, wheel_speed
from terrafusion.datasets.checks.yaw_signals import SURE_R, Account, account, agreement, seconds
from terrafusion.datasets.core.channels import Imu

Array = NDArray[np.float64]

WIDEST_TRACK_M = 6.0
"""Sides that turn against each other by v spin a robot at v over half its effective track, below this."""
LEAST_S, LEAST_MPS = 10.0, 0.05
"""Shorter and slower drives do not tell which way the wheels run."""
LEAST_PROGRESS = 0.3
"""Way made good over way rolled, if the sides turn the same way, from which the robot does not spin."""


def sides_opposed(context: CheckContext) -> str | None:
    """Whether one side has the wrong sign: what tells it; "" where nothing does; None where none has.

    Sides of opposite sign nearly all the time may be a robot that spins on the spot: then the gyro
    turns as they say.
    """
    wheels = context.recording.wheels
    if wheels is None or not wheels.has_sides():
        return None
    sides = wheels.side_speeds_mps(context.wheel_radius_m() or ANY_RADIUS_M)
    known = np.isfinite(sides).all(axis=1)
    t_ns, sides = wheels.t_ns[known], sides[known]
    moving = (np.abs(sides) > 0.05 * np.abs(sides).max(initial=0.0)).all(axis=1) & sides.any(axis=1)
    opposite = (np.sign(sides[:, 0]) != np.sign(sides[:, 1])) & moving
    if moving.sum() < 50 or opposite.sum() < 0.9 * moving.sum():
        return None
    apart, together = np.abs(sides[:, 1] - sides[:, 0]), sides.sum(axis=1)
    if np.abs(together[moving]).mean() > 0.5 * np.abs(sides[moving]).mean():
        return None
    imu, start = context.recording.imu, context.recording.start_ns
    gyro = None if imu is None else account(start, imu.t_ns, _upright_rate(context, imu))
    made_good = _progress(context, account(start, t_ns, 0.5 * apart))
    if gyro is not None:
        rate = float(np.abs(gyro.rates(np.linspace(gyro.t_s[0], gyro.t_s[-1], 200))).mean())
        if rate * WIDEST_TRACK_M > float(apart.mean()):
            return None
        summed = account(start, t_ns, together)
        by_sum = agreement(gyro, summed) if summed is not None else None
        if by_sum is not None and by_sum.is_sure():
            return f"the gyro turns as their sum does (correlation {abs(by_sum.r):.2f})"
    if made_good is not None:
        progress, source = made_good
        return (
            f"by the {source} the robot makes {progress:.0%} of their way"
            if progress > LEAST_PROGRESS
            else None
        )
    return ""


def _upright_rate(context: CheckContext, imu: Imu) -> Array:
    """Angular rate (N,) about the direction of gravity, up to its sign; about z where that is unknown."""
    mean = gravity(context)
    if mean is None or not imu.has_gyro() or not np.linalg.norm(mean) > 0.0:
        return imu.gyro_radps[:, 2]
    return np.asarray(imu.gyro_radps @ (mean / np.linalg.norm(mean)))


def _progress(context: CheckContext, rolled: Account | None) -> tuple[float, str] | None:
    """Way made good over way rolled, both over 10 s, and what told it."""
    for true in places(context.recording):
        grid = np.arange(true.t_s[0], true.t_s[-1], 10.0)
        if rolled is None or len(grid) < 3:
            continue
        steps = np.abs(np.diff(np.interp(grid, true.t_s, true.place)))
        way = float(np.sum(rolled.rates(grid)) * 10.0)
        if way > 10.0 * max(true.sigma_m, 0.1):
            return float(steps.sum()) / way, true.source
    return None


def runs_backwards(context: CheckContext) -> str | None:
    """What tells that the wheels say backwards when the robot drives forward; None where nothing does."""
    driven = wheel_speed(context, context.wheel_radius_m() or ANY_RADIUS_M)
    if driven is None:
        return None
    found = heading(context)
    if found is not None and found.angle is not None:
        backwards = abs(found.angle) > 0.75 * np.pi and wheels_turn_backwards(context)
        return "acceleration answers them with the opposite sign" if backwards else None
    t, v = driven
    way = Account(t, np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))]))
    for name, there in _forward_ways(context).items():
        start, end = max(t[0], there.t_s[0]), min(t[-1], there.t_s[-1])
        if end - start < LEAST_S:
            continue
        grid = np.arange(start, end, 0.5)
        a, b = way.rates(grid), there.rates(grid)
        power = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
        if power > 0.0 and np.abs(a).mean() > LEAST_MPS:
            r = float(np.sum(a * b)) / power
            return f"{name} goes the other way (correlation {r:.2f})" if r < -SURE_R else None
    total = float(np.abs(v).sum())
    mostly = total > 0.0 and float(v.sum()) / total < -0.8 and t[-1] - t[0] > LEAST_S
    return "they run backwards nearly all the time" if mostly and wheels_turn_backwards(context) else None


def _forward_ways(context: CheckContext) -> dict[str, Account]:
    """The way driven forward (m), by what tells it with its sign."""
    recording, start = context.recording, context.recording.start_ns
    truth, command = recording.truth, recording.command
    found: dict[str, Account | None] = {}
    if truth is not None and truth.quaternion is not None:
        known = np.isfinite(truth.position_m[:, :2]).all(axis=1) & np.isfinite(truth.quaternion).all(axis=1)
        if known.sum() > 10:
            t, yaw = seconds(truth.t_ns[known], start), truth.yaw_rad()[known]
            step = np.diff(truth.position_m[known, 0] + 1j * truth.position_m[known, 1])
            forward = np.real(step * np.exp(-1j * yaw[:-1]))
            found["the truth"] = Account(t, np.concatenate([[0.0], np.cumsum(forward)]))
    if command is not None:
        found["the command"] = account(start, command.t_ns, command.v_mps)
    return {name: way for name, way in found.items() if way is not None}
