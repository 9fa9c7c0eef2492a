"""The IMU alone: units, gravity, what the gyro says at rest."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.mounting import gravity, is_metric
from terrafusion.datasets.checks.timing import GAP_PERIODS, GAP_S
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.recording import Recording

Array = NDArray[np.float64]

REMOVED_SHARE = 0.15
"""Mean specific force over g below which gravity has been taken out."""
REST_S, MARGIN_S = 2.0, 0.5
"""Wheels that stand for so long, less a margin at both ends, are a rest."""
LARGE_BIAS_RADPS, STILL_RADPS = 0.02, 0.05
"""1.1 deg/s is beyond what MEMS gyros of robots say at rest; a gyro that scatters more than the second
(standard deviation of its tenths of a second) is not at rest."""


def check_gravity(context: CheckContext) -> Iterator[Finding]:
    """The mean specific force must be as long as gravity, in m/s2."""
    mean = gravity(context)
    if mean is None or is_metric(mean):
        return
    size = float(np.linalg.norm(mean))
    evidence = f"mean specific force ({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) m/s2"
    if 0.85 < size < 1.15:
        yield Finding(
            "accel-in-g",
            "error",
            "imu",
            "acceleration looks like g, not m/s2",
            evidence,
            f"multiply by {GRAVITY_MPS2}",
            _to_mps2,
        )
        return
    removed = size < REMOVED_SHARE * GRAVITY_MPS2
    yield Finding(
        "accel-magnitude",
        "error",
        "imu",
        f"mean specific force is {size:.2f} m/s2, not 9.8{': gravity has been removed' if removed else ''}",
        evidence,
        "give raw accelerometer data in m/s2, gravity included",
    )


def _to_mps2(recording: Recording) -> Recording:
    assert recording.imu is not None
    imu = dataclasses.replace(recording.imu, accel_mps2=recording.imu.accel_mps2 * GRAVITY_MPS2)
    return dataclasses.replace(recording, imu=imu)


def check_bias(context: CheckContext) -> Iterator[Finding]:
    """The gyro must say next to nothing while the wheels stand."""
    imu = context.recording.imu
    resting = at_rest(context)
    if imu is None or resting.sum() < 50:
        return
    gyro = imu.gyro_radps[resting]
    known = np.isfinite(gyro).all(axis=0)
    bias = np.where(known, np.nan_to_num(gyro).mean(axis=0), 0.0)
    rough = np.where(known, np.nan_to_num(gyro).std(axis=0), 0.0)
    if np.abs(bias).max() <= LARGE_BIAS_RADPS or rough.max() > STILL_RADPS:
        return
    said = ", ".join(f"{value:.3f}" for value in bias)
    yield Finding(
        "gyro-bias",
        "warning",
        "imu",
        f"the gyro turns at rest by up to {np.degrees(np.abs(bias).max()):.1f} deg/s",
        f"mean ({said}) rad/s in {resting.sum()} samples while the wheels stand",
        "subtract these means",
        lambda recording: _less(recording, bias),
    )


def at_rest(context: CheckContext) -> NDArray[np.bool_]:
    """Mask (N,) of the IMU's samples inside stretches in which all wheels stand still."""
    wheels, imu = context.recording.wheels, context.recording.imu
    if wheels is None or imu is None or len(wheels) < 2:
        return np.zeros(0 if imu is None else len(imu), dtype=bool)
    top = np.nanmax(np.abs(wheels.speed), initial=0.0) if np.isfinite(wheels.speed).any() else 0.0
    standing = (np.abs(wheels.speed) <= 1e-3 * top).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], standing, [False]]).astype(int)))
    begins, ends = wheels.t_ns[edges[::2]], wheels.t_ns[edges[1::2] - 1]
    steps = np.diff(wheels.t_ns)
    gaps = wheels.t_ns[:-1][steps > max(GAP_PERIODS * float(np.median(steps)), GAP_S * 1e9)]
    whole = np.searchsorted(gaps, begins) == np.searchsorted(gaps, ends)  # what happens in a gap nobody knows
    rests = whole & ((ends - begins) * 1e-9 >= REST_S)
    margin = round(MARGIN_S * 1e9)
    begins, ends = begins[rests] + margin, ends[rests] - margin
    if not len(begins):
        return np.zeros(len(imu), dtype=bool)
    rest = np.searchsorted(begins, imu.t_ns, side="right") - 1
    return np.asarray((rest >= 0) & (imu.t_ns <= ends[np.maximum(rest, 0)]))


def _less(recording: Recording, bias: Array) -> Recording:
    assert recording.imu is not None
    imu = dataclasses.replace(recording.imu, gyro_radps=recording.imu.gyro_radps - bias)
    return dataclasses.replace(recording, imu=imu)
