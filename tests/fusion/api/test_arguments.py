"""Arguments of the public functions: logs as recordings or paths, and one clear line for wrong ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

import terrafusion as tf
from terrafusion.datasets.core.recording import Overrides
from terrafusion.datasets.readers.logs import opened
from terrafusion.datasets.writers.log_folder import write_log_folder
from terrafusion.fusion.api import diagnoses
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.assumptions import assumptions
from terrafusion.fusion.config.sensor_config import sensor_config_of
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.twin.model.choose import choose_vehicle
from tests.datasets.ros_bags import MAKE1, imu_messages, write_ros1

MOUNTED = 'robot: {extends: elevate, imu_axes: ["-z", "-x", "+y"], imu_frame: front_imu}\n'


@pytest.fixture(scope="module")
def log() -> tf.Recording:
    return tf.simulate("straight", terrain="grass", seed=1)


@pytest.mark.parametrize("frame", ["front_imu", "/front_imu", "rear_imu"])
def test_a_vehicle_turns_the_imu_of_a_bag_that_was_opened_without_it(tmp_path: Path, frame: str) -> None:
    (tmp_path / "robot.yaml").write_text(MOUNTED)
    vehicle = tf.Vehicle.load(tmp_path / "robot.yaml")
    bag = write_ros1(tmp_path / "a.bag", imu_messages(MAKE1, gyro=(1.0, 2.0, 3.0), frame=frame))
    with_vehicle = tf.open(bag, vehicle=vehicle)
    (later,) = opened(tf.open(bag), vehicle.rig())
    assert with_vehicle.imu is not None
    assert later.imu is not None
    assert later.imu.gyro_radps[0].tolist() == ([1.0, 2.0, 3.0] if "rear" in frame else [-3.0, -1.0, 2.0])
    assert np.array_equal(later.imu.accel_mps2, with_vehicle.imu.accel_mps2)
    assert any("rotated from front_imu to the body" in note for note in later.notes) is ("rear" not in frame)
    assert opened(later, vehicle.rig()) == [later]  # once only


def test_calibrate_takes_paths(log: tf.Recording, tmp_path: Path) -> None:
    folder = write_log_folder(log, tmp_path / "log")
    name = "vehicle.wheel.radius_m"
    by_path = tf.calibrate(str(folder), vehicle="elevate", soils="grass", parameters=[name])
    assert by_path[name].value == tf.calibrate(log, "elevate", "grass", [name])[name].value


def test_a_policy_may_be_a_path_as_text(log: tf.Recording, tmp_path: Path) -> None:
    with pytest.raises(tf.ConfigError, match=r"mine\.yaml: no such file"):
        tf.replay(log, policy=str(tmp_path / "mine.yaml"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"outages": (60, 30)}, r"60 is not an outage; give pairs \(start, length\)"),
        ({"outages": [(20, -10)]}, r"\(20, -10\) is not an outage"),
        ({"outages": [(20, float("nan"))]}, "is not an outage"),
        ({"outages": ["20:10"]}, "'20:10' is not an outage"),
        ({"outages": [(20, 10, 5)]}, "is not an outage"),
        ({"outages": None}, r"outages are None; give pairs"),
        ({"policy": 3}, "a int is no policy; give its file"),
        ({"terrain_model": {}}, "a dict is no terrain model; give the file"),
        ({"lag_s": float("nan")}, "'lag_s' is nan, out of range"),
        ({"lag_s": float("inf")}, "'lag_s' is inf, out of range"),
        ({"lag_s": "5"}, "'lag_s' is '5'; give"),
        ({"lag_s": None}, "'lag_s' is 'None'; give a number"),
        ({"lag_s": 0.2}, "at least five keyframes"),
    ],
)
def test_a_replay_refuses_wrong_arguments(log: tf.Recording, wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(tf.ConfigError, match=message):
        tf.replay(log, **wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"effects": ["slope"]}, r"effects are \['slope'\]; give"),
        ({"effects": {"slope": None}}, "effect 'slope/uniform' is None, out of range"),
        ({"effects": {"slope": "0.1"}}, "effect 'slope/uniform' is 0.1, out of range"),
        ({"slope_deg": "5"}, "'slope_deg' is '5'; give a number"),
        ({"payload_kg": []}, r"'payload_kg' is \[\]; give a number"),
        ({"terrain": ["mud"]}, r"terrain is \['mud'\]; give the name of one"),
        ({"seed": 1.5}, r"seed 1\.5 is no whole number"),
        ({"seed": "1"}, "seed '1' is no whole number"),
    ],
)
def test_a_simulation_refuses_wrong_arguments(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(tf.ConfigError, match=message):
        tf.simulate("straight", **wrong)


@pytest.mark.parametrize("wrong", [None, 5, [None], [], ["monday", "tuesday"]])
def test_what_is_no_log_is_refused(wrong: Any) -> None:
    with pytest.raises(tf.DataError, match="is no log; give a Recording, or the path"):
        tf.replay(wrong)


@pytest.mark.parametrize("out", [None, 3])
def test_a_place_to_write_that_is_no_path_is_refused(out: Any) -> None:
    for write in (
        lambda: tf.sweep("friction_slope", out),
        lambda: tf.benchmark(out, quick=True),
        lambda: tf.policy.fit(out),
        lambda: tf.Replay.report(None, out),
        lambda: tf.Diagnosis.report(None, out),
    ):
        with pytest.raises(tf.ConfigError, match=f"'out' is {out}; give a path"):
            write()


def test_one_name_needs_no_list(log: tf.Recording, tmp_path: Path) -> None:
    name = "vehicle.wheel.radius_m"
    assert tf.calibrate(log, parameters=name)[name].value == tf.calibrate(log, parameters=[name])[name].value
    with pytest.raises(tf.ConfigError, match="unknown effect 'wheels'"):
        tf.diagnose(log, effects="wheels")
    with pytest.raises(tf.ConfigError, match="unknown family 'mixd'"):
        tf.benchmark(tmp_path, only="mixd")


def test_a_diagnosis_takes_the_vehicle_of_its_logs(
    log: tf.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It took `elevate` for any robot, without a word."""
    husky, unnamed = (dataclasses.replace(log, name=name, vehicle=name) for name in ("husky", ""))
    taken: list[str] = []
    monkeypatch.setattr(diagnoses, "run", lambda a, b, vehicle, *_, **__: taken.append(vehicle.name) or 1 / 0)
    for vehicle in (None, "warthog"):
        with pytest.raises(ZeroDivisionError):
            tf.diagnose(husky, references=[husky], vehicle=vehicle)
    assert taken == ["husky", "warthog"]
    with pytest.raises(tf.DataError, match="names no vehicle, and the log lacks its wheel_radius_m"):
        tf.diagnose(unnamed)
    with pytest.raises(tf.DataError, match="give logs of one vehicle"):
        tf.diagnose(husky, references=log)


