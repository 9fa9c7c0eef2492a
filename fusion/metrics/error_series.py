"""Errors of an estimate against a reference at common times, in the horizontal plane.

The reference is the truth of a recording or held-out GNSS fixes. `scores` condenses the series.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.frames import quaternion_to_matrix, wrap_angle, yaw_of
from terrafusion.datasets.core.planar_alignment import planar_rotation
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.estimate.antenna import AntennaPlaces
from terrafusion.fusion.estimate.estimate import Estimate

MIN_STEP_M = 0.1
"""Shorter displacements of a reference do not count as distance: they may be its noise at rest."""

ALIGN_M = 10.0
"""Path over which a run without GNSS is aligned if the reference has no heading."""

NOT_SCORED = ("waiting", "aligning")
"""Status of keyframes before the pose is initialised."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Estimate and reference at M common times.

    Attributes:
        t_ns: (M,).
        estimate_m, reference_m: (M, 2) horizontal positions of the same point of the robot.
        estimate_yaw_rad, reference_yaw_rad: (M,); NaN where the reference has no heading.
        velocity_error_mps: (M, 2); body axes against truth, east-north against fixes; NaN where unknown.
        covariance_m2: (M, 2, 2) of the position error; NaN where unknown.
        yaw_sigma_rad: (M,).
        min_step_m: shorter displacements of the reference may be its noise.
    """

    t_ns: TimesNs
    estimate_m: Array
    reference_m: Array
    estimate_yaw_rad: Array
    reference_yaw_rad: Array
    velocity_error_mps: Array
    covariance_m2: Array
    yaw_sigma_rad: Array
    min_step_m: float = MIN_STEP_M

    def position_error_m(self) -> Array:
        """Estimate minus reference, (M, 2)."""
        return self.estimate_m - self.reference_m

    def distance_m(self) -> Array:
        """Length of the position error, (M,)."""
        error = self.position_error_m()
        return np.asarray(np.hypot(error[:, 0], error[:, 1]))

    def yaw_error_rad(self) -> Array:
        """Estimate minus reference, (M,), in [-pi, pi)."""
        return wrap_angle(self.estimate_yaw_rad - self.reference_yaw_rad)

    def nees(self) -> Array:
        """e' P^-1 e / 2 at each time, (M,); NaN where P is unknown or singular."""
        e, P = self.position_error_m(), self.covariance_m2
        det = P[:, 0, 0] * P[:, 1, 1] - P[:, 0, 1] * P[:, 1, 0]
        square = P[:, 1, 1] * e[:, 0] ** 2 + P[:, 0, 0] * e[:, 1] ** 2
        square -= (P[:, 0, 1] + P[:, 1, 0]) * e[:, 0] * e[:, 1]
        proper = np.isfinite(det) & (det > 0.0) & (P[:, 0, 0] > 0.0)
        return np.divide(square, 2.0 * det, out=np.full(len(e), np.nan), where=proper)

    def path_m(self) -> Array:
        """Distance (M,) the reference has travelled up to each time."""
        return travelled_m(self.reference_m, self.min_step_m)


