"""The planar graph: logs without accelerometer, with gyro z alone, without IMU, sides or GNSS."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.frames import GRAVITY_MPS2, wrap_angle
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.writers import write_log_folder
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import (
    SensorConfig,
    complete_samples,
    sensor_config_of,
    yaw_factor,
)
from terrafusion.fusion.estimator.alignment import level_start
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.graph.key_state import LINEAR, KeyState
from terrafusion.fusion.graph.planar import PlanarPreintegrator, with_centripetal_force, yaw_of_wheels
from terrafusion.fusion.inputs.streams import ImuSegment, ImuStream, WheelStream
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.vehicle import load_vehicle, with_overrides
from terrafusion.twin.simulate import simulate

REDUCED = ("gyro z", "no accelerometer", "no imu", "body speed")


@pytest.fixture(scope="module")
def exact() -> Recording:
    return until(simulate("figure_eight", terrain="asphalt", noiseless=True), 35.0)


@pytest.fixture(scope="module")
def noisy() -> Recording:
    return until(simulate("waypoints", terrain="medium_sand", seed=3), 45.0)


@pytest.fixture(scope="module")
def replayed(noisy: Recording) -> Callable[..., ReplayResult]:
    """Replays of the noisy drive, as it is or reduced, each made once."""
    return functools.cache(
        lambda what=None, gnss=True: replay(noisy if what is None else reduced(noisy, what, gnss))
    )


def reduced(recording: Recording, what: str, gnss: bool = True) -> Recording:
    """The recording with channels or axes taken away."""
    imu, wheels = recording.imu, recording.wheels
    assert imu is not None
    assert wheels is not None
    nan = np.full_like(imu.gyro_radps, np.nan)
    if what.startswith("gyro z"):
        z = nan.copy()
        z[:, 2] = imu.gyro_radps[:, 2]
        recording = dataclasses.replace(recording, imu=Imu(imu.t_ns, z, nan))
    elif what == "no accelerometer":
        recording = dataclasses.replace(recording, imu=Imu(imu.t_ns, imu.gyro_radps, nan))
    elif what in ("no imu", "body speed"):
        recording = dataclasses.replace(recording, imu=None)
    if what in ("body speed", "gyro z and body speed"):
        speed = wheels.side_speeds_mps(load_vehicle("elevate").wheel.radius_m).mean(axis=1, keepdims=True)
        recording = dataclasses.replace(recording, wheels=Wheels(wheels.t_ns, speed, ("speed",), "mps"))
    return recording if gnss else dataclasses.replace(recording, gnss=None)


def turned(recording: Recording, angle_rad: float) -> Recording:
    """The same drive with another start heading."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    gnss, truth = recording.gnss, recording.truth
    assert gnss is not None
    assert truth is not None
    velocity = None if gnss.velocity_enu_mps is None else gnss.velocity_enu_mps @ R.T
    moved = dataclasses.replace(gnss, enu_m=gnss.enu_m @ R.T, velocity_enu_mps=velocity)
    path = Trajectory(truth.t_ns, truth.position_m @ R.T, None)
    return dataclasses.replace(recording, gnss=moved, truth=path, truth_channels=("position",))


def yaw_of(result: ReplayResult) -> np.ndarray:
    x, y, z, w = result.estimate.trajectory.quaternion.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@pytest.mark.parametrize("batch", [False, True], ids=["live", "batch"])
@pytest.mark.parametrize("what", REDUCED)
def test_exact_data_give_near_exact_estimates(exact: Recording, what: str, batch: bool) -> None:
    scores = replay(reduced(exact, what), batch=batch).scores
    assert scores.ate_m is not None
    # Live, body speed alone must first find its heading in a turn that nothing measures.
    assert scores.ate_m < (0.5 if what == "body speed" and not batch else 0.01)
    assert scores.velocity_rmse_mps is not None
    assert scores.velocity_rmse_mps < 0.03


def test_exact_yaw_rate_alone_keeps_the_heading_without_gnss(exact: Recording) -> None:
    scores = replay(reduced(exact, "gyro z", gnss=False)).scores
    assert scores.yaw_rmse_rad is not None
    assert scores.yaw_rmse_rad < 1e-3


@pytest.mark.parametrize(("what", "factor"), [(what, 1.3) for what in REDUCED[:3]])
def test_error_stays_within_a_factor_of_the_full_graph(
    replayed: Callable[..., ReplayResult], what: str, factor: float
) -> None:
    """With RTK fixes the position hardly suffers, whatever tells the yaw."""
    ate, full = replayed(what).scores.ate_m, replayed().scores.ate_m
    assert full is not None
    assert ate is not None
    assert ate < factor * full


