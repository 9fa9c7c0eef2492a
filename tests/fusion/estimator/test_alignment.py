"""Starts without a known heading, from any motion, and starts that were given wrong."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix, wrap_angle
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import SensorConfig
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

WAVE = {"yaw_rate_amplitude_radps": 0.3, "period_s": 8.0}
DRIVES = {
    "forward": (DriveSegment(3.0), DriveSegment(30.0, v_mps=1.0, **WAVE)),
    "backward": (DriveSegment(3.0), DriveSegment(30.0, v_mps=-0.8, **WAVE)),
    "spin": (
        DriveSegment(1.5),
        DriveSegment(8.0, yaw_rate_radps=0.6),
        DriveSegment(30.0, v_mps=1.0, **WAVE),
    ),
}


@dataclass(frozen=True)
class Started:
    """When the first state came after the first motion, s, and the states after it."""

    time_s: float
    states: list[State]


def drive(
    kind: str = "forward",
    *,
    seed: int = 1,
    slope_deg: float = 0.0,
    seconds: float = 16.0,
    heading: float = 70.0,
) -> Recording:
    scenario = Scenario(
        kind,
        seconds,
        drive=DRIVES[kind],
        route=(RouteLeg("asphalt"),),
        slope_deg=slope_deg,
        heading_deg=heading,
    )
    return simulate(scenario, seed=seed)


def moving(recording: Recording, after_s: float) -> Recording:
    """The part after `after_s`: the robot is already under way."""
    begin, end = recording.start_ns + round(after_s * 1e9), 2**62
    parts = {name: getattr(recording, name).between(begin, end) for name in ("imu", "wheels", "gnss")}
    return dataclasses.replace(recording, **parts)


def run(
    recording: Recording,
    *,
    velocity: bool = True,
    watch: Callable[[Estimator], None] = lambda _: None,
    **start: object,
) -> Started:
    """Feed a drive in time order, with what only the fixes tell of the heading."""
    states: list[State] = []
    vehicle = load_vehicle("elevate")
    estimator = Estimator(EstimatorConfig(vehicle.rig(), "elevate"), on_state=states.append)
    if start:
        estimator.set_start(**start)  # type: ignore[arg-type]
    imu, wheels, gnss = recording.imu, recording.wheels, recording.gnss
    assert imu is not None
    assert wheels is not None
    assert gnss is not None
    sides = wheels.side_speeds_mps(vehicle.wheel.radius_m)
    first = None
    w = g = 0
    for i, t_ns in enumerate(imu.t_ns.tolist()):
        while w < len(wheels) and wheels.t_ns[w] <= t_ns:
            estimator.add_wheels(int(wheels.t_ns[w]), *sides[w].tolist())
            w += 1
        while g < len(gnss) and gnss.t_ns[g] <= t_ns:
            known = gnss.velocity_enu_mps is not None and gnss.sigma_v_mps is not None and velocity
            more = (gnss.velocity_enu_mps[g], float(gnss.sigma_v_mps[g])) if known else ()  # type: ignore[index]
            estimator.add_gnss(int(gnss.t_ns[g]), gnss.enu_m[g], gnss.sigma_enu_m[g], *more)
            g += 1
        estimator.add_imu(t_ns, imu.gyro_radps[i], imu.accel_mps2[i])
        watch(estimator)
        if first is None and states:
            first = t_ns
    estimator.finish()
    assert first is not None, "never started"
    moved = wheels.t_ns[np.argmax(np.abs(sides.mean(axis=1)) > 0.05)]
    return Started((first - int(moved)) * 1e-9, states)


def test_a_long_rest_before_the_start_costs_neither_memory_nor_time() -> None:
    """Two minutes at rest: buffers stay short, the first motion starts the graph as after three seconds."""
    segments = (DriveSegment(120.0), DriveSegment(30.0, v_mps=1.0, **WAVE))
    scenario = Scenario("rest", 140.0, drive=segments, route=(RouteLeg("asphalt"),), heading_deg=70.0)
    recording = simulate(scenario, seed=1)
    longest: list[tuple[int, int]] = []
    started = run(
        recording, velocity=False, watch=lambda e: longest.append((len(e.imu.t_ns), len(e.gnss.waiting)))
    )
    samples, fixes = np.array(longest).max(axis=0)
    assert samples < 25.0 * 100
    assert fixes < 25.0 * 5
    assert started.time_s < run(drive(), velocity=False).time_s + 1.0
    assert np.abs(yaw_errors(recording, started.states)[-20:]).max() < np.radians(8.0)


def yaw_errors(recording: Recording, states: list[State]) -> np.ndarray:
    """Error of the heading (N,), rad."""
    truth = recording.truth
    assert truth is not None
    t = np.array([s.t_ns for s in states])
    true = np.interp(t, truth.t_ns, np.unwrap(truth.yaw_rad()))
    R = quaternion_to_matrix(np.array([s.quaternion for s in states]))
    return np.asarray(wrap_angle(np.arctan2(R[:, 1, 0], R[:, 0, 0]) - true))


def tilt_errors(recording: Recording, states: list[State]) -> np.ndarray:
    """Angle (N,) between the true and the estimated vertical, rad."""
    truth = recording.truth
    assert truth is not None
    i = np.searchsorted(truth.t_ns, [s.t_ns for s in states])
    up = quaternion_to_matrix(truth.quaternion[np.minimum(i, len(truth.t_ns) - 1)])[:, 2]
    seen = quaternion_to_matrix(np.array([s.quaternion for s in states]))[:, 2]
    # In body axes the vertical does not depend on the heading.
    return np.asarray(np.arccos(np.clip((up * seen).sum(axis=1), -1.0, 1.0)))


CASES = {
    "at rest": lambda seed: drive("forward", seed=seed),
    "moving": lambda seed: moving(drive("forward", seed=seed), 5.0),
    "backward": lambda seed: drive("backward", seed=seed),
    "moving backward": lambda seed: moving(drive("backward", seed=seed), 5.0),
    "spin": lambda seed: drive("spin", seed=seed, seconds=20.0),
    "moving spin": lambda seed: moving(drive("spin", seed=seed, seconds=20.0), 5.0),
    "slope 10": lambda seed: drive("forward", seed=seed, slope_deg=10.0),
    "slope 20 moving": lambda seed: moving(drive("forward", seed=seed, slope_deg=20.0), 5.0),
}


@pytest.mark.parametrize("velocity", [True, False], ids=["velocity", "position"])
@pytest.mark.parametrize("case", CASES)
def test_heading_is_found_from_any_motion(case: str, velocity: bool) -> None:
    recording = CASES[case](3)
    started = run(recording, velocity=velocity)
    errors = np.abs(yaw_errors(recording, started.states))
    limit_s = 3.0 + (8.0 if "spin" in case else 0.0)  # on the spot there is nothing to see a heading from
    assert started.time_s < limit_s
    assert errors[0] < 0.25
    assert errors[20:].max() < 0.1
    assert tilt_errors(recording, started.states).max() < 0.05


@pytest.mark.parametrize("off_deg", [90.0, -90.0, 180.0])
def test_a_wrong_given_heading_recovers(off_deg: float) -> None:
    recording = drive("forward", seed=4, seconds=20.0, heading=30.0)
    yaw = np.radians(30.0 + off_deg)
    started = run(recording, position_m=np.zeros(3), yaw_rad=yaw, position_sigma_m=0.1, yaw_sigma_rad=0.3)
    t = np.array([s.t_ns - recording.start_ns for s in started.states]) * 1e-9
    assert abs(yaw_errors(recording, started.states)[0]) > 1.5
    right = np.abs(yaw_errors(recording, started.states)) < 0.1
    assert right[t > 9.0].all()  # six seconds after the robot set off
    truth = recording.truth
    assert truth is not None
    end = started.states[-1].position_m - truth.positions_at(np.array([started.states[-1].t_ns]))[0]
    assert np.hypot(*end[:2]) < 0.1


def test_a_right_given_heading_starts_at_once_and_stays() -> None:
    recording = drive("forward", seed=5, heading=30.0)
    started = run(recording, position_m=np.zeros(3), yaw_rad=np.radians(30.0), yaw_sigma_rad=0.05)
    assert started.states[0].t_ns - recording.start_ns < 1.5e9
    assert np.abs(yaw_errors(recording, started.states)).max() < 0.1


@pytest.mark.parametrize("bad", [{"yaw_rad": np.nan}, {"yaw_rad": 0.0, "yaw_sigma_rad": 0.0}])
def test_a_start_that_is_none_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(DataError):
        Estimator.for_vehicle("elevate").set_start(np.zeros(3), **bad)


def test_a_start_in_degrees_is_refused() -> None:
    with pytest.raises(DataError, match="yaw 90 rad of the start is more than a turn; give radians"):
        Estimator.for_vehicle("elevate").set_start(np.zeros(3), 90.0)
    Estimator.for_vehicle("elevate").set_start(np.zeros(3), 1.5 * np.pi)


RATE_RADPS = 0.02
"""What the gyro below tells at rest."""


def samples(rest_s: float, wheel_period_s: float, wheels_first: bool) -> list[tuple[int, str, float]]:
    """Time, channel and speed of 3 s of wheels and a 100 Hz IMU that set off at 0.5 m/s after `rest_s`."""
    times = {"wheels": np.arange(0.0, 3.0, wheel_period_s), "imu": np.arange(0.0, 3.0, 0.01)}
    order = sorted(times, reverse=wheels_first)
    rows = [(round(t * 1e9), name, 0.5 * (t > rest_s + 1e-6)) for name in order for t in times[name]]
    return sorted(rows, key=lambda row: row[0])


@pytest.mark.parametrize("wheels_first", [True, False])
@pytest.mark.parametrize(
    ("wheel_period_s", "rest_s", "stood"),
    [(0.02, 1.0, True), (0.02, 0.9, False), (0.07, 1.05, True), (0.4, 1.2, True), (0.4, 0.7, False)],
)
def test_a_rest_of_just_a_second_is_seen_whichever_channel_comes_first_and_however_slow(
    wheel_period_s: float, rest_s: float, stood: bool, wheels_first: bool
) -> None:
    """The rest ends with the first sample of the wheels that is a second old, or sooner."""
    states: list[State] = []
    config = EstimatorConfig(load_vehicle("elevate").rig(), "elevate", inputs=SensorConfig(gnss=False))
    estimator = Estimator(config, on_state=states.append)
    for t_ns, name, speed in samples(rest_s, wheel_period_s, wheels_first):
        if name == "wheels":
            estimator.add_wheels(t_ns, speed, speed)
        else:
            estimator.add_imu(t_ns, [0.0, 0.0, RATE_RADPS], [0.0, 0.0, 9.81])
    seen = states[0].gyro_bias_radps[2] / RATE_RADPS
    assert seen == pytest.approx(1.0, abs=0.1) if stood else seen < 0.5
    assert states[0].t_ns < 1_500_000_000


def test_wheels_that_fall_silent_do_not_hold_up_the_start() -> None:
    states: list[State] = []
    config = EstimatorConfig(load_vehicle("elevate").rig(), "elevate", inputs=SensorConfig(gnss=False))
    estimator = Estimator(config, on_state=states.append)
    estimator.add_wheels(0, 0.0, 0.0)
    for i in range(300):
        estimator.add_imu(i * 10_000_000, np.zeros(3), [0.0, 0.0, 9.81])
    assert states


@pytest.mark.parametrize("off_s", [-100, -600_000_000, 100])
def test_fixes_of_a_clock_that_is_wrong_do_not_hold_up_the_start(off_s: int) -> None:
    """They are as none: the path is local once they have been waited for."""
    estimator = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate", start_without_gnss_s=3.0))
    for t_ns in range(0, 4_000_000_000, 10_000_000):
        if t_ns % 200_000_000 == 0:
            estimator.add_gnss(t_ns + off_s * 1_000_000_000, [0.0, 0.0, 0.0], 1.0)
        estimator.add_wheels(t_ns, 0.5, 0.5)
        estimator.add_imu(t_ns, np.zeros(3), [0.0, 0.0, 9.81])
    assert estimator.status == "no_gnss"


def test_few_fixes_and_then_none_hold_samples_for_a_while_only() -> None:
    estimator = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate", start_without_gnss_s=3.0))
    held = 0
    for t_ns in range(0, 25_000_000_000, 20_000_000):
        if t_ns < 3_000_000_000 and t_ns % 1_000_000_000 == 0:
            estimator.add_gnss(t_ns, [0.0, 0.0, 0.0], 1.0)
        estimator.add_wheels(t_ns, 0.0, 0.0)
        estimator.add_imu(t_ns, np.zeros(3), [0.0, 0.0, 9.81])
        held = max(held, len(estimator.imu.t_ns))
    assert held <= 21 * 50
    assert estimator.status == "no_gnss"


@pytest.mark.parametrize(("fixes", "status"), [(2, "no_gnss"), (6, "outage")])
def test_a_robot_that_drives_on_without_fixes_starts_where_the_few_there_were_place_it(
    fixes: int, status: str
) -> None:
    """Their heading is too rough to start with at once, and none comes that would tell it."""
    estimator = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate", start_without_gnss_s=5.0))
    rng = np.random.default_rng(0)
    for t_ns in range(0, 12_000_000_000, 20_000_000):
        if t_ns < 200_000_000 * fixes and t_ns % 200_000_000 == 0:
            estimator.add_gnss(t_ns, np.array([30.0, 7.0, 0.0]) + rng.normal(size=3), 2.0)
        estimator.add_wheels(t_ns, 0.5, 0.5)
        estimator.add_imu(t_ns, np.zeros(3), [0.0, 0.0, 9.81])
    state = estimator.latest()
    assert state is not None
    assert state.status == status
    if fixes == 6:
        off_m = state.position_m[:2] - [30.0, 7.0]
        assert abs(np.hypot(*off_m) - 6.0) < 3.0
        assert off_m @ np.linalg.solve(state.covariance[:2, :2], off_m) < 9.21


def test_an_imu_that_falls_silent_stalls_the_estimator() -> None:
    estimator = Estimator(
        EstimatorConfig(load_vehicle("elevate").rig(), "elevate", inputs=SensorConfig(gnss=False))
    )
    for t_ns in range(0, 6_000_000_000, 20_000_000):
        estimator.add_wheels(t_ns, 0.5, 0.5)
        if t_ns < 3_000_000_000:
            estimator.add_imu(t_ns, np.zeros(3), [0.0, 0.0, 9.81])
        assert (estimator.status == "stalled") == (t_ns > 4_980_000_000)


@pytest.mark.parametrize("back_s", [None, 3600, 3])
def test_a_clock_set_back_or_fixes_alone_stall_the_estimator(back_s: int | None) -> None:
    estimator = Estimator.for_vehicle("elevate")
    estimator.set_start(np.zeros(3), 0.0)
    for t_ns in range(3600 * 10**9, 3612 * 10**9, 20_000_000):
        after = t_ns >= 3604 * 10**9
        stamp_ns = t_ns - (back_s or 0) * 10**9 * after
        if t_ns % 10**9 == 0:
            estimator.add_gnss(t_ns, np.zeros(3), 0.02)
        if back_s is not None or not after:
            with contextlib.suppress(DataError):
                estimator.add_wheels(stamp_ns, 0.0, 0.0)
            with contextlib.suppress(DataError):
                estimator.add_imu(stamp_ns, np.zeros(3), [0.0, 0.0, 9.81])
        began_s, ended_s = (3607, 3612) if back_s is None else (3605, 3607 if back_s == 3 else 3612)
        if t_ns % 10**9 == 0 and t_ns > 3601 * 10**9:
            assert (estimator.status == "stalled") == (began_s * 10**9 <= t_ns < ended_s * 10**9), t_ns
