"""Calibration of logs that are not plain: several grounds, a reference, effects, holes, other clocks."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.twin.calibrate import solver
from terrafusion.twin.calibrate.calibrate import calibrate
from terrafusion.twin.calibrate.files import write_files
from terrafusion.twin.calibrate.log import prepare
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.predict import predict
from terrafusion.twin.calibrate.start import coordinates_of, start_model
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle, with_overrides
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

SOIL, OTHER = "loose_sand", "asphalt"
SHEAR = f"{SOIL}.shear.shear_modulus_m"
NAMES = (SHEAR, "vehicle.wheel.radius_m", "vehicle.body.mass_kg")
DRIVE = Scenario(
    "short", 15.0, route=(RouteLeg(SOIL),),
    drive=(DriveSegment(1.0), DriveSegment(7.0, 0.8, 0.4), DriveSegment(7.0, 1.2, -0.5)),
)  # fmt: skip
TRUTH = {SHEAR: 0.013, "vehicle.wheel.radius_m": 0.18, "vehicle.body.mass_kg": 36.0}


@functools.cache
def drive(*, effect: tuple[str, float] | None = None) -> Recording:
    """The short drive with `TRUTH`."""
    model = Model(load_vehicle("elevate"), {SOIL: load_soil(SOIL)}).replaced(TRUTH)
    effects = dict([effect]) if effect else {}
    return simulate_run(DRIVE, vehicle=model.vehicle, soils=model.soils, seed=3, effects=effects).recording


def scores(found, truth) -> list[float]:
    return [(found[name].value - value) / found[name].sigma for name, value in truth.items()]


def test_two_labelled_grounds_in_one_log() -> None:
    truth = {SHEAR: 0.02, f"{OTHER}.shear.shear_modulus_m": 0.003, "vehicle.wheel.radius_m": 0.18}
    model = Model(load_vehicle("elevate"), {name: load_soil(name) for name in (SOIL, OTHER)})
    model = model.replaced(truth)
    legs = (RouteLeg(SOIL, 10.0), RouteLeg(OTHER))
    turns = (DriveSegment(1.0), DriveSegment(12.0, 1.0, 0.4), DriveSegment(11.0, 1.2, -0.5))
    run = simulate_run(
        Scenario("two", 24.0, route=legs, drive=turns), vehicle=model.vehicle, soils=model.soils, seed=2
    )
    found = calibrate(run.recording, "elevate", None, ("soil.shear.shear_modulus_m", *NAMES[1:2]))
    assert found.converged()
    assert [f.name for f in found.fitted] == list(truth)
    assert all(f.status == "identified" for f in found.fitted)
    assert np.max(np.abs(scores(found, truth))) < 3.5


def test_a_reference_pose_sharpens() -> None:
    blind, seeing = (calibrate(drive(), "elevate", SOIL, NAMES, truth=truth) for truth in (False, True))
    assert any(c.channel == "truth_yaw_rad" for c in seeing.channels)
    for name, value in TRUTH.items():
        assert seeing[name].sigma < blind[name].sigma
        assert seeing[name].value == pytest.approx(value, rel=1e-4)


def test_an_effect_is_a_parameter(tmp_path) -> None:
    """It is written into the vehicle's file, whose twin has it."""
    key, value = "drivetrain_friction/coulomb", 1.5
    found = calibrate(drive(effect=(key, value)), "elevate", SOIL, (*NAMES, f"effects.{key}"))
    truth = {**TRUTH, f"effects.{key}": value}
    assert found.converged()
    assert found[f"effects.{key}"].status == "identified"
    assert np.max(np.abs(scores(found, truth))) < 3.5
    write_files(found, tmp_path, "elevate")
    assert load_vehicle(tmp_path / "vehicle.yaml").effects == {key: found[f"effects.{key}"].value}


