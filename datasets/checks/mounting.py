"""How the IMU is mounted, by gravity, by the wheels' changes of speed, and by the turns.

Gravity tells which axis points up; the specific force along and across the drive (change of speed,
speed times yaw rate) tells which one points forward; gyro and wheels tell whether the gyro shares
the axes of the accelerometer.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair
from terrafusion.datasets.checks.path import ANY_RADIUS_M, wheel_speed
from terrafusion.datasets.checks.yaw_signals import Account, account, accounts, agreement
from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import AXES, axes_matrix

Array = NDArray[np.float64]
Axes = tuple[str, ...]

MOST_TILT = np.cos(np.radians(30.0))
"""Drives on slopes to 25 deg tilt the mean specific force by as much."""
WINDOW_S, SMOOTH_S = 0.5, 8.0
"""Motion is compared over the first, less its mean over the second: slopes and biases change slowly."""
LEAST_C, SIGMAS = 0.25, 5.0
"""A correlation counts above the first, and above so many standard errors of noise."""
NEAR_AXIS = np.radians(25.0)
LEAST_GAIN = 0.4
"""Acceleration felt over that of the wheels: of a robot that is stuck only the shaking answers the wheels."""
HANDED = 0.1
"""By how much the correlation with the turns as told must differ from that with them mirrored."""
LEAST_ACCEL = 0.02
"""m/s2; a drive more even than this tells nothing."""


def gravity(context: CheckContext) -> Array | None:
    """Mean specific force (3,), m/s2, where all three axes are known."""
    imu = context.recording.imu
    if imu is None or not imu.has_accel() or len(imu) < 10:
        return None
    return np.asarray(np.nanmean(imu.accel_mps2, axis=0))


def is_metric(mean: Array) -> bool:
    """Whether a mean specific force is as long as gravity in m/s2."""
    return bool(0.85 * GRAVITY_MPS2 < np.linalg.norm(mean) < 1.15 * GRAVITY_MPS2)


def stands_up(context: CheckContext) -> bool:
    """Whether gravity, where it is known, stands on +z."""
    mean = gravity(context)
    return mean is None or bool(mean[2] >= MOST_TILT * np.linalg.norm(mean))


@dataclass(frozen=True)
class Heading:
    """What accelerometer, gyro and wheels say together.

    Attributes:
        angle: rad, to the left, from the body's forward axis to the first axis of the specific
            force; None where the gyro contradicts the accelerometer.
        turn: 1 where the robot is pressed outwards in the turns that the gyro tells, -1 where it
            is pressed inwards (the gyro has the wrong sign), 0 where it hardly turns.
    """

    angle: float | None
    turn: float


def heading_of(context: CheckContext, accel: Array, yaw_rate: Array) -> Heading | None:
    """How the horizontal specific force answers the changes of speed and the turns.

    Args:
        context: gives the wheels and the IMU's times.
        accel: (N, 2) horizontal specific force, m/s2, the second axis left of the first.
        yaw_rate: (N,) about the upward axis, rad/s.

    Returns:
        None where the drive does not tell: too short, too even, too noisy.
    """
    imu, start = context.recording.imu, context.recording.start_ns
    driven = wheel_speed(context, context.wheel_radius_m() or ANY_RADIUS_M)
    if imu is None or driven is None:
        return None
    t_wheel, v = driven
    columns = [account(start, imu.t_ns, column) for column in (*accel.T, yaw_rate)]
    distance = Account(t_wheel, np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t_wheel))]))
    known = [column for column in columns if column is not None] + [distance]
    first, last = max(one.t_s[0] for one in known), min(one.t_s[-1] for one in known)
    if len(known) < 4 or not last - first >= 2.0 * SMOOTH_S:
        return None
    grid = np.arange(first, last, WINDOW_S)
    along, across, turn, speed = (one.rates(grid) for one in known)
    felt = _lively(0.5 * (along + 1j * across)[1:] + 0.5 * (along + 1j * across)[:-1])
    left = speed * turn
    driven_by = _lively(np.diff(speed) / WINDOW_S + 0.5j * (left[1:] + left[:-1]))
    power = float(np.sqrt(np.sum(np.abs(felt) ** 2) * np.sum(np.abs(driven_by) ** 2)))
    if np.abs(driven_by).std() < LEAST_ACCEL or power <= 0.0:
        return None
    common, mirrored = complex(np.sum(felt * np.conj(driven_by))), complex(np.sum(felt * driven_by))
    best = max(abs(common), abs(mirrored))
    gain = best / float(np.sum(np.abs(driven_by) ** 2))
    noise = SIGMAS / np.sqrt(len(felt))
    if gain < LEAST_GAIN or best / power < max(LEAST_C, noise):
        return None
    apart = (abs(common) - abs(mirrored)) / power
    side = float(np.sign(apart)) if abs(apart) > max(HANDED, noise) else 0.0
    return Heading(None if side < 0.0 else -float(np.angle(common)), side)


def _lively(values: Array | NDArray[np.complex128]) -> NDArray[np.complex128]:
    """What is left of a signal without its running mean."""
    kernel = np.ones(round(SMOOTH_S / WINDOW_S) + 1)
    count = np.convolve(np.ones(len(values)), kernel, "same")
    return np.asarray(values - np.convolve(values, kernel, "same") / count)


def turning_axis(context: CheckContext) -> str | None:
    """The axis of the gyro, with its sign, that turns as the wheels (else the truth) do."""
    imu, known = context.recording.imu, accounts(context)
    other = known.get("wheels") or known.get("truth")
    if imu is None or other is None:
        return None
    best, name = 0.0, None
    for k, axis in enumerate("xyz"):
        turned = account(context.recording.start_ns, imu.t_ns, imu.gyro_radps[:, k])
        both = agreement(turned, other) if turned is not None else None
        if both is not None and both.is_sure() and abs(both.r) > best:
            best, name = abs(both.r), f"{'+' if both.r > 0 else '-'}{axis}"
    return name


def check_axes(context: CheckContext) -> Iterator[Finding]:
    """Gravity must stand on +z, and the specific force must answer the wheels along +x and +y."""
    mean, imu = gravity(context), context.recording.imu
    if mean is None or imu is None or not is_metric(mean):
        return
    evidence = f"mean specific force ({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) m/s2"
    if stands_up(context):
        yield from _check_forward(context)
        return
    k = int(np.argmax(np.abs(mean)))
    up = f"{'+' if mean[k] > 0 else '-'}{'xyz'[k]}"
    if abs(mean[k]) < MOST_TILT * np.linalg.norm(mean):
        what, fix, repair = "gravity lies between the axes", "rotate the IMU to x forward, y left, z up", None
    else:
        what = f"gravity stands on {up}, not on +z"
        told, fix, repair = _uprighted(context, imu, up)
        evidence += told
    yield Finding("imu-axes", "error", "imu", what, evidence, fix, repair)


def _uprighted(context: CheckContext, imu: Imu, up: str) -> tuple[str, str, Repair]:
    """What else the data tell of the mounting, what to do, and the repair."""
    turning = turning_axis(context)
    alone = turning == "+z"  # the gyro is right as it is: the accelerometer has axes of its own
    if alone and up == "-z":
        return "; gyro z turns with the wheels", "change the sign of the specific force", _negated
    axes, told = _axes_for(context, imu, up, alone)
    said = f"turn the {'accelerometer' if alone else 'IMU'} so that {', '.join(axes)} point forward, left, up"
    if turning is not None:
        told = f"; the gyro turns with the wheels about {turning}{told}"
    return told, said, lambda recording: _turned(recording, axes, gyro=not alone)


def _axes_for(context: CheckContext, imu: Imu, up: str, alone: bool) -> tuple[Axes, str]:
    """The axes with z `up` that the drive determines, else those nearest to the log's; and which it was."""
    choices = [axes for axes in _all_axes() if axes[2] == up]
    nearest = max(choices, key=lambda axes: (np.trace(axes_matrix(axes)), axes[0] == "+x"))
    R = axes_matrix(nearest)
    accel = imu.accel_mps2 @ R.T
    rate = imu.gyro_radps[:, 2] if alone else _column(imu.gyro_radps, up)
    found = heading_of(context, accel[:, :2], rate)
    if found is None or found.angle is None:
        return nearest, "; nothing tells which axis is forward: the nearest rotation is assumed"
    quarter = round(found.angle / (0.5 * np.pi)) % 4
    turn = np.linalg.matrix_power(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), quarter)
    axes = next(a for a in choices if np.allclose(axes_matrix(a), turn @ R))
    return axes, f"; acceleration follows the wheels along {axes[0]}"


