"""Consecutive windows of a log joined into one run.

Public sets cut runs into windows of two seconds, each with a truth in a frame of its own. Wheels and IMU of
the joined run are the samples of the windows; its truth is the path with the gyro's heading and the forward
and sideways speeds that best explain the poses of every window (`body_velocity`). It contains the error of
the gyro.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from tests.studies.body_velocity import CHUNK_S, Poses, body_velocity, heading

DT_S = 0.05
JOIN_RADPS, JOIN_WHEEL_RADPS = 0.25, 1.5
"""Largest steps of gyro and wheel speed between consecutive windows."""
HELD_S = 0.2
"""A wheel speed constant for longer counts as measured again."""
POSE_GAP_S = 0.6
"""The true velocity is unknown in longer gaps between poses."""
MIN_POSES = 20
FIX_SIGMA_M = 0.1
"""Fixes with a larger sigma do not determine the speed over 5 s (docs/evidence/field.md)."""
MAX_TRUTH_GAP_S = 1.0
"""A joined run with a longer gap in its truth gets no truth."""


@dataclass(frozen=True, eq=False)
class ChainMotion:
    """Motion of a chain of recordings, sampled at `DT_S`.

    Attributes:
        vehicle: nominal parameters.
        t_s: (N,) from 0.
        sides_radps: (N, 2) measured speed of left and right wheels.
        yaw_rate_radps: (N,) of the gyro.
        velocity_mps: (N, 2) true forward and sideways speed, NaN where no pose is near.
        poses: from which it was found.
    """

    vehicle: VehicleParams
    t_s: Array
    sides_radps: Array
    yaw_rate_radps: Array
    velocity_mps: Array
    poses: Poses


def joined_runs(name: str, recordings: Sequence[Recording]) -> list[Recording]:
    """The runs of two or more consecutive windows among `recordings`, in their order.

    A run starts at time 0 in the origin, heading along x, and has wheels, IMU and truth only; no truth if
    that has a gap of more than `MAX_TRUTH_GAP_S`.

    Raises:
        DataError: the windows have no wheels or no gyro, or do not say which vehicle it is.
    """
    chains = [chain for chain in chains_of(recordings) if len(chain) > 1]
    return [_joined_run(f"{name}#{k}", name, chain) for k, chain in enumerate(chains)]


def _joined_run(name: str, recording: str, chain: Sequence[Recording]) -> Recording:
    starts, _ = chain_starts(chain)
    run = motion_of_chain(recording, chain)
    first = chain[0]
    imu = _channel(chain, starts, lambda r: r.imu, ("gyro_radps", "accel_mps2"))
    # The first wheel speed of a window repeats an old one, as does its first pose.
    wheels = _channel(chain, starts, lambda r: r.wheels, ("speed",), held=True)
    assert first.wheels is not None
    truth = _path(run)
    note = f"{len(chain)} windows joined, {run.t_s[-1]:.1f} s; the truth's heading is the gyro's"
    return dataclasses.replace(
        first,
        name=name,
        start_ns=0,
        wheels=Wheels(wheels["t_ns"], wheels["speed"], first.wheels.names, first.wheels.unit),
        imu=Imu(imu["t_ns"], imu["gyro_radps"], imu["accel_mps2"]),
        command=None,
        gnss=None,
        motor=None,
        terrain=None,
        barometer=None,
        magnetometer=None,
        truth=truth,
        truth_channels=("position", "yaw"),
        description="",
    ).with_notes(note)


def _channel(
    chain: Sequence[Recording],
    starts: Sequence[float],
    of: Callable[[Recording], Any],
    names: tuple[str, ...],
    *,
    held: bool = False,
) -> dict[str, NDArray[Any]]:
    """Times and columns of a channel over a chain; times count from the first IMU sample and increase."""
    parts: dict[str, list[NDArray[Any]]] = {key: [] for key in ("t_ns", *names)}
    last = -(2**62)
    for k, (recording, start) in enumerate(zip(chain, starts, strict=True)):
        assert recording.imu is not None
        channel = of(recording)
        t = channel.t_ns - recording.imu.t_ns[0] + round(start * 1e9)
        rows = np.flatnonzero(t > last)[1 if held and k else 0 :]
        if not len(rows):
            continue
        last = int(t[rows[-1]])
        parts["t_ns"].append(t[rows])
        for key in names:
            parts[key].append(getattr(channel, key)[rows])
    return {key: np.concatenate(found) for key, found in parts.items()}


def _path(run: ChainMotion) -> Trajectory | None:
    """The run's path by its speeds and the gyro's heading, from the first to the last known speed."""
    known = np.flatnonzero(np.isfinite(run.velocity_mps).all(axis=1))
    if len(known) < 2 or float(np.diff(run.t_s[known]).max()) > MAX_TRUTH_GAP_S:
        return None
    rows = slice(known[0], known[-1] + 1)
    t = run.t_s[rows]
    along, across = (np.interp(t, run.t_s[known], run.velocity_mps[known, i]) for i in (0, 1))
    psi = heading(run.t_s, run.yaw_rate_radps)[rows]
    psi = psi - psi[0]
    world = np.stack(
        [np.cos(psi) * along - np.sin(psi) * across, np.sin(psi) * along + np.cos(psi) * across], 1
    )
    steps = 0.5 * DT_S * (world[1:] + world[:-1])
    position = np.zeros((len(t), 3))
    position[1:, :2] = np.cumsum(steps, axis=0)
    quaternion = np.stack([0 * psi, 0 * psi, np.sin(0.5 * psi), np.cos(0.5 * psi)], axis=1)
    return Trajectory(np.rint(t * 1e9).astype(np.int64), position, quaternion)


def chains_of(recordings: Sequence[Recording]) -> list[list[Recording]]:
    """Chains of consecutive recordings, in their order."""
    chains: list[list[Recording]] = []
    for recording in recordings:
        if chains and _continues(chains[-1][-1], recording):
            chains[-1].append(recording)
        else:
            chains.append([recording])
    return chains


def _continues(before: Recording, after: Recording) -> bool:
    if not (before.imu and after.imu and before.wheels and after.wheels):
        return False
    turn = abs(float(after.imu.gyro_radps[0, 2] - before.imu.gyro_radps[-1, 2]))
    spin = float(np.abs(after.wheels.speed[0] - before.wheels.speed[-1]).max())
    return turn < JOIN_RADPS and spin < JOIN_WHEEL_RADPS


def motion_of_chain(recording: str, chain: Sequence[Recording]) -> ChainMotion:
    """Motion of the recordings of a chain, all of the log `recording`.

    Raises:
        DataError: the log has no wheels or no gyro, or does not say which vehicle it is.
    """
    first = chain[0]
    if first.imu is None or first.wheels is None or first.vehicle is None:
        raise DataError(
            "has no gyro, no wheels or no vehicle", file=recording, remedy="compare logs that have all three"
        )
    vehicle = load_vehicle(first.vehicle)
    starts, end = chain_starts(chain)
    t = np.arange(0.0, end, DT_S)
    gyro = joined(chain, starts, lambda r: (r.imu.t_ns, r.imu.gyro_radps[:, 2]) if r.imu else None)
    rate, sides = _means(t, *gyro), _sides(t, chain, starts, vehicle)
    velocity, poses = np.full((len(t), 2), np.nan), _poses(chain, starts)
    if len(poses.t_s) >= MIN_POSES:
        rolled = sides.mean(axis=1) * vehicle.wheel.radius_m
        velocity = np.where(_near(t, poses.t_s)[:, None], body_velocity(t, rate, poses, rolled), np.nan)
    return ChainMotion(vehicle, t, sides, rate, velocity, poses)


def chain_starts(chain: Sequence[Recording]) -> tuple[list[float], float]:
    """Start of each recording of a chain, s from the first, and end of the last one."""
    starts, at = [], 0.0
    for recording in chain:
        starts.append(at)
        imu = recording.imu
        assert imu is not None
        step = float(np.median(np.diff(imu.t_ns))) * 1e-9
        at += float(imu.t_ns[-1] - imu.t_ns[0]) * 1e-9 + step
    return starts, at


def joined(chain: Sequence[Recording], starts: Sequence[float], part) -> tuple[Array, Array]:  # type: ignore[no-untyped-def]
    """Times (M,) and values (M, ...) of a channel over a chain; times count from the first IMU sample."""
    times, values = [np.zeros(0)], []
    for recording, start in zip(chain, starts, strict=True):
        found = part(recording)
        if found is None:
            continue
        assert recording.imu is not None
        times.append(start + (found[0] - recording.imu.t_ns[0]) * 1e-9)
        values.append(found[1])
    return np.concatenate(times), np.concatenate(values) if values else np.zeros(0)


def _means(t: Array, at: Array, values: Array) -> Array:
    """(N,) means over `DT_S` about each time if the samples are denser, else interpolated."""
    known = np.isfinite(values)
    at, values = at[known], values[known]
    if float(np.median(np.diff(at))) > 0.5 * DT_S:
        return np.interp(t, at, values)
    steps = np.diff(at) * 0.5 * (values[1:] + values[:-1])
    total = np.concatenate([[0.0], np.cumsum(steps)])
    low, high = np.clip(t - 0.5 * DT_S, at[0], at[-1]), np.clip(t + 0.5 * DT_S, at[0], at[-1])
    return (np.interp(high, at, total) - np.interp(low, at, total)) / np.maximum(high - low, 1e-9)


def _sides(t: Array, chain: Sequence[Recording], starts: Sequence[float], vehicle: VehicleParams) -> Array:
    """(N, 2) wheel speeds, linear between the updates of each side."""
    radius = vehicle.odometry.wheel_radius_m

    def part(r: Recording) -> tuple[NDArray[np.int64], Array] | None:
        if r.wheels is None:
            return None
        own = r.overrides.wheel_radius_m or radius
        return r.wheels.t_ns, r.wheels.side_speeds_mps(own) / own

    at, sides = joined(chain, starts, part)
    out = np.empty((len(t), 2))
    for side in range(2):
        keep, last = [0], 0
        for i in range(1, len(at)):
            if sides[i, side] != sides[last, side] or at[i] - at[last] > HELD_S:
                keep.append(i)
                last = i
        out[:, side] = np.interp(t, at[keep], sides[keep, side])
    return out


def _poses(chain: Sequence[Recording], starts: Sequence[float]) -> Poses:
    """Truth or good fixes; every window, and every `CHUNK_S` of a long run, is a chunk with an origin."""
    times, places, yaws, chunks = (
        [np.zeros(0)],
        [np.zeros((0, 2))],
        [np.zeros(0)],
        [np.zeros(0, dtype=np.int64)],
    )
    for k, (recording, start) in enumerate(zip(chain, starts, strict=True)):
        assert recording.imu is not None
        found = _positions(recording)
        if found is None:
            continue
        t_ns, xy, yaw = found
        t = (t_ns - recording.imu.t_ns[0]) * 1e-9
        if len(chain) > 1:  # the first pose of a window repeats an old one
            t, xy, yaw = t[1:], xy[1:], yaw[1:]
        times.append(start + t)
        places.append(xy)
        yaws.append(yaw)
        long = np.floor(t / CHUNK_S).astype(np.int64) if len(chain) == 1 else np.zeros(len(t), dtype=np.int64)
        chunks.append(k * 100_000 + long)
    joined = np.concatenate(times)
    order = np.argsort(joined, kind="stable")
    return Poses(
        joined[order],
        np.concatenate(places)[order],
        np.concatenate(yaws)[order],
        np.concatenate(chunks)[order],
    )


def _positions(recording: Recording) -> tuple[NDArray[np.int64], Array, Array] | None:
    if recording.truth is not None:
        yaw = recording.truth.yaw_rad()
        return recording.truth.t_ns, recording.truth.position_m[:, :2], yaw
    gnss = recording.gnss
    if gnss is None or not float(np.median(gnss.sigma_enu_m[:, :2])) <= FIX_SIGMA_M:
        return None
    return gnss.t_ns, gnss.enu_m[:, :2], np.full(len(gnss), np.nan)


def _near(t: Array, poses: Array) -> NDArray[np.bool_]:
    """Whether times lie between poses no further apart than `POSE_GAP_S`."""
    after = np.searchsorted(poses, t)
    inside = (after > 0) & (after < len(poses))
    a, b = poses[np.clip(after - 1, 0, len(poses) - 1)], poses[np.clip(after, 0, len(poses) - 1)]
    return inside & (b - a <= POSE_GAP_S)
