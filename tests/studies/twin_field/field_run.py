"""Measured runs on one clock, with their commands and the noise of their true speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.vehicle import VehicleParams
from tests.studies.body_velocity import Poses, body_velocity
from tests.studies.joined_windows import DT_S, chain_starts, joined, motion_of_chain


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


def field_run(name: str, recording: str, chain: Sequence[Recording]) -> FieldRun:
    """One run from the recordings of its chain.

    Raises:
        DataError: the log has no wheels or no gyro, or does not say which vehicle it is.
    """
    motion = motion_of_chain(recording, chain)
    t, vehicle, wheels = motion.t_s, motion.vehicle, chain[0].wheels
    commanded = _commanded(t, chain, chain_starts(chain)[0], vehicle)
    assert wheels is not None
    noise = np.full(len(t), np.nan)
    if np.isfinite(motion.velocity_mps).any():
        rolled = motion.sides_radps.mean(axis=1) * vehicle.wheel.radius_m
        found = speed_noise(t, motion.yaw_rate_radps, motion.poses, rolled)
        noise = np.where(np.isfinite(motion.velocity_mps[:, 0]), found, np.nan)
    return FieldRun(
        name, recording, chain[0].terrain_name, vehicle, t, motion.sides_radps,
        commanded, motion.yaw_rate_radps, motion.velocity_mps, noise, wheels.has_sides(),
    )  # fmt: skip


def speed_noise(t_s: Array, yaw_rate_radps: Array, poses: Poses, rolled_mps: Array) -> Array:
    """(N,) half the difference of the speeds from even and from odd poses, m/s: the noise of those from all.

    Only errors that are independent between poses (scatter, time stamps), not a common scale or lag.
    """
    even = np.arange(len(poses.t_s)) % 2 == 0
    one, two = (
        body_velocity(t_s, yaw_rate_radps, poses.select(half), rolled_mps)[:, 0] for half in (even, ~even)
    )
    return 0.5 * (one - two)


def _commanded(
    t: Array, chain: Sequence[Recording], starts: Sequence[float], vehicle: VehicleParams
) -> Array:
    """(N, 2) commanded side speeds, each held until the next, for three samples at most; else NaN."""

    def part(r: Recording) -> tuple[NDArray[np.int64], Array] | None:
        c = r.command
        return None if c is None else (c.t_ns, np.stack([c.v_mps, c.yaw_rate_radps], axis=1))

    at, twist = joined(chain, starts, part)
    if not len(at):
        return np.full((len(t), 2), np.nan)
    row = np.clip(np.searchsorted(at, t + 1e-6, side="right") - 1, 0, len(at) - 1)
    half = 0.5 * vehicle.odometry.track_m * twist[row, 1]
    sides = np.stack([twist[row, 0] - half, twist[row, 0] + half], axis=1) / vehicle.odometry.wheel_radius_m
    return np.where((np.abs(t - at[row]) < 3.0 * DT_S)[:, None], sides, np.nan)
