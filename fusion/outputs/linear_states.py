"""The linear states of an `Estimate`: series by name, and the result of an online calibration."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.robot import SensorNumbers
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.calibration.numbers import antenna_sigma_m
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.estimator.learned_numbers import NumberAfterDrive
from terrafusion.fusion.graph.key_state import CALIBRATION, LINEAR
from terrafusion.fusion.graph.slow_states import CALIBRATION_SIGMA

OBSERVED_SHARE = 0.5
"""A state counts as observed once its sigma is below this share of the prior's."""


_DEGREES = math.degrees(1.0)
QUANTITIES = {
    "radius_scale": ("wheel radius, beyond the vehicle file's", "%", 100.0),
    "antenna_x_m": ("GNSS antenna, further forward", "m", 1.0),
    "antenna_y_m": ("GNSS antenna, further left", "m", 1.0),
    "imu_roll_rad": ("IMU turned about x", "deg", _DEGREES),
    "imu_pitch_rad": ("IMU turned about y", "deg", _DEGREES),
    "imu_yaw_rad": ("IMU turned about z", "deg", _DEGREES),
    "wheel_delay_s": ("wheel stamps later than the IMU's", "s", 1.0),
    "gnss_delay_s": ("GNSS stamps later than the IMU's", "s", 1.0),
}
"""How each state of `key_state.CALIBRATION` is shown: label, unit, and the factor to that unit."""
SHOWN = QUANTITIES | {
    "turn_scale": ("turns beyond those of the source of yaw", "%", 100.0),
    "wheel_scale": ("distance beyond that of the wheels", "%", 100.0),
    "course_lag_s": ("course behind the heading, in turns", "s", 1.0),
    "slip_per_grade": ("slip over the sine of the slope", "", 1.0),
}
"""With the numbers of self-calibration."""


def series(estimate: Estimate, name: str) -> tuple[Array, Array] | None:
    """A linear state (N,) over the drive and its 1 sigma (N,); None where it was not estimated."""
    if estimate.linear is None or estimate.linear_sigma is None:
        return None
    i = LINEAR.index(name)
    sigma = estimate.linear_sigma[:, i]
    return (estimate.linear[:, i], sigma) if np.isfinite(sigma).any() else None


def calibration(estimate: Estimate, rig: Rig | None = None) -> list[dict[str, Any]]:
    """What the last keyframe knows of each state of a calibration; empty where none was estimated.

    Rows of `state`, `value`, `sigma`, `prior_sigma` (SI, as the name says) and `observed`: sigma is less
    than `OBSERVED_SHARE` of the prior's. `rig` is the robot; None: nothing is known of it.
    """
    known, wheelbase_m = (SensorNumbers(), 0.0) if rig is None else (rig.known, rig.wheelbase_m)
    antenna = zip(("antenna_x_m", "antenna_y_m"), antenna_sigma_m(known, wheelbase_m), strict=True)
    prior = CALIBRATION_SIGMA | dict(antenna)
    found = {name: series(estimate, name) for name in CALIBRATION}
    return [
        _row(name, float(values[0][-1]), float(values[1][-1]), prior[name])
        for name, values in found.items()
        if values is not None
    ]


def _row(state: str, value: float, sigma: float, prior_sigma: float) -> dict[str, Any]:
    observed = sigma < OBSERVED_SHARE * prior_sigma
    return {"state": state, "value": value, "sigma": sigma, "prior_sigma": prior_sigma, "observed": observed}


def learned_rows(numbers: Sequence[NumberAfterDrive]) -> list[dict[str, Any]]:
    """What self-calibration knows at the end, in rows as those of `calibration`, with `corrects`."""
    return [
        _row(one.state, one.value, one.sigma, one.prior_sigma) | {"corrects": one.corrects} for one in numbers
    ]


def cells(row: Mapping[str, Any]) -> list[str]:
    """A row of `calibration` as text: quantity, value, sigma, prior's sigma, verdict."""
    label, unit, scale = SHOWN[row["state"]]
    numbers = [f"{row[key] * scale:z.3f}" for key in ("value", "sigma", "prior_sigma")]
    verdict = "observed" if row["observed"] else "not observable on this drive"
    if row.get("corrects"):
        verdict = "observed, corrects the sensor"
    return [f"{label}, {unit}" if unit else label, *numbers, verdict]