def test_counts_and_names_are_of_their_types(log: tf.Recording, tmp_path: Path) -> None:
    calls: list[tuple[Any, dict[str, Any], str]] = [
        (tf.diagnose, {"seed": "x"}, "'seed' is 'x'; give a whole number from 0"),
        (tf.diagnose, {"significance": None}, "'significance' is None"),
        (tf.diagnose, {"effects": 3}, "'effects' is 3; give a name, or a list"),
        (tf.calibrate, {"parameters": 3}, "'parameters' is 3"),
        (lambda _, **wrong: tf.benchmark(tmp_path, **wrong), {"only": [3]}, r"'only' is \[3\]"),
        (lambda _, **wrong: tf.benchmark(tmp_path, **wrong), {"seeds": 1.5}, "'seeds' is 1.5"),
        (lambda _, **wrong: tf.benchmark(tmp_path, **wrong), {"jobs": 0}, "'jobs' is 0; give a whole"),
    ]
    for call, wrong, message in calls:
        with pytest.raises(tf.ConfigError, match=message):
            call(log, **wrong)


def test_progress_is_a_function(log: tf.Recording, tmp_path: Path) -> None:
    calls: list[Callable[..., object]] = [
        lambda **wrong: tf.replay(log, **wrong),
        lambda **wrong: tf.calibrate_sensors(log, **wrong),
        lambda **wrong: tf.calibrate(log, **wrong),
        lambda **wrong: tf.diagnose(log, **wrong),
        lambda **wrong: tf.sweep("friction_slope", tmp_path, **wrong),
        lambda **wrong: tf.benchmark(tmp_path, **wrong),
        lambda **wrong: tf.policy.fit(tmp_path / "policy.yaml", **wrong),
    ]
    for call in calls:
        with pytest.raises(tf.ConfigError, match="'progress' is True; give a function to call"):
            call(progress=True)