def errors_against_truth(estimate: Estimate, recording: Recording, antenna: AntennaPlaces) -> Errors | None:
    """The error series against the truth, or None if nothing can be compared.

    The denser of the two is interpolated at the times of the sparser, except inside gaps. Only channels
    listed in `truth_channels`, if any, are used.
    """
    truth, holds = recording.truth, recording.truth_holds
    if truth is None or len(truth) < 2 or len(estimate.trajectory) < 2:
        return None
    has_position = holds("position")
    has_yaw = truth.quaternion is not None and (holds("yaw") or holds("orientation"))
    has_velocity = truth.twist_body is not None and holds("velocity")
    rows = np.isfinite(truth.position_m[:, :2]).all(axis=1) if has_position else np.ones(len(truth), bool)
    truth = truth.select(rows)
    t_ns = _common_times(estimate.trajectory.t_ns, truth.t_ns)
    if not len(t_ns) or not (has_position or has_yaw or has_velocity):
        return None
    point = antenna if recording.truth_frame == "antenna" else AntennaPlaces.fixed((0.0, 0.0, 0.0))
    errors, velocity, R = _without_reference(estimate, t_ns, point)
    if has_position:
        errors = dataclasses.replace(errors, reference_m=truth.positions_at(t_ns)[:, :2])
    if has_yaw:
        errors = dataclasses.replace(errors, reference_yaw_rad=_yaw_at(truth, t_ns))
    if has_velocity and truth.twist_body is not None:
        body = np.einsum("nji,nj->ni", R, velocity)
        moved = body[:, :2] - _interpolate(t_ns, truth.t_ns, truth.twist_body[:, :2])
        errors = dataclasses.replace(errors, velocity_error_mps=moved)
    return errors


def errors_against_fixes(estimate: Estimate, held_out: Gnss | None, antenna: AntennaPlaces) -> Errors | None:
    """The error series of the antenna against GNSS fixes, or None if no fix lies within the estimate.

    A late fix is compared with the estimate at the time when it was measured, as far as the estimator has
    learned how late it is.
    """
    if held_out is None or len(estimate.trajectory) < 2:
        return None
    measured_ns = np.maximum.accumulate(antenna.measured_ns(held_out.t_ns))
    held_out = dataclasses.replace(held_out, t_ns=measured_ns)
    valid = np.isfinite(held_out.enu_m[:, :2]).all(axis=1) & (held_out.fix != Fix.NONE)
    grid = estimate.trajectory.t_ns
    inside = (held_out.t_ns >= grid[0]) & (held_out.t_ns <= grid[-1])
    fixes = held_out.select(valid & inside & _bracketed(held_out.t_ns, grid))
    if not len(fixes):
        return None
    errors, velocity, _ = _without_reference(estimate, fixes.t_ns, antenna)
    variance = fixes.sigma_enu_m[:, :2] ** 2
    if fixes.velocity_enu_mps is not None:
        moved = velocity[:, :2] - fixes.velocity_enu_mps[:, :2]
        errors = dataclasses.replace(errors, velocity_error_mps=moved)
    noise_m = float(np.median(fixes.sigma_enu_m[:, :2])) if np.isfinite(variance).all() else 0.0
    return dataclasses.replace(
        errors,
        reference_m=fixes.enu_m[:, :2],
        covariance_m2=errors.covariance_m2 + variance[:, :, None] * np.eye(2),
        min_step_m=max(MIN_STEP_M, 3.0 * noise_m),
    )


def travelled_m(position_m: ArrayLike, min_step_m: float = MIN_STEP_M) -> Array:
    """Distance (N,) travelled up to each of the horizontal positions (N, 2 or more).

    A position counts once it is `min_step_m` away from the last one that counted, so that noise at rest does
    not add up; unknown ones (NaN) do not count.
    """
    total = 0.0
    out = np.zeros(len(np.asarray(position_m)))
    points = np.asarray(position_m, dtype=float)[:, :2].tolist()
    x0, y0 = next(((x, y) for x, y in points if x == x and y == y), (math.nan, math.nan))
    square = min_step_m * min_step_m
    for i, (x, y) in enumerate(points):
        step = (x - x0) ** 2 + (y - y0) ** 2
        if step >= square:
            total += step**0.5
            x0, y0 = x, y
        out[i] = total
    return out


