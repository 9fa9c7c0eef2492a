"""The friction estimator on a twin whose laws are not those of `graph.coulomb`."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import gtsam
import numpy as np
import pytest

from terrafusion.datasets.core.messages import GnssSample
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import aided_by_truth, until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import SensorConfig, sensor_config_of
from terrafusion.fusion.estimate.estimate import WeightChange
from terrafusion.fusion.estimator import friction
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.friction import FrictionEstimator, friction_estimator
from terrafusion.fusion.graph.key_state import LINEAR, KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.choose import choose_vehicle
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.simulate import simulate_run

FRICTION = 0.1
"""Of rubber on ice: 0.98 m/s2."""
DRIVE = """
description: fast turns and stops
max_accel_mps2: 3.0
drive:
  - {duration_s: 3}
  - {duration_s: 6, v_mps: 3.0}
  - {duration_s: 4, v_mps: 3.0, yaw_rate_radps: 0.6}
  - {duration_s: 4, v_mps: 0.5}
  - {duration_s: 5, v_mps: 3.0, yaw_rate_radps: -0.6}
  - {duration_s: 5, v_mps: 2.0, yaw_rate_radps: 0.8}
  - {duration_s: 4, v_mps: -2.0}
  - {duration_s: 5, v_mps: 3.0}
  - {duration_s: 4, v_mps: 3.0, yaw_rate_radps: 0.6}
  - {duration_s: 4, v_mps: 0.0}
  - {duration_s: 5, v_mps: 3.0, yaw_rate_radps: -0.6}
  - {duration_s: 6, v_mps: 2.0, yaw_rate_radps: 0.8}
  - {duration_s: 3}
"""


def driven(folder: Path, friction: float | None) -> Recording:
    """A Warthog that is driven hard, with a gyro about z alone, and fixes of 0.1 m twice a second."""
    soil = load_soil("asphalt")
    if friction is not None:
        shear = dataclasses.replace(
            soil.shear, friction_angle_rad=float(np.arctan(friction)), friction_cap=friction
        )
        soil = dataclasses.replace(soil, shear=shear)
    (folder / "hard.yaml").write_text(DRIVE)
    run = simulate_run(
        folder / "hard.yaml", vehicle="warthog", terrain="asphalt", soils={"asphalt": soil}, seed=3
    )
    imu = run.recording.imu
    assert imu is not None
    flat = dataclasses.replace(imu, gyro_radps=imu.gyro_radps * np.array([np.nan, np.nan, 1.0]))
    return aided_by_truth(dataclasses.replace(run.recording, imu=flat, gnss=None), 1)


@pytest.fixture(scope="module")
def ice(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return driven(tmp_path_factory.mktemp("ice"), FRICTION)


@pytest.fixture(scope="module")
def asphalt(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return driven(tmp_path_factory.mktemp("asphalt"), None)


def places(found: ReplayResult) -> bytes:
    return found.estimate.trajectory.position_m.tobytes()


def rms_m(found: ReplayResult) -> float:
    assert found.scores.errors is not None
    return float(np.sqrt(np.nanmean(found.scores.errors.distance_m() ** 2)))


def config_of(recording: Recording) -> EstimatorConfig:
    robot, _ = choose_vehicle(recording, None)
    return EstimatorConfig(robot.rig(), robot.name, inputs=sensor_config_of(recording, recording.gnss))


def followed(recording: Recording, until_s: float = np.inf) -> tuple[list[float], list[bool], Estimator]:
    """FrictionEstimator and whether the robot slides after every fix, of a live estimator."""
    estimator = Estimator(config_of(recording))
    grip = estimator.gnss.skid.friction
    assert grip is not None
    found, leads = [], []
    for message in recording.messages():
        if message.t_ns > recording.start_ns + until_s * 1e9:
            break
        estimator.add(message)
        if isinstance(message, GnssSample):
            found.append(grip.mps2)
            leads.append(grip.leads)
    return found, leads, estimator


def test_the_grip_of_ice_is_found(ice: Recording) -> None:
    """Wheels on the twin slip on by a law of shear displacement, and roll: the grip comes out low."""
    found, slides, _ = followed(ice)
    late = slice(len(found) // 3, None)
    assert all(slides[late])
    assert 0.5 < np.median(found[late]) < 1.2 * FRICTION * 9.81


def test_without_fixes_friction_leads_where_wheels_do_not(ice: Recording) -> None:
    """12 s without fixes, four times: 2 m at the end where wheels lead to 7 (geometric means)."""
    logs = [aided_by_truth(dataclasses.replace(ice, gnss=None), seed) for seed in (1, 2)]

    def end_m(mode: str) -> float:
        found = [
            replay(until(log, at + 12.5), mode=mode, outages=[Outage(at, 12.0)])
            for log in logs
            for at in (27.0, 35.0)
        ]
        return float(np.exp(np.mean([np.log(one.scores.outages[0].end_error_m) for one in found])))

    assert end_m("adaptive") < 0.6 * end_m("fixed")


def test_with_fixes_none_is_refused_for_the_wheels(ice: Recording) -> None:
    found = replay(ice)
    assert found.rejected_gnss <= 3
    assert rms_m(found) < 0.25
    assert any("the robot skidded, with a friction limit of" in note for note in found.estimate.notes)


def test_ground_that_holds_costs_nothing(asphalt: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where rolling wheels tell the way, the estimate is to the last bit the one without a grip, but for the
    slip of grounds, which the grip helps to tell apart.
    """
    monkeypatch.setattr("terrafusion.fusion.weighting.adaptive.GroundLearner.update", lambda *_: None)
    _, slides, _ = followed(asphalt)
    assert not any(slides)
    heard = replay(asphalt)
    monkeypatch.setattr("terrafusion.fusion.estimator.estimator.friction_estimator", lambda *_: None)
    assert places(heard) == places(replay(asphalt))


