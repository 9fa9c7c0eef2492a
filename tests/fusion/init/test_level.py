"""The tilt of an IMU: found over all headings, told from a slope, and taken out by the estimator."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import gtsam
import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import KnownNumber, SensorNumbers
from terrafusion.fusion.init.answers import Answers
from terrafusion.fusion.init.draft import write_draft
from terrafusion.fusion.init.level import FORWARD_SIGMA_RAD, forward_line, measure_tilt, tilt_lines
from terrafusion.fusion.init.vehicle import COMMENTS, first_vehicle
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate

ROLL, PITCH = math.radians(-6.0), math.radians(11.0)
RIG = load_vehicle("elevate").rig()


def tilted(recording: Recording) -> Recording:
    """The recording of an IMU that is mounted rolled and pitched."""
    imu = recording.imu
    assert imu is not None
    R = gtsam.Rot3.RzRyRx(ROLL, PITCH, 0.0).matrix()  # turns its readings into body axes
    turned = dataclasses.replace(imu, gyro_radps=imu.gyro_radps @ R, accel_mps2=imu.accel_mps2 @ R)
    return dataclasses.replace(recording, imu=turned)


@pytest.fixture(scope="module")
def drive() -> Recording:
    return simulate("figure_eight", terrain="asphalt", seed=3)


def test_a_tilt_is_found_within_its_sigma_and_taken_out(drive: Recording, tmp_path: Path) -> None:
    log = tilted(drive)
    tilt = measure_tilt(log, RIG)
    assert tilt is not None
    assert abs(tilt.roll_rad - ROLL) < 2.0 * tilt.sigma_rad
    assert abs(tilt.pitch_rad - PITCH) < 2.0 * tilt.sigma_rad
    lines, notes = tilt_lines(tilt, "log")
    assert set(lines) == {"imu_roll_rad", "imu_pitch_rad"}
    assert not notes
    head = {"extends": dataclasses.replace(lines["imu_roll_rad"], value="elevate")}
    file = write_draft(tmp_path / "robot.yaml", head | lines, "tilted")
    outages = [Outage(50.0, 25.0)]
    with_file, without = (replay(log, vehicle=v, outages=outages).scores for v in (file, "elevate"))
    assert with_file.ate_m is not None
    assert without.ate_m is not None
    assert with_file.ate_m < 0.3 * without.ate_m


def test_a_slope_is_no_tilt(drive: Recording) -> None:
    sloping = simulate("figure_eight", terrain="asphalt", seed=3, slope_deg=8.0)
    for log in (drive, sloping):
        assert tilt_lines(measure_tilt(log, RIG), "log") == ({}, ())


def test_a_bend_is_no_tilt_whatever_the_wheels() -> None:
    t_ns, noise = np.arange(0, 60 * 10**9, 2 * 10**7), np.random.default_rng(1).normal(0.0, 0.01, (3000, 8))
    gyro, force = noise[:, :3] + [0.0, 0.0, 0.5], noise[:, 3:6] + [0.0, 0.8, 9.81]  # at 1.6 m/s
    sides = (noise[:, 6:] + [1.4, 1.8]) / 0.09
    log = Recording(
        "bend", 0, imu=Imu(t_ns, gyro, force), wheels=Wheels(t_ns, sides, ("left", "right"), "radps")
    )
    small = Answers("small", wheel_radius_m=KnownNumber(0.09, "measured"))
    draft = first_vehicle(lambda rig: log, log, small).draft
    assert "imu_roll_rad" not in draft


def test_a_motor_mounted_mirrored_is_repaired_before_the_radius_is_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("terrafusion.fusion.init.vehicle._calibrated", lambda *args: (None, ()))
    t_ns = np.arange(0, 60 * 10**9, 2 * 10**7)
    v, rate = 1.0 + 0.3 * np.sin(np.arange(3000) / 200), 0.1 + 0.2 * np.sin(np.arange(3000) / 300)
    place = np.cumsum(v * np.exp(1j * np.cumsum(rate) * 0.02)) * 0.02
    sides = np.stack([v - 0.3 * rate, -v - 0.3 * rate], axis=1) / 0.15
    noise = np.random.default_rng(1).normal(0.0, 0.01, (3000, 8))
    gyro, force = noise[:, :3] + np.outer(rate, [0, 0, 1]), noise[:, 3:6] + [0.0, 0.0, 9.81]
    enu = np.stack([place.real, place.imag, 0.0 * rate], axis=1)[::10] + noise[::10, 5:]
    fixes = Gnss(t_ns[::10], enu, np.full((300, 3), 0.01), np.full(300, Fix.FIXED, dtype=np.uint8))
    imu, wheels = Imu(t_ns, gyro, force), Wheels(t_ns, sides, ("left", "right"), "radps")
    log = Recording("mirrored", 0, imu=imu, wheels=wheels, gnss=fixes)
    found = first_vehicle(lambda rig: log, log, Answers("mirrored"))
    assert [finding.code for finding in found.repaired] == ["wheel-sign"]
    radius = found.draft["wheel_radius_m"].value
    assert isinstance(radius, KnownNumber)
    assert radius.number == pytest.approx(0.15, rel=0.02)


def test_a_straight_drive_up_a_slope_gets_a_remedy_and_no_number() -> None:
    uphill = simulate("straight", terrain="asphalt", seed=3, slope_deg=8.0)
    lines, (note,) = tilt_lines(measure_tilt(uphill, RIG), "log")
    assert not lines
    assert "a slope, or a tilted mount; drive once round on level ground" in note


def test_without_six_axes_nothing_is_measured(drive: Recording) -> None:
    assert drive.imu is not None
    flat = dataclasses.replace(drive.imu, accel_mps2=np.full_like(drive.imu.accel_mps2, np.nan))
    assert measure_tilt(dataclasses.replace(drive, imu=flat), RIG) is None
    assert measure_tilt(dataclasses.replace(drive, wheels=None), RIG) is None


def test_acceleration_shows_that_the_imu_is_not_turned_by_a_quarter(drive: Recording) -> None:
    """The estimator then needs no drive to find that out; of an IMU that is turned nothing is claimed."""
    (line,) = forward_line(drive, RIG).values()
    assert isinstance(line.value, KnownNumber)
    assert (line.value.value, line.value.sigma) == (0.0, FORWARD_SIGMA_RAD)
    assert drive.imu is not None
    R = gtsam.Rot3.Rz(0.5 * math.pi).matrix()
    imu = dataclasses.replace(
        drive.imu, gyro_radps=drive.imu.gyro_radps @ R, accel_mps2=drive.imu.accel_mps2 @ R
    )
    assert not forward_line(dataclasses.replace(drive, imu=imu), RIG)


def test_every_number_that_a_calibration_finds_has_its_comment_in_the_file() -> None:
    assert COMMENTS.keys() == SensorNumbers.__dataclass_fields__.keys()
