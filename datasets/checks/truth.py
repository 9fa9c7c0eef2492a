"""The truth: its yaw against its own course, its unit against the wheels, its frame against the fixes."""

import dataclasses
from collections.abc import Iterator
from functools import partial

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, Finding, changed, with_fields
from terrafusion.datasets.checks.motion import on_plane, seconds, typical_sigma, wheel_speed
from terrafusion.datasets.checks.path import fit_windows, path_by
from terrafusion.datasets.core.arrays import Complex
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory

CHORD_S, LEAST_CHORD_M = 1.0, 0.2
LEAST_CHORDS, LEAST_R = 20, 0.95
"""Chords that are needed, and the resultant length of their offsets (length of the mean of unit vectors)."""
LARGE_OFFSET = np.radians(30.0)
"""Robots that side-slip across a slope crab by less."""
UNITS = {"mm": 1000.0, "cm": 100.0, "feet": 1.0 / 0.3048}
UNIT_ERROR = 0.1
LEAST_FIXES, LEAST_APART_M = 20, 1.0


def check_yaw(context: CheckContext) -> Iterator[Finding]:
    """The truth's yaw must be its course when driving forward."""
    offset = yaw_offset(context)
    if offset is None or abs(offset[0]) < LARGE_OFFSET:
        return
    angle, chords, r = offset
    yield Finding(
        "truth-yaw", "warning", "truth",
        f"the truth's yaw is {np.degrees(angle):.0f} deg off its course",
        f"mean over {chords} chords of {CHORD_S:g} s on which the wheels run; resultant length {r:.2f}",
        f"turn its body frame by {-np.degrees(angle):.0f} deg about z",
        changed("truth", _turned, angle=-angle),
    )  # fmt: skip


def yaw_offset(context: CheckContext) -> tuple[float, int, float] | None:
    """Mean of yaw less course of the truth (rad), number of chords, and resultant length.

    Where the wheels run backwards the course is reversed. None where the truth, or the sign of the
    wheels' speed, is not known well enough.
    """
    truth = context.recording.truth
    driven = wheel_speed(context)
    if truth is None or truth.quaternion is None or driven is None:
        return None
    known = np.isfinite(truth.position_m[:, :2]).all(axis=1) & np.isfinite(truth.quaternion).all(axis=1)
    if known.sum() < 2 * LEAST_CHORDS:
        return None
    t, yaw = seconds(truth.t_ns[known], context.recording.start_ns), np.unwrap(truth.yaw_rad()[known])
    place = on_plane(truth.position_m[known])
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


def _turned(truth: Trajectory, angle: float) -> Trajectory:
    """The truth with its body frame turned by `angle` about its own z."""
    from scipy.spatial.transform import Rotation

    assert truth.quaternion is not None
    known = np.isfinite(truth.quaternion).all(axis=1)
    quaternion = truth.quaternion.copy()
    turn = Rotation.from_quat(rpy_to_quaternion([0.0, 0.0, angle]))
    quaternion[known] = (Rotation.from_quat(quaternion[known]) * turn).as_quat()
    twist = truth.twist_body
    if twist is not None:
        twist = np.hstack([twist[:, :3] @ turn.as_matrix(), twist[:, 3:] @ turn.as_matrix()])
    return dataclasses.replace(truth, quaternion=quaternion, twist_body=twist)


def check_unit(context: CheckContext) -> Iterator[Finding]:
    """The truth's positions must be metres."""
    fits = fit_windows(context, path_by(context.recording, "truth"))
    if fits is None:
        return
    ratio = float(np.median(fits.span_ratio))
    for unit, factor in UNITS.items():
        if abs(ratio / factor - 1.0) < UNIT_ERROR:
            yield Finding(
                "truth-unit", "error", "truth",
                f"positions look like {unit}",
                f"the truth spreads {ratio:.4g} times as far as the path of the wheels",
                f"divide them by {factor:.6g}, and leave velocities and covariances out",
                partial(_scaled, factor=1.0 / factor),
            )  # fmt: skip
            return


def check_frame(context: CheckContext) -> Iterator[Finding]:
    """Truth and fixes must have one frame: scores compare the two as they are."""
    gnss, truth = context.recording.gnss, context.recording.truth
    if gnss is None or truth is None:
        return
    known = np.isfinite(truth.position_m[:, :2]).all(axis=1)
    t_ns, place = truth.t_ns[known], on_plane(truth.position_m[known])
    first, last = (int(t_ns[0]), int(t_ns[-1])) if len(t_ns) else (0, -1)
    during = (gnss.t_ns >= first) & (gnss.t_ns <= last) & (gnss.fix != Fix.NONE)
    fixes = gnss.select(during & np.isfinite(gnss.enu_m[:, :2]).all(axis=1))
    if len(fixes) < LEAST_FIXES:
        return
    there = np.interp((fixes.t_ns - first).astype(float), (t_ns - first).astype(float), place)
    seen, sigma_m = on_plane(fixes.enu_m), typical_sigma(fixes)
    turn, shift = _moved_onto(there, seen)
    apart_m, left_m = (float(np.median(np.abs(seen - at))) for at in (there, turn * there + shift))
    if not apart_m > max(LEAST_APART_M, 5.0 * left_m, 5.0 * sigma_m):
        return
    degrees, middle = float(np.degrees(np.angle(turn))), complex(there.mean())
    away = turn * middle + shift - middle
    yield Finding(
        "truth-frame", "warning", "truth",
        f"the truth is not in the frame of the fixes: turned by {-degrees:.1f} deg, its middle "
        f"{-away.real:.3g} m east and {-away.imag:.3g} m north of theirs",
        f"median distance from {len(fixes)} fixes {apart_m:.3g} m, {left_m:.2g} m once that is removed",
        "turn and move it onto the fixes, and leave its covariance out",
        changed("truth", _placed, turn=turn, shift=shift),
    )  # fmt: skip


def _moved_onto(points: Complex, others: Complex) -> tuple[complex, complex]:
    """Turn (of length 1) and shift that bring points (n,) closest to others (n,), by the nearer half."""
    use, turn = np.ones(len(points), dtype=bool), 1.0 + 0.0j
    for _ in range(3):
        a, b = points[use] - points[use].mean(), others[use] - others[use].mean()
        product = complex(np.vdot(a, b))
        turn = product / abs(product) if product else turn
        shift = complex(others[use].mean() - turn * points[use].mean())
        left = np.abs(turn * points + shift - others)
        use = left <= np.median(left)
    return turn, shift


def _placed(truth: Trajectory, turn: complex, shift: complex) -> Trajectory:
    """The truth in another frame of the world: turned about z, then moved."""
    from scipy.spatial.transform import Rotation

    place, position = turn * on_plane(truth.position_m) + shift, truth.position_m.copy()
    position[:, 0], position[:, 1] = place.real, place.imag
    quaternion = truth.quaternion
    if quaternion is not None:
        known = np.isfinite(quaternion).all(axis=1)
        quaternion, about_z = quaternion.copy(), Rotation.from_euler("z", np.angle(turn))
        quaternion[known] = (about_z * Rotation.from_quat(quaternion[known])).as_quat()
    return dataclasses.replace(truth, position_m=position, quaternion=quaternion, covariance=None)


def _scaled(recording: Recording, factor: float) -> Recording:
    assert recording.truth is not None
    position = recording.truth.position_m * factor
    recording = with_fields(recording, "truth", position_m=position, twist_body=None, covariance=None)
    remaining = tuple(name for name in recording.truth_channels if name != "velocity")
    return dataclasses.replace(recording, truth_channels=remaining)