def test_slip_of_a_slide_is_told(ice: Recording) -> None:
    assert ice.truth is not None
    assert ice.wheels is not None
    robot, _ = choose_vehicle(ice, None)
    rim = ice.wheels.side_speeds_mps(robot.odometry.wheel_radius_m).mean(axis=1)
    velocity = ice.truth.twist_body
    assert velocity is not None

    def error(mode: str) -> float:
        found = replay(ice, mode=mode).estimate
        t_ns = found.trajectory.t_ns
        rolled = np.interp(t_ns, ice.wheels.t_ns, rim)  # type: ignore[union-attr]
        went = np.interp(t_ns, ice.truth.t_ns, velocity[:, 0])  # type: ignore[union-attr]
        turning = np.abs(rolled) > 1.0
        return float(np.sqrt(np.mean((found.slip - 1.0 + went / rolled)[turning] ** 2)))

    assert error("adaptive") < 0.5 * error("fixed")


def test_a_change_of_the_wheels_worth_is_told_with_its_reason(ice: Recording) -> None:
    told = [c for c in replay(ice).estimate.changes if c.reason.startswith("friction: friction")]
    assert told
    assert told[0].before == np.inf
    assert all(change.unit == "m/s2" for change in told)


def test_a_dump_in_a_slide_goes_on_with_the_same_bits(ice: Recording) -> None:
    config = config_of(ice)
    one, other = Estimator(config), None
    for k, message in enumerate(ice.messages()):
        one.add(message)
        if other is not None:
            other.add(message)
        elif k > 1000 and one.gnss.skid.friction is not None and one.gnss.skid.friction.leads:
            other = Estimator.restore(config, one.dump())
    assert other is not None
    state, same = one.latest(), other.latest()
    assert state is not None
    assert same is not None
    assert state.position_m.tobytes() == same.position_m.tobytes()
    assert state.covariance.tobytes() == same.covariance.tobytes()


def test_who_hears_the_grip() -> None:
    """A planar graph with two wheels and a gyro, whose weights follow the ground; no calibration."""
    base = dataclasses.replace(Estimator.for_vehicle("warthog").config, inputs=SensorConfig(imu="gyro_z"))

    def hears(**changes: object) -> bool:
        config: EstimatorConfig = dataclasses.replace(base, **changes)  # type: ignore[arg-type]
        return (
            friction_estimator(config, config.inputs.preintegrator(config.rig.sensors.imu), lambda _: None)
            is not None
        )

    assert hears()
    assert not hears(mode="fixed")
    assert not hears(calibrate=True)
    assert not hears(inputs=SensorConfig())
    assert not hears(inputs=SensorConfig(imu="none"))
    assert not hears(inputs=SensorConfig(imu="gyro_z", sides=False))