def heading(context: CheckContext) -> Heading | None:
    """`heading_of` the IMU's x and y, with its gyro z."""
    imu = context.recording.imu
    if imu is None or not stands_up(context):
        return None
    return heading_of(context, imu.accel_mps2[:, :2], imu.gyro_radps[:, 2])


def _check_forward(context: CheckContext) -> Iterator[Finding]:
    found = heading(context)
    angle = found.angle if found is not None else None
    if angle is None or abs(angle) < 0.25 * np.pi:
        return
    quarter = round(angle / (0.5 * np.pi)) % 4
    if quarter == 2 and wheels_turn_backwards(context):
        return  # one fault explains both: see wheels.check_direction
    off = abs(np.angle(np.exp(1j * (angle - 0.5 * np.pi * quarter))))
    axes = {1: ("-y", "+x", "+z"), 2: ("-x", "-y", "+z"), 3: ("+y", "-x", "+z")}.get(quarter)
    sure = axes is not None and off < NEAR_AXIS
    yield Finding(
        "imu-forward",
        "error" if sure else "warning",
        "imu",
        "x does not point forward",
        f"by change of speed and speed times yaw rate it is turned by {np.degrees(angle):.0f} deg",
        f"turn the IMU so that {', '.join(axes)} point forward, left, up"
        if axes is not None and sure
        else "give the IMU's mounting",
        (lambda recording: _turned(recording, axes, gyro=True)) if axes is not None and sure else None,
    )


