"""Slip, yaw scale and side-slip on the grounds of labelled logs, for the weighting policy.

A log needs wheels of both sides, a truth with position and orientation, and ground labels. All other noise
stays the twin's: a lidar or motion-capture truth shows neither wheel speed over 0.1 s nor IMU noise, and
receiver errors need a truth in the receiver's frame.

Speeds are means over `MEAN_S` of the displacement in body axes, every 0.5 s. Pose time stamps good to 50 ms
cause slip errors of 0.07 s over that length: the sigma of a Warthog on asphalt is 0.071 for 2 s, 0.041 for 6
s and 0.026 for 10 s. Shorter variation is not seen, so logs give no correlation time and reduce no standard
deviation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix, yaw_of
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.terrain.classifier import UNKNOWN
from terrafusion.fusion.training.ground_samples import (
    SLIP_S,
    GroundSamples,
    side_slips_of,
    slips_of,
    yaw_scales_of,
)
from terrafusion.fusion.training.logged_runs import labelled_grounds
from terrafusion.fusion.training.policy_fit import LoggedSamples

MEAN_S = 6.0
GAP_S = 1.0
"""Means across longer gaps of wheels or truth are unknown."""
MIN_SLIPS = 60
"""Samples needed on a ground: half a minute of driving."""
NEEDED = ("position", "yaw")
_HALF_NS = round(0.5e9 * MEAN_S)


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Means over `MEAN_S` every `SLIP_S`, NaN where unknown, (n,) each.

    `t_ns` is the middle; speeds: mean of the wheels, forward and to the left; yaw rates by wheels and truth;
    `grade` is the sine of the pitch.
    """

    t_ns: NDArray[np.int64]
    wheel_mps: Array
    forward_mps: Array
    lateral_mps: Array
    wheel_radps: Array
    true_radps: Array
    grade: Array


def read_logs(logs: Sequence[str], vehicle: str | None = None) -> LoggedSamples:
    """Samples of logs: files, folders, or names of the catalogue; `vehicle` instead of theirs.

    Raises:
        DataError: a log lacks wheels, truth or labels, or moves too little on a ground.
        TerrafusionError: a log cannot be read.
    """
    from terrafusion.datasets.readers import hashes_of, open_recordings
    from terrafusion.twin.model.vehicle import load_vehicle

    parts: dict[str, list[GroundSamples]] = {}
    rig = None if vehicle is None else load_vehicle(vehicle).rig()
    for log in logs:
        for recording in open_recordings(log, rig=rig):
            for ground, samples in logged_samples(recording, vehicle).items():
                parts.setdefault(ground, []).append(samples)
    grounds = {name: GroundSamples.joined(found) for name, found in parts.items()}
    if not grounds:
        raise DataError(
            f"the logs hold no {MEAN_S:g} s on one ground whose label is not '{UNKNOWN}'",
            channel="terrain",
            remedy="give longer drives on labelled ground, or no logs",
        )
    for name, samples in grounds.items():
        if len(samples.slip) < MIN_SLIPS:
            raise DataError(
                f"the logs hold {len(samples.slip)} slips on '{name}', {MIN_SLIPS} are needed",
                channel="terrain",
                remedy="give longer drives on that ground, or leave its logs out",
            )
    return LoggedSamples(grounds, hashes_of(logs), MEAN_S)


def logged_samples(recording: Recording, vehicle: str | None = None) -> dict[str, GroundSamples]:
    """Samples of a recorded run by ground."""
    motion, grounds = motion_of(recording, vehicle), labelled_grounds(recording)
    names = np.array([_ground_around(t, grounds) for t in motion.t_ns.tolist()])
    found = {}
    for ground in sorted(set(names.tolist()) - {"", UNKNOWN}):
        here = names == ground
        forward = np.where(here, motion.forward_mps, np.nan)
        slip = slips_of(motion.wheel_mps, forward, motion.grade)
        yaw = yaw_scales_of(motion.wheel_radps, np.where(here, motion.true_radps, np.nan))
        side = side_slips_of(forward, motion.lateral_mps, motion.true_radps)
        unseen = dict.fromkeys(("wheel_mps", "gyro", "gyro_yaw", "accel", "gnss"), np.empty(0))
        found[ground] = GroundSamples(**slip, yaw_scale=yaw, side_slip=side, **unseen)
    return found


