"""Effective track of a skid-steered robot on each ground, from wheels and gyro alone: a check on diagnoses.

    python -m tests.studies.effective_track LOG... --vehicle warthog

A robot that skids turns as if its wheels stood B apart: r (w_right - w_left) = B gyro, with B beyond the
track (Mandow et al. 2007, eq. 5: the ICR's lateral place). B is fitted to means over a second, on every
other block of ten; the others tell how well it predicts the gyro, beside the track of the vehicle's file.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.bootstrap import percentile_interval, resampled_rows
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recordings
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle, with_overrides

Array = NDArray[np.float64]

MEAN_S, BLOCK_S = 1.0, 10.0
"""Rows are means over the first; blocks that are left out or drawn anew are as long as the second."""
DRAWS = 400


@dataclass(frozen=True)
class Track:
    """Effective track, its 95 % interval (bootstrap over blocks), and gyro errors on blocks left out, rad/s.

    Attributes:
        blocks: how many there are.
        effective_rms, nominal_rms: with the fitted track, and with that of the vehicle's file.
        turn_rms: of the yaw rate itself.
    """

    track_m: float
    low_m: float
    high_m: float
    blocks: int
    effective_rms: float
    nominal_rms: float
    turn_rms: float


def blocks_of(recording: Recording, vehicle: VehicleParams) -> list[Array]:
    """Rows of (speed difference in m/s, yaw rate in rad/s), means over `MEAN_S`, by block."""
    wheels, imu = recording.wheels, recording.imu
    if wheels is None or imu is None or not wheels.has_sides() or len(wheels) < 2 or len(imu) < 2:
        return []
    radius = with_overrides(vehicle, recording.overrides).odometry.wheel_radius_m
    sides = wheels.side_speeds_mps(radius)
    first, last = max(wheels.t_ns[0], imu.t_ns[0]), min(wheels.t_ns[-1], imu.t_ns[-1])
    grid = np.arange(0.0, float(last - first) * 1e-9, 0.05)
    if len(grid) < round(MEAN_S / 0.05):
        return []
    difference = np.interp(grid, (wheels.t_ns - first) * 1e-9, sides[:, 1] - sides[:, 0])
    rate = np.interp(grid, (imu.t_ns - first) * 1e-9, imu.gyro_radps[:, 2])
    size = round(MEAN_S / 0.05)
    means = np.stack([difference, rate], axis=1)[: len(grid) // size * size].reshape(-1, size, 2).mean(axis=1)
    per = round(BLOCK_S / MEAN_S)
    found = [means[i : i + per] for i in range(0, len(means), per)]
    return [block[np.isfinite(block).all(axis=1)] for block in found]


def fitted(blocks: Sequence[Array]) -> float:
    """Least squares of the speed difference on the yaw rate, the less noisy of the two."""
    rows = np.concatenate(blocks)
    return float(rows[:, 0] @ rows[:, 1] / (rows[:, 1] @ rows[:, 1]))


def effective_track(blocks: Sequence[Array], nominal_m: float, seed: int = 0) -> Track:
    """The effective track of some blocks, checked on those left out of the fit."""
    drawn = [fitted([blocks[i] for i in rows]) for rows in resampled_rows(len(blocks), DRAWS, seed)]
    low, high = percentile_interval(np.array(drawn))
    effective, nominal, turn = [], [], []
    for parity in (0, 1):
        track = fitted(blocks[parity::2])
        rows = np.concatenate(blocks[1 - parity :: 2])
        effective.append(rows[:, 0] / track - rows[:, 1])
        nominal.append(rows[:, 0] / nominal_m - rows[:, 1])
        turn.append(rows[:, 1])
    rms = [float(np.sqrt(np.mean(np.concatenate(part) ** 2))) for part in (effective, nominal, turn)]
    return Track(fitted(blocks), low, high, len(blocks), rms[0], rms[1], rms[2])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table, a row a log."""
    parser = argparse.ArgumentParser(description="Effective track from wheels and gyro.")
    parser.add_argument("logs", nargs="+", metavar="LOG")
    parser.add_argument("--vehicle", required=True)
    given = parser.parse_args(arguments)
    vehicle = load_vehicle(given.vehicle)
    print("| log | track, m (95 %) | blocks | gyro left over: effective, nominal, of, rad/s |")
    print("| --- | --- | --- | --- |")
    for name in given.logs:
        try:
            recordings = open_recordings(name, rig=vehicle.rig())
        except TerrafusionError as error:
            raise SystemExit(f"error: {error}") from None
        blocks = [b for r in recordings for b in blocks_of(r, vehicle) if len(b)]
        if len(blocks) < 4:
            print(f"| {name} | too short, or without wheels of both sides or gyro | {len(blocks)} | |")
            continue
        t = effective_track(blocks, with_overrides(vehicle, recordings[0].overrides).odometry.track_m)
        left = f"{t.effective_rms:.3f}, {t.nominal_rms:.3f}, {t.turn_rms:.3f}"
        print(
            f"| {name} | {t.track_m:.3f} ({t.low_m:.3f} to {t.high_m:.3f}) | {t.blocks} | {left} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
