"""The estimator on drives of the twin: exact data, start poses, outages, bad input."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix, rpy_to_quaternion, wrap_angle
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.feed import split_fixes
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.choose import choose_vehicle
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate


@pytest.fixture(scope="module")
def exact() -> Recording:
    return until(simulate("figure_eight", terrain="asphalt", noiseless=True), 60.0)


@pytest.fixture(scope="module")
def mixed() -> Recording:
    """Over all grounds, 225 s."""
    return simulate("mixed_terrain", seed=11)


@pytest.fixture(scope="module")
def short(mixed: Recording) -> Recording:
    """Its first 60 s, asphalt and sand: what happens before does not depend on what comes after."""
    return until(mixed, 60.0)


@pytest.fixture(scope="module")
def replayed(short: Recording) -> ReplayResult:
    """The short drive as it is."""
    return replay(short)


def turned(recording: Recording, angle_rad: float, shift_m: tuple[float, float]) -> Recording:
    """The same drive with another start pose."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    offset = np.array([*shift_m, 0.0])
    gnss, truth = recording.gnss, recording.truth
    assert gnss is not None
    assert truth is not None
    velocity = None if gnss.velocity_enu_mps is None else gnss.velocity_enu_mps @ R.T
    moved = dataclasses.replace(gnss, enu_m=gnss.enu_m @ R.T + offset, velocity_enu_mps=velocity)
    path = Trajectory(truth.t_ns, truth.position_m @ R.T + offset, truth.quaternion, truth.twist_body)
    return dataclasses.replace(recording, gnss=moved, truth=path, truth_channels=("position",))


@pytest.mark.parametrize("batch", [False, True], ids=["live", "batch"])
def test_exact_data_give_exact_estimates(exact: Recording, batch: bool) -> None:
    """Noiseless sensors: what is left is integration error, millimetres over 60 m."""
    scores = replay(exact, batch=batch).scores
    assert scores.errors is not None
    assert np.nanmax(scores.errors.distance_m()) < 0.005
    assert scores.yaw_rmse_rad is not None
    assert scores.yaw_rmse_rad < 0.006
    assert scores.velocity_rmse_mps is not None
    assert scores.velocity_rmse_mps < 0.006


def test_start_pose_and_heading_do_not_matter(short: Recording, replayed: ReplayResult) -> None:
    here, there = replayed.scores, replay(turned(short, -2.9, (350.0, -900.0))).scores
    assert here.ate_m is not None
    assert there.ate_m == pytest.approx(here.ate_m, rel=0.02, abs=1e-3)


def test_same_input_gives_the_same_bits(short: Recording, replayed: ReplayResult) -> None:
    again = replay(short).estimate
    assert again.trajectory.position_m.tobytes() == replayed.estimate.trajectory.position_m.tobytes()
    assert again.slip.tobytes() == replayed.estimate.slip.tobytes()


def test_estimates_are_consistent_on_noisy_data_and_weights_adapt(mixed: Recording) -> None:
    """Normalised position error is near one, neither overconfident nor blind; weights change for a reason."""
    result = replay(until(mixed, 130.0), mode="adaptive")
    scores, estimate = result.scores, result.estimate
    assert scores.nees_mean is not None
    assert 0.1 < scores.nees_mean < 2.0
    assert estimate.changes
    assert all("terrain" in change.reason and change.before != change.after for change in estimate.changes)


def test_an_outage_is_bridged_and_left_without_a_jump(mixed: Recording) -> None:
    result = replay(until(mixed, 155.0), outages=[Outage(70.0, 40.0)])
    score = result.scores.outages[0]
    assert score.percent is not None
    assert score.percent < 10.0
    status = result.estimate.status
    t = (result.estimate.trajectory.t_ns - mixed.start_ns) * 1e-9
    assert set(status[(t > 73) & (t < 109)]) == {"outage"}
    assert set(status[(t > 112) & (t < 150)]) == {"running"}
    after = result.scores.errors
    assert after is not None


