"""A live gyro in deg/s is refused, and says so; slow turns, other tracks and gaps are not."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import ImuSample, Message
from terrafusion.fusion.config.sensor_config import SensorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.stuck_gyro import StuckGyro
from terrafusion.fusion.inputs.gyro_unit import WINDOWS, GyroUnit
from terrafusion.fusion.inputs.streams import WheelStream
from terrafusion.twin.model.vehicle import load_vehicle
from tests.fusion.estimator.live_machine import drive


def with_gyro_times(factor: float) -> Iterator[Message]:
    for message in drive():
        if isinstance(message, ImuSample):
            message = message._replace(gyro_radps=np.asarray(message.gyro_radps) * factor)
        yield message


def test_a_live_gyro_in_degrees_is_refused_in_one_line() -> None:
    estimator, refused = Estimator.for_vehicle("elevate"), []
    for message in with_gyro_times(math.degrees(1.0)):
        try:
            estimator.add(message)
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 100
    assert len(set(refused)) < len(refused)
    assert all("as in deg/s" in text and "give rad/s" in text and "\n" not in text for text in refused)


@pytest.mark.parametrize("factor", [1.0, -1.0, 3.0])
def test_other_gyros_are_taken(factor: float) -> None:
    estimator = Estimator.for_vehicle("elevate")
    for message in with_gyro_times(factor):
        estimator.add(message)
    assert not estimator.gyro.unit.in_degrees
    assert estimator.latest() is not None


def turned(ratio: float, seconds: int, noise_radps: float = 0.0, turn_radps: float = 0.2) -> GyroUnit:
    """A robot that turns for a time, IMU at 50 Hz; wheels in step."""
    wheels, unit = WheelStream(), GyroUnit(0.5)
    noise = np.random.default_rng(0).normal(0.0, noise_radps, 50 * seconds)
    for i in range(50 * seconds):
        t_ns = i * 20_000_000
        wheels.add(t_ns, 0.5 - 0.25 * turn_radps, 0.5 + 0.25 * turn_radps)
        unit.check(t_ns, ratio * turn_radps + float(noise[i]), wheels)
    return unit


def test_it_needs_some_turns_that_agree() -> None:
    assert not turned(57.3, WINDOWS - 1).in_degrees
    with pytest.raises(DataError, match="57 times"):
        turned(57.3, 2 * WINDOWS)
    with pytest.raises(DataError, match="deg/s"):
        turned(-30.0, 2 * WINDOWS)
    assert not turned(9.8, 40).in_degrees
    assert not turned(57.3, 40, turn_radps=0.01).in_degrees, "wheels that hardly turn show nothing"
    assert not turned(0.0, 40, noise_radps=10.0).in_degrees, "noise has no one sign"


def test_right_readings_are_taken_again() -> None:
    wheels, unit, refused = WheelStream(), GyroUnit(0.5), 0
    for i in range(50 * 40):
        t_ns = i * 20_000_000
        wheels.add(t_ns, 0.45, 0.55)
        try:
            unit.check(t_ns, 0.2 * (57.3 if i < 1000 else 1.0), wheels)
        except DataError:
            refused += 1
    assert 100 < refused < 1000
    assert not unit.in_degrees


def test_without_sides_there_is_nothing_to_compare() -> None:
    gyro = StuckGyro(load_vehicle("husky").rig(), SensorConfig(sides=False))
    reading = np.array([0.0, 0.0, 60.0])
    for i in range(1000):
        np.testing.assert_array_equal(gyro.checked(i * 20_000_000, reading, WheelStream()), reading)


def test_a_window_begun_anew_begins_without_a_turn() -> None:
    """Just below the bound, with a pause after every window."""
    wheels, unit = WheelStream(), GyroUnit(0.5)
    for i in range(50 * 30):
        t_ns = i * 20_000_000
        wheels.add(t_ns, 0.45, 0.55)
        if i % 70 < 55:
            unit.check(t_ns, 0.2 * 9.8, wheels)
    assert not unit.in_degrees
    assert len(unit._ratios) == WINDOWS
