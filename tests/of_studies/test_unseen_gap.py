"""The robots of the study `unseen_gap`: what is changed on them shows in the log where it should."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from tests.studies.unseen_gap import plant
from tests.studies.unseen_gap.changes import FOREIGN, SIZES, Change, machine
from tests.studies.unseen_gap.plant import run
from tests.studies.unseen_gap.study import CLEAN, USUAL, lines, trials, vehicle_of

pytestmark = pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="mujoco is not installed")


def log(name: str = "", size: float = 0.0) -> Recording:
    """A short one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plant, "SECONDS", 20.0)
        return run(machine(0), Change(name, size), USUAL, 1)


@pytest.fixture(scope="module")
def plain() -> Recording:
    """Of the robot as it is."""
    return log()


def way_m(recording: Recording) -> tuple[float, float]:
    """Way by the fixes and by the wheels."""
    assert recording.gnss is not None
    assert recording.wheels is not None
    fixes = recording.gnss.enu_m[::5, :2]
    rolled = np.abs(recording.wheels.speed.mean(axis=1)).sum() / machine(0).wheels_hz * machine(0).radius_m
    return float(np.hypot(*np.diff(fixes, axis=0).T).sum()), float(rolled)


def test_the_same_seed_is_the_same_log(plain: Recording) -> None:
    one, other = plain, log()
    assert one.imu is not None
    assert other.imu is not None
    assert np.array_equal(one.imu.gyro_radps, other.imu.gyro_radps)


def test_larger_wheels_go_further_than_they_roll(plain: Recording) -> None:
    (ahead, rolled), (further, as_far) = way_m(plain), way_m(log("wheel_radius", 0.1))
    assert further / as_far == pytest.approx(1.1 * ahead / rolled, rel=0.03)


def test_sensor_changes_leave_the_drive_alone(plain: Recording) -> None:
    biased = log("gyro_bias", 0.01)
    assert plain.gnss is not None
    assert biased.gnss is not None
    assert np.array_equal(plain.gnss.enu_m, biased.gnss.enu_m)
    assert plain.imu is not None
    assert biased.imu is not None
    assert biased.imu.gyro_radps[:, 2] - plain.imu.gyro_radps[:, 2] == pytest.approx(0.01, abs=1e-12)


def test_late_commands_move_the_robot_later(plain: Recording) -> None:
    def starts(recording: Recording) -> float:
        assert recording.wheels is not None
        fast = np.abs(recording.wheels.speed).max(axis=1) > 0.5
        return float(np.argmax(fast)) / machine(0).wheels_hz

    assert starts(log("dead_time", 0.3)) - starts(plain) == pytest.approx(0.3, abs=0.06)


def test_every_robot_has_every_change_and_clean_runs_on_both_drives() -> None:
    found = trials([100, 101])
    mine = [t for t in found if t.seed == 100]
    assert {t.change.name for t in mine} == {"", *SIZES, *FOREIGN}
    assert [sum(not t.change.name and t.other == other for t in mine) for other in (True, False)] == [
        CLEAN
    ] * 2
    sizes = [{t.change.size for t in found if t.change.name == name} for name in SIZES]
    assert all(len(both) == 2 for both in sizes)


def test_the_table_counts_alarms_detections_and_names() -> None:
    wanted = [t for t in trials([100]) if t.change.name in ("", "mass")]
    one = {"seconds": 1.0, "p": 0.5, "verdict": "no_gap", "named": [], "sets": [], "covered": 1.0}
    found = [{**one, "detected": bool(t.change.name), "sets": [["mass", "slope"]] if t.change.name else []}
             for t in wanted]  # fmt: skip
    text = "\n".join(lines(wanted, found))
    assert f"false alarms, same drives: 0 of {CLEAN}" in text
    assert "right effect in a named set: 1 of 1" in text
    assert "mean credible set 2.0" in text


def test_the_owner_tells_what_the_robot_is() -> None:
    robot, known = machine(3), vehicle_of(machine(3))
    assert known.body.mass_kg == robot.mass_kg
    assert known.odometry.wheel_radius_m == known.wheel.radius_m == robot.radius_m
