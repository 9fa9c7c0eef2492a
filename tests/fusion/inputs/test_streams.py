"""Samples between keyframes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.inputs.streams import ImuStream, WheelStream

STEP_NS = 20_000_000


def stream(accel_mps2: float, until_s: float) -> WheelStream:
    """Wheels at 50 Hz from 1 m/s on, both sides alike."""
    wheels = WheelStream()
    for i in range(round(until_s * 1e9) // STEP_NS + 1):
        speed = 1.0 + accel_mps2 * i * STEP_NS * 1e-9
        wheels.add(i * STEP_NS, speed, speed)
    return wheels


@given(st.floats(-2.0, 2.0), st.integers(0, 5))
def test_a_steady_acceleration_is_seen_whole_however_new_the_keyframe_is(accel: float, later: int) -> None:
    wheels = stream(accel, 1.0 + 0.02 * later)
    assert wheels.speed_change_mps(900_000_000, 1_000_000_000) == pytest.approx(
        0.1 * accel, rel=0.02, abs=1e-9
    )


def test_without_samples_no_change_is_told() -> None:
    assert WheelStream().speed_change_mps(900_000_000, 1_000_000_000) == 0.0
    assert stream(1.0, 0.9).speed_change_mps(900_000_000, 1_000_000_000) == 0.0
    assert stream(1.0, 2.0).speed_change_mps(0, 100_000_000) == 0.0


def test_a_gyro_of_one_axis_may_be_mounted_at_any_angle() -> None:
    imu = ImuStream(six_axis=False)
    imu.mounting_rad = 1.5
    for i in range(10):
        imu.add(i * STEP_NS, [np.nan, np.nan, 0.3], [np.nan] * 3)
    rates, _ = imu.levelled(0, 9 * STEP_NS)
    np.testing.assert_array_equal(rates, np.tile([0.0, 0.0, 0.3], (9, 1)))