def test_slip_is_seen_where_the_ground_gives_way() -> None:
    """Loose sand on 5 deg: the slip state follows the twin's true slip while GNSS is there."""
    recording = until(simulate("paper_profile", terrain="loose_sand", slope_deg=5.0, seed=3), 90.0)
    estimate = replay(recording).estimate
    truth, wheels = recording.truth, recording.wheels
    assert truth is not None
    assert truth.twist_body is not None
    assert wheels is not None
    radius = load_vehicle("elevate").wheel.radius_m
    wheel = np.interp(estimate.trajectory.t_ns, wheels.t_ns, wheels.side_speeds_mps(radius).mean(axis=1))
    body = np.interp(estimate.trajectory.t_ns, truth.t_ns, truth.twist_body[:, 0])
    moving = wheel > 0.6
    true_slip = 1.0 - body[moving] / wheel[moving]
    assert np.median(true_slip) > 0.1
    assert np.median(np.abs(estimate.slip[moving] - true_slip)) < 0.06


def test_fixed_weights_do_not_change(short: Recording) -> None:
    estimate = replay(short, mode="fixed").estimate
    assert not estimate.changes
    # The slip is the robot's own, by self-calibration.
    learned = ("slip_mean", "slip_per_grade", "slip_sigma", "slip_time_s")
    assert all(np.ptp(series) == 0.0 for name, series in estimate.weights.items() if name not in learned)


def test_without_gnss_the_path_is_local_and_said_to_be(mixed: Recording) -> None:
    result = replay(dataclasses.replace(until(mixed, 110.0), gnss=None))
    assert result.estimate.status[-1] == "no_gnss"
    assert any("local" in note for note in result.estimate.notes)
    assert result.scores.ate_m is not None
    assert result.scores.ate_m < 7.0


def test_a_long_local_drive_with_stops_does_not_diverge() -> None:
    """Rest tells the gyro's bias, which turns the whole window by metres."""
    drive = simulate("paper_profile", terrain="asphalt", seed=0)
    result = replay(dataclasses.replace(drive, gnss=None))
    assert np.abs(result.estimate.velocity_mps).max() < 2.5
    assert result.scores.ate_m is not None
    assert result.scores.ate_m < 6.0