@pytest.mark.parametrize("what", REDUCED[:3])
def test_start_heading_does_not_matter(
    noisy: Recording, replayed: Callable[..., ReplayResult], what: str
) -> None:
    here = replayed(what).scores.ate_m
    there = replay(turned(reduced(noisy, what), 2.5)).scores.ate_m
    assert here is not None
    assert there == pytest.approx(here, rel=0.05, abs=1e-3)


def test_left_and_right_are_mirrored(noisy: Recording) -> None:
    """A mirrored log without IMU and GNSS gives the mirrored path."""
    log = reduced(noisy, "no imu", gnss=False)
    assert log.wheels is not None
    swapped = [log.wheels.names.index(n) for n in ("front_right", "front_left", "rear_right", "rear_left")]
    angle = None if log.wheels.angle_rad is None else log.wheels.angle_rad[:, swapped]
    mirror = dataclasses.replace(log.wheels, speed=log.wheels.speed[:, swapped], angle_rad=angle)
    path = replay(log).estimate.trajectory.position_m
    mirrored = replay(dataclasses.replace(log, wheels=mirror)).estimate.trajectory.position_m
    assert np.ptp(path[:, 1]) > 1.0
    np.testing.assert_allclose(mirrored[:, 1], -path[:, 1], atol=1e-6)
    np.testing.assert_allclose(mirrored[:, 0], path[:, 0], atol=1e-6)


@pytest.mark.parametrize("what", ["gyro z", "no imu"])
def test_same_input_gives_the_same_bits(
    noisy: Recording, replayed: Callable[..., ReplayResult], what: str
) -> None:
    first, second = replayed(what), replay(reduced(noisy, what))
    assert first.estimate.trajectory.position_m.tobytes() == second.estimate.trajectory.position_m.tobytes()


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("gyro z", ("no gyro x, no gyro y, no accelerometer", "planar graph", "roll and pitch are not")),
        ("no accelerometer", ("the log has no accelerometer: a planar graph",)),
        ("no imu", ("the log has no IMU", "yaw is taken from the wheels")),
        ("body speed", ("the log has no IMU", "heading comes from GNSS alone")),
        ("gyro z and body speed", ("the wheels tell nothing of yaw",)),
    ],
)
def test_what_is_assumed_is_said(exact: Recording, what: str, said: tuple[str, ...]) -> None:
    log = reduced(exact, what)
    notes = "; ".join(sensor_config_of(log, log.gnss).notes(log, load_vehicle("elevate").rig()))
    assert all(words in notes for words in said), notes


def test_a_full_log_has_nothing_to_say(exact: Recording) -> None:
    assert sensor_config_of(exact, exact.gnss) == SensorConfig()
    assert sensor_config_of(exact, exact.gnss).notes(exact, load_vehicle("elevate").rig()) == ()


def test_roll_pitch_and_height_stay_level_without_gnss(replayed: Callable[..., ReplayResult]) -> None:
    path = replayed("gyro z", False).estimate.trajectory
    assert path.quaternion is not None
    assert np.abs(path.quaternion[:, :2]).max() < 5e-3
    assert np.abs(path.position_m[:, 2]).max() < 0.05


def test_a_tilt_that_is_not_estimated_is_not_called_known(replayed: Callable[..., ReplayResult]) -> None:
    covariance = replayed("gyro z").estimate.trajectory.covariance
    assert covariance is not None
    assert np.sqrt(covariance[-1, 3, 3]) > 0.03


def test_without_gnss_the_path_begins_with_the_log(
    noisy: Recording, replayed: Callable[..., ReplayResult]
) -> None:
    estimate = replayed("gyro z", False).estimate
    assert estimate.trajectory.t_ns[0] - noisy.start_ns < 2_000_000_000
    assert set(estimate.status) == {"no_gnss"}


def test_rows_without_a_yaw_rate_are_left_out(exact: Recording) -> None:
    """NaN cells in the one axis that is used cost those rows only."""
    log = reduced(exact, "gyro z")
    assert log.imu is not None
    gyro = log.imu.gyro_radps.copy()
    gyro[::3, 2] = np.nan
    holed = dataclasses.replace(log, imu=dataclasses.replace(log.imu, gyro_radps=gyro))
    scores = replay(holed).scores
    assert scores.ate_m is not None
    assert scores.ate_m < 0.01


def test_an_accelerometer_with_few_rows_is_not_relied_on(exact: Recording) -> None:
    assert exact.imu is not None
    accel = exact.imu.accel_mps2.copy()
    accel[np.arange(len(accel)) % 10 != 0] = np.nan
    log = dataclasses.replace(exact, imu=dataclasses.replace(exact.imu, accel_mps2=accel))
    inputs = sensor_config_of(log, log.gnss)
    assert inputs.imu == "gyro_z"
    assert "few rows" in inputs.notes(log, load_vehicle("elevate").rig())[0]
    assert log.imu is not None
    assert complete_samples(log.imu, "six_axis").sum() < complete_samples(log.imu, "gyro_z").sum()


