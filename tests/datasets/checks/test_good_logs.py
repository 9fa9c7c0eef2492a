"""A good log, recorded or simulated, is not changed by a repair; a fault put into it is named and undone.

All public logs and 50 simulated runs are in `tests.studies.good_logs`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

import terrafusion as tf
from terrafusion.datasets.checks import repair, run, run_checks
from terrafusion.datasets.checks.finding import Finding
from terrafusion.datasets.checks.scale import _keeps_moving
from terrafusion.datasets.core.channels import Gnss, Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.cli.common import rig_of
from tests.studies.good_logs import repairs_offered, simulated

pytestmark = pytest.mark.usefixtures("checked_once")

FIELD = (
    "husky_parkinglot/test1",
    "wvu_pathfinder/test17run",
    "norlab_drive/grass_2024_8_8_15h56s39/raw",
    "umich_husky/mair_mocap/trial7",
    "borealtc/SNOW/10",
)


def rig(recording: Recording) -> Rig | None:
    return rig_of(recording, None)


def field(name: str) -> Recording:
    try:
        return open_recording(name)
    except DataError as error:
        pytest.skip(f"not on this machine: {error}")


@pytest.mark.parametrize("name", FIELD)
def test_no_repair_changes_a_good_field_log(name: str) -> None:
    log = field(name)
    repaired, done = repair(log, rig(log))
    assert [finding.code for finding in done] == []
    assert repaired is log


@pytest.mark.parametrize("seed", [*range(6), 10])
def test_no_repair_changes_a_good_simulated_log(seed: int) -> None:
    assert repairs_offered(simulated(seed)) == set()


def fixes_of_truth(log: Recording) -> Recording:
    """The log with fixes made of its truth, 5 a second, 1 sigma 5 cm, and without the truth."""
    assert log.truth is not None
    every = max(round(0.2 / float(np.median(np.diff(log.truth.t_ns)) * 1e-9)), 1)
    place = log.truth.position_m[::every].copy()
    place += np.random.default_rng(1).normal(0.0, 0.05, place.shape)
    sigma, single = np.full(place.shape, 0.05), np.ones(len(place), dtype=np.uint8)
    gnss = Gnss(log.truth.t_ns[::every], place, sigma, single)
    return dataclasses.replace(log, gnss=gnss, truth=None, truth_channels=())


def imu_with(
    log: Recording, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> Recording:
    assert log.imu is not None
    gyro, accel = change(log.imu.gyro_radps.copy(), log.imu.accel_mps2.copy())
    return dataclasses.replace(log, imu=dataclasses.replace(log.imu, gyro_radps=gyro, accel_mps2=accel))


def about_z(degrees: float) -> Callable[[Recording], Recording]:
    """The IMU mounted so that it is turned by an angle to the left."""
    a = np.radians(degrees)
    R = np.array([[np.cos(a), np.sin(a), 0.0], [-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    return lambda log: imu_with(log, lambda gyro, accel: (gyro @ R.T, accel @ R.T))


def late(seconds: float) -> Callable[[Recording], Recording]:
    def fault(log: Recording) -> Recording:
        assert log.gnss is not None
        moved = dataclasses.replace(log.gnss, t_ns=log.gnss.t_ns + round(seconds * 1e9))
        return dataclasses.replace(log, gnss=moved)

    return fault


def left_side(factor: float) -> Callable[[Recording], Recording]:
    def fault(log: Recording) -> Recording:
        assert log.wheels is not None
        factors = [factor if "left" in name else 1.0 for name in log.wheels.names]
        return dataclasses.replace(
            log, wheels=dataclasses.replace(log.wheels, speed=log.wheels.speed * factors)
        )

    return fault


def sampled_in_turn(log: Recording) -> Recording:
    assert log.wheels is not None
    speed, even = log.wheels.speed.copy(), np.arange(len(log.wheels)) % 2 == 0
    left = np.array(["left" in name for name in log.wheels.names])
    speed[np.ix_(even, left)] = np.nan
    speed[np.ix_(~even, ~left)] = np.nan
    return dataclasses.replace(log, wheels=dataclasses.replace(log.wheels, speed=speed))


def stuck(axis: int) -> Callable[[Recording], Recording]:
    def change(gyro: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gyro[:, axis] = 0.54
        return gyro, accel

    return lambda log: imu_with(log, change)


def lateness_s(log: Recording, good: Recording) -> float:
    assert log.gnss is not None
    assert good.gnss is not None
    return abs(float(log.gnss.t_ns[0] - good.gnss.t_ns[0])) * 1e-9


def gyro_scale_off(log: Recording, good: Recording) -> float:
    assert log.imu is not None
    assert good.imu is not None
    return abs(float(np.vdot(log.imu.gyro_radps[:, 2], good.imu.gyro_radps[:, 2])) /
               float(np.vdot(good.imu.gyro_radps[:, 2], good.imu.gyro_radps[:, 2])) - 1.0)  # fmt: skip


def turned_by_deg(log: Recording, good: Recording) -> float:
    assert log.imu is not None
    assert good.imu is not None
    a, b = (one.imu.accel_mps2[:, 0] + 1j * one.imu.accel_mps2[:, 1] for one in (log, good) if one.imu)
    return abs(float(np.degrees(np.angle(np.vdot(b - b.mean(), a - a.mean())))))


def sides_off(log: Recording, good: Recording) -> float:
    """Change of left over right, against the good log."""
    ratios = []
    for one in (log, good):
        assert one.wheels is not None
        left, right = np.abs(one.wheels.side_speeds_mps(1.0)).sum(axis=0)
        ratios.append(left / right)
    return abs(ratios[0] / ratios[1] - 1.0)


def distance_off(log: Recording, good: Recording) -> float:
    """Error of the distance rolled, over itself."""
    rolled = []
    for one in (log, good):
        assert one.wheels is not None
        speed, t = one.wheels.side_speeds_mps(1.0).mean(axis=1), one.wheels.t_ns * 1e-9
        rolled.append(float(np.sum(0.5 * np.abs(speed[1:] + speed[:-1]) * np.diff(t))))
    return abs(rolled[0] / rolled[1] - 1.0)


@dataclass(frozen=True)
class Injected:
    """A fault, the code it is named by, and how much of it at most is left after the repair."""

    fault: Callable[[Recording], Recording]
    code: str
    left: Callable[[Recording, Recording], float]
    most: float


INJECTED = {
    "fixes 1.5 s late": Injected(late(1.5), "clock-offset", lateness_s, 0.25),
    "fixes 3 s late": Injected(late(3.0), "clock-offset", lateness_s, 0.25),
    "fixes on GPS time": Injected(late(18.0), "clock-offset", lateness_s, 0.5),
    "gyro 3 % too much": Injected(
        lambda log: imu_with(log, lambda g, a: (g * [1.0, 1.0, 1.03], a)), "gyro-scale", gyro_scale_off, 0.01
    ),
    "gyro x stuck": Injected(stuck(0), "stuck", gyro_scale_off, 1e-9),
    "imu turned by 25 deg": Injected(about_z(25.0), "imu-forward", turned_by_deg, 10.0),
    "imu turned by -60 deg": Injected(about_z(-60.0), "imu-forward", turned_by_deg, 10.0),
    "imu backwards": Injected(about_z(180.0), "imu-forward", turned_by_deg, 1e-6),
    "left tyre deflated": Injected(left_side(1.05), "wheel-sides", sides_off, 0.02),
    "left wheel large": Injected(left_side(0.94), "wheel-sides", sides_off, 0.02),
    "sides in turn": Injected(sampled_in_turn, "sides-apart", distance_off, 0.02),
}
LOGS = {
    "simulated": lambda: tf.simulate("figure_eight", terrain="asphalt", seed=0),
    "husky": lambda: field("husky_parkinglot/test1"),
    "warthog": lambda: fixes_of_truth(field("norlab_drive/grass_2024_8_8_15h56s39/raw")),
}
NOT_SHOWN = {
    ("husky", "gyro-scale"), ("warthog", "gyro-scale"), ("husky", "sides-apart"), ("warthog", "sides-apart"),
    ("husky", "fixes on GPS time"),
}  # fmt: skip
"""Fixes too noisy or a drive too short for it; wheels at 5 and 10 Hz are too slow to be halved."""


@pytest.fixture(scope="module", params=LOGS)
def good(request: pytest.FixtureRequest) -> tuple[str, Recording]:
    return request.param, LOGS[request.param]()


@pytest.mark.parametrize("name", INJECTED)
def test_a_fault_in_a_good_log_is_named_and_undone(good: tuple[str, Recording], name: str) -> None:
    (log_name, log), case = good, INJECTED[name]
    if {(log_name, case.code), (log_name, name)} & NOT_SHOWN:
        pytest.skip("the log does not show it")
    faulty = case.fault(log)
    assert case.code in {finding.code for finding in run_checks(faulty, rig(log))}
    repaired, done = repair(faulty, rig(log))
    assert [finding.code for finding in done] == [case.code]
    assert case.left(repaired, log) < case.most


def test_wheels_that_read_8_percent_too_much_are_named_but_may_be_slip() -> None:
    log = LOGS["simulated"]()
    assert log.wheels is not None
    faster = dataclasses.replace(log, wheels=dataclasses.replace(log.wheels, speed=log.wheels.speed * 1.08))
    [found] = run_checks(faster, rig(log))
    assert (found.code, found.repair) == ("wheel-scale", None)


def test_wheels_that_stand_the_wrong_way_round_are_named_and_not_the_imu() -> None:
    """Sign and sides reversed: yaw agrees with the gyro, and only the direction of most of the way tells."""
    log = LOGS["simulated"]()
    assert log.wheels is not None
    reversed_ = dataclasses.replace(log.wheels, speed=-log.wheels.speed[:, [1, 0, 3, 2]], angle_rad=None)
    faulty = dataclasses.replace(log, wheels=reversed_, command=None, truth=None)
    assert [found.code for found in run_checks(faulty, rig(log))] == ["wheel-reversed"]
    repaired, _ = repair(faulty, rig(log))
    assert repaired.wheels is not None
    assert np.array_equal(repaired.wheels.speed, log.wheels.speed)


def test_wheels_that_are_late_against_all_others_are_moved_and_not_the_imu() -> None:
    """By less than a speed alone would show, but by the same against IMU and fixes."""
    log = LOGS["simulated"]()
    assert log.wheels is not None
    t_ns = log.wheels.t_ns + 160_000_000
    late_wheels = dataclasses.replace(log, wheels=dataclasses.replace(log.wheels, t_ns=t_ns), command=None)
    [found] = run_checks(late_wheels, rig(log))
    assert (found.code, found.channel) == ("clock-offset", "wheels")


def test_rtk_steps_that_the_wheels_explain_are_no_jumps() -> None:
    """A mower at 3 m/s with fixes of 2 cm, 1 Hz, that turns round within two seconds at the end of a lane."""
    rng = np.random.default_rng(7)
    t = np.arange(0.0, 120.0, 0.02)
    rate = np.where(t % 15.0 > 13.0, np.pi / 2.0, 0.0) * np.where(t % 30.0 > 15.0, 1.0, -1.0)
    yaw = np.cumsum(rate) * 0.02
    place = np.cumsum(3.0 * np.exp(1j * yaw)) * 0.02
    sides = np.stack([3.0 - 0.25 * rate, 3.0 + 0.25 * rate], axis=1) + rng.normal(0.0, 0.01, (len(t), 2))
    gyro = np.stack([0.0 * rate, 0.0 * rate, rate], axis=1) + rng.normal(0.0, 0.005, (len(t), 3))
    t_ns = np.rint(t * 1e9).astype(np.int64)
    enu = np.stack([place.real, place.imag, 0.0 * t], axis=1)[::50] + rng.normal(0.0, 0.02, (len(t[::50]), 3))
    fixes = Gnss(t_ns[::50], enu, np.full(enu.shape, 0.02), np.full(len(enu), 4, dtype=np.uint8))
    imu = Imu(t_ns, gyro, np.full((len(t), 3), np.nan))
    log = Recording("mower", 0, wheels=Wheels(t_ns, sides, ("left", "right"), "mps"), imu=imu, gnss=fixes)
    assert run_checks(log) == []
    enu = enu.copy()
    enu[50:54, 0] += 4.0
    jumped = dataclasses.replace(log, gnss=dataclasses.replace(fixes, enu_m=enu))
    repaired, [found] = repair(jumped)
    assert (found.code, found.what) == ("gnss-jumps", "2 jumps of position")
    assert repaired.gnss is not None
    assert len(repaired.gnss) == len(fixes) - 4


def test_wheels_that_roll_under_a_standing_robot_are_named() -> None:
    log = LOGS["simulated"]()
    assert log.gnss is not None
    assert log.imu is not None
    rng = np.random.default_rng(3)
    place = log.gnss.enu_m[:1] + rng.normal(0.0, 0.02, log.gnss.enu_m.shape)
    gnss = dataclasses.replace(log.gnss, enu_m=place, velocity_enu_mps=None, sigma_v_mps=None)
    imu = dataclasses.replace(log.imu, gyro_radps=rng.normal(0.0, 0.002, log.imu.gyro_radps.shape))
    standing = dataclasses.replace(log, gnss=gnss, imu=imu, truth=None, truth_channels=(), command=None)
    assert "standing" in {finding.code for finding in run_checks(standing, rig(log))}


def test_wheels_that_stand_while_the_robot_is_pushed_are_named() -> None:
    log = LOGS["simulated"]()
    assert log.wheels is not None
    since_s = (log.wheels.t_ns - log.start_ns) * 1e-9
    speed = np.where((since_s > 50.0)[:, None], 0.0, log.wheels.speed)
    pushed = dataclasses.replace(log.wheels, speed=speed, angle_rad=None)
    found = run_checks(dataclasses.replace(log, wheels=pushed, command=None), rig(log))
    assert "carried" in {finding.code for finding in found}


def test_reflected_fixes_of_a_standing_robot_do_not_carry_it() -> None:
    rng, t_s, grid = np.random.default_rng(0), np.arange(0.0, 400.0, 0.5), np.arange(0.0, 400.0, 20.0)
    noise = rng.normal(0.0, 0.5, (len(t_s), 2)) @ np.array([1.0, 1j])
    moves = 1.0 * t_s + noise
    jumps = np.where((t_s > 105.0) & (t_s < 131.0), 9.0, 0.0) + np.where(t_s > 309.0, 12.0, 0.0) + noise
    assert _keeps_moving(t_s, moves, grid, np.full(len(grid) - 1, 20.0)).all()
    assert not _keeps_moving(t_s, jumps, grid, np.full(len(grid) - 1, 9.0)).any()


def test_fixes_half_a_minute_late_do_not_show_a_standing_robot() -> None:
    """The clock is named; that the robot stands while its wheels roll follows from it."""
    log = LOGS["simulated"]()
    assert log.gnss is not None
    late = dataclasses.replace(log.gnss, t_ns=log.gnss.t_ns + 18 * 10**9)
    codes = {finding.code for finding in run_checks(dataclasses.replace(log, gnss=late), rig(log))}
    assert "clock-offset" in codes
    assert not codes & {"standing", "carried"}


@pytest.mark.parametrize(("severity", "left"), [("error", 1), ("warning", 2)])
def test_only_a_wrong_clock_explains_a_standing_robot(
    monkeypatch: pytest.MonkeyPatch, severity: str, left: int
) -> None:
    """Fixes are often late by tenths of a second: wheels that spin in place are named beside that."""
    late = Finding("clock-offset", severity, "gnss", "late", "", "")
    spinning = Finding("standing", "warning", "wheels", "rolls in place", "", "")
    monkeypatch.setattr(run, "CHECKS", (lambda _: [late, spinning],))
    assert len(run_checks(LOGS["simulated"]())) == left


def test_fixes_that_end_within_a_window_show_no_standing_robot() -> None:
    log = LOGS["simulated"]()
    assert log.gnss is not None
    since_s = (log.gnss.t_ns - log.start_ns) * 1e-9
    few = dataclasses.replace(
        log, gnss=log.gnss.select(abs(since_s % 10.0 - 4.5) < 0.5), truth=None, truth_channels=()
    )
    assert "standing" not in {finding.code for finding in run_checks(few, rig(log))}


def test_a_truth_of_positions_alone_turns_no_wheels() -> None:
    """The yaw of a truth that lists its position alone is not true, and used by no check."""
    log = LOGS["simulated"]()
    assert log.truth is not None
    assert log.truth.quaternion is not None
    backwards = log.truth.quaternion[:, [1, 0, 3, 2]] * [1.0, -1.0, 1.0, -1.0]  # half a turn about z
    truth = dataclasses.replace(log.truth, quaternion=backwards, twist_body=None)
    claimed = dataclasses.replace(log, truth=truth, truth_channels=("position", "yaw"), command=None)
    assert {finding.channel for finding in run_checks(claimed, rig(log))} & {"wheels", "truth"}
    assert run_checks(dataclasses.replace(claimed, truth_channels=("position",)), rig(log)) == []
