"""Consecutive windows of a log joined into one run.

Public sets cut runs into windows of two seconds, each with a truth in a frame of its own. Wheels and IMU of
the joined run are the samples of the windows; its truth is the path with the gyro's heading and the forward
and sideways speeds that best explain the poses of every window (`body_velocity`). It contains the error of
the gyro.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.benchmark.body_velocity import heading
from terrafusion.fusion.benchmark.field_runs import DT_S, FieldRun, chain_starts, chains_of, field_run

MAX_TRUTH_GAP_S = 1.0
"""A joined run with a longer gap in its truth gets no truth."""


def joined_runs(name: str, recordings: Sequence[Recording]) -> list[Recording]:
    """The runs of two or more consecutive windows among `recordings`, in their order.

    A run starts at time 0 in the origin, heading along x, and has wheels, IMU and truth only; no truth if
    that has a gap of more than `MAX_TRUTH_GAP_S`.

    Raises:
        DataError: the windows have no wheels or no gyro, or do not say which vehicle it is.
    """
    chains = [chain for chain in chains_of(recordings) if len(chain) > 1]
    return [_joined(f"{name}#{k}", name, chain) for k, chain in enumerate(chains)]


def _joined(name: str, recording: str, chain: Sequence[Recording]) -> Recording:
    starts, _ = chain_starts(chain)
    run = field_run(name, recording, chain)
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


def _path(run: FieldRun) -> Trajectory | None:
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
