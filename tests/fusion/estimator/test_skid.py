"""A skidding robot: fixes that refute the wheels are used; others are not."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import strategies as st

from terrafusion.datasets.core.messages import GnssSample
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimator.dead_reckoning import DeadReckoning
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.skid import SkidDetector
from terrafusion.fusion.graph.key_state import LINEAR, KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.simulate import simulate, simulate_run
from tests.studies.mode_tuning import DRIVES
from tests.studies.opponents.drives import drives_of, longest

FRICTION = 0.1
"""Of rubber on ice."""


@pytest.fixture(scope="module")
def sliding() -> Recording:
    """Steps of the speed up to 1.5 m/s on ground as slippery as ice, RTK fixes at 5 Hz."""
    soil = load_soil("asphalt")
    grip = dataclasses.replace(
        soil.shear, friction_angle_rad=float(np.arctan(FRICTION)), friction_cap=FRICTION
    )
    ice = dataclasses.replace(soil, shear=grip)
    return simulate_run("staircase", terrain="asphalt", soils={"asphalt": ice}, seed=3).recording


def thinned(recording: Recording, every: int, planar: bool) -> Recording:
    """Each so many-th fix only; `planar`: no roll and pitch rate, as many robots have it."""
    assert recording.gnss is not None
    assert recording.imu is not None
    gnss = recording.gnss
    keep = np.arange(len(gnss)) % every == 0
    parts = {f.name: getattr(gnss, f.name) for f in dataclasses.fields(gnss)}
    kept = {name: part[keep] if isinstance(part, np.ndarray) else part for name, part in parts.items()}
    axes = np.array([np.nan, np.nan, 1.0]) if planar else np.ones(3)
    imu = dataclasses.replace(recording.imu, gyro_radps=recording.imu.gyro_radps * axes)
    return dataclasses.replace(recording, gnss=type(gnss)(**kept), imu=imu)


def rms_m(found: ReplayResult) -> float:
    assert found.scores.errors is not None
    return float(np.sqrt(np.nanmean(found.scores.errors.distance_m() ** 2)))


@pytest.fixture(scope="module")
def replayed(sliding: Recording) -> Callable[[bool, str], ReplayResult]:
    """Replays with one fix a second, each made once."""
    return functools.cache(lambda planar, mode: replay(thinned(sliding, 5, planar), mode=mode))


@pytest.mark.parametrize("mode", ["adaptive", "fixed"])
@pytest.mark.parametrize("planar", [False, True])
def test_fixes_are_not_refused_for_wheels_that_spin_on_ice(
    replayed: Callable[[bool, str], ReplayResult], planar: bool, mode: str
) -> None:
    """Fixes once a second: they free the velocity, too, which locked wheels had taken for zero."""
    found = replayed(planar, mode)
    assert found.rejected_gnss <= 2
    assert rms_m(found) < 0.08


def test_a_real_robot_that_slides_sideways_follows_its_fixes() -> None:
    """A Warthog on gravel turns at 2 rad/s and slides at 1.6 m/s: its wheels say that it drives ahead."""
    if not os.environ.get("TERRAFUSION_DATA"):
        pytest.skip("TERRAFUSION_DATA names no folder of field logs")
    (drive,) = longest(drives_of("norlab_drive/gravel_2024_8_6_11h37s32/windows@rtk"), 1)
    found = replay(drive.recording, mode="fixed")
    assert found.rejected_gnss <= 10
    assert rms_m(found) < 0.15
    assert found.verdict is not None
    assert found.verdict.value == "good"


def test_a_batch_knows_what_was_learnt_of_the_wheels(
    sliding: Recording, replayed: Callable[[bool, str], ReplayResult]
) -> None:
    batch = replay(thinned(sliding, 5, True), batch=True)
    assert rms_m(batch) < min(0.05, rms_m(replayed(True, "adaptive")))  # .086 m where nothing was learnt


def test_a_dump_in_a_slide_goes_on_with_the_same_bits(sliding: Recording) -> None:
    """Until the wheels were refuted, then on: one estimator, and one that is restored from a dump of it."""
    one, other = Estimator.for_vehicle("elevate"), None
    for message in thinned(sliding, 5, False).messages():
        one.add(message)
        if other is not None:
            other.add(message)
        elif one.gnss.skid.rate_m2ps:
            other = Estimator.restore(Estimator.for_vehicle("elevate").config, one.dump())
    assert other is not None
    state, same = one.latest(), other.latest()
    assert state is not None
    assert same is not None
    assert state.position_m.tobytes() == same.position_m.tobytes()
    assert one.gnss.skid.rate_m2ps == other.gnss.skid.rate_m2ps


def test_nothing_is_learnt_on_ground_that_holds() -> None:
    log = simulate("staircase", terrain="asphalt", seed=3)
    estimator = Estimator.for_vehicle("elevate")
    for message in log.messages():
        estimator.add(message)
        assert estimator.gnss.skid.rate_m2ps == 0.0


@drawn(variance=st.floats(1e-8, 1e4), sigma=st.floats(1e-4, 1.0), distance=st.floats(-3.0, 3.0))
def test_loosened_wheels_know_less_of_the_way_and_as_much_of_the_turn(
    variance: float, sigma: float, distance: float
) -> None:
    wheels = WheelIncrement(np.array([distance, 0.0, 0.0]), np.full(4, sigma), distance, 0.1)
    loose = wheels.with_extra_variance(variance)
    assert np.allclose(loose.sigma[:2] ** 2, sigma**2 + variance)
    assert (loose.sigma[2:] == sigma).all()
    twice = wheels.with_extra_variance(0.5 * variance).with_extra_variance(0.5 * variance)
    assert np.allclose(twice.sigma, loose.sigma)


def moving(speed_mps: float) -> KeyState:
    """A state at the origin that moves along x."""
    velocity = np.array([speed_mps, 0.0, 0.0])
    return KeyState(gtsam.Pose3(), velocity, gtsam.imuBias.ConstantBias(), np.zeros(len(LINEAR)))


def test_a_robot_at_rest_does_not_slide() -> None:
    slide = SkidDetector()
    slide.rate_m2ps = 0.5
    still = WheelIncrement(np.zeros(3), np.full(4, 0.01), 0.0, 0.0)
    assert (slide.with_extra_variance(still, moving(0.0), 0.1).sigma == still.sigma).all()
    sliding, spinning = (
        slide.with_extra_variance(still, moving(3.0), 0.1),
        dataclasses.replace(still, distance_m=0.3),
    )
    assert sliding.sigma[0] == pytest.approx(np.hypot(0.01, np.sqrt(0.05)), rel=0.02)
    assert slide.with_extra_variance(spinning, moving(0.0), 0.1).sigma[0] == pytest.approx(
        sliding.sigma[0], rel=0.02
    )


def test_a_slide_is_forgotten_when_fixes_agree_with_the_wheels_and_only_then() -> None:
    slide = SkidDetector()
    slide.rate_m2ps = 0.5
    state = moving(3.0)
    wheels = WheelIncrement(np.array([3.0, 0.0, 0.0]), np.full(4, 0.01), 3.0, 0.0)

    def told(k: int, innovation_m: float) -> float:
        slide.with_extra_variance(wheels, state, 1.0)
        slide.accepted(k * 10**9, np.full(2, innovation_m), np.full(2, 0.02 + slide.rate_m2ps), 0.04)
        return slide.rate_m2ps

    told(1, 0.0)
    assert all(0.4 < told(k, 0.8) < 0.8 for k in range(2, 40))  # still .8 m off after a second, each axis
    falling = [told(k, 0.0) for k in range(40, 100)]
    assert falling[0] > falling[10] > falling[-1] == 0.0
    assert told(200, 5.0) == 0.0  # a fix that the gate lets in refutes nothing


def test_after_an_outage_a_fine_fix_still_tells_of_a_slide_and_a_coarse_one_does_not() -> None:
    wheels, doubt_m2 = WheelIncrement(np.array([3.0, 0.0, 0.0]), np.full(4, 0.01), 3.0, 0.0), 30.0
    for fix_m2, told in ((0.02, True), (9.0, False)):
        slide = SkidDetector()
        slide.rate_m2ps = 0.2
        slide.with_extra_variance(wheels, moving(3.0), 1.0)
        before = slide.rate_m2ps
        slide.accepted(10**9, np.zeros(2), np.full(2, doubt_m2), fix_m2)
        assert (slide.rate_m2ps < before) == told


def track_of(points_m: np.ndarray, sigma_m: float, step_s: float = 0.2) -> DeadReckoning:
    track = DeadReckoning(np.zeros(3))
    for k in range(-1, len(points_m)):
        track._append(round(k * step_s * 1e9), 0j, 0.0)
    for k, (x, y) in enumerate(points_m):
        track.add(
            GnssFix(round(k * step_s * 1e9), np.array([x, y, 0.0]), np.full(3, sigma_m), None, 0.0, None)
        )
    return track


@drawn(
    speed=st.floats(-3.0, 3.0),
    accel=st.floats(-3.0, 3.0),
    turn=st.floats(-1.0, 1.0),
    sigma=st.floats(0.01, 1.0),
)
def test_fixes_of_a_robot_follow_each_other(speed: float, accel: float, turn: float, sigma: float) -> None:
    t = 0.2 * np.arange(4)
    way, heading = speed * t + 0.5 * accel * t**2, turn * t
    points = np.stack([way * np.cos(heading), way * np.sin(heading)], axis=1)
    assert track_of(points, sigma).smooth_at(round(0.6e9))
    assert not track_of(points[:3], sigma).smooth_at(round(0.4e9))


def test_fixes_that_scatter_beyond_their_claims_do_not() -> None:
    rng = np.random.default_rng(0)
    followed = [track_of(rng.normal(0.0, 0.5, (4, 2)), 0.01).smooth_at(round(0.6e9)) for _ in range(400)]
    assert np.mean(followed) < 0.05
    honest = [track_of(rng.normal(0.0, 0.5, (4, 2)), 0.5).smooth_at(round(0.6e9)) for _ in range(400)]
    assert np.mean(honest) > 0.98


def test_a_refutation_that_does_not_help_keeps_no_fix_out() -> None:
    """Wheels dig in at the start; the IMU, not the wheels, holds the estimate. Once, 35 were refused."""
    mud = next(drive for drive in DRIVES if drive.ground == "mud").lesson().recording
    found = replay(mud, mode="fixed")
    accepted = [i.accepted for i in found.estimate.innovations if i.sensor == "gnss"]
    runs = "".join("x" if yes else "." for yes in accepted).split("x")
    assert max(map(len, runs)) <= 4
    assert found.rejected_gnss <= 16
    assert rms_m(found) < 0.1


def test_wheels_that_slipped_through_an_outage_are_soon_used_again() -> None:
    """They erred alike for half a minute; taken for a random walk, that would be a metre within a second."""
    drive = simulate("waypoints", terrain="asphalt", seed=4)
    assert drive.wheels is not None
    t_s = 1e-9 * (drive.wheels.t_ns - drive.start_ns)
    speed = drive.wheels.speed * np.where((t_s > 30.0) & (t_s < 58.0), 1.33, 1.0)[:, None]
    slipping = dataclasses.replace(
        drive, wheels=dataclasses.replace(drive.wheels, speed=speed, angle_rad=None)
    )
    estimator, rates = Estimator.for_vehicle("elevate"), list[float]()
    for message in slipping.messages():
        at_s = 1e-9 * (message.t_ns - drive.start_ns)
        if at_s > 65.0:
            break
        if not (isinstance(message, GnssSample) and 30.0 < at_s < 55.0):
            estimator.add(message)
        rates.append(estimator.gnss.skid.rate_m2ps)
    assert estimator.gnss.skid.refutations == 1
    assert 0.0 < max(rates) < 0.1