def test_friction_of_a_heavy_robot_is_sought_in_proportion_to_its_weight_and_wheels() -> None:
    name = "effects.drivetrain_friction/coulomb"
    light, heavy = (Model(load_vehicle(v), {SOIL: load_soil(SOIL)}) for v in ("elevate", "warthog"))
    one, other = (coordinates_of(name, model, {})[0] for model in (light, heavy))
    grown = 15.0  # 280 kg on wheels of 0.3 m, over 32 kg on wheels of 0.175 m
    assert (other.high, other.scale) == pytest.approx((grown * one.high, grown * one.scale))
    assert coordinates_of(name, heavy.replaced({name: 17.0}), {})[0].value(1.0) == 17.0 + other.scale


def predicted(
    recording: Recording, vehicle: VehicleParams, effects: dict[str, float]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What the twin says of each channel of a log, beside what was measured."""
    model, ground, _ = start_model([recording], vehicle, None, effects)
    log = prepare(recording, model, ground=ground)
    values = predict(log, model, NAMES[2:], log.start)
    return {o.channel: (v.value, o.value) for o, v in zip(log.observed, values, strict=True)}


def test_what_grows_with_time_grows_from_the_first_sample() -> None:
    effects = {"gyro_bias/warm_up": 0.05}
    made = simulate_run("figure_eight", noiseless=True, effects=effects).recording
    told, read = predicted(made, load_vehicle("elevate"), effects)["yaw_rate_radps"]
    assert np.abs(told - read)[:20].max() < 1e-5


def test_fixes_that_the_vehicle_file_knows_to_be_late() -> None:
    vehicle = load_vehicle("elevate")
    late = dataclasses.replace(vehicle, realism=dataclasses.replace(vehicle.realism, gnss_latency_s=0.3))
    made = simulate_run("figure_eight", vehicle=late, seed=1).recording
    off = [np.abs(np.subtract(*predicted(made, one, {})["gnss_v_e_mps"])).mean() for one in (vehicle, late)]
    assert off[1] < 0.85 * off[0]


@pytest.mark.parametrize("field", ["position_m", "quaternion"])
def test_holes_in_the_reference_are_left_out(field: str) -> None:
    reference = drive().truth
    assert reference is not None
    corrupt = getattr(reference, field).copy()
    corrupt[500:600] = np.nan
    log = dataclasses.replace(drive(), truth=dataclasses.replace(reference, **{field: corrupt}))
    found = calibrate(log, "elevate", SOIL, NAMES, truth=True)
    assert found[SHEAR].value == pytest.approx(TRUTH[SHEAR], rel=1e-4)


def test_unknown_commands_are_a_hole_and_not_a_stop() -> None:
    command = drive().command
    assert command is not None
    v = command.v_mps.copy()
    v[100:300] = np.nan
    log = dataclasses.replace(drive(), command=dataclasses.replace(command, v_mps=v))
    found = calibrate(log, "elevate", SOIL, NAMES)
    assert any("1 gap of up to 4" in note for note in found.notes)
    assert np.max(np.abs(scores(found, TRUTH))) < 3.5
    v[:] = np.nan
    with pytest.raises(DataError, match="not numbers"):
        calibrate(log, "elevate", SOIL, NAMES)


def test_other_clocks_are_reported_or_refused() -> None:
    gnss = drive().gnss
    assert gnss is not None
    late, early = (
        dataclasses.replace(drive(), gnss=dataclasses.replace(gnss, t_ns=gnss.t_ns + way * 10**15))
        for way in (1, -1)
    )
    with pytest.raises(DataError, match="clocks differ; try --stamps receipt"):
        calibrate(late, "elevate", SOIL, NAMES)
    assert any("gnss_east_m" in note for note in calibrate(early, "elevate", SOIL, NAMES).notes)


def test_a_wrong_vehicle_is_noted() -> None:
    right, wrong = (calibrate(drive(), name, SOIL, NAMES) for name in ("elevate", "husky"))
    assert not any("times its noise" in note for note in right.notes)
    (off,) = (note for note in wrong.notes if "current_left_a is off by" in note)
    assert off in [channel.misfit() for channel in wrong.channels]


def test_the_vehicle_to_start_from_is_that_of_the_log() -> None:
    named = dataclasses.replace(drive(), vehicle="husky")
    assert calibrate(named, soils=SOIL, parameters=NAMES[2]).before.vehicle.body.mass_kg == 50.0


def test_logs_of_one_name_stay_apart_and_geometries_agree() -> None:
    found = calibrate([drive(), drive()], "elevate", SOIL, NAMES)
    assert list(found.sensor_errors) == ["short", "short (2)"]
    assert len({(c.log, c.channel) for c in found.channels}) == len(found.channels)
    other = dataclasses.replace(drive(), name="other", overrides=Overrides(track_m=0.5))
    with pytest.raises(DataError, match="another geometry"):
        calibrate([drive(), other], "elevate", SOIL, NAMES)


def test_what_was_calibrated_holds_against_the_geometry_that_a_log_assumes(tmp_path) -> None:
    log = dataclasses.replace(drive(), overrides=Overrides(wheel_radius_m=0.175, track_m=0.51))
    found = calibrate(log, "elevate", SOIL, NAMES)
    write_files(found, tmp_path, "elevate")
    known = load_vehicle(tmp_path / "vehicle.yaml")
    assert "the log's own geometry is used: wheel_radius_m = 0.175, track_m = 0.51" in found.notes
    assert known == found.model.vehicle
    assert known.measured == ("body.mass_kg", "wheel.radius_m")
    assert with_overrides(known, log.overrides).wheel.radius_m == found["vehicle.wheel.radius_m"].value
    assert with_overrides(known, Overrides(track_m=0.7)).body.track_m == 0.7
    again = calibrate(log, known, SOIL, NAMES[:1])
    assert any("retained for its body: wheel.radius_m" in note for note in again.notes)
    assert again.before.vehicle.wheel.radius_m == pytest.approx(TRUTH["vehicle.wheel.radius_m"], rel=0.01)


def test_a_search_that_is_cut_short_says_so_everywhere(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(solver, "MAX_RUNS", 2)
    found = calibrate(drive(), "elevate", SOIL, (*NAMES, "vehicle.body.cg_height_m"))
    said = found.as_dict()
    assert (found.outcome, said["converged"]) == ("too_long", False)
    assert not any(entry["sigma_valid"] for entry in said["parameters"].values())
    write_files(found, tmp_path, "elevate")
    assert "did not converge" in (tmp_path / "soil.yaml").read_text()


def test_validity_ranges_stay_or_are_said_to_be_left(tmp_path) -> None:
    """The file's range stays beside a number inside it; one outside loads again and says so."""
    wide = calibrate(drive(), "elevate", SOIL, NAMES)
    write_files(wide, tmp_path, "elevate")
    text = (tmp_path / "soil.yaml").read_text()
    assert "valid:" in text.partition("shear_modulus_m:")[2].partition("source:")[0]
    outside = dataclasses.replace(wide.fitted[0], value=0.1)
    model = wide.model.replaced({SHEAR: 0.1})
    write_files(
        dataclasses.replace(wide, fitted=(outside, *wide.fitted[1:]), model=model), tmp_path, "elevate"
    )
    assert "outside the validity range" in (tmp_path / "soil.yaml").read_text()
    assert load_soil(tmp_path / "soil.yaml").shear.shear_modulus_m == 0.1


def test_a_published_soil_is_written_too(tmp_path) -> None:
    soil = "pavlov:direct_90_sand"
    found = calibrate(drive(), "elevate", soil, NAMES[1:])
    (name,) = found.model.soils
    write_files(found, tmp_path, "elevate", {name: soil})
    assert load_soil(tmp_path / "soil.yaml") == found.model.soils[name]


def test_a_vehicle_file_of_the_short_form_keeps_what_it_knows_of_the_sensors(tmp_path) -> None:
    short = tmp_path / "mine.yaml"
    known = "{value: 0.01, known: calibrated, sigma: 0.003, logs: [monday]}"
    short.write_text(f"robot:\n  extends: elevate\n  name: mine\n  gyro_scale: {known}\n")
    found = calibrate(drive(), short, SOIL, NAMES)
    write_files(found, tmp_path, short)
    assert load_vehicle(tmp_path / "vehicle.yaml") == found.model.vehicle
    assert found.model.vehicle.robot.gyro_scale == load_vehicle(short).robot.gyro_scale
