"""The twin drives as the references do before anything is a change of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.start import coordinates_of
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.null.channel_noise import learn_noise
from terrafusion.twin.gap.null.reference_twin import RUNS, _Fit, differences, set_to_references
from terrafusion.twin.gap.rollout.residuals import LinearisationCache, run_residuals, whitened
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.simulate import simulate
from tests.twin.gap.runs import DRIVE

CANDIDATES = Candidates.of(["soil_strength", "wheel_radius"])
STIFFER, STRONGER = 3.0, {"soil_strength/shear": 0.4, "soil_strength/bearing": 0.8}


def references() -> list[Recording]:
    """Of a robot whose motors follow more stiffly than its file says, on ground that is stronger."""
    known = load_vehicle("elevate")
    drive = dataclasses.replace(known.drive, speed_loop_p_nms=STIFFER * known.drive.speed_loop_p_nms)
    robot = dataclasses.replace(known, drive=drive)
    return [
        dataclasses.replace(simulate(DRIVE, vehicle=robot, seed=k, effects=STRONGER), name=f"reference {k}")
        for k in range(RUNS)
    ]


def wheel_error(log, model: Model) -> float:
    """Root mean square, rad/s."""
    channels = tuple(o.channel for o in log.observed)
    found = run_residuals(log, LinearisationCache(model, CANDIDATES), channels)
    return float(np.sqrt(np.mean(found.error[channels.index("wheel_left_radps")] ** 2)))


@pytest.fixture(scope="module")
def fitted() -> tuple:
    logs, model, _ = prepared(references(), load_vehicle("elevate"), "loose_sand")
    channels = tuple(o.channel for o in logs[0].observed)
    return logs, model, set_to_references(logs, LinearisationCache(model, CANDIDATES), channels, 1)


def test_the_speed_loop_and_the_ground_are_those_of_the_references(fitted) -> None:
    _, model, found = fitted
    stiffer = found.vehicle.drive.speed_loop_p_nms / model.vehicle.drive.speed_loop_p_nms
    print(stiffer, found.effects, [wheel_error(log, m) for log in fitted[0] for m in (model, found)])
    assert stiffer == pytest.approx(STIFFER, rel=0.25)
    assert found.effects["soil_strength/shear"] == pytest.approx(0.4, abs=0.15)


def test_the_twin_then_errs_less(fitted) -> None:
    logs, model, found = fitted
    assert wheel_error(logs[0], found) < 0.5 * wheel_error(logs[0], model)


def test_drives_of_another_twin_are_linearised_anew(fitted) -> None:
    logs, model, found = fitted
    plain = dataclasses.replace(found, effects=model.effects)
    keys = {LinearisationCache(m, CANDIDATES).key(logs[0]) for m in (model, plain, found)}
    assert len(keys) == 3


def test_ground_that_is_too_hard_for_the_steps_is_not_tried() -> None:
    """Half a millimetre of give: wheels at rest would shake."""
    logs, model, _ = prepared(references()[:1], load_vehicle("elevate"), "loose_sand")
    channels = tuple(o.channel for o in logs[0].observed)
    cache = LinearisationCache(model, CANDIDATES)
    runs = [run_residuals(logs[0], cache, channels)]
    noise = learn_noise(runs, [], CANDIDATES)
    numbers = coordinates_of(["soil.shear.shear_modulus_m"], model, {})
    fit = _Fit(cache, noise, numbers, [whitened(runs[0].without_nuisance(), noise)], 1)
    soft, hard = np.zeros(1), np.array([-12.0])
    assert fit.model(hard).soils["loose_sand"].shear.shear_modulus_m < 5e-4
    found = fit.errors([soft, hard, soft])
    assert found[1] is None
    assert all(some is not None and len(some) == 1 for some in (found[0], found[2]))


def set_to(
    robot: VehicleParams, file: VehicleParams, effects: Mapping[str, float] | None = None
) -> tuple[Model, Model]:
    """The twin of a vehicle file, and as references of the robot set it."""
    runs = [
        dataclasses.replace(simulate(DRIVE, vehicle=robot, seed=k, effects=effects), name=f"reference {k}")
        for k in range(RUNS)
    ]
    logs, model, _ = prepared(runs, file, "loose_sand")
    channels = tuple(o.channel for o in logs[0].observed)
    return model, set_to_references(logs, LinearisationCache(model, CANDIDATES), channels, 1)


def test_how_the_robot_follows_its_commands_is_that_of_the_references() -> None:
    """Limits of acceleration and a dead time that no owner has measured."""
    known = load_vehicle("elevate")
    own = {"max_accel_mps2": 0.7, "max_yaw_accel_radps2": 1.2, "dead_time_s": 0.06}
    robot = dataclasses.replace(known, drive=dataclasses.replace(known.drive, **own))
    model, found = set_to(robot, known)
    drive = found.vehicle.drive
    assert drive.max_accel_mps2 == pytest.approx(0.7, rel=0.1)
    assert drive.max_yaw_accel_radps2 == pytest.approx(1.2, rel=0.15)
    assert drive.dead_time_s == pytest.approx(0.06, abs=0.03)
    (told,) = differences(model, found)
    assert "drive.max_accel_mps2 0.7" in told
    assert "(file: 1.5)" in told
    assert not differences(model, model)


def test_limits_are_found_though_errors_hardly_depend_on_them_farther_off() -> None:
    known = load_vehicle("elevate")
    own = {"max_accel_mps2": 0.5, "speed_loop_p_nms": 2.0 * known.drive.speed_loop_p_nms}
    robot = dataclasses.replace(known, drive=dataclasses.replace(known.drive, **own))
    _, found = set_to(robot, known, STRONGER)
    drive = found.vehicle.drive
    assert drive.max_accel_mps2 == pytest.approx(0.5, rel=0.1)
    assert drive.max_yaw_accel_radps2 == pytest.approx(known.drive.max_yaw_accel_radps2, rel=0.15)
    assert drive.dead_time_s < 0.02


def test_the_base_of_two_driven_wheels_is_found_where_nobody_measured_it() -> None:
    """Casters do not scrub: the robot turns as if all four wheels stood on one axle."""
    known = load_vehicle("elevate")
    drive = dataclasses.replace(known.drive, type="differential")
    file = dataclasses.replace(known, drive=drive, measured=())
    robot = dataclasses.replace(file, body=dataclasses.replace(file.body, wheelbase_m=0.1))
    _, found = set_to(robot, file)
    assert found.vehicle.body.wheelbase_m < 0.6 * known.body.wheelbase_m