def _ground_around(t_ns: int, grounds: list[tuple[int, str]]) -> str:
    """The ground of the mean about a time, or "" if it spans several."""
    last = [name for begin, name in grounds if begin <= t_ns - _HALF_NS][-1:]
    seen = {name for begin, name in grounds if t_ns - _HALF_NS < begin <= t_ns + _HALF_NS} | set(last)
    return seen.pop() if last and len(seen) == 1 else ""


def motion_of(recording: Recording, vehicle: str | None = None) -> MeasuredMotion:
    """Motion of a recorded run by wheels and truth.

    Raises:
        DataError: no wheels of both sides, or no truth of the body with position and yaw.
    """
    from terrafusion.twin.model.choose import choose_vehicle

    wheels, truth = recording.wheels, recording.truth
    if wheels is None or not wheels.has_sides():
        raise DataError(f"{recording.name}: the wheels of both sides are needed", channel="wheels")
    listed = recording.truth_channels or NEEDED
    usable = truth is not None and truth.quaternion is not None and set(NEEDED) <= set(listed)
    if not usable or recording.truth_frame != "base":
        raise DataError(
            f"{recording.name}: a truth with position and yaw of the body is needed", channel="truth"
        )
    assert truth is not None
    assert truth.quaternion is not None
    wheels = wheels.select(np.isfinite(wheels.speed).all(axis=1))
    truth = truth.select(
        np.isfinite(np.column_stack([truth.position_m[:, :2], truth.quaternion])).all(axis=1)
    )
    if len(wheels) < 2 or len(truth) < 2:
        raise DataError(f"{recording.name}: wheels or truth hold no two samples", channel="truth")
    rig = choose_vehicle(recording, vehicle)[0].rig()
    first, last = max(wheels.t_ns[0], truth.t_ns[0]), min(wheels.t_ns[-1], truth.t_ns[-1])
    middle = np.arange(first + _HALF_NS, last - _HALF_NS, round(SLIP_S * 1e9), dtype=np.int64)
    left, right = _means(
        wheels.t_ns, _rolled(wheels.t_ns, wheels.side_speeds_mps(rig.wheel_radius_m)), middle
    )
    forward, lateral, rate = _means(truth.t_ns, _moved(truth), middle)
    grade = np.interp(middle, truth.t_ns, _rotations(truth)[:, 2, 0])
    return MeasuredMotion(
        middle, 0.5 * (left + right), forward, lateral, (right - left) / rig.track_m, rate, grade
    )


def _means(t_ns: NDArray[np.int64], path: Array, middle_ns: NDArray[np.int64]) -> Array:
    """Mean rates (k, n) of a path (m, k) at times (m,) over `MEAN_S` about `middle_ns` (n,)."""
    begin, end = middle_ns - _HALF_NS, middle_ns + _HALF_NS
    rates = np.stack([(np.interp(end, t_ns, x) - np.interp(begin, t_ns, x)) / MEAN_S for x in path.T])
    unknown = (begin < t_ns[0]) | (end > t_ns[-1])
    for i in np.flatnonzero(np.diff(t_ns) > GAP_S * 1e9):
        unknown |= (end > t_ns[i]) & (begin < t_ns[i + 1])
    rates[:, unknown] = np.nan
    return rates


def _rolled(t_ns: NDArray[np.int64], sides_mps: Array) -> Array:
    """Distance (n, 2), m, rolled by each side since the first sample."""
    steps = 0.5 * (sides_mps[1:] + sides_mps[:-1]) * (np.diff(t_ns) * 1e-9)[:, None]
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def _moved(truth: Trajectory) -> Array:
    """Displacement forward and to the left in body axes, m, and yaw, rad, (n, 3) since the first pose."""
    R = _rotations(truth)
    step = np.diff(np.nan_to_num(truth.position_m), axis=0)
    along = 0.5 * np.einsum("nij,ni->nj", R[:-1] + R[1:], step)[:, :2]
    assert truth.quaternion is not None
    yaw = np.unwrap(yaw_of(truth.quaternion))
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(along, axis=0)]), yaw - yaw[0]])


def _rotations(truth: Trajectory) -> Array:
    """Body to world (n, 3, 3)."""
    assert truth.quaternion is not None
    return quaternion_to_matrix(truth.quaternion)
