"""The opponents follow a drive without noise, outages are scored strictly, and made fixes are as declared."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.trajectory import Trajectory
from tests.studies import parts
from tests.studies.opponents import ekf, estimators, ours
from tests.studies.opponents.drives import RECEIVERS, as_unknown, made, vehicle_of
from tests.studies.opponents.inertial import GRAVITY_MPS2, Inertial
from tests.studies.opponents.page import Cell, compared, markdown
from tests.studies.opponents.protocol import scored, streams_of
from tests.studies.opponents.summary import geometric_mean, losses, median
from tests.studies.opponents.tuning import split

SPEED_MPS, SECONDS = 1.0, 95.0


def winding() -> Recording:
    """A drive without noise or slip whose heading swings; truth and IMU at 20 Hz, wheels at 10 Hz."""
    t = np.arange(0.0, SECONDS, 1e-3)
    yaw = 0.8 * np.sin(0.15 * t)
    rate = 0.8 * 0.15 * np.cos(0.15 * t)
    path = np.cumsum(np.column_stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw]) * SPEED_MPS * 1e-3, axis=0)

    def at(step: int) -> np.ndarray:
        return (t[::step] * 1e9).round().astype(np.int64)

    n = len(t[::50])
    gyro = np.column_stack([np.zeros(n), np.zeros(n), rate[::50]])
    accel = np.column_stack([np.zeros(n), SPEED_MPS * rate[::50], np.full(n, GRAVITY_MPS2)])
    quaternion = np.column_stack([0.0 * yaw, 0.0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)])
    return Recording(
        name="winding",
        start_ns=0,
        vehicle="husky",
        imu=Imu(at(50), gyro, accel),
        wheels=Wheels(at(100), np.full((len(t[::100]), 1), SPEED_MPS), ("speed",), "mps"),
        truth=Trajectory(at(50), path[::50], quaternion[::50]),
        truth_channels=("position", "orientation"),
    )


@pytest.fixture(scope="module")
def drive() -> Recording:
    recording = winding()
    truth = recording.truth
    assert truth is not None
    rows = slice(None, None, 4)
    n = len(truth.t_ns[rows])
    fixes = Gnss(
        truth.t_ns[rows], truth.position_m[rows], np.full((n, 3), 0.02), np.full(n, Fix.FIXED, np.uint8)
    )
    return dataclasses.replace(recording, gnss=fixes, overrides=Overrides(antenna_m=(0.0, 0.0, 0.0)))


def test_opponents_bridge_a_drive_without_noise(drive: Recording) -> None:
    inputs = Inertial.of(drive, vehicle_of(drive, None))
    assert inputs is not None
    for name in estimators.OPPONENTS:
        rows = estimators.rows_of(name, inputs, 30.0, estimators.noise_of(name, {}))
        assert len(rows) == 1
        assert max(row.error_m for row in rows) < 0.01 * 30.0 * SPEED_MPS, name
        assert rows[0].distance_m == pytest.approx(30.0, abs=0.2)


def test_a_biased_gyro_is_learned_before_the_outage(drive: Recording) -> None:
    assert drive.imu is not None
    biased = dataclasses.replace(drive.imu, gyro_radps=drive.imu.gyro_radps + np.array([0.0, 0.0, 0.01]))
    inputs = Inertial.of(dataclasses.replace(drive, imu=biased), vehicle_of(drive, None))
    assert inputs is not None
    untouched = 0.5 * 0.01 * 30.0**2 * SPEED_MPS  # way to the side of a heading that drifts unseen
    for name in estimators.OPPONENTS:
        rows = estimators.rows_of(name, inputs, 30.0, estimators.noise_of(name, {}))
        assert max(row.error_m for row in rows) < 0.5 * untouched, name


def test_an_error_is_that_at_the_last_reference_before_the_end(drive: Recording) -> None:
    streams = streams_of(drive, vehicle_of(drive, None))
    assert streams is not None
    late = np.where(streams.t_s[:, None] >= streams.passes(10.0)[0][0] + 10.0, 1e6, 0.0)
    truth = np.column_stack(
        [np.interp(streams.t_s, streams.reference[:, 0], streams.reference[:, c]) for c in (1, 2)]
    )
    rows = scored(streams, 10.0, lambda blocked: (streams.t_s, truth + late))
    assert rows[0].error_m < 0.11  # one step of the wheels: nothing after the end is looked at
    starts = list(itertools.chain(*streams.passes(10.0)))
    assert min(starts) == pytest.approx(streams.t_s[0] + 0.4 * np.ptp(streams.t_s))
    assert np.diff(sorted(starts)).min() >= 20.0 - 1e-9


def test_blocked_fixes_are_not_used(drive: Recording) -> None:
    streams = streams_of(drive, vehicle_of(drive, None))
    assert streams is not None
    wild = streams.fixes.copy()
    start = streams.passes(30.0)[0][0]
    wild[(wild[:, 0] >= start) & (wild[:, 0] < start + 30.0), 1] += 500.0
    spoilt = dataclasses.replace(streams, fixes=wild)
    rows = scored(spoilt, 30.0, lambda blocked: ekf.run(spoilt, blocked))
    assert rows[0].error_m < 0.2


@pytest.mark.parametrize("kind", RECEIVERS)
def test_made_fixes_have_the_declared_rate_and_scatter(kind: str) -> None:
    recording, receiver = winding(), RECEIVERS[kind]
    first, again = made(recording, kind).gnss, made(recording, kind).gnss
    assert first is not None
    assert again is not None
    assert np.array_equal(first.enu_m, again.enu_m)
    assert recording.truth is not None
    assert np.median(np.diff(first.t_ns)) * 1e-9 == pytest.approx(1.0 / receiver.rate_hz, rel=0.3)
    error = first.enu_m - recording.truth.positions_at(first.t_ns)
    scatter = float(np.hypot(receiver.white_m, receiver.slow_m))
    assert 0.3 * scatter < float(np.sqrt(np.mean(error[:, :2] ** 2))) < 2.0 * scatter


def test_an_unknown_robot_keeps_wheel_radius_and_track_alone(drive: Recording) -> None:
    unknown = as_unknown(drive)
    assert unknown.vehicle is None
    rig = vehicle_of(drive, None).rig()
    assert unknown.overrides == Overrides(wheel_radius_m=rig.wheel_radius_m, track_m=rig.track_m)


def test_terrafusion_is_scored_on_the_same_outages(drive: Recording) -> None:
    streams = streams_of(drive, vehicle_of(drive, None))
    assert streams is not None
    rows, failures = ours.rows(drive, streams, 30.0, "fixed", original=drive)
    assert not failures
    assert [row.start_s for row in rows] == pytest.approx(list(itertools.chain(*streams.passes(30.0))))
    assert max(row.error_m for row in rows) < 1.0
    assert rows[0].share_inside is not None


def test_parts_are_computed_once(tmp_path: Path) -> None:
    tasks = [parts.Task(f"task {k}", "code", k) for k in range(3)]
    parts.run_all(tasks[:2], lambda k: k * k, tmp_path, parts.TaskWorkers())
    parts.run_all(tasks, lambda k: -k, tmp_path, parts.TaskWorkers())
    assert [parts.result_of(task, tmp_path) for task in tasks] == [0, 1, -2]
    assert parts.result_of(parts.Task("task 0", "other code", 0), tmp_path) is None


def test_ratios_are_to_the_best_opponent() -> None:
    cells = [
        *(
            Cell("set/log", 30.0, name, "k", (2.0 + i,), (30.0,))
            for i, name in enumerate(estimators.OPPONENTS)
        ),
        Cell("set/log", 30.0, "fixed", "k", (3.0,), (30.0,)),
    ]
    assert [c.ratio for c in compared(cells, "fixed", "k")] == [1.5]
    page = markdown(cells, [], 0, 3)
    assert "fixed, k, 30 s: 1.50, lost 1 of 1" in page
    assert "EKF / best of the others and fixed, 30 s: 0.67, lost 0 of 1" in page
    assert "EKF tuned / best of the others and fixed, 30 s: 1.50, lost 1 of 1" in page
    assert not compared(cells[1:], "fixed", "k")  # the best of some would flatter


def test_summary() -> None:
    assert geometric_mean([0.5, 2.0]).value == pytest.approx(1.0)
    assert losses([1.04, 1.06, 0.2]) == 1
    found = median([1.0, 2.0, 3.0, 4.0, 5.0])
    assert found.low is not None
    assert found.high is not None
    assert found.low <= 3.0 <= found.high
    assert median([1.0, 2.0]).low is None


def test_the_split_is_by_log_and_complete() -> None:
    names = ["a/1", "a/2", "a/3", "b/1"]
    halves = split(names)
    assert sorted(halves["tuning"] + halves["held_out"]) == names
    assert halves["tuning"] == ["a/1", "a/3", "b/1"]
