"""Signals that a sensor cannot have made: held values."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.doctor.finding import Finding, Patient
from terrafusion.datasets.recording import Channel

Array = NDArray[np.float64]


def check_held(patient: Patient) -> Iterator[Finding]:
    """Values repeated between true samples: the rate of the log is not the rate of the sensor."""
    recording = patient.recording
    signals: dict[str, tuple[Channel, Array]] = {}
    if recording.imu is not None:
        signals["imu"] = recording.imu, np.hstack([recording.imu.gyro_radps, recording.imu.accel_mps2])
    if recording.wheels is not None:
        signals["wheels"] = recording.wheels, recording.wheels.speed
    if recording.gnss is not None:
        signals["gnss"] = recording.gnss, recording.gnss.enu_m
    for name, (channel, values) in signals.items():
        share, run = _held_share(channel.t_ns, values)
        if share > 0.5:
            yield Finding(
                "held-values",
                "warning",
                name,
                "values are held",
                f"{share:.0%} of the samples repeat the one before while the signal changes; "
                f"a new value comes every {run:.1f} samples",
                "keep the first sample of each run, or log at the sensor's rate",
            )


def _held_share(t_ns: NDArray[np.int64], values: Array) -> tuple[float, float]:
    """Share of repeats among samples inside a change, and the mean run length there."""
    values = np.nan_to_num(values[:, ~np.isnan(values).all(axis=0)])
    if len(values) < 50 or not values.size:
        return 0.0, 1.0
    period = max(float(np.median(np.diff(t_ns))) * 1e-9, 1e-4)
    reach = int(np.clip(round(0.5 / period), 3, 500))
    spread = np.percentile(values, 95, axis=0) - np.percentile(values, 5, axis=0)
    across = np.abs(values[2 * reach :] - values[: -2 * reach])
    changing = np.any(across > 0.1 * np.where(spread > 0, spread, np.inf), axis=1)
    same = np.all(values[reach:-reach] == values[reach - 1 : -reach - 1], axis=1)
    if changing.sum() < 20:
        return 0.0, 1.0
    share = float(same[changing].mean())
    return share, 1.0 / max(1.0 - share, 1e-3)