def test_nothing_that_tells_the_heading_is_refused(exact: Recording) -> None:
    with pytest.raises(DataError, match="nothing tells the heading"):
        replay(reduced(exact, "body speed", gnss=False))
    with pytest.raises(ConfigError, match="unknown kind of IMU"):
        SensorConfig(imu="magic")


def test_fixes_of_class_none_are_no_gnss(exact: Recording) -> None:
    log = reduced(exact, "no imu")
    assert log.gnss is not None
    blind = dataclasses.replace(log.gnss, fix=np.zeros_like(log.gnss.fix))
    assert not sensor_config_of(log, blind).gnss


def test_a_stream_admits_only_what_was_declared() -> None:
    z_only, nan = [np.nan, np.nan, 0.1], [np.nan] * 3
    with pytest.raises(DataError, match="six finite numbers"):
        ImuStream().add(0, z_only, nan)
    stream = ImuStream(six_axis=False)
    stream.add(0, z_only, nan)
    stream.add(10, z_only, nan)
    piece = stream.segments(0, 10)[0]
    assert piece.gyro_radps.tolist() == [0.0, 0.0, 0.1]
    assert piece.accel_mps2.tolist() == [0.0, 0.0, GRAVITY_MPS2]
    with pytest.raises(DataError, match="finite yaw rate"):
        stream.add(20, nan, nan)


def test_an_estimator_told_of_no_imu_refuses_one() -> None:
    config = EstimatorConfig(load_vehicle("husky").rig(), inputs=SensorConfig(imu="none"))
    with pytest.raises(DataError, match="without an IMU"):
        Estimator(config).add_imu(0, [0.0, 0.0, 0.0])


def test_yaw_rate_of_the_wheels() -> None:
    wheels = WheelStream()
    wheels.add(0, 0.0, 0.0, 0.0, 0.0)
    assert yaw_of_wheels(wheels, 0.5)[2] == 0.0
    wheels.add(500_000_000, 0.8, 1.2, 0.4, 0.6)
    rate = yaw_of_wheels(wheels, 0.5)
    assert rate[2] == pytest.approx(0.8)
    assert np.isnan(rate[:2]).all()


def _level_robot(ahead_mps: float, left_mps: float, bias_radps: float = 0.0) -> KeyState:
    heading = gtsam.Rot3.Rz(1.0)
    velocity = heading.matrix() @ np.array([ahead_mps, left_mps, 0.0])
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.array([0.0, 0.0, bias_radps]))
    return KeyState(gtsam.Pose3(heading, np.zeros(3)), velocity, bias, np.zeros(len(LINEAR)))


def test_a_turn_adds_the_centripetal_force() -> None:
    segment = ImuSegment(0.1, np.array([0.0, 0.0, 0.4]), np.array([0.0, 0.0, GRAVITY_MPS2]))
    force = with_centripetal_force([segment], _level_robot(2.0, 0.0, 0.1))[0].accel_mps2
    np.testing.assert_allclose(force, [0.0, 2.0 * 0.3, GRAVITY_MPS2], atol=1e-12)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(ahead=st.floats(-4.0, 4.0), left=st.floats(-4.0, 4.0), rate=st.floats(-2.5, 2.5))
def test_a_turn_makes_no_energy(ahead: float, left: float, rate: float) -> None:
    """A robot that slides sideways while it turns keeps its speed: two seconds of predictions."""
    link = PlanarPreintegrator(load_vehicle("elevate").rig().sensors.imu, "gyro")
    state, noise = _level_robot(ahead, left), load_policy().fixed
    segments = [ImuSegment(2e-3, np.array([0.0, 0.0, rate]), np.array([0.0, 0.0, GRAVITY_MPS2]))] * 50
    for _ in range(20):
        now = gtsam.NavState(state.pose, state.velocity)
        nav = link.integrate(with_centripetal_force(segments, state), state.bias, noise).predict(
            now, state.bias
        )
        state = dataclasses.replace(state, pose=nav.pose(), velocity=nav.velocity())
    assert np.linalg.norm(state.velocity) == pytest.approx(np.hypot(ahead, left), rel=0.02, abs=1e-9)


def test_the_link_goes_round_a_circle_and_comes_back() -> None:
    """Constant speed and yaw rate: after one turn the predicted robot is where it began."""
    link = PlanarPreintegrator(load_vehicle("elevate").rig().sensors.imu, "gyro")
    rate, speed, n = 0.5, 1.0, 4000
    dt = 2.0 * np.pi / rate / n
    bias = gtsam.imuBias.ConstantBias()
    segment = ImuSegment(dt, np.array([0.0, 0.0, rate]), np.array([0.0, speed * rate, GRAVITY_MPS2]))
    start = gtsam.NavState(gtsam.Pose3(), np.array([speed, 0.0, 0.0]))
    end = link.integrate([segment] * n, bias, load_policy().fixed).predict(start, bias)
    assert np.linalg.norm(end.pose().translation()) < 0.02
    assert abs(float(wrap_angle(end.pose().rotation().yaw()))) < 1e-9


