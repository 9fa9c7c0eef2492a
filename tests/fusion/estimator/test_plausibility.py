"""Faults of receivers and gyros put into simulated drives: the error stays small, or sigma covers it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import SensorConfig
from terrafusion.fusion.estimate.estimate import Innovation, State
from terrafusion.fusion.estimator.dead_reckoning import FixPair
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.notes import notes_of
from terrafusion.fusion.estimator.plausibility import (
    BEYOND,
    MIRRORED,
    REPEATS,
    PathShape,
    RepeatedPosition,
    plausible_fixes,
    within_reach,
)
from terrafusion.fusion.estimator.stuck_gyro import StuckGyro
from terrafusion.fusion.inputs.streams import WheelStream
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.twin.model.vehicle import load_vehicle, with_overrides
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

SECONDS = 60.0
FAR_M = np.array([500.0, 500.0, 0.0])


@functools.cache
def drive() -> Recording:
    segments = (
        DriveSegment(2.0),
        DriveSegment(SECONDS, v_mps=1.0, v_amplitude_mps=0.3, yaw_rate_amplitude_radps=0.3, period_s=9.0),
    )
    route = (RouteLeg("asphalt"),)
    return simulate(Scenario("winding", SECONDS, drive=segments, route=route), seed=6, vehicle="elevate")


@dataclasses.dataclass(frozen=True, eq=False)
class Result:
    """A live run: time, error and its normalised square a degree of freedom, at each keyframe."""

    estimator: Estimator
    states: list[State]
    innovations: list[Innovation]
    t_s: np.ndarray
    error_m: np.ndarray
    nees: np.ndarray

    def reasons(self) -> set[str]:
        return {one.reason for one in self.innovations if not one.accepted}

    def status(self) -> set[str]:
        return {state.status for state in self.states}


def run(recording: Recording, mode: str = "adaptive") -> Result:
    vehicle = load_vehicle("elevate")
    states: list[State] = []
    innovations: list[Innovation] = []
    config = EstimatorConfig(vehicle.rig(), vehicle.name, mode)
    estimator = Estimator(config, on_state=states.append, on_innovation=innovations.append)
    for message in recording.messages():
        estimator.add(message)
    estimator.finish()
    truth = recording.truth
    assert truth is not None
    t_ns = np.array([s.t_ns for s in states])
    off = (np.array([s.position_m for s in states]) - truth.positions_at(t_ns))[:, :2]
    P = np.array([s.covariance[:2, :2] for s in states])
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(P), off) / 2.0
    return Result(estimator, states, innovations, (t_ns - recording.start_ns) * 1e-9, np.hypot(*off.T), nees)


def changed(
    change: Callable[[np.ndarray, np.ndarray], np.ndarray], sigma_m: float | None = None
) -> Recording:
    """The drive with other fixes: `change` of times (n,) s and positions (n, 3); no velocities."""
    recording = drive()
    gnss = recording.gnss
    assert gnss is not None
    enu = change((gnss.t_ns - recording.start_ns) * 1e-9, gnss.enu_m.copy())
    sigma = gnss.sigma_enu_m if sigma_m is None else np.full_like(enu, sigma_m)
    fixes = dataclasses.replace(gnss, enu_m=enu, sigma_enu_m=sigma, velocity_enu_mps=None, sigma_v_mps=None)
    return dataclasses.replace(recording, gnss=fixes)


@pytest.mark.parametrize("mode", ["adaptive", "robust"])
@pytest.mark.parametrize(("lasts_s", "off_m"), [(1.5, FAR_M), (8.0, FAR_M), (8.0, 0.02 * FAR_M)])
def test_a_burst_of_fixes_elsewhere_does_not_move_the_pose(
    mode: str, lasts_s: float, off_m: np.ndarray
) -> None:
    def burst(t: np.ndarray, enu: np.ndarray) -> np.ndarray:
        return enu + ((t > 30.0) & (t < 30.0 + lasts_s))[:, None] * off_m

    result = run(until(changed(burst), 48.0), mode)
    assert result.error_m.max() < 0.5
    assert BEYOND in result.reasons()
    assert "doubtful" in result.status()
    assert result.states[-1].status == "running"
    assert any(BEYOND in note for note in notes_of(result.estimator))


def test_a_receiver_that_repeats_its_position_is_not_followed() -> None:
    def frozen(t: np.ndarray, enu: np.ndarray) -> np.ndarray:
        held = (t > 25.0) & (t < 40.0)
        enu[held] = enu[np.argmax(held)]
        return enu

    result = run(changed(frozen))
    assert result.error_m.max() < 0.5
    assert REPEATS in result.reasons()
    assert result.states[-1].status == "running"


def test_a_start_from_wrong_fixes_is_left_again() -> None:
    """After tens of metres; from the contradiction on sigma covers the error."""
    result = run(changed(lambda t, enu: enu + (t < 6.0)[:, None] * FAR_M))
    contradicted = result.t_s > 8.0
    assert result.nees[contradicted].max() < 9.0
    assert result.error_m[-1] < 0.2
    assert result.states[-1].status == "doubtful"
    assert any("the position was moved to them" in note for note in notes_of(result.estimator))


@pytest.mark.parametrize("signs", [(1, 0, 2), None])
def test_swapped_or_mirrored_axes_are_named_and_not_used(signs: tuple[int, ...] | None) -> None:
    def turned(_: np.ndarray, enu: np.ndarray) -> np.ndarray:
        return enu[:, signs] if signs else enu * [-1.0, 1.0, 1.0]

    result = run(changed(turned))
    assert MIRRORED in result.reasons()
    assert result.states[-1].status == "doubtful"
    assert result.nees[result.t_s > 12.0].max() < 9.0


def test_a_claim_of_3_mm_counts_as_the_2_cm_of_the_data_sheet() -> None:
    honest, bold = run(changed(lambda _, enu: enu)), run(changed(lambda _, enu: enu, sigma_m=0.003))
    assert bold.nees.mean() < 1.2 * honest.nees.mean()


@pytest.mark.parametrize("every", [1, 5])
def test_fixes_that_scatter_a_hundred_times_their_claim(every: int) -> None:
    rng = np.random.default_rng(1)
    recording = changed(lambda _, enu: enu + rng.normal(0.0, 0.3, enu.shape), sigma_m=0.003)
    assert recording.gnss is not None
    thinned = recording.gnss.select(np.arange(len(recording.gnss)) % every == 0)
    result = run(dataclasses.replace(recording, gnss=thinned))
    late = result.t_s > 20.0
    assert result.nees[late].mean() < 6.0
    assert result.error_m[late].max() < 1.5


@pytest.mark.parametrize("every", [1, 5])
def test_half_of_the_fixes_wild_is_bearable(every: int) -> None:
    """Errors with heavy tails, 5 m (Cauchy), in every second fix of a receiver that claims 2 cm."""
    rng = np.random.default_rng(4)

    def wild(_: np.ndarray, enu: np.ndarray) -> np.ndarray:
        off = (5.0 * rng.standard_cauchy(enu.shape)).clip(-300.0, 300.0) * [1.0, 1.0, 0.0]
        return enu + (rng.random(len(enu)) < 0.5)[:, None] * off

    recording = changed(wild)
    assert recording.gnss is not None
    thinned = recording.gnss.select(np.arange(len(recording.gnss)) % every == 0)
    result = run(dataclasses.replace(recording, gnss=thinned))
    assert np.sqrt(np.mean(result.error_m**2)) < 0.5
    assert result.nees.mean() < 4.0


def test_a_velocity_that_no_robot_has_is_left_out() -> None:
    gnss = drive().gnss
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    velocity = gnss.velocity_enu_mps.copy()
    velocity[len(velocity) // 2] = [9000.0, 0.0, 0.0]
    velocity[-20:] = [15.0, 0.0, 0.0]
    fast = dataclasses.replace(gnss, velocity_enu_mps=velocity)
    result = run(dataclasses.replace(drive(), gnss=fast))
    assert result.error_m.max() < 0.5
    assert result.estimator.gnss.velocities.refused in (20, 21)


@pytest.mark.parametrize("rate", [0.54, None])
def test_a_stuck_gyro_gives_way_to_the_wheels(rate: float | None) -> None:
    """At any reading, or at that of the moment."""
    imu = drive().imu
    assert imu is not None
    gyro = imu.gyro_radps.copy()
    half = len(gyro) // 2
    gyro[half:, 2] = gyro[half, 2] if rate is None else rate
    result = run(dataclasses.replace(drive(), imu=dataclasses.replace(imu, gyro_radps=gyro)))
    assert result.error_m.max() < 0.5
    assert any("the wheels stood in for it" in note for note in notes_of(result.estimator))


# --- parts ---------------------------------------------------------------------------------------------


def test_a_robot_at_rest_may_have_a_receiver_at_rest() -> None:
    position = RepeatedPosition()
    pairs = [FixPair(i, 0j, 1 + 1j, 0.02) for i in range(100)]
    assert all(position.moved_m(pair, 0j) == 0.0 for pair in pairs)
    spinning = [FixPair(100 + i, complex(i), 1 + 1j, 0.02) for i in range(10)]
    assert all(position.moved_m(pair, 0j) == 0.0 for pair in spinning), "wheels that spin on the spot"
    driving = [FixPair(200 + i, complex(i), 1 + 1j, 0.02) for i in range(10)]
    assert position.moved_m(driving[-1], 9 + 0j) > 1.0


@given(st.floats(0.0, 500.0), st.floats(0.0, 500.0), st.floats(0.01, 5.0))
def test_reach_is_symmetric_and_grows_with_path_and_sigma(
    away_m: float, path_m: float, sigma_m: float
) -> None:
    a, b = FixPair(0, 0j, 0j, sigma_m), FixPair(1, 0j, complex(away_m), sigma_m, path_m)
    assert within_reach(a, b, 1.0) == within_reach(b, a, 1.0) == (within_reach(a, b, 1.0))
    if within_reach(a, b, 1.0):
        assert within_reach(a, dataclasses.replace(b, reach_m=path_m + 1.0), 1.0)
        assert within_reach(a, b, 2.0)
    assert within_reach(a, b, 1.0) or away_m > path_m


@given(st.floats(-3.1, 3.1), st.integers(0, 1000))
def test_the_shape_of_a_path_tells_its_mirror_image(turn: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0.15, 0.2, 60))
    z = np.cumsum(np.exp(1j * heading))
    noise = 0.05 * (rng.normal(size=60) + 1j * rng.normal(size=60))

    def shape(path: np.ndarray) -> PathShape:
        fixes = np.exp(1j * turn) * path + 100.0 + noise
        return PathShape.of([FixPair(i, a, b, 0.05) for i, (a, b) in enumerate(zip(z, fixes, strict=True))])

    assert not shape(z).is_mirrored()
    assert not shape(z.conj()).is_own()


def test_fixes_before_the_start_are_those_of_one_place() -> None:
    wheels = WheelStream()
    for i in range(21):
        wheels.add(i * 10**9, 1.0, 1.0)
    fixes = [
        GnssFix(i * 10**9, np.array([float(i), 0.0, 0.0]) + (i < 4) * FAR_M, np.full(3, 0.02))
        for i in range(20)
    ]
    assert plausible_fixes(fixes, wheels) == fixes[4:]
    assert plausible_fixes(fixes[4:], wheels) == fixes[4:]
    scattered = [dataclasses.replace(fix, enu_m=FAR_M * i) for i, fix in enumerate(fixes)]
    assert plausible_fixes(scattered, wheels) == scattered, "as many as are waited for"
    assert plausible_fixes(scattered[:10], wheels) == []


def test_a_gyro_at_rest_or_in_order_is_not_stuck() -> None:
    wheels, check = WheelStream(), StuckGyro(load_vehicle("elevate").rig(), SensorConfig())
    for i in range(300):
        wheels.add(i * 10**7, -0.17, 0.17)
        check.checked(i * 10**7, [0.0, 0.0, 0.4], wheels)
    assert not check.stuck, "it agrees with the wheels"
    rng = np.random.default_rng(0)
    for i in range(300, 600):
        wheels.add(i * 10**7, -0.1, 0.1)
        check.checked(i * 10**7, [0.0, 0.0, -0.4 + 1e-4 * rng.normal()], wheels)
    assert check.samples == 0, "a reading that changes is that of a gyro"


@pytest.mark.parametrize(("drive", "share"), [("differential", 1.0), ("skid_steer", 0.6)])
def test_the_stand_in_turns_as_far_as_the_wheels_of_its_drive(drive: str, share: float) -> None:
    vehicle = with_overrides(load_vehicle("elevate"), Overrides(drive=drive))
    wheels, check = WheelStream(), StuckGyro(vehicle.rig(), SensorConfig())
    half = 0.5 * vehicle.body.track_m
    for i in range(100):
        wheels.add(i * 10**7, -half, half)
        given = check.checked(i * 10**7, [0.0, 0.0, 0.0], wheels)
    assert given[2] == pytest.approx(share)
    assert check.doubt_rad == pytest.approx(0.5 * share, abs=0.02), "by what it was wrong for half a second"
