"""The truth against itself and the wheels: its yaw, its unit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.path import ANY_RADIUS_M, compare, places, wheel_speed
from terrafusion.datasets.checks.yaw_signals import seconds
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory

Array = NDArray[np.float64]

CHORD_S, LEAST_CHORD_M = 1.0, 0.2
LEAST_CHORDS, LEAST_R = 20, 0.95
"""Chords that are needed, and how alike their offsets must be (length of the mean of unit vectors)."""
LARGE_OFFSET = np.radians(30.0)
"""Robots that slide across a slope crab by less."""
UNITS = {"mm": 1000.0, "cm": 100.0, "feet": 1.0 / 0.3048}
UNIT_ERROR = 0.1


def check_yaw(context: CheckContext) -> Iterator[Finding]:
    """The truth must face the way it goes, driving forward."""
    offset = yaw_offset(context)
    if offset is None or abs(offset[0]) < LARGE_OFFSET:
        return
    angle, chords, r = offset
    yield Finding(
        "truth-yaw",
        "warning",
        "truth",
        f"the truth's yaw is {np.degrees(angle):.0f} deg off the way it goes",
        f"mean over {chords} chords of {CHORD_S:g} s on which the wheels run; of one mind to {r:.2f}",
        f"turn its body frame by {-np.degrees(angle):.0f} deg about z",
        partial(_turned, angle=-angle),
    )


def yaw_offset(context: CheckContext) -> tuple[float, int, float] | None:
    """Mean of yaw less course of the truth (rad), the chords it was found from, and how alike they are.

    Where the wheels run backwards the course is taken the other way. None where the truth, or the sign
    of the wheels' speed, is not known well enough.
    """
    truth = context.recording.truth
    driven = wheel_speed(context, context.wheel_radius_m() or ANY_RADIUS_M)
    if truth is None or truth.quaternion is None or driven is None:
        return None
    known = np.isfinite(truth.position_m[:, :2]).all(axis=1) & np.isfinite(truth.quaternion).all(axis=1)
    if known.sum() < 2 * LEAST_CHORDS:
        return None
    t, yaw = seconds(truth.t_ns[known], context.recording.start_ns), np.unwrap(truth.yaw_rad()[known])
    place = truth.position_m[known, 0] + 1j * truth.position_m[known, 1]
    t_wheel, v = driven
    grid = np.arange(max(t[0], t_wheel[0]), min(t[-1], t_wheel[-1]), CHORD_S)
    if len(grid) < LEAST_CHORDS:
        return None
    chord, middle = np.diff(np.interp(grid, t, place)), 0.5 * (grid[1:] + grid[:-1])
    speed = np.interp(middle, t_wheel, v)
    turned = np.abs(np.diff(np.interp(grid, t, yaw)))
    use = (np.abs(chord) > LEAST_CHORD_M) & (np.abs(speed) > 0.5 * LEAST_CHORD_M) & (turned < 0.5)
    if use.sum() < LEAST_CHORDS:
        return None
    course = np.angle(chord * np.sign(speed))[use]
    mean = complex(np.exp(1j * (np.interp(middle, t, yaw)[use] - course)).mean())
    return (float(np.angle(mean)), int(use.sum()), abs(mean)) if abs(mean) > LEAST_R else None


def _turned(recording: Recording, angle: float) -> Recording:
    """The truth with its body frame turned by `angle` about its own z."""
    from scipy.spatial.transform import Rotation

    truth = recording.truth
    assert truth is not None
    assert truth.quaternion is not None
    known = np.isfinite(truth.quaternion).all(axis=1)
    quaternion = truth.quaternion.copy()
    turn = Rotation.from_quat(rpy_to_quaternion([0.0, 0.0, angle]))
    quaternion[known] = (Rotation.from_quat(quaternion[known]) * turn).as_quat()
    twist = truth.twist_body
    if twist is not None:
        twist = np.hstack([twist[:, :3] @ turn.as_matrix(), twist[:, 3:] @ turn.as_matrix()])
    return dataclasses.replace(
        recording, truth=dataclasses.replace(truth, quaternion=quaternion, twist_body=twist)
    )


def check_unit(context: CheckContext) -> Iterator[Finding]:
    """The truth's positions must be metres."""
    true = next((one for one in places(context.recording) if one.source == "truth"), None)
    windows = compare(context, true) if true is not None else None
    if windows is None:
        return
    ratio = float(np.median(windows.span_ratio))
    for unit, factor in UNITS.items():
        if abs(ratio / factor - 1.0) < UNIT_ERROR:
            yield Finding(
                "truth-unit",
                "error",
                "truth",
                f"positions look like {unit}",
                f"the truth spreads {ratio:.4g} times as far as the path of the wheels",
                f"divide them by {factor:.6g}, and leave velocities and covariances out",
                partial(_scaled, factor=1.0 / factor),
            )
            return


def _scaled(recording: Recording, factor: float) -> Recording:
    truth: Trajectory | None = recording.truth
    assert truth is not None
    scaled = dataclasses.replace(
        truth, position_m=truth.position_m * factor, twist_body=None, covariance=None
    )
    held = tuple(name for name in recording.truth_channels if name != "velocity")
    return dataclasses.replace(recording, truth=scaled, truth_channels=held)
