"""Wheels, turns and fixes of a stretch of driving, and the path that the numbers of a robot make of them."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.numbers import (
    COURSE_LAG,
    GYRO_BIAS,
    NUMBERS,
    SLIP_PER_GRADE,
    TURN_SCALE,
    WHEEL_DELAY,
)

Complex = NDArray[np.complex128]

LEAST_STEP_S = 1e-3
"""Shorter times between samples show no rate."""
LEAST_NODE_S, LONGEST_NODE_S = 2.0, 30.0
NODE_M, NODE_SIGMAS, LONGEST_NODE_M = 4.0, 20.0, 40.0
"""A new node after 2 s and a distance that the fixes show to 5 %, from 4 to 40 m; or after 30 s."""


@dataclass(frozen=True, eq=False)
class MotionSegment:
    """Wheels, turns and fixes of one uninterrupted part of a drive.

    Attributes:
        t_s: (N + 1,) times; sample 0 is the start.
        distance_m: (N,) mean distance of the wheels along the body's x axis since the sample before.
        turn_rad: (N,) turn by its source since the sample before, as measured.
        fix_t_s: (F,) stamps of the fixes.
        fix: (F,) positions, east + i north, m.
        fix_sigma_m: (F,) 1 sigma of each axis.
        antenna_m: nominal lever arm, forward + i left, m.
        first: (M,) samples at which a node begins, from 0 on.
        course_rad: (N,) angle from the body's x axis to where the wheels roll, as steered; None: along it.
        climb_m: (N,) unsigned distance times the sine of the body's slope, x axis up; None: on the level.
    """

    t_s: Array
    distance_m: Array
    turn_rad: Array
    fix_t_s: Array = field(default_factory=lambda: np.zeros(0))
    fix: Complex = field(default_factory=lambda: np.zeros(0, dtype=complex))
    fix_sigma_m: Array = field(default_factory=lambda: np.zeros(0))
    antenna_m: complex = 0j
    first: NDArray[np.intp] = field(default_factory=lambda: np.zeros(1, dtype=np.intp))
    course_rad: Array | None = None
    climb_m: Array | None = None


def node_due(apart_s: float, rolled_m: float, fix_sigma_m: float) -> bool:
    """Whether a new node is due this long and far after the last one."""
    long_m = min(max(NODE_SIGMAS * fix_sigma_m, NODE_M), LONGEST_NODE_M)
    return (apart_s >= LEAST_NODE_S and rolled_m >= long_m) or apart_s >= LONGEST_NODE_S


@dataclass(frozen=True, eq=False)
class Path:
    """Dead reckoning of a drive with given numbers, and its derivatives by them.

    Attributes:
        yaw_rad: (N + 1,) from 0.
        z: (N + 1,) position without slip, east + i north for yaw 0 at the start, m.
        yaw_by: (N + 1, 9) derivatives of the yaw by `NUMBERS`; zero where there is none.
        z_by: (N + 1, 9) of the position.
    """

    yaw_rad: Array
    z: Complex
    yaw_by: Array
    z_by: Complex


def dead_reckoned(drive: MotionSegment, numbers: Array, begin: int = 0, end: int | None = None) -> Path:
    """The path of `drive` by wheels and turns with `numbers` (9,), from sample `begin` to `end`."""
    end = len(drive.t_s) - 1 if end is None else end
    t_s = drive.t_s[begin : end + 1]
    dt, distance_m = np.diff(t_s), drive.distance_m[begin:end]
    rate_scale = 1.0 + numbers[TURN_SCALE]
    turn = rate_scale * (drive.turn_rad[begin:end] - numbers[GYRO_BIAS] * dt)
    yaw = _summed(turn)
    gained = _speed_gained(drive, begin, end)
    step = distance_m + numbers[WHEEL_DELAY] * gained
    climb_m = np.zeros(len(step)) if drive.climb_m is None else drive.climb_m[begin:end]
    step = step - numbers[SLIP_PER_GRADE] * climb_m
    per_s = 1.0 / np.maximum(dt, LEAST_STEP_S)
    lag_s, rate = numbers[COURSE_LAG], turn * per_s
    middle = np.exp(1j * (0.5 * (yaw[1:] + yaw[:-1]) - lag_s * rate))
    if drive.course_rad is not None:
        middle = middle * (1.0 + 1j * np.tan(drive.course_rad[begin:end]))
    yaw_by = np.zeros((len(yaw), len(NUMBERS)))
    yaw_by[:, TURN_SCALE] = yaw / rate_scale
    yaw_by[:, GYRO_BIAS] = -rate_scale * (t_s - t_s[0])
    z_by = np.zeros((len(yaw), len(NUMBERS)), dtype=complex)
    for number in (TURN_SCALE, GYRO_BIAS):
        by = 0.5 * (yaw_by[1:, number] + yaw_by[:-1, number]) - lag_s * np.diff(yaw_by[:, number]) * per_s
        z_by[:, number] = _summed(1j * by * step * middle)
    z_by[:, WHEEL_DELAY] = _summed(gained * middle)
    z_by[:, SLIP_PER_GRADE] = _summed(-climb_m * middle)
    z_by[:, COURSE_LAG] = _summed(-1j * rate * step * middle)
    return Path(yaw, _summed(step * middle), yaw_by, z_by)


def _speed_gained(drive: MotionSegment, begin: int, end: int) -> Array:
    """Change of the wheels' speed over each sample, m/s, by central differences."""
    first, last = max(begin - 1, 0), min(end + 1, len(drive.distance_m))
    if last - first < 2:
        return np.zeros(end - begin)
    dt = np.maximum(np.diff(drive.t_s[first : last + 1]), LEAST_STEP_S)
    speed = drive.distance_m[first:last] / dt
    return np.asarray(np.gradient(speed)[begin - first :][: end - begin])


def _summed(steps: Any) -> Any:
    return np.concatenate([np.zeros(1, dtype=steps.dtype), np.cumsum(steps)])