def test_a_wild_fix_is_refused(short: Recording, replayed: ReplayResult) -> None:
    """One fix 707 m off moves the path by less than 0.1 m."""
    gnss = short.gnss
    assert gnss is not None
    enu = gnss.enu_m.copy()
    enu[len(enu) // 2] += [500.0, 500.0, 0.0]
    spiked = replay(dataclasses.replace(short, gnss=dataclasses.replace(gnss, enu_m=enu)))
    assert spiked.rejected_gnss == replayed.rejected_gnss + 1
    moved = spiked.estimate.trajectory.position_m - replayed.estimate.trajectory.position_m
    assert np.hypot(*moved[:, :2].T).max() < 0.1


def test_a_jump_of_all_fixes_is_followed_in_the_end(short: Recording) -> None:
    """When GNSS stays elsewhere, the estimate gives in instead of locking good fixes out for ever."""
    gnss = short.gnss
    assert gnss is not None
    enu = gnss.enu_m.copy()
    enu[len(enu) // 2 :, 0] += 40.0
    result = replay(dataclasses.replace(short, gnss=dataclasses.replace(gnss, enu_m=enu)))
    end = result.estimate.trajectory
    error = end.position_m[-1, 0] - np.interp(end.t_ns[-1], gnss.t_ns, enu[:, 0])
    assert abs(error) < 1.0


def test_a_hole_in_the_imu_is_bridged(short: Recording) -> None:
    imu = short.imu
    assert imu is not None
    t = (imu.t_ns - short.start_ns) * 1e-9
    result = replay(dataclasses.replace(short, imu=imu.select((t < 40.0) | (t > 43.0))))
    assert result.scores.ate_m is not None
    assert result.scores.ate_m < 2.0


def test_a_turn_in_a_hole_of_the_imu_is_no_greater_than_the_robot_turns() -> None:
    """A skid-steered robot turns by about half of what its sides tell; the yaw scale has been seen before."""
    drive = (DriveSegment(3.0), DriveSegment(8.0, 0.8), DriveSegment(60.0, 0.8, 0.25))
    recording = simulate(Scenario("round", 50.0, drive=drive, route=(RouteLeg("asphalt"),)), seed=4)
    imu = recording.imu
    assert imu is not None
    t = (imu.t_ns - recording.start_ns) * 1e-9
    result = replay(
        dataclasses.replace(recording, imu=imu.select((t < 40.0) | (t > 44.0))), outages=[Outage(38.0, 7.0)]
    )
    errors = result.scores.errors
    assert errors is not None
    behind = (errors.t_ns - recording.start_ns) * 1e-9 > 44.2
    wrong = wrap_angle(errors.estimate_yaw_rad - errors.reference_yaw_rad)[behind]
    assert np.abs(wrong[:5]).max() < 0.05


def test_late_wheels_do_not_stop_the_estimator(short: Recording) -> None:
    wheels = short.wheels
    assert wheels is not None
    t = (wheels.t_ns - short.start_ns) * 1e-9
    result = replay(dataclasses.replace(short, wheels=wheels.select((t < 40.0) | (t > 44.0))))
    assert result.scores.ate_m is not None
    assert result.scores.ate_m < 2.0


def test_a_start_on_a_slope_finds_the_attitude() -> None:
    recording = simulate("straight", terrain="asphalt", slope_deg=10.0, seed=2)
    estimate = replay(recording).estimate
    R = quaternion_to_matrix(estimate.trajectory.quaternion[-1])
    assert np.degrees(np.arcsin(np.clip(abs(R[2, 0]), 0, 1))) == pytest.approx(10.0, abs=1.0)


def test_live_use_without_replay(exact: Recording) -> None:
    """The loop of the README, message by message."""
    states = []
    estimator = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate"), on_state=states.append)
    imu, wheels, gnss = exact.imu, exact.wheels, exact.gnss
    assert imu is not None
    assert wheels is not None
    assert gnss is not None
    sides = wheels.side_speeds_mps(load_vehicle("elevate").wheel.radius_m)
    assert estimator.latest() is None
    assert estimator.status == "waiting"
    seen = set()
    events = sorted(
        [(int(t), 0, i) for i, t in enumerate(wheels.t_ns)]
        + [(int(t), 1, i) for i, t in enumerate(gnss.t_ns)]
        + [(int(t), 2, i) for i, t in enumerate(imu.t_ns)]
    )
    for t_ns, kind, i in events:
        if kind == 0:
            estimator.add_wheels(t_ns, *sides[i].tolist())
        elif kind == 1:
            estimator.add_gnss(t_ns, gnss.enu_m[i], gnss.sigma_enu_m[i])
        else:
            estimator.add_imu(t_ns, imu.gyro_radps[i], imu.accel_mps2[i])
            seen.add(estimator.status)
    assert seen == {"waiting", "aligning", "running"}
    state = estimator.latest()
    assert state is states[-1]
    assert state is not None
    truth = exact.truth
    assert truth is not None
    assert np.hypot(*(state.position_m - truth.positions_at(np.array([state.t_ns]))[0])[:2]) < 0.02
    assert sum(state.terrain.values()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda e: e.add_imu(0, [0.0, 0.0, np.nan], [0.0, 0.0, 9.8]), "six finite numbers"),
        (lambda e: e.add_imu(0, [0.0, 0.0], [0.0, 0.0, 9.8]), "six finite numbers"),
        (lambda e: e.add_wheels(0, float("inf"), 0.0), "not finite"),
        (lambda e: e.add_gnss(0, [np.nan, 0.0, 0.0], [1.0, 1.0, 1.0]), "without east and north"),
        (lambda e: e.add_gnss(0, [0.0, 0.0, 0.0], [0.0, 1.0, 1.0]), "not positive"),
        (lambda e: e.add_terrain(0, {"lava": 1.0}), "unknown class 'lava'"),
    ],
)
def test_bad_samples_are_refused_in_words(call, match: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(DataError, match=match):
        call(Estimator.for_vehicle("husky"))


def test_a_clock_that_jumps_back_is_refused() -> None:
    estimator = Estimator.for_vehicle("elevate")
    for k in range(5):  # the first samples of a stream may themselves be the wrong ones
        estimator.add_imu(10_000_000_000 + k * 10_000_000, [0, 0, 0], [0, 0, 9.8])
    with pytest.raises(DataError, match="after a newer one"):
        estimator.add_imu(4_000_000_000, [0, 0, 0], [0, 0, 9.8])


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown mode"):
        EstimatorConfig(load_vehicle("husky").rig(), mode="magic")


def test_every_fifth_fix_is_kept_back_without_truth(mixed: Recording) -> None:
    used, held = split_fixes(dataclasses.replace(mixed, truth=None), [])
    assert used is not None
    assert held is not None
    assert mixed.gnss is not None
    assert len(used) + len(held) == len(mixed.gnss)
    assert held.t_ns[0] == mixed.gnss.t_ns[4]
    assert np.isin(held.t_ns, used.t_ns).sum() == 0
    used, held = split_fixes(mixed, [])
    assert held is None


def test_a_repeated_fix_is_kept_back_with_its_repetition(mixed: Recording) -> None:
    assert mixed.gnss is not None
    twice = mixed.gnss.select(np.repeat(np.arange(len(mixed.gnss)), 2))
    used, held = split_fixes(dataclasses.replace(mixed, truth=None, gnss=twice), [])
    assert used is not None
    assert held is not None
    assert len(held) == 2 * len(np.unique(held.t_ns))
    assert np.isin(held.t_ns, used.t_ns).sum() == 0


def test_rtk_fixes_are_believed_on_a_robot_whose_sheet_says_metres() -> None:
    """The vehicle's receiver drifts by metres, but what the log holds are fixes of 1 cm: another receiver."""
    drive = simulate("figure_eight", vehicle="pathfinder", terrain="asphalt", seed=3)
    exact = simulate("figure_eight", vehicle="pathfinder", terrain="asphalt", noiseless=True).gnss
    assert exact is not None
    rng = np.random.default_rng(4)
    fixes = dataclasses.replace(
        exact,
        enu_m=exact.enu_m + rng.normal(0.0, 0.01, exact.enu_m.shape),
        sigma_enu_m=np.full_like(exact.enu_m, 0.01),
        fix=np.full(len(exact), Fix.FIXED, dtype=np.uint8),
        velocity_enu_mps=None,
        sigma_v_mps=None,
    )
    scores = replay(dataclasses.replace(drive, gnss=fixes), vehicle="pathfinder", mode="fixed").scores
    assert scores.errors is not None
    assert np.nanmedian(scores.errors.distance_m()) < 0.05


def test_a_log_of_an_unknown_robot_is_refused_or_run_with_its_own_geometry(mixed: Recording) -> None:
    nameless = dataclasses.replace(mixed, vehicle=None)
    with pytest.raises(DataError, match="names no vehicle"):
        choose_vehicle(nameless, None)
    overrides = dataclasses.replace(nameless.overrides, wheel_radius_m=0.175, track_m=0.51)
    vehicle, notes = choose_vehicle(dataclasses.replace(nameless, overrides=overrides), None)
    assert vehicle.name == "generic"
    assert vehicle.odometry.wheel_radius_m == 0.175
    assert any("generic" in note for note in notes)


def test_a_log_without_wheels_is_refused(mixed: Recording) -> None:
    with pytest.raises(DataError, match="the log has no"):
        replay(dataclasses.replace(mixed, wheels=None))


def test_an_outage_after_the_end_is_refused(mixed: Recording) -> None:
    with pytest.raises(DataError, match="after the end"):
        replay(mixed, outages=[Outage(1e5, 10.0)])


def test_yaw_helper_is_consistent() -> None:
    """The scores' heading is that of the trajectory."""
    q = rpy_to_quaternion(np.array([[0.0, 0.0, 3.0]]))
    path = Trajectory(np.array([0]), np.zeros((1, 3)), q)
    assert wrap_angle(path.yaw_rad() - 3.0)[0] == pytest.approx(0.0, abs=1e-12)
