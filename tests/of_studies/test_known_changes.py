"""Changes put into a log are what they say, and do not touch its reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.recording import Recording
from tests.of_studies.test_opponents import winding
from tests.studies.known_changes.changes import ANTENNA_M, CHANGES, WHEELS, antenna_moved, slower
from tests.studies.known_changes.page import BEFORE, Found, markdown, ratios
from tests.studies.opponents.drives import made, vehicle_of


@pytest.fixture(scope="module")
def drive() -> Recording:
    return made(winding(), "rtk")


def test_the_antenna_moves_along_the_heading(drive: Recording) -> None:
    moved = antenna_moved(drive).gnss
    assert moved is not None
    assert drive.gnss is not None
    assert drive.truth is not None
    way = (moved.enu_m - drive.gnss.enu_m)[:, :2]
    assert np.hypot(*way.T) == pytest.approx(ANTENNA_M, abs=1e-3)
    yaw = 0.8 * np.sin(0.15 * moved.t_ns * 1e-9)
    assert np.arctan2(way[:, 1], way[:, 0]) == pytest.approx(yaw, abs=0.02)


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 10.0])
def test_slower_sensors_keep_the_turn_and_the_way(drive: Recording, rate_hz: float) -> None:
    cut = slower(drive, rate_hz)
    assert cut.imu is not None
    assert drive.imu is not None
    assert cut.wheels is not None
    step = np.diff(cut.imu.t_ns) * 1e-9
    assert step == pytest.approx(1.0 / rate_hz)
    turned = np.sum(cut.imu.gyro_radps[:, 2]) / rate_hz
    assert turned == pytest.approx(np.sum(drive.imu.gyro_radps[:, 2]) * 0.05, abs=0.01)
    assert float(np.ptp(cut.wheels.t_ns)) * 1e-9 == pytest.approx(95.0, abs=1.1 / rate_hz)
    assert cut.wheels.speed == pytest.approx(1.0)


def test_slower_streams_stay(drive: Recording) -> None:
    n = 20
    gnss = Gnss(
        np.arange(n) * 2_000_000_000, np.zeros((n, 3)), np.ones((n, 3)), np.full(n, Fix.SINGLE, np.uint8)
    )
    assert slower(dataclasses.replace(drive, gnss=gnss), 1.0).gnss is gnss


def test_the_truth_stays_and_told_numbers_are_those_put_in(drive: Recording) -> None:
    for change in CHANGES:
        if change.name == "left side +3 %":  # one speed for both sides
            continue
        assert change.put(drive).truth is drive.truth
    told = {change.name: change.told for change in CHANGES if change.told is not None}
    antenna = told["antenna .35 m off"](drive).overrides.antenna_m
    assert antenna == pytest.approx((ANTENNA_M, 0.0, 0.0))
    assert drive.wheels is not None
    turning = dataclasses.replace(drive.wheels, speed=drive.wheels.speed / 0.165, unit="radps")
    wheels = told["wheels +8 %"](dataclasses.replace(drive, wheels=turning))
    radius = vehicle_of(drive, None).rig().wheel_radius_m
    assert wheels.overrides.wheel_radius_m == pytest.approx(radius / (1.0 + WHEELS))


def test_ratios_are_after_to_before() -> None:
    found = [
        Found("set", "set/log", BEFORE, False, [1.0, 2.0, 3.0], [1.0, 0.9, 0.95]),
        Found("set", "set/log", "gyro x 1.03", False, [2.0, 3.0, 4.0], [1.0, 1.0, None]),
    ]
    assert ratios(found, "gyro x 1.03", False) == {"set/log": 1.5}
    text = markdown(found, [], 0, 2)
    assert "1.50" in text
    assert "95 %" in text