def wheels_turn_backwards(context: CheckContext) -> bool:
    """Whether the wheels turn against gyro z; on a straight drive, whether they mostly run backwards."""
    driven = wheel_speed(context, context.wheel_radius_m() or ANY_RADIUS_M)
    wheels = context.recording.wheels
    axis = turning_axis(context) if wheels is not None and wheels.has_sides() else None
    return axis == "-z" or (axis is None and driven is not None and float(driven[1].mean()) < 0.0)


def _all_axes() -> list[Axes]:
    """The 24 right-handed ways to lay sensor axes along the body's."""
    return [a for a in permutations(AXES, 3) if np.linalg.det(np.array([AXES[name] for name in a])) > 0.5]


def _column(values: Array, axis: str) -> Array:
    return np.asarray(values[:, "xyz".index(axis[1])] * (1.0 if axis[0] == "+" else -1.0))


def _turned(recording: Recording, axes: Axes, *, gyro: bool) -> Recording:
    """The recording with `axes` of its IMU laid along x, y, z; of the accelerometer alone without `gyro`."""
    imu = recording.imu
    turned = apply(recording, Conventions(imu_axes=axes))
    if gyro or imu is None or turned.imu is None:
        return turned
    return dataclasses.replace(turned, imu=dataclasses.replace(turned.imu, gyro_radps=imu.gyro_radps))


def _negated(recording: Recording) -> Recording:
    assert recording.imu is not None
    imu = dataclasses.replace(recording.imu, accel_mps2=-recording.imu.accel_mps2)
    return dataclasses.replace(recording, imu=imu)
