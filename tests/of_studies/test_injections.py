"""Known changes in logs: what each does to a recording, and one real log."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Gnss, Imu, Terrain, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.model.vehicle import load_vehicle
from tests.studies.effective_track import blocks_of, effective_track
from tests.studies.fault_injection import table as injections
from tests.studies.fault_injection.faults import (
    INJECTIONS,
    biased_gyro,
    late_fixes,
    late_imu,
    lost_counts,
    moved_antenna,
    pose_as_gnss,
    scaled_left,
    scaled_wheels,
    turned_imu,
)
from tests.studies.fault_injection.table import (
    SEVERITIES,
    LogSet,
    Source,
    answered,
    cases,
    estimated,
    table,
    verdict_on,
)
from tests.studies.parts import TaskWorkers

HUSKY = load_vehicle("husky")
RATE_HZ, SECONDS, SPEED_MPS, TURN_RADPS = 20, 60, 1.0, 0.2


def circle() -> Recording:
    """A circle to the left at constant speed: wheels (rad/s), IMU, and GNSS at the body's origin."""
    t_s = np.arange(SECONDS * RATE_HZ) / RATE_HZ
    t_ns, n = (t_s * 1e9).astype(np.int64), len(t_s)
    yaw, radius_m = TURN_RADPS * t_s, SPEED_MPS / TURN_RADPS
    enu = radius_m * np.stack([np.sin(yaw), 1.0 - np.cos(yaw), np.zeros(n)], axis=1)
    r, half = HUSKY.odometry.wheel_radius_m, 0.5 * HUSKY.odometry.track_m * TURN_RADPS
    speed = np.tile([(SPEED_MPS - half) / r, (SPEED_MPS + half) / r], (n, 1))
    gyro = np.tile([0.0, 0.0, TURN_RADPS], (n, 1))
    accel = np.tile([0.1, SPEED_MPS * TURN_RADPS, 9.81], (n, 1))
    gnss = Gnss(t_ns[::4], enu[::4], np.full((n, 3), 0.01)[::4], np.full(n, 4, dtype=np.uint8)[::4])
    terrain = Terrain(t_ns[[0, n // 2]], np.array(["grass", "gravel"]))
    wheels = Wheels(t_ns, speed, ("left", "right"), "radps", np.cumsum(speed, axis=0) / RATE_HZ)
    return Recording("circle", 0, wheels=wheels, imu=Imu(t_ns, gyro, accel), gnss=gnss, terrain=terrain)


CIRCLE = circle()
LOGS = LogSet(("set/circle",), "husky", 20.0)


@settings(deadline=None, max_examples=30)
@given(st.floats(-0.5, 0.5))
def test_scaled_wheels_scale_speeds_and_angles_and_nothing_else(share: float) -> None:
    changed = scaled_wheels(CIRCLE, HUSKY, share)
    assert changed.wheels.speed == pytest.approx((1.0 + share) * CIRCLE.wheels.speed)
    assert changed.wheels.angle_rad == pytest.approx((1.0 + share) * CIRCLE.wheels.angle_rad)
    assert changed.imu is CIRCLE.imu
    assert changed.gnss is CIRCLE.gnss


def test_scaled_left_leaves_the_right_side() -> None:
    changed = scaled_left(CIRCLE, HUSKY, 0.03)
    assert changed.wheels.speed[:, 0] == pytest.approx(1.03 * CIRCLE.wheels.speed[:, 0])
    assert np.array_equal(changed.wheels.speed[:, 1], CIRCLE.wheels.speed[:, 1])


@pytest.mark.parametrize("unit", ["radps", "mps"])
def test_lost_counts_take_their_share_of_the_way(unit: str) -> None:
    wheels = CIRCLE.wheels
    if unit == "mps":
        speed = wheels.speed * HUSKY.odometry.wheel_radius_m
        wheels = dataclasses.replace(wheels, speed=speed, unit=unit, angle_rad=None)
    before = dataclasses.replace(CIRCLE, wheels=wheels)
    changed = lost_counts(before, HUSKY, 0.05).wheels
    ratio = changed.speed[1:].sum(axis=0) / wheels.speed[1:].sum(axis=0)
    # A binomial share of so many counts scatters by less than this, 5 sigma.
    quantum = HUSKY.sensors.wheels.quantum_rad * (1.0 if unit == "radps" else HUSKY.odometry.wheel_radius_m)
    counts = wheels.speed.sum(axis=0).min() / RATE_HZ / quantum
    assert ratio == pytest.approx(0.95, abs=5.0 * math.sqrt(0.05 * 0.95 / counts) + 1e-3)
    assert (changed.speed <= wheels.speed + 1e-12).all()
    if changed.angle_rad is not None:
        steps = np.diff(changed.angle_rad, axis=0) * RATE_HZ
        assert steps == pytest.approx(changed.speed[1:], abs=1e-6)


def test_lost_counts_of_wheels_at_rest_are_none() -> None:
    still = dataclasses.replace(CIRCLE.wheels, speed=np.zeros_like(CIRCLE.wheels.speed))
    changed = lost_counts(dataclasses.replace(CIRCLE, wheels=still), HUSKY, 0.5)
    assert not changed.wheels.speed.any()


def test_late_channels_keep_their_values() -> None:
    fixes, imu = late_fixes(CIRCLE, HUSKY, 0.2), late_imu(CIRCLE, HUSKY, -0.1)
    assert (fixes.gnss.t_ns - CIRCLE.gnss.t_ns == 200_000_000).all()
    assert np.array_equal(fixes.gnss.enu_m, CIRCLE.gnss.enu_m)
    assert (imu.imu.t_ns - CIRCLE.imu.t_ns == -100_000_000).all()


@settings(deadline=None, max_examples=30)
@given(st.floats(-180.0, 180.0))
def test_a_turned_imu_reads_the_same_magnitude(angle_deg: float) -> None:
    changed = turned_imu(CIRCLE, HUSKY, angle_deg).imu
    assert np.hypot(*changed.accel_mps2[:, :2].T) == pytest.approx(np.hypot(*CIRCLE.imu.accel_mps2[:, :2].T))
    assert changed.accel_mps2[:, 2] == pytest.approx(CIRCLE.imu.accel_mps2[:, 2])
    back = turned_imu(dataclasses.replace(CIRCLE, imu=changed), HUSKY, -angle_deg).imu
    assert back.accel_mps2 == pytest.approx(CIRCLE.imu.accel_mps2)


def test_an_imu_turned_to_the_left_reads_forward_force_on_its_right() -> None:
    assert turned_imu(CIRCLE, HUSKY, 90.0).imu.accel_mps2[0, :2] == pytest.approx([0.2, -0.1])


def test_a_turned_imu_without_some_axes_keeps_the_others() -> None:
    gyro = CIRCLE.imu.gyro_radps.copy()
    gyro[:, :2] = np.nan
    log = dataclasses.replace(CIRCLE, imu=dataclasses.replace(CIRCLE.imu, gyro_radps=gyro))
    changed = turned_imu(log, HUSKY, 3.0).imu
    assert changed.gyro_radps[:, 2] == pytest.approx(gyro[:, 2])
    assert np.isnan(changed.gyro_radps[:, :2]).all()


def test_gyro_bias_is_of_yaw() -> None:
    added = biased_gyro(CIRCLE, HUSKY, 0.005).imu.gyro_radps - CIRCLE.imu.gyro_radps
    assert added == pytest.approx(np.tile([0.0, 0.0, 0.005], (len(added), 1)))


def test_a_moved_antenna_runs_on_a_wider_circle() -> None:
    """Moved forward by d, the antenna of a circling robot keeps sqrt(R^2 + d^2) from the centre."""
    changed = moved_antenna(CIRCLE, HUSKY, 0.5).gnss.enu_m
    centre = np.array([0.0, SPEED_MPS / TURN_RADPS])
    away = np.hypot(*(changed[:, :2] - centre).T)
    assert away == pytest.approx(math.hypot(SPEED_MPS / TURN_RADPS, 0.5), abs=0.02)
    assert np.hypot(*(changed - CIRCLE.gnss.enu_m)[:, :2].T) == pytest.approx(0.5)


@pytest.mark.parametrize("injection", INJECTIONS, ids=lambda i: i.name)
def test_a_log_without_the_channel_is_refused_in_one_line(injection) -> None:
    bare = dataclasses.replace(CIRCLE, **{injection.channel: None})
    with pytest.raises(DataError) as raised:
        injection.into(bare, HUSKY, 1.0)
    assert "\n" not in str(raised.value)


def test_poses_stand_in_for_gnss_only_where_there_are_some() -> None:
    with pytest.raises(DataError):
        pose_as_gnss(CIRCLE, 0.05)
    path = Trajectory(CIRCLE.gnss.t_ns, CIRCLE.gnss.enu_m)
    changed = pose_as_gnss(dataclasses.replace(CIRCLE, truth=path, truth_channels=("position",)), 0.05)
    assert changed.truth is None
    assert np.array_equal(changed.gnss.enu_m, path.position_m)


def answer(first: str, members: list[str], verdict: str = "effect", p: float = 0.01) -> dict:
    causes = [
        {"effect": first, "class": members, "parameters": {}},
        {
            "effect": "gyro_bias", "class": ["gyro_bias"],
            "parameters": {"gyro_bias/constant": {"value": 0.004, "sigma": 0.001, "unit": "rad/s"}},
        },
    ]  # fmt: skip
    gap = {"detected": p <= 0.05, "p_value": p}
    return {"gap": gap, "verdict": verdict, "causes": causes, "named": [first], "shrink": None}


GYRO = next(i for i in INJECTIONS if i.name == "gyro biased")


def test_right_answers() -> None:
    wrong = verdict_on(answer("mass", ["mass"]), GYRO)
    assert not wrong["right"]
    assert wrong["rank"] == 2
    assert wrong["estimate"] == pytest.approx([0.004, 0.001])
    assert verdict_on(answer("mass", ["mass", "gyro_bias"], "ambiguous"), GYRO)["right"]
    assert not verdict_on(answer("mass", ["mass", "gyro_bias"], "unknown"), GYRO)["right"]
    assert not verdict_on(answer("mass", ["gyro_bias"], "no_gap", p=0.5), GYRO)["right"]
    assert verdict_on(answer("mass", ["mass"], "no_gap", p=0.5), None)["right"]
    assert not verdict_on(answer("mass", ["mass"]), None)["right"]
    assert estimated({"parameters": {}}, GYRO) is None


def test_every_change_and_severity_is_a_case_once() -> None:
    found = [(i.name if i else None, s) for _, i, s, _ in cases(["x"])]
    assert (
        len([f for f in found if f[0]])
        == len(SEVERITIES) * len(INJECTIONS)
        == len({f for f in found if f[0]})
    )
    assert len([f for f in found if not f[0]]) == 4


def test_a_crash_is_a_wrong_answer_in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(*_: object, **__: object) -> None:
        raise ZeroDivisionError("x")

    monkeypatch.setattr("tests.studies.fault_injection.table.diagnose", crash)
    source = Source(HUSKY, [CIRCLE], [(0, 0.0, 20.0), (0, 20.0, 40.0)])
    row = answered(source, LOGS, GYRO, 1.0, 0)
    assert row["right"] is False
    assert "crash" in table([{"set": "x", "change": "y", "size": 1.0, **row}])[-1]


def test_sums_count_what_was_judged() -> None:
    def row(change: str, severity: float, **more: object) -> dict[str, object]:
        return {"set": "x", "change": change, "severity": severity, "size": 0.0, **more}

    rows = [
        row("unchanged", 0.0, verdict="no_gap", right=True),
        row("unchanged", 0.0, verdict="effect", right=False),
        row("GNSS late", 1.0, skipped="no GNSS"),
        row("gyro biased", 1.0, verdict="effect", rank=1, right=True),
        row("gyro biased", 1.0, verdict="no_gap", rank=3, right=False),
        row("gyro biased", 2.0, crash="ZeroDivisionError: x", right=False),
    ]
    lines = injections.sums(rows)
    assert lines[0] == "Alarms on unchanged segments: 1 of 2 (0.09 to 0.91)"
    assert "| `x` | 1 of 2 | 3 | 1 | 1 | 1; 2 | GNSS late |" in lines
    gyro = next(line for line in lines if line.startswith("| gyro biased"))
    assert gyro == "| gyro biased (0.005 rad/s) | 0, 0, 0 of 0 | 1, 1, 1 of 2 | 0, 0, 0 of 1 | 0, 0, 0 of 0 |"


def test_a_stopped_table_goes_on_and_rows_of_other_candidates_do_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counter = tmp_path / "asked"

    def answer(source, logs, injection, severity, fold, effects):
        with counter.open("a") as asked:
            asked.write(f"{severity:g} ")
        return {"skipped": "not tried"}

    monkeypatch.setattr(injections, "answered", answer)
    monkeypatch.setattr(injections, "SETS", {"one": None})
    monkeypatch.setattr(injections, "cases", lambda _: [("one", None, s, 0) for s in (1.0, 2.0)])
    monkeypatch.setattr(injections, "source_of", lambda _: None)
    one = TaskWorkers()
    injections.run(tmp_path, ["one"], (), one)
    injections.run(tmp_path, ["one"], (), one)
    assert counter.read_text() == "1 2 "
    next(p for p in (tmp_path / "parts").iterdir() if "2.0" in p.read_text()).unlink()
    injections.run(tmp_path, ["one"], (), None)
    assert counter.read_text() == "1 2 "
    injections.run(tmp_path, ["one"], (), one)
    assert counter.read_text() == "1 2 2 "
    injections.run(tmp_path, ["one"], ("mass",), one)
    assert counter.read_text() == "1 2 2 1 2 "


def test_unchanged_segments_can_be_judged_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(injections, "run_all", lambda tasks, *_: asked.extend(task.name for task in tasks))
    monkeypatch.setattr(injections, "SETS", {"one": None})
    injections.run(tmp_path, ["one"], (), TaskWorkers(), unchanged=True)
    assert asked == [f"one/None/0.0/{fold}" for fold in range(injections.FOLDS)]


def test_what_a_log_cannot_show_is_said() -> None:
    bare = dataclasses.replace(CIRCLE, gnss=None)
    late = next(i for i in INJECTIONS if i.name == "GNSS late")
    row = answered(Source(HUSKY, [bare], [(0, 0.0, 20.0)]), LOGS, late, 1.0, 0)
    assert "no GNSS" in row["skipped"]
    assert "cannot be judged" in table([{"set": "x", "change": "y", "size": 1.0, **row}])[-1]


@pytest.mark.skipif("TERRAFUSION_DATA" not in os.environ, reason="TERRAFUSION_DATA is not set: no field logs")
def test_a_left_wheel_scaled_in_a_real_log_is_named_with_its_size() -> None:
    whole = Source.of(LogSet(("husky_parkinglot/test1",), "husky", 20.0, "asphalt"))
    source = dataclasses.replace(whole, spans=whole.spans[:8])
    left = next(i for i in INJECTIONS if i.name == "left wheel scaled")
    runs, references = source.cut([1, 5], left, 1.0), source.cut([0, 2, 3, 4, 6, 7])
    few = ("gyro_bias", "gyro_scale", "wheel_radius", "wheel_radius_asymmetry", "soil_strength")
    found = diagnose(runs, references, source.vehicle, "asphalt", source="wheels", effects=few)
    told = verdict_on(found.to_json(), left)
    assert told["right"], told
    size, _ = told["estimate"]
    assert size == pytest.approx(0.03, abs=0.01)


def test_effective_track_of_a_made_drive() -> None:
    """Wheels that turn a track of 1.5 m: found to the noise, and better than 1.0 m on blocks left out."""
    rng = np.random.default_rng(1)
    rate = rng.normal(0.0, 0.5, (20, 10))
    blocks = [np.stack([1.5 * r + rng.normal(0.0, 0.02, 10), r], axis=1) for r in rate]
    found = effective_track(blocks, nominal_m=1.0)
    assert found.track_m == pytest.approx(1.5, abs=0.02)
    assert found.low_m < 1.5 < found.high_m
    assert found.effective_rms < 0.1 * found.nominal_rms


def test_effective_track_of_a_log_is_that_of_its_odometry() -> None:
    found = effective_track(blocks_of(CIRCLE, HUSKY), HUSKY.odometry.track_m)
    assert found.track_m == pytest.approx(HUSKY.odometry.track_m, rel=1e-6)
    assert blocks_of(dataclasses.replace(CIRCLE, imu=None), HUSKY) == []
