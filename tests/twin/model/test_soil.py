"""Soils: every number with source and range, published ones in SI, and what lies outside is refused."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.channels import TERRAINS
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.soil import Validity, load_soil
from terrafusion.twin.model.soil_table import published_soils
from terrafusion.twin.model.vectors import soil_vector
from terrafusion.twin.model.vehicle import load_vehicle, vehicle_names
from terrafusion.twin.physics.layout import SOIL_PARAMETERS, STATES, state_slice
from terrafusion.twin.physics.terramechanics import WheelShape
from terrafusion.twin.physics.wheel import WheelSoil, steady_contact
from terrafusion.twin.scenario.route import Route
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.scenario.validity import check_slip, check_wheel, ground_pressure_pa
from terrafusion.twin.simulate import simulate_run

SOILS = resources.files("terrafusion.twin.params") / "soils"
ELEVATE = load_vehicle("elevate")
SHORT = Scenario("short", 6.0, drive=(DriveSegment(6.0, v_mps=0.8),), route=(RouteLeg("loose_sand"),))


def numbers(raw: dict[str, Any], key: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """The sourced entries of a soil file, by dotted key, without its `validity` section."""
    for name, value in raw.items():
        if isinstance(value, dict) and name != "validity":
            if "value" in value:
                yield f"{key}{name}", value
            else:
                yield from numbers(value, f"{key}{name}.")


def raw_soil(name: str) -> dict[str, Any]:
    with resources.as_file(SOILS / f"{name}.yaml") as path:
        return read_yaml(path)


def own(tmp_path: Path, name: str, old: str, new: str) -> Path:
    """A soil file of the library with one text replaced."""
    text = (SOILS / f"{name}.yaml").read_text(encoding="utf-8")
    assert text.count(old) == 1
    path = tmp_path / "own.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_all_grounds_have_a_soil() -> None:
    assert set(known_names("soils")) == set(TERRAINS)


@pytest.mark.parametrize("name", known_names("soils"))
def test_every_number_has_source_and_range(name) -> None:
    entries = dict(numbers(raw_soil(name)))
    assert len(entries) >= 24
    for key, entry in entries.items():
        low, high = entry["valid"]
        assert low <= entry["value"] <= high, key
        assert len(entry["source"]) > 10, key
    validity = raw_soil(name)["validity"]
    assert {"ground_pressure_pa", "wheel_diameter_m", "slip"} <= set(validity)


@pytest.mark.parametrize("name", known_names("soils"))
@pytest.mark.parametrize("vehicle", vehicle_names())
def test_every_vehicle_may_drive_on_every_ground_with_all_its_payload(name, vehicle) -> None:
    robot = load_vehicle(vehicle)
    for kg in (robot.body.mass_kg, robot.body.mass_kg + robot.body.payload_max_kg):
        check_wheel(load_soil(name), robot.wheel.radius_m, robot.wheel.width_m, 0.25 * kg * 9.81)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("value: 0.5, valid: [0.4, 0.6]", "value: 0.7, valid: [0.4, 0.6]",
         r"'shear.friction_cap' is 0.7, outside its validity range; its source covers \[0.4, 0.6\]"),
        ("value: 1.52843e6", "value: 1528.43", r"'pressure.k_phi_n_per_m_n2' is 1528.43, outside"),
        ("valid: [0.4, 0.6]", "valid: 0.5", r"'shear.friction_cap.valid' is '0.5'; give 2 numbers"),
        ("valid: [0.4, 0.6]", "range: [0.4, 0.6]", r"unknown entry 'range'; keep .*'valid'"),
        ("value: [0.2, 1.5]", "value: [1.5, 0.2]", r"validity.wheel_diameter_m must be \[low, high\]"),
    ],
)  # fmt: skip
def test_a_number_outside_its_range_is_reported_when_the_file_is_loaded(tmp_path, old, new, message) -> None:
    with pytest.raises(ConfigError, match=message):
        load_soil(own(tmp_path, "loose_sand", old, new))


def test_a_wheel_too_small_or_a_load_too_heavy_for_the_soil_is_reported() -> None:
    sand = load_soil("loose_sand")
    with pytest.raises(ConfigError, match=r"wheel diameter is 0.1 m, outside .*'loose_sand'; .*0.2 to 1.5 m"):
        check_wheel(sand, 0.05, 0.05, 20.0)
    with pytest.raises(ConfigError, match=r"under a wheel with 20000 N is .*from 1000 to 100000 Pa"):
        check_wheel(sand, 0.175, 0.145, 20_000.0)
    small = dataclasses.replace(ELEVATE, wheel=dataclasses.replace(ELEVATE.wheel, radius_m=0.09))
    with pytest.raises(ConfigError, match=r"validity.wheel_diameter_m: wheel diameter is 0.18 m"):
        simulate_run(SHORT, vehicle=small)


def test_ground_pressure_is_load_over_contact() -> None:
    asphalt = load_soil("asphalt")
    floor = asphalt.pressure.contact_length_floor_m
    assert ground_pressure_pa(asphalt, 0.175, 0.145, 78.5) == pytest.approx(78.5 / (0.145 * floor), rel=1e-3)


@pytest.mark.parametrize(
    ("terrain", "moisture", "message"),
    [
        ("mud", 20.0, r"moisture is 20 %, outside .* of 'mud'; .* hold from 38 to 60 %"),
        ("asphalt", 5.0, r"'asphalt' has no range of moisture"),
    ],
)  # fmt: skip
def test_a_moisture_the_soil_was_not_measured_at_is_reported(terrain, moisture, message) -> None:
    wet = dataclasses.replace(SHORT, route=(RouteLeg(terrain, None, moisture),))
    with pytest.raises(ConfigError, match=message):
        simulate_run(wet)


def test_a_moisture_inside_the_range_changes_nothing() -> None:
    damp = dataclasses.replace(SHORT, route=(RouteLeg("loose_sand", None, 3.0),))
    assert simulate_run(damp).summary == simulate_run(SHORT).summary


def test_slip_beyond_what_was_measured_is_reported() -> None:
    sand = load_soil("loose_sand")
    narrow = dataclasses.replace(sand, validity=Validity(slip=(-0.02, 0.02)))
    with pytest.raises(ConfigError, match=r"slip reached .* on 'loose_sand', .* from -0.02 to 0.02"):
        simulate_run(SHORT, soils={"loose_sand": narrow})
    wide = dataclasses.replace(sand, validity=Validity(slip=(-1.0, 1.0)))
    assert simulate_run(SHORT, soils={"loose_sand": wide}).summary.distance_m > 3.0


def test_slip_of_a_robot_that_digs_in_on_the_spot_counts() -> None:
    sand = load_soil("loose_sand")
    narrow = dataclasses.replace(sand, validity=Validity(slip=(-0.8, 0.8)))
    route = Route.of(SHORT, {"loose_sand": narrow})
    states, slip = np.zeros((100, len(STATES))), np.ones((100, 4))
    check_slip(route, None, np.arange(100.0), states, slip)
    states[:, state_slice("wheel_speed")] = 5.0
    with pytest.raises(ConfigError, match=r"slip reached 1.00 on 'loose_sand', 100 %"):
        check_slip(route, None, np.arange(100.0), states, slip)


@pytest.mark.parametrize("name", published_soils())
def test_a_published_soil_loads_in_si_and_can_be_driven_on(name) -> None:
    row, soil = published_soils()[name], load_soil(name)
    assert soil.pressure.k_phi_n_per_m_n2 == pytest.approx(1e3 * float(row["k_phi_kn_per_m_n2"]))
    assert soil.pressure.k_c_n_per_m_n1 == pytest.approx(1e3 * float(row["k_c_kn_per_m_n1"]))
    assert math.degrees(soil.shear.friction_angle_rad) == pytest.approx(float(row["friction_angle_deg"]))
    assert soil.shear.shear_modulus_m == pytest.approx(1e-2 * float(row["shear_modulus_cm"]))
    assert soil.shear.cohesion_pa == pytest.approx(1e3 * float(row["cohesion_kpa"]))
    assert len(row["source"]) > 10
    assert soil_vector(soil).shape == (len(SOIL_PARAMETERS),)
    run = simulate_run(SHORT, terrain=name, noiseless=True)
    assert run.recording.terrain_name == row["name"]
    assert any(f" of terrain '{name}'" in note for note in run.recording.notes)


def test_library_soils_are_the_published_ones_they_name() -> None:
    for own_name, published in (
        ("medium_sand", "wong:lete_sand"), ("loose_sand", "wong:dry_sand_lll"),
        ("mud", "wong:clayey_soil_thailand_55"), ("grass", "wong:grenville_loam"),
        ("ploughed_soil", "wong:sandy_loam_michigan_11"),
    ):  # fmt: skip
        a, b = load_soil(own_name), load_soil(published)
        assert a.pressure.k_phi_n_per_m_n2 == pytest.approx(b.pressure.k_phi_n_per_m_n2)
        assert a.pressure.exponent == b.pressure.exponent
        assert a.shear.cohesion_pa == pytest.approx(b.shear.cohesion_pa)
        if own_name != "medium_sand":  # denser than LETE sand, see its file
            assert a.shear.friction_angle_rad == pytest.approx(b.shear.friction_angle_rad, abs=1e-4)


def test_an_unknown_published_soil_is_reported_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"unknown published soil 'wong:custard'; .*wong:lete_sand"):
        load_soil("wong:custard")
    with pytest.raises(ConfigError, match="unknown terrain 'wang:lete_sand'"):
        load_soil("wang:lete_sand")


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("medium_sand", 0.8, 1.0), ("loose_sand", 0.4, 0.6), ("mud", 0.1, 0.2)],
)
def test_effective_friction_is_the_studys(name, low, high) -> None:
    """Source study, Tab. 3: the most a wheel of the nominal platform pulls, over its load."""
    ground = WheelSoil(*soil_vector(load_soil(name)))
    load = 0.25 * ELEVATE.body.mass_kg * 9.81
    shape = WheelShape(ELEVATE.wheel.radius_m, ELEVATE.wheel.width_m)
    hubs = [(1.0 - slip, 0.0) for slip in (0.3, 0.6, 0.99)]
    pulls = [float(steady_contact(ground, load, 1.0, hub, shape).traction_x_n) for hub in hubs]
    assert low <= max(pulls) / load <= high