class Straight:
    """A robot whose wheels roll at 3 m/s along a heading, while it goes as told; a fix every half second."""

    def __init__(self, heading_rad: float = 0.0, origin_m: tuple[float, float] = (0.0, 0.0)) -> None:
        config = dataclasses.replace(
            Estimator.for_vehicle("warthog").config, inputs=SensorConfig(imu="gyro_z")
        )
        self.told: list[WeightChange] = []
        grip = friction_estimator(
            config, config.inputs.preintegrator(config.rig.sensors.imu), self.told.append
        )
        assert grip is not None
        self.friction: FrictionEstimator = grip
        self.heading = gtsam.Rot3.Rz(heading_rad)
        self.at = np.array([*origin_m, 0.0]) + self.heading.matrix() @ grip.antenna_m
        self.k = 0

    def drive(
        self, seconds: float, speed_mps: float, acceleration_mps2: float = 0.0, jump_m: float = 0.0
    ) -> float:
        """Wheels at 3 m/s, the robot from `speed_mps` on; gives its speed at the end."""
        R = self.heading.matrix()
        wheels = WheelIncrement(np.array([0.3, 0.0, 0.0]), np.full(4, 0.01), 0.3, 0.0)
        for _ in range(round(seconds / 0.1)):
            self.k += 1
            # The grip is given the velocity that an estimate would have: the robot's own.
            state = KeyState(
                gtsam.Pose3(self.heading, self.at),
                R @ np.array([speed_mps, 0.0, 0.0]),
                gtsam.imuBias.ConstantBias(),
                np.zeros(len(LINEAR)),
            )
            segments = [ImuSegment(0.1, np.zeros(3), np.array([0.0, 0.0, 9.81]))]
            self.friction.step(self.k * 10**8, 0.1, segments, wheels, state, np.eye(21) * 1e-4, 0.0)
            self.at = self.at + R @ np.array([0.1 * speed_mps + 0.005 * acceleration_mps2, 0.0, 0.0])
            speed_mps = min(speed_mps + 0.1 * acceleration_mps2, 3.0)
            if self.k % 5 == 0:
                jump = jump_m if self.k == 20 else 0.0
                self.friction.score_fix(
                    GnssFix(self.k * 10**8, self.at + jump * np.array([1.0, 1.0, 0.0]), np.full(3, 0.05))
                )
        return speed_mps


@pytest.mark.parametrize("true_mps2", [0.7, 1.0, 1.4])
def test_the_grip_of_a_robot_that_speeds_up(true_mps2: float) -> None:
    robot = Straight()
    robot.drive(2.6, 0.1, true_mps2)
    assert robot.friction.leads
    assert robot.friction.mps2 == pytest.approx(true_mps2, rel=0.3)
    assert robot.told[0].before == np.inf
    assert robot.told[-1].after == pytest.approx(robot.friction.mps2, rel=friction.REPORT_STEP)


@pytest.mark.parametrize("late_s", [0.0, 0.5, 1.0, 1.4])
def test_late_fixes_on_ground_that_holds_are_no_skid(late_s: float) -> None:
    """A robot that starts and stops: fixes follow its wheels as a sliding robot would."""
    grip, places = Straight().friction, [np.zeros(3)]
    for k in range(1, 301):
        speed_mps = 1.5 if k % 80 > 40 else 0.0
        wheels = WheelIncrement(np.array([0.1 * speed_mps, 0.0, 0.0]), np.full(4, 0.01), 0.1 * speed_mps, 0.0)
        velocity = np.array([speed_mps, 0.0, 0.0])
        state = KeyState(
            gtsam.Pose3(gtsam.Rot3(), places[-1]),
            velocity,
            gtsam.imuBias.ConstantBias(),
            np.zeros(len(LINEAR)),
        )
        segments = [ImuSegment(0.1, np.zeros(3), np.array([0.0, 0.0, 9.81]))]
        grip.step(k * 10**8, 0.1, segments, wheels, state, np.eye(21) * 1e-4, 0.0)
        places.append(places[-1] + 0.1 * velocity)
        if k % 5 == 0:
            fix_m = places[max(k - round(10.0 * late_s), 0)] + grip.antenna_m
            grip.score_fix(GnssFix(k * 10**8, fix_m, np.full(3, 0.05)))
    assert not grip.leads