def test_a_prior_is_no_number(log: tf.Recording) -> None:
    with pytest.raises(tf.ConfigError, match=r"'vehicle.wheel.radius_m' is 0.17; give a Prior\(value"):
        tf.calibrate(log, parameters="vehicle.wheel.radius_m", priors={"vehicle.wheel.radius_m": 0.17})  # type: ignore[dict-item]


def test_an_estimator_takes_a_configuration_and_that_a_rig() -> None:
    with pytest.raises(tf.ConfigError, match=r"a str is no configuration.*Estimator\.for_vehicle"):
        tf.Estimator("husky")  # type: ignore[arg-type]
    with pytest.raises(tf.ConfigError, match=r"a VehicleParams is no rig; give Vehicle\.load"):
        tf.EstimatorConfig(tf.Vehicle.load("husky"))  # type: ignore[arg-type]


def test_types_allow_the_times_that_the_estimator_takes() -> None:
    takes_time = [getattr(tf.Estimator, name) for name in dir(tf.Estimator) if name.startswith("add_")]
    kinds = [get_args(get_type_hints(function)["t_ns"]) for function in takes_time]
    assert len(kinds) == 8
    assert all(set(kind) == {int, np.integer, np.datetime64} for kind in kinds)


def test_an_imu_without_samples_is_none(log: tf.Recording) -> None:
    assert log.imu is not None
    short = until(log, 10.0)
    silent = dataclasses.replace(short, imu=log.imu.select(np.zeros(len(log.imu), dtype=bool)))
    estimates = [tf.replay(dataclasses.replace(silent, imu=imu)).estimate for imu in (silent.imu, None)]
    assert np.array_equal(*(one.trajectory.position_m for one in estimates))


def test_a_policy_is_fitted_to_one_drive_at_least(tmp_path: Path) -> None:
    with pytest.raises(tf.ConfigError, match="'seeds' is 0; give a whole number from 1"):
        tf.policy.fit(tmp_path / "policy.yaml", seeds=0)


def test_topics_are_a_mapping(tmp_path: Path) -> None:
    bag = write_ros1(tmp_path / "a.bag", imu_messages(MAKE1))
    with pytest.raises(tf.DataError, match=r"topics is 'imu=/imu/data'; give \{'imu'"):
        tf.open(bag, topics="imu=/imu/data")  # type: ignore[arg-type]


def test_an_effect_by_its_short_name_replaces_that_of_the_vehicle() -> None:
    sloping = dataclasses.replace(tf.Vehicle.load("elevate"), effects={"slope/uniform": 0.1})
    short = tf.simulate("straight", vehicle=sloping, effects={"slope": 0.05}).wheels
    full = tf.simulate("straight", effects={"slope/uniform": 0.05}).wheels
    assert short is not None
    assert full is not None
    assert np.array_equal(short.speed, full.speed)


def test_a_memory_of_grounds_is_of_one_robot(log: tf.Recording) -> None:
    other = GroundMemory(robot="husky")
    with pytest.raises(tf.ConfigError, match="the memory of grounds is that of 'husky', the robot here is"):
        tf.replay(log, grounds=other)
    with pytest.raises(tf.ConfigError, match="grounds is 3"):
        tf.replay(log, grounds=3)  # type: ignore[arg-type]


def test_a_magnetometer_that_is_not_there_is_missed(log: tf.Recording) -> None:
    assert log.magnetometer is None
    result = tf.replay(until(log, 20.0), magnetometer=True)
    assert any("no magnetometer" in note for note in result.estimate.notes)


def test_a_recording_is_open_already(log: tf.Recording) -> None:
    with pytest.raises(tf.DataError, match="a Recording is no path of a log"):
        tf.open(log)  # type: ignore[arg-type]
    with pytest.raises(tf.DataError, match=r"drive\.csv: columns is 3; give the path of a column map"):
        tf.open("drive.csv", columns=3)


def test_a_car_of_unknown_wheelbase_says_so() -> None:
    car = dataclasses.replace(
        tf.simulate("straight"),
        vehicle=None,
        overrides=Overrides(drive="ackermann", wheel_radius_m=0.17, track_m=1.0),
    )
    for given, assumed in ((None, True), (1.8, False)):
        one = dataclasses.replace(car, overrides=dataclasses.replace(car.overrides, wheelbase_m=given))
        vehicle, _ = choose_vehicle(one, None)
        found = assumptions(one, None, vehicle, sensor_config_of(one, one.gnss), one.gnss)
        assert any(a.name == "wheelbase_m" for a in found) == assumed
