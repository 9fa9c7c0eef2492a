"""The antenna of a car sits farther from its middle than that of a small robot: it is found where it is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Steering, Wheels
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.robot import ANTENNA_SIGMA_M, antenna_spread_m
from terrafusion.fusion.api.replays import replay

WHEELBASE_M, DT_S, LENGTH_S, SIGMA_M = 2.6, 0.02, 120.0, 0.5


def car(antenna_x_m: float) -> Recording:
    """A car that rolls in bends without slip, its fixes in time."""
    rng, t_s = np.random.default_rng(1), np.arange(0.0, LENGTH_S, DT_S)
    v = np.where(t_s < 5.0, 0.0, np.minimum(0.8 * (t_s - 5.0), 5.0 + 2.0 * np.sin(0.1 * t_s)))
    steered = np.where(t_s < 6.0, 0.0, 0.25 * np.sin(0.25 * t_s) + 0.1 * np.sin(0.6 * t_s))
    rate = v * np.tan(steered) / WHEELBASE_M
    yaw = np.cumsum(rate) * DT_S
    rear = np.cumsum(v[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0) * DT_S
    ahead_m = 0.5 * WHEELBASE_M + antenna_x_m
    t_ns, none = np.round(t_s * 1e9).astype(np.int64), np.zeros(len(t_s))
    gyro = np.stack([none, none, rate], axis=1) + 0.002 * rng.standard_normal((len(t_s), 3))
    accel = np.stack([np.gradient(v, DT_S), v * rate, none + 9.81], axis=1)
    some = slice(None, None, 10)
    fixes = np.column_stack([rear + ahead_m * np.stack([np.cos(yaw), np.sin(yaw)], axis=1), none])[some]
    return Recording(
        "car", 0,
        wheels=Wheels(t_ns[::2], v[::2, None], ("speed",), "mps"),
        steering=Steering(t_ns[::2], steered[::2, None], ("angle",)),
        imu=Imu(t_ns, gyro, accel + 0.05 * rng.standard_normal(accel.shape)),
        gnss=Gnss(
            t_ns[some], fixes + SIGMA_M * rng.standard_normal(fixes.shape), np.full(fixes.shape, SIGMA_M),
            np.full(len(fixes), Fix.DGPS, dtype=np.uint8),
        ),
        overrides=Overrides(track_m=1.5, wheelbase_m=WHEELBASE_M, drive="ackermann"),
    )  # fmt: skip


@pytest.mark.parametrize("antenna_x_m", [-1.3, 0.8])
def test_the_antenna_of_a_car_is_found_and_not_taken_for_a_delay(antenna_x_m: float) -> None:
    found = {number.state: number for number in replay(car(antenna_x_m), mode="fixed").learned}
    antenna = found["antenna_x_m"]
    assert abs(antenna.value - antenna_x_m) < 2.0 * antenna.sigma < 0.6
    assert abs(found["gnss_delay_s"].value) < 0.07


def test_it_sits_anywhere_between_the_axles() -> None:
    assert antenna_spread_m(WHEELBASE_M) == pytest.approx(WHEELBASE_M / math.sqrt(12.0))
    assert antenna_spread_m(0.5) == ANTENNA_SIGMA_M
