"""Counters read out of step with their stamps: seen, bridged by the speeds, true to the counts over time."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.inputs.streams import WheelStream

SPEED_MPS, STEP_NS = 0.85, 100_000_000


def stream(noise_m: float, speed_scale: float = 1.0, jump_m: float = 0.0) -> WheelStream:
    """One minute of steady driving whose counters read up to `noise_m` wrong; `jump_m` at half time."""
    wheels = WheelStream()
    true_m = SPEED_MPS * 0.1 * np.arange(600)
    counted = true_m + noise_m * np.tile([1.0, 1.0, -1.0, -1.0], 150) + jump_m * (np.arange(600) >= 300)
    for k, m in enumerate(counted.tolist()):
        wheels.add(k * STEP_NS, speed_scale * SPEED_MPS, speed_scale * SPEED_MPS, m, m)
    return wheels


def test_counters_in_step_are_taken_as_they_are() -> None:
    wheels = stream(3e-4)
    assert not wheels.noise.out_of_step
    assert wheels.left_m[400] == pytest.approx(SPEED_MPS * 40.0, abs=3.1e-4)


def test_increments_out_of_step_follow_the_speeds() -> None:
    """Counted increments are 20 mm off, two of four."""
    wheels = stream(0.01)
    assert wheels.noise.out_of_step
    assert np.abs(np.diff(wheels.left_m)[100:] - 0.1 * SPEED_MPS).max() < 0.002


@pytest.mark.parametrize("speed_scale", [0.95, 1.05])
def test_over_time_the_distance_is_the_counters(speed_scale: float) -> None:
    wheels = stream(0.01, speed_scale)
    assert wheels.left_m[590] - wheels.left_m[190] == pytest.approx(SPEED_MPS * 40.0, abs=0.02)


def test_a_jump_of_the_counters_is_no_way_driven() -> None:
    wheels = stream(0.01, jump_m=1.0)
    assert wheels.left_m[590] - wheels.left_m[190] == pytest.approx(SPEED_MPS * 40.0, abs=0.05)