def known_keyframes(estimate: Estimate) -> tuple[Estimate, tuple[str, ...]]:
    """The keyframes with a pose, and notes on the excluded ones."""
    path = estimate.trajectory
    status = estimate.status.astype(str)
    early, local = np.isin(status, NOT_SCORED), status == "no_gnss"
    local &= not local.all()  # a drive that stays local is aligned and scored
    sound = np.isfinite(path.position_m[:, :2]).all(axis=1)
    if path.quaternion is not None:
        sound &= np.isfinite(path.quaternion).all(axis=1)
    notes: tuple[str, ...] = ()
    if early.any():
        notes += (f"{int(early.sum())} keyframes before the heading was known are not scored",)
    if local.any():
        notes += (f"{int(local.sum())} keyframes before GNSS laid the path onto the map are not scored",)
    if not sound.all():
        notes += (f"{int((~sound).sum())} keyframes are not finite and are not scored",)
    rows = sound & ~early & ~local
    if rows.all():
        return estimate, notes
    selected = dataclasses.replace(
        estimate,
        trajectory=path.select(rows),
        velocity_mps=estimate.velocity_mps[rows],
        status=estimate.status[rows],
    )
    return selected, notes


def _without_reference(
    estimate: Estimate, t_ns: TimesNs, point: AntennaPlaces
) -> tuple[Errors, Array, Array]:
    """The series of a body-fixed point whose reference is unknown; the point's world velocity (M, 3), and the
    rotation to the world (M, 3, 3) of the body."""
    path = estimate.trajectory
    nearest = np.searchsorted((path.t_ns[1:] + path.t_ns[:-1]) // 2, t_ns)
    quaternion = path.quaternions_at(t_ns)
    velocity = _interpolate(t_ns, path.t_ns, estimate.velocity_mps)
    covariance = np.full((len(t_ns), 2, 2), np.nan)
    yaw_sigma = np.full(len(t_ns), np.nan)
    R = quaternion_to_matrix(quaternion)
    lever = point.at(t_ns)
    arm = np.zeros((len(t_ns), 3))
    if lever.any():
        arm = np.einsum("nij,nj->ni", R, lever)
        if path.twist_body is not None:
            spin = np.nan_to_num(_interpolate(t_ns, path.t_ns, path.twist_body[:, 3:]))
            velocity = velocity + np.einsum("nij,nj->ni", R, np.cross(spin, lever))
    if path.covariance is not None:
        P = path.covariance[nearest]
        J = np.zeros((len(t_ns), 2, 6))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, 0, 4], J[:, 0, 5] = arm[:, 2], -arm[:, 1]
        J[:, 1, 3], J[:, 1, 5] = -arm[:, 2], arm[:, 0]
        covariance = J @ P @ np.swapaxes(J, 1, 2)
        yaw_sigma = np.sqrt(np.maximum(P[:, 5, 5], 0.0))
    unknown = np.full((len(t_ns), 2), np.nan)
    errors = Errors(
        t_ns=t_ns,
        estimate_m=(path.positions_at(t_ns) + arm)[:, :2],
        reference_m=unknown,
        estimate_yaw_rad=yaw_of(quaternion),
        reference_yaw_rad=unknown[:, 0],
        velocity_error_mps=unknown,
        covariance_m2=covariance,
        yaw_sigma_rad=yaw_sigma,
    )
    return errors, velocity, R


def _yaw_at(truth: Trajectory, t_ns: TimesNs) -> Array:
    """Yaw (M,) of the truth, slerp between the known orientations next to each time."""
    known = np.isfinite(truth.quaternion).all(axis=1) if truth.quaternion is not None else np.zeros(0, bool)
    if not known.any():
        return np.full(len(t_ns), np.nan)
    rows = np.flatnonzero(known)
    after = np.clip(np.searchsorted(truth.t_ns[rows], t_ns), 0, len(rows) - 1)
    beside = np.unique(np.concatenate([after, np.maximum(after - 1, 0)]))
    return yaw_of(truth.select(rows[beside]).quaternions_at(t_ns))