def test_heading_and_place_do_not_matter() -> None:
    here, there = Straight(), Straight(2.3, (-400.0, 1200.0))
    for robot in (here, there):
        robot.drive(2.6, 0.1, 1.0)
    assert there.friction.mps2 == pytest.approx(here.friction.mps2, rel=1e-6)


def test_one_wild_fix_makes_no_slide() -> None:
    robot = Straight()
    robot.drive(6.0, 3.0, jump_m=4.0)
    assert not robot.friction.leads
    assert not robot.told


def test_what_is_heard_is_forgotten_on_the_way() -> None:
    robot = Straight()
    speed = robot.drive(2.6, 0.1, 1.0)
    assert robot.friction.leads
    robot.drive(30.0, 3.0 if speed > 2.6 else speed)
    assert not robot.friction.leads
    assert robot.told[-1].after == np.inf


def test_silent_wheels_begin_the_ways_anew() -> None:
    robot = Straight()
    robot.drive(2.6, 0.1, 1.0)
    before = robot.friction.mps2
    state = KeyState(gtsam.Pose3(), np.zeros(3), gtsam.imuBias.ConstantBias(), np.zeros(len(LINEAR)))
    segments = [ImuSegment(0.1, np.zeros(3), np.array([0.0, 0.0, 9.81]))]
    assert robot.friction.step(10**10, 0.1, segments, None, state, np.eye(21), 0.0) == (segments, None)
    robot.friction.score_fix(GnssFix(10**10, np.array([50.0, 0.0, 0.0]), np.full(3, 0.05)))
    assert robot.friction.mps2 == before


def test_a_refuted_slide_loosens_its_links_and_has_them_back(ice: Recording) -> None:
    _, _, estimator = followed(ice, until_s=34.0)
    chain, skid = estimator.chain, estimator.gnss.skid
    nodes = chain.nodes[-8:]
    links, sure = [node.link for node in nodes], chain.covariance
    since, ahead = nodes[0].t_ns, [np.array([0.5, 0.0]), np.array([0.6, 0.0])]
    assert skid.test_wheels(chain, chain.last, since, ahead, 0.1, estimator.weights.noise)
    assert all(node.link is not link for node, link in zip(nodes[1:], links[1:], strict=True))
    assert (np.diag(chain.covariance)[3:8] > 1.2 * np.diag(sure)[3:8]).any()
    skid.undo(chain)
    assert all(node.link is link for node, link in zip(nodes, links, strict=True))


def test_a_receiver_known_to_scatter_more_than_it_claims_says_less() -> None:
    honest, liar = Straight(), Straight()
    liar.friction.score_fix = functools.partial(liar.friction.score_fix, scale=20.0)  # type: ignore[method-assign]
    for robot in (honest, liar):
        robot.drive(2.6, 0.1, 1.0)
    assert honest.friction.leads
    assert not liar.friction.leads


def test_a_fix_that_comes_after_a_newer_one_judges_nothing() -> None:
    robot = Straight()
    robot.drive(2.0, 0.1, 1.0)
    before = robot.friction.mps2
    robot.friction.score_fix(GnssFix(19 * 10**8, np.array([40.0, 9.0, 0.0]), np.full(3, 0.05)))
    assert robot.friction.mps2 == before


@pytest.mark.parametrize(
    ("best_mps2", "lead", "leads"),
    [(4.0, 6.0, False), (4.0, 20.0, True), (1.0, 6.0, True), (None, 20.0, False)],
)
def test_on_dry_ground_friction_leads_only_where_it_is_sure(
    best_mps2: float | None, lead: float, leads: bool
) -> None:
    """`lead` is the logarithm of how much better one grip, or rolling, told the way than all others."""
    grip = Straight().friction
    i = -1 if best_mps2 is None else int(np.flatnonzero(best_mps2 == friction.FRICTION_MPS2)[0])
    grip._score[i] += lead
    assert grip.leads == leads
    if leads:
        assert grip.mps2 == pytest.approx(best_mps2, rel=0.1)