@pytest.mark.parametrize("rate_radps", [-0.7, 0.0, 0.7])
def test_yaw_noise_by_source(rate_radps: float) -> None:
    spec = load_vehicle("elevate").rig().sensors.imu
    gyro, wheels, none = (PlanarPreintegrator(spec, who) for who in ("gyro", "wheels", "none"))
    assert gyro.yaw_density(rate_radps, 2.0) == pytest.approx(2.0 * spec.gyro_noise_radps_sqrthz)
    assert wheels.yaw_density(rate_radps, 2.0) == wheels.yaw_density(-rate_radps, 1.0)
    assert wheels.yaw_density(rate_radps, 1.0) >= wheels.yaw_density(0.0, 1.0) > gyro.yaw_density(0.0, 1.0)
    assert none.yaw_density(0.0, 1.0) > wheels.yaw_density(0.0, 1.0)


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("what", [*REDUCED, "gyro z and body speed"])
def test_the_command_on_a_reduced_log_folder(exact: Recording, tmp_path: Path, what: str) -> None:
    from typer.testing import CliRunner

    from terrafusion.fusion.cli.main import app

    log = write_log_folder(reduced(exact, what), tmp_path / "log")
    result = CliRunner().invoke(app, ["replay", str(log), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["ate_m"] < (0.5 if what == "body speed" else 0.02)
    assert "planar graph" in json.dumps(metrics)


def rolling(drive: str, mean_mps: float = 1.0) -> Recording:
    """A robot of wheels that roll without slip through bends to both sides, without an IMU; 1 m fixes."""
    vehicle = with_overrides(load_vehicle("elevate"), Overrides(drive=drive))
    t_ns = np.arange(0, 120 * 50) * 20_000_000
    rate = 0.5 * np.sin(2e-9 * np.pi * t_ns / 20.0)
    yaw = np.cumsum(rate) * 0.02
    xy = np.cumsum(mean_mps * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0) * 0.02
    half = 0.5 * vehicle.body.track_m * rate
    speeds = np.column_stack([mean_mps - half, mean_mps + half])
    place = np.column_stack([xy, np.zeros(len(xy))])
    fixes = place[::10] + np.random.default_rng(0).normal(size=(len(place[::10]), 3))
    fixes[:, 2] = 0.0
    gnss = Gnss(t_ns[::10], fixes, np.ones_like(fixes), np.full(len(fixes), int(Fix.SINGLE), dtype=np.uint8))
    quaternion = np.column_stack([np.zeros((len(yaw), 2)), np.sin(0.5 * yaw), np.cos(0.5 * yaw)])
    return Recording(
        "rolling", start_ns=0, wheels=Wheels(t_ns, speeds, ("left", "right"), "mps"), gnss=gnss,
        truth=Trajectory(t_ns, place, quaternion),
        overrides=Overrides(drive=drive, track_m=vehicle.body.track_m),
    )  # fmt: skip


def test_wheels_that_roll_turn_the_robot_by_the_geometry() -> None:
    """Without an IMU from the first fix on, whereas wheels that skid turn it by less."""
    rig = with_overrides(load_vehicle("elevate"), Overrides(drive="differential")).rig()
    assert yaw_factor(rig) == 1.0
    assert yaw_factor(load_vehicle("elevate").rig()) < 0.8
    result = replay(rolling("differential"), outages=[Outage(40.0, 30.0)])
    end_m = result.scores.outages[0].end_error_m
    assert end_m is not None
    assert end_m < 2.0
    assert any("1 of what their difference" in note for note in result.estimate.notes)


@pytest.mark.parametrize(("speeds", "yaw_rate"), [((2.0, 2.0), 0.8), ((1.0, 2.5), 0.0)])
def test_a_start_in_motion_without_an_accelerometer_is_level(
    speeds: tuple[float, float], yaw_rate: float
) -> None:
    imu, wheels = ImuStream(six_axis=False), WheelStream()
    for i in range(120):
        speed = np.interp(i, (0, 100), speeds)
        imu.add(i * 10**7, [np.nan, np.nan, yaw_rate], [np.nan] * 3)
        wheels.add(i * 10**7, speed, speed)
    start = level_start(imu, wheels, 0)
    assert (start.roll_rad, start.pitch_rad) == pytest.approx((0.0, 0.0), abs=1e-9)