def _common_times(estimate_ns: TimesNs, truth_ns: TimesNs) -> TimesNs:
    """Times of the sparser of two clocks that lie inside the other, but not in its gaps."""
    if len(truth_ns) < 2:
        return np.zeros(0, dtype=np.int64)
    sparse, dense = estimate_ns, truth_ns
    if np.median(np.diff(truth_ns)) > np.median(np.diff(estimate_ns)):
        sparse, dense = truth_ns, estimate_ns
    times = sparse[(sparse >= dense[0]) & (sparse <= dense[-1])]
    return times[_bracketed(times, dense)]


def _bracketed(t_ns: TimesNs, grid_ns: TimesNs) -> NDArray[np.bool_]:
    """Whether times have grid points close enough on both sides for interpolation."""
    limit_ns = max(0.25e9, 2.5 * float(np.median(np.diff(grid_ns))))
    after = np.clip(np.searchsorted(grid_ns, t_ns, side="left"), 1, len(grid_ns) - 1)
    exact = (grid_ns[after] == t_ns) | (grid_ns[after - 1] == t_ns)
    return np.asarray(exact | (grid_ns[after] - grid_ns[after - 1] <= limit_ns))


def _interpolate(t_ns: TimesNs, grid_ns: TimesNs, values: Array) -> Array:
    query, grid = (t_ns - grid_ns[0]) * 1e-9, (grid_ns - grid_ns[0]) * 1e-9
    return np.stack([np.interp(query, grid, column) for column in values.T], axis=1)


def align_both(
    truth: Errors | None, fixes: Errors | None
) -> tuple[Errors | None, Errors | None, tuple[str, ...]]:
    """Align the start of the path with truth and fixes, each by itself (`align_start`); also notes on how.

    Errors that are None or hold no known distance come back as they are, without a note.
    """
    out, notes = [], []
    for errors, name in ((truth, "truth"), (fixes, "held-out fixes")):
        if errors is None or not np.isfinite(errors.distance_m()).any():
            out.append(errors)
            continue
        moved, how = align_start(errors)
        out.append(moved)
        notes.append(f"without GNSS the path is local: for scoring it was moved to the {name} by {how}")
    return out[0], out[1], tuple(notes)


def align_start(errors: Errors) -> tuple[Errors, str]:
    """Align the start of the estimate with the reference by a rigid motion in the plane; also describe how.

    With a reference heading by its first position and the mean heading over the first metre, else by least
    squares (Umeyama 1991, no scale) over the first `ALIGN_M` of path.
    """
    path = errors.path_m()
    finite = np.isfinite(errors.distance_m())
    start = int(np.flatnonzero(finite)[0])
    by_yaw = bool(np.isfinite(errors.reference_yaw_rad[start]))
    rows = finite & (path <= (1.0 if by_yaw else ALIGN_M))
    p, q = errors.estimate_m[rows], errors.reference_m[rows]
    if by_yaw:
        turn = np.nanmean(np.exp(-1j * errors.yaw_error_rad()[rows]))
        p0, q0 = errors.estimate_m[start], errors.reference_m[start]
        how = "its first position and the mean heading over its first metre"
    else:
        p0, q0 = p.mean(axis=0), q.mean(axis=0)
        turn = planar_rotation(p[:, 0] + 1j * p[:, 1], q[:, 0] + 1j * q[:, 1])[0] if path[-1] >= 1.0 else 1.0
        how = f"a least-squares fit over the first {min(ALIGN_M, float(path[-1])):.1f} m"
    angle = float(np.angle(turn))
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    against_fixes = not np.isfinite(errors.reference_yaw_rad).any()
    velocity = errors.velocity_error_mps
    moved = dataclasses.replace(
        errors,
        estimate_m=(errors.estimate_m - p0) @ R.T + q0,
        estimate_yaw_rad=errors.estimate_yaw_rad + angle,
        covariance_m2=R @ errors.covariance_m2 @ R.T,
        velocity_error_mps=np.full_like(velocity, np.nan) if against_fixes else velocity,
    )
    return moved, how
