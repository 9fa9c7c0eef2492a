"""Assumptions: what neither log nor vehicle file gives is listed, what either gives is not."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.fusion.config.assumptions import Assumption, assumptions
from terrafusion.fusion.config.sensor_config import sensor_config_of
from terrafusion.twin.model.vehicle import load_vehicle, with_overrides
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

ANTENNA_M = (0.1, 0.0, 0.5)


def log(**changed: object) -> Recording:
    """A second of a drive."""
    drive = Scenario("second", 1.0, drive=(DriveSegment(1.0, 0.5),), route=(RouteLeg("asphalt"),))
    return dataclasses.replace(simulate(drive, vehicle="husky"), notes=(), **changed)  # type: ignore[arg-type]


def found(recording: Recording, asked: str | Path) -> dict[str, Assumption]:
    vehicle = with_overrides(load_vehicle(asked), recording.overrides)
    inputs = sensor_config_of(recording, recording.gnss)
    return {one.name: one for one in assumptions(recording, asked, vehicle, inputs, recording.gnss)}


def test_a_generic_vehicle_is_assumed_where_the_log_gives_nothing() -> None:
    geometry = Overrides(wheel_radius_m=0.2, antenna_m=ANTENNA_M)
    assumed = found(log(overrides=geometry), "generic")
    assert {"track_m", "imu_m", "gyro_bias_radps"} <= assumed.keys()
    assert not {"wheel_radius_m", "antenna_m"} & assumed.keys()
    generic = load_vehicle("generic")
    assert assumed["track_m"].value == generic.odometry.track_m
    assert 0.0 < (assumed["track_m"].sigma or 0.0) < generic.odometry.track_m


def test_places_of_a_vehicle_of_the_library_are_another_robots() -> None:
    assumed = found(log(), "husky")
    assert {"antenna_m", "imu_m"} <= assumed.keys()
    assert not {"wheel_radius_m", "track_m"} & assumed.keys()
    assert "antenna_m" not in found(log(overrides=Overrides(antenna_m=ANTENNA_M)), "husky")


def test_a_file_of_ones_own_assumes_what_it_says(tmp_path: Path) -> None:
    from terrafusion.datasets.core.yaml_file import read_yaml
    from terrafusion.twin.model import library

    text = (Path(library.__file__).parents[1] / "params" / "vehicles" / "husky.yaml").read_text()
    text = text.replace("name: husky", "name: mine")
    text = text.replace('source: "field log: antenna in base_link"', 'source: "assumed: by eye"')
    own = tmp_path / "mine.yaml"
    own.write_text(text)
    assert read_yaml(own)["name"] == "mine"
    assumed = found(log(), own)
    assert "antenna_m" in assumed
    assert "imu_m" not in assumed


def test_yaw_of_the_wheels_has_an_assumed_factor() -> None:
    assumed = found(log(imu=None), "husky")
    assert 0.0 < assumed["yaw_factor"].value <= 1.0
    assert "imu_m" not in assumed
    assert "yaw_factor" not in found(log(), "husky")


def test_without_fixes_start_and_heading_are_arbitrary() -> None:
    assumed = found(log(gnss=None), "husky")
    assert assumed["start_heading_rad"].sigma is None
    assert "antenna_m" not in assumed


def test_fixes_without_sigma_get_that_of_their_class() -> None:
    recording = log()
    assert recording.gnss is not None
    blind = dataclasses.replace(recording.gnss, sigma_enu_m=np.full((len(recording.gnss), 3), np.nan))
    names = found(dataclasses.replace(recording, gnss=blind), "husky")
    assert any(name.startswith("gnss_sigma_m") for name in names)


def test_what_a_reader_took_for_granted_is_quoted() -> None:
    note = "imu: axes -z, -x, +y brought to x forward, y left, z up"
    recording = dataclasses.replace(log(), notes=(note, "gnss: datum is the first fix"))
    one = found(recording, "husky")["imu"]
    assert str(one) == note
    assert str(Assumption("track_m", 0.55, 0.2, "m")) == "track_m = 0.55 +- 0.2 m"
