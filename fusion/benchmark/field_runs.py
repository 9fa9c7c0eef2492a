"""Measured runs on one clock: wheel speeds, commands, gyro and true body velocity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.body_velocity import CHUNK_S, Poses, body_velocity, speed_noise
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle

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


@dataclass(frozen=True, eq=False)
class FieldRun:
    """One continuous run sampled at `DT_S`.

    Attributes:
        name: recording and number of the run in it.
        recording: its recording; runs of one recording are never on both sides of a split.
        ground: terrain, "" where unknown.
        vehicle: nominal parameters.
        t_s: (N,) from 0.
        sides_radps: (N, 2) measured speed of left and right wheels.
        commanded_radps: (N, 2) commanded speed of left and right, NaN where no command is in the log.
        yaw_rate_radps: (N,) of the gyro.
        velocity_mps: (N, 2) true forward and sideways speed, NaN where no pose is near.
        noise_mps: (N,) see `truth.speed_noise`.
        has_sides: whether the log has left and right wheels; if not, the yaw rate is the gyro's.
    """

    name: str
    recording: str
    ground: str
    vehicle: VehicleParams
    t_s: Array
    sides_radps: Array
    commanded_radps: Array
    yaw_rate_radps: Array
    velocity_mps: Array
    noise_mps: Array
    has_sides: bool


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


def field_run(name: str, recording: str, chain: Sequence[Recording]) -> FieldRun:
    """One run from the recordings of its chain."""
    first = chain[0]
    if first.imu is None or first.wheels is None or first.vehicle is None:
        raise DataError(
            "has no gyro, no wheels or no vehicle", file=recording, remedy="compare logs that have all three"
        )
    vehicle = load_vehicle(first.vehicle)
    starts, end = chain_starts(chain)
    t = np.arange(0.0, end, DT_S)
    gyro = _joined(chain, starts, lambda r: (r.imu.t_ns, r.imu.gyro_radps[:, 2]) if r.imu else None)
    rate = _means(t, *gyro)
    sides = _sides(t, chain, starts, vehicle)
    velocity, noise = np.full((len(t), 2), np.nan), np.full(len(t), np.nan)
    poses = _poses(chain, starts)
    if len(poses.t_s) >= MIN_POSES:
        rolled = sides.mean(axis=1) * vehicle.wheel.radius_m
        near = _near(t, poses.t_s)
        velocity = np.where(near[:, None], body_velocity(t, rate, poses, rolled), np.nan)
        noise = np.where(near, speed_noise(t, rate, poses, rolled), np.nan)
    return FieldRun(
        name, recording, first.terrain_name, vehicle, t, sides, _commanded(t, chain, starts, vehicle), rate,
        velocity, noise, first.wheels.has_sides(),
    )  # fmt: skip


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


def _joined(chain: Sequence[Recording], starts: Sequence[float], part) -> tuple[Array, Array]:  # type: ignore[no-untyped-def]
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

    at, sides = _joined(chain, starts, part)
    out = np.empty((len(t), 2))
    for side in range(2):
        keep, last = [0], 0
        for i in range(1, len(at)):
            if sides[i, side] != sides[last, side] or at[i] - at[last] > HELD_S:
                keep.append(i)
                last = i
        out[:, side] = np.interp(t, at[keep], sides[keep, side])
    return out


def _commanded(
    t: Array, chain: Sequence[Recording], starts: Sequence[float], vehicle: VehicleParams
) -> Array:
    """(N, 2) commanded side speeds, each held until the next, for three samples at most; else NaN."""

    def part(r: Recording) -> tuple[NDArray[np.int64], Array] | None:
        c = r.command
        return None if c is None else (c.t_ns, np.stack([c.v_mps, c.yaw_rate_radps], axis=1))

    at, twist = _joined(chain, starts, part)
    if not len(at):
        return np.full((len(t), 2), np.nan)
    row = np.clip(np.searchsorted(at, t + 1e-6, side="right") - 1, 0, len(at) - 1)
    half = 0.5 * vehicle.odometry.track_m * twist[row, 1]
    sides = np.stack([twist[row, 0] - half, twist[row, 0] + half], axis=1) / vehicle.odometry.wheel_radius_m
    return np.where((np.abs(t - at[row]) < 3.0 * DT_S)[:, None], sides, np.nan)


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
