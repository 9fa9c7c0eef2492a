"""What a user has without the estimator: plain dead reckoning, and the receiver alone, of the same log.

Dead reckoning integrates the mean speed of both sides along the heading of the gyro (of the wheels, where
there is no gyro), its bias taken out where the run begins at rest. It is laid onto the estimate over the
first `ALIGN_M` of path; in an outage it starts from the estimate at the begin of the outage. The receiver
alone is the last fixes, interpolated while they come and held in gaps.

Both are scored like the estimate: at the same times, against the same reference.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.motion import cumulative
from terrafusion.datasets.core.arrays import Array, Complex, TimesNs
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.json_text import finite
from terrafusion.datasets.core.planar_alignment import planar_rotation
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.error_series import ALIGN_M, Errors, align_start, known_keyframes
from terrafusion.fusion.metrics.scores import Outage, Scores

REST_MPS, REST_S = 0.01, 1.0
"""Wheels slower than this for so long at the start: the mean of the gyro is its bias."""
HELD_INTERVALS = 2.5
"""In gaps longer than so many usual intervals the last fix is held, as a receiver would."""


@dataclass(frozen=True)
class OutageBaseline:
    """Errors at the end of one outage, m; comparable with `OutageScore.end_error_m`."""

    start_s: float
    dead_reckoning_m: float | None
    gnss_m: float | None


@dataclass(frozen=True, eq=False)
class Baselines:
    """Root mean square position errors, m, comparable with `Scores.ate_m`; None where not scored."""

    dead_reckoning_m: float | None = None
    gnss_m: float | None = None
    outages: tuple[OutageBaseline, ...] = ()


@dataclass(frozen=True, eq=False)
class ReckonedPath:
    """Path by wheels and heading alone, in a frame of its own: times (N,), positions (N,), heading (N,)."""

    t_ns: TimesNs
    position_m: Complex
    yaw_rad: Array

    def at(self, t_ns: TimesNs) -> tuple[Complex, Array]:
        """Positions (M,) and headings (M,); held before the first and after the last sample."""
        t, grid = (t_ns - self.t_ns[0]) * 1e-9, (self.t_ns - self.t_ns[0]) * 1e-9
        return np.interp(t, grid, self.position_m), np.interp(t, grid, self.yaw_rad)


def baselines(
    recording: Recording,
    estimate: Estimate,
    scores: Scores,
    used: Gnss | None,
    outages: Sequence[Outage] = (),
    *,
    rig: Rig,
    aligned: bool = False,
) -> Baselines:
    """Both baselines of a run, scored as `scores` were; `used` are the fixes the estimator was given.

    `aligned` is a local estimate that was moved to the start of the reference, as `score` does.
    """
    errors = scores.errors
    if errors is None or not np.isfinite(errors.reference_m).any():
        return Baselines()
    known, _ = known_keyframes(estimate)
    against_antenna = scores.against != "truth" or recording.truth_frame == "antenna"
    lever = complex(*rig.sensors.gnss.antenna_m[:2])
    path = dead_reckoning(recording, rig.wheel_radius_m, rig.track_m)
    reckoned = receiver = None
    if path is not None:
        point = lever if against_antenna else 0j
        reckoned = _aligned_with(known, path, errors, point, aligned)
    fixes = _valid(used)
    if fixes is not None:
        receiver = _receiver_error_m(fixes, errors, 0j if against_antenna else lever)
    found = []
    for outage in outages:
        rows = outage.scored(errors, int(known.trajectory.t_ns[-1]), recording.start_ns)
        ends: list[float | None] = [None, None]
        if len(rows):
            begin_ns = recording.start_ns + round(outage.start_s * 1e9)
            if path is not None and not aligned:
                ends[0] = _outage_end_m(path, known, errors, rows, begin_ns, lever if against_antenna else 0j)
            if receiver is not None:
                ends[1] = finite(receiver[rows[-1]])
        found.append(OutageBaseline(outage.start_s, *ends))
    return Baselines(rms(reckoned), rms(receiver), tuple(found))


def dead_reckoning(recording: Recording, wheel_radius_m: float, track_m: float) -> ReckonedPath | None:
    """The path by wheels and gyro z, else by the wheels alone; None where nothing shows the heading."""
    wheels, imu = recording.wheels, recording.imu
    if wheels is None:
        return None
    sides = wheels.side_speeds_mps(wheel_radius_m)
    rows = np.isfinite(sides).all(axis=1)
    t_ns, sides = wheels.t_ns[rows], sides[rows]
    if len(t_ns) < 2:
        return None
    speed, t = sides.mean(axis=1), (t_ns - t_ns[0]) * 1e-9
    rate = np.full(0, np.nan) if imu is None else imu.gyro_radps[:, 2]
    turning = np.isfinite(rate)
    if imu is not None and turning.sum() > 1:
        at, rate = (imu.t_ns[turning] - t_ns[0]) * 1e-9, rate[turning]
        moving = np.abs(sides).max(axis=1) > REST_MPS
        begin_s = float(t[np.argmax(moving)]) if moving.any() else float(t[-1])
        rest = at < begin_s
        if rest.any() and begin_s - at[0] >= REST_S:
            rate = rate - rate[rest].mean()
        yaw = np.interp(t, at, cumulative(at, rate))
    elif wheels.has_sides():
        yaw = cumulative(t, (sides[:, 1] - sides[:, 0]) / track_m)
    else:
        return None
    rolled = np.diff(cumulative(t, speed))
    steps = rolled * np.exp(0.5j * (yaw[1:] + yaw[:-1]))
    return ReckonedPath(t_ns, np.concatenate([[0j], np.cumsum(steps)]), yaw)


def _aligned_with(
    known: Estimate, path: ReckonedPath, errors: Errors, point: complex, aligned: bool
) -> Array:
    """Errors (M,) of the dead-reckoned path, aligned with the start of the estimate."""
    keys = known.trajectory
    z, yaw = path.at(keys.t_ns)
    rolled = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(z)))])
    rows = rolled <= ALIGN_M
    target = keys.position_m[:, 0] + 1j * keys.position_m[:, 1]
    turn = planar_rotation(z[rows], target[rows])[0] if rolled[-1] >= 1.0 else 0j
    if abs(turn) == 0.0:
        turn = np.exp(1j * (keys.yaw_rad()[0] - yaw[0]))
    turn /= abs(turn)
    at, heading = path.at(errors.t_ns)
    heading = heading + float(np.angle(turn))
    place = target[rows].mean() + turn * (at - z[rows].mean()) + point * np.exp(1j * heading)
    moved = dataclasses.replace(
        errors, estimate_m=np.stack([place.real, place.imag], axis=1), estimate_yaw_rad=heading
    )
    return (align_start(moved)[0] if aligned else moved).distance_m()


def _outage_end_m(
    path: ReckonedPath, known: Estimate, errors: Errors, rows: NDArray[np.intp], begin_ns: int, point: complex
) -> float | None:
    """Error at the last reference of an outage, of dead reckoning from the estimate at its begin."""
    keys = known.trajectory
    k = int(np.searchsorted(keys.t_ns, begin_ns, side="right")) - 1
    if k < 0:
        return None
    (z0, z1), (yaw0, yaw1) = path.at(np.array([keys.t_ns[k], errors.t_ns[rows[-1]]]))
    turn = keys.yaw_rad()[k] - yaw0
    place = complex(*keys.position_m[k, :2]) + np.exp(1j * turn) * (z1 - z0)
    place += point * np.exp(1j * (yaw1 + turn))
    return finite(float(abs(place - complex(*errors.reference_m[rows[-1]]))))


def _receiver_error_m(fixes: Gnss, errors: Errors, lever: complex) -> Array:
    """Errors (M,) of the fixes; `lever` brings them to the reference by the estimate's heading."""
    t = (errors.t_ns - fixes.t_ns[0]) * 1e-9
    at = (fixes.t_ns - fixes.t_ns[0]) * 1e-9
    antenna = fixes.enu_m[:, 0] + 1j * fixes.enu_m[:, 1]
    place = np.interp(t, at, antenna)
    before = np.searchsorted(at, t, side="right") - 1
    after = np.minimum(before + 1, len(at) - 1)
    held = at[after] - at[np.maximum(before, 0)] > HELD_INTERVALS * float(np.median(np.diff(at)))
    place = np.where(held, antenna[np.maximum(before, 0)], place)
    place = place - (lever * np.exp(1j * errors.estimate_yaw_rad) if lever else 0.0)
    place[before < 0] = np.nan
    return np.asarray(np.abs(place - (errors.reference_m[:, 0] + 1j * errors.reference_m[:, 1])))


def _valid(gnss: Gnss | None) -> Gnss | None:
    if gnss is None:
        return None
    fixes = gnss.select(np.isfinite(gnss.enu_m[:, :2]).all(axis=1) & (gnss.fix != Fix.NONE))
    return fixes if len(fixes) > 1 else None


def rms(values: Array | None) -> float | None:
    """Root mean square of the finite values; None where there are none."""
    known = np.zeros(0) if values is None else values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None
