"""The vehicle of a recording: by name, file, object, by the log, or generic with the log's geometry."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Imu, Steering, Wheels
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.sensors import DRIVES, STEERED_DRIVES
from terrafusion.twin.model.choose import choose_vehicle, vehicle_of_logs
from terrafusion.twin.model.vehicle import load_vehicle, reported_geometry

NAMELESS = Recording("run", 0)


def test_a_name_and_the_vehicle_itself_are_the_same() -> None:
    husky = load_vehicle("husky")
    assert choose_vehicle(NAMELESS, "husky") == choose_vehicle(NAMELESS, husky) == (husky, ())


def test_the_log_names_the_vehicle_unless_another_is_asked_for() -> None:
    named = dataclasses.replace(NAMELESS, vehicle="husky")
    assert choose_vehicle(named)[0].name == "husky"
    assert choose_vehicle(named, "warthog")[0].name == "warthog"


def test_logs_name_the_vehicle_they_are_calibrated_from() -> None:
    husky, warthog = (dataclasses.replace(NAMELESS, name=name, vehicle=name) for name in ("husky", "warthog"))
    assert vehicle_of_logs([husky, husky]) == ("husky", ())
    assert vehicle_of_logs([husky, warthog], "elevate") == ("elevate", ())
    with pytest.raises(DataError, match="warthog: its vehicle is 'warthog', that of husky 'husky'"):
        vehicle_of_logs([husky, warthog])
    unknown = dataclasses.replace(
        husky, vehicle="rover", overrides=Overrides(wheel_radius_m=0.2, track_m=0.6)
    )
    name, notes = vehicle_of_logs([unknown])
    assert name == "generic"
    assert "unknown vehicle 'rover': the generic vehicle is used" in notes[0]
    with pytest.raises(DataError, match="names no vehicle"):
        vehicle_of_logs([NAMELESS])


def test_without_a_name_the_geometry_of_the_log_is_needed() -> None:
    with pytest.raises(DataError, match="names no vehicle"):
        choose_vehicle(NAMELESS)
    known = dataclasses.replace(NAMELESS, overrides=Overrides(wheel_radius_m=0.2, track_m=0.6))
    vehicle, notes = choose_vehicle(known)
    assert vehicle.rig().track_m == 0.6
    assert "the generic vehicle is used" in notes[-1]


GYRO = Imu(np.arange(2), np.zeros((2, 3)), np.full((2, 3), np.nan))
SIDES = Wheels(np.arange(2), np.zeros((2, 2)), ("left", "right"), "radps")


def test_an_unknown_vehicle_is_generic_with_the_geometry_of_the_log() -> None:
    log = dataclasses.replace(
        NAMELESS, vehicle="segway_rmp", imu=GYRO, wheels=SIDES, overrides=Overrides(wheel_radius_m=0.24)
    )
    vehicle, notes = choose_vehicle(log)
    assert vehicle.rig().wheel_radius_m == 0.24
    assert "unknown vehicle 'segway_rmp'" in notes[0]
    assert "wheel_radius_m = 0.24 of the log" in notes[0]
    assert f"assumed are its track of {vehicle.odometry.track_m:g} m" in notes[0]


@pytest.mark.parametrize(
    ("changes", "missing"),
    [
        ({"overrides": Overrides(track_m=0.6)}, "wheel_radius_m"),
        ({"imu": None, "overrides": Overrides(wheel_radius_m=0.2)}, "track_m"),
        ({"imu": None}, "wheel_radius_m and track_m"),
    ],
)
def test_an_unknown_vehicle_needs_what_nothing_else_shows(changes: dict[str, Any], missing: str) -> None:
    log = dataclasses.replace(NAMELESS, vehicle="segway_rmp", imu=GYRO, wheels=SIDES)
    with pytest.raises(DataError, match=f"unknown vehicle 'segway_rmp', and the log lacks its {missing};"):
        choose_vehicle(dataclasses.replace(log, **changes))


def test_an_unknown_vehicle_that_is_asked_for_and_a_missing_file_are_refused() -> None:
    log = dataclasses.replace(NAMELESS, imu=GYRO)
    with pytest.raises(ConfigError, match="unknown vehicle 'segway_rmp'"):
        choose_vehicle(log, "segway_rmp")
    with pytest.raises(ConfigError, match="no such file"):
        choose_vehicle(dataclasses.replace(log, vehicle="segway_rmp.yaml"))


STEERED = dataclasses.replace(
    NAMELESS,
    wheels=Wheels(np.arange(2), np.zeros((2, 1)), ("speed",), "mps"),
    steering=Steering(np.arange(2), np.full((2, 1), 0.1), ("angle",)),
)


@pytest.mark.parametrize("drive", DRIVES)
def test_a_generic_vehicle_of_each_drive(drive: str) -> None:
    """Of a log that gives drive, wheel radius, track and wheelbase and names no vehicle."""
    own = Overrides(wheel_radius_m=0.2, track_m=0.6, drive=drive, wheelbase_m=1.1)
    vehicle, notes = choose_vehicle(dataclasses.replace(NAMELESS, wheels=SIDES, overrides=own))
    rig = vehicle.rig()
    assert (rig.drive, rig.wheelbase_m) == (drive, 1.1)
    assert (rig.steering is not None) == (drive in STEERED_DRIVES)
    assert f"drive = {drive}" in notes[0]


def test_steering_angles_tell_the_drive() -> None:
    own = Overrides(wheelbase_m=2.5, steering_ratio=15.0)
    vehicle, _ = choose_vehicle(dataclasses.replace(STEERED, overrides=own))
    rig = vehicle.rig()
    assert rig.drive == "ackermann"
    assert rig.steering is not None
    assert rig.steering.ratio == 15.0
    assert rig.track_m == pytest.approx(1.5)
    both = Steering(np.arange(2), np.array([[0.1, -0.1]] * 2), ("front", "rear"))
    vehicle, _ = choose_vehicle(dataclasses.replace(STEERED, steering=both, overrides=own))
    assert vehicle.drive.type == "four_wheel_steer"


def test_without_a_gyro_a_steered_robot_needs_its_wheelbase() -> None:
    with pytest.raises(DataError, match="wheelbase_m"):
        choose_vehicle(STEERED)
    vehicle, notes = choose_vehicle(dataclasses.replace(STEERED, imu=GYRO))
    assert f"wheelbase of {vehicle.body.wheelbase_m:g} m" in notes[0]


def test_logs_of_one_robot_may_leave_its_drive_out_but_not_differ() -> None:
    tracked = Recording("monday", 0, overrides=Overrides(track_m=0.5, drive="tracked"))
    silent = Recording("tuesday", 0, overrides=Overrides(track_m=0.5))
    for logs in ([tracked, silent], [silent, tracked]):
        assert reported_geometry(logs) == tracked.overrides
    skid = Recording("friday", 0, overrides=Overrides(track_m=0.5, drive="skid_steer"))
    with pytest.raises(DataError, match=r"friday: .*give logs of one vehicle, or the same drive in"):
        reported_geometry([silent, tracked, skid])
