"""Fixes whose path is the mirror image of that of wheels and gyro, where courses are too coarse to say."""

from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.gnss_frame import reflection
from terrafusion.datasets.checks.motion import course_agreement, gyro_angle
from terrafusion.datasets.checks.path import LONGEST_S, antenna, dead_reckoned, path_by
from terrafusion.datasets.checks.yaw_agreement import agreements
from terrafusion.datasets.core.arrays import Array, Complex

LEAST_FIXES = 20
"""Fixes a piece, at least; more are averaged to so many, for noise of single fixes hides both images."""
CLEARER, LEAST_OFF_M, SCALES = 3.0, 1.0, (0.5, 1.5)
"""Ratio of what is left of the fixes about the path and about its image, and the least of the former, from
which on the image is meant: a straight path and its image differ by nothing, noise and drift bring both near
each other. The image must have about the scale of the path."""


def check_mirrored(context: CheckContext) -> Iterator[Finding]:
    """The path of the fixes must not be the mirror image of that of wheels and gyro."""
    gnss, yaw = context.recording.gnss, gyro_angle(context.recording)
    if gnss is None or yaw is None or course_agreement(yaw, gnss, context.recording.start_ns) is not None:
        return  # see yaw_agreement.check_turns
    wheels = agreements(context).get(("gyro", "wheels"))
    if wheels is not None and wheels.r < 0.0:
        return  # the gyro is wrong
    left = residuals_m(context)
    if left is None or left[0] < max(LEAST_OFF_M, CLEARER * left[1]):
        return
    fix, repair = reflection(context.recording)
    yield Finding(
        "gnss-course", "error", "gnss",
        "the path of the fixes is the mirror image of that of wheels and gyro",
        f"{left[1]:.2f} m RMS are left about the image, {left[0]:.2f} m about the path itself",
        fix,
        repair,
    )  # fmt: skip


def residuals_m(context: CheckContext) -> tuple[float, float] | None:
    """RMS distance of the fixes from the dead-reckoned path, and from its image; None where not comparable.

    Both are turned, shifted and scaled onto the fixes every `LONGEST_S`, after averages over equal times.
    """
    measured, reckoned = path_by(context.recording, "gnss"), dead_reckoned(context, antenna(context))
    if measured is None or reckoned is None:
        return None
    t, _, path = reckoned
    inside = (measured.t_s >= t[0]) & (measured.t_s <= t[-1])
    t_s, fix = measured.t_s[inside], measured.place[inside]
    if len(t_s) < LEAST_FIXES:
        return None
    z = np.interp(t_s, t, path)
    piece = ((t_s - t_s[0]) // LONGEST_S).astype(int)
    squares, count = np.zeros(2), 0
    for k in range(piece[-1] + 1):
        rows = piece == k
        if rows.sum() < LEAST_FIXES:
            continue
        path, place = _averaged(t_s[rows], z[rows], fix[rows])
        own, image = _left(path, place), _left(path.conj(), place)
        if not SCALES[0] <= image[1] <= SCALES[1]:
            return None
        squares += [own[0], image[0]]
        count += len(place)
    return (float(np.sqrt(squares[0] / count)), float(np.sqrt(squares[1] / count))) if count else None


def _averaged(t_s: Array, *places: Complex) -> list[Complex]:
    """Means over `LEAST_FIXES` equal times, of those that hold fixes."""
    at = np.minimum((t_s - t_s[0]) * LEAST_FIXES / max(float(np.ptp(t_s)), 1e-9), LEAST_FIXES - 1).astype(int)
    count = np.bincount(at, minlength=LEAST_FIXES)
    sums = (np.bincount(at, p.real).astype(complex) + 1j * np.bincount(at, p.imag) for p in places)
    return [one[count > 0] / count[count > 0] for one in sums]


def _left(path: Complex, fix: Complex) -> tuple[float, float]:
    """Sum of squares that a turned, shifted and scaled path leaves of the fixes, and its scale."""
    path, fix = path - path.mean(), fix - fix.mean()
    power = float(np.vdot(path, path).real)
    if power == 0.0:
        return float(np.vdot(fix, fix).real), 0.0
    turn = np.vdot(path, fix) / power
    return float(np.sum(np.abs(fix - turn * path) ** 2)), float(abs(turn))
