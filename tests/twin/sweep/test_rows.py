"""The rows of a sweep: physics of the conditions, and what becomes of a run that fails."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.commands import DrivenStates
from terrafusion.twin.scenario.scenario import DriveSegment, Interval, Scenario
from terrafusion.twin.simulate import simulate_run
from terrafusion.twin.sweep import rows as rows_module
from terrafusion.twin.sweep.load import load_sweep
from terrafusion.twin.sweep.plan import Sweep
from terrafusion.twin.sweep.rows import DONE, FAILED, IMMOBILISED, Row, arguments, columns, results, run_chunk

DRIVE = """\
drive:
  - {duration_s: 3}
  - {duration_s: 9, v_mps: 1.0, yaw_rate_radps: YAW}
"""


def sweep_of(folder: Path, axes: str, more: str = "", yaw: float = 0.0) -> Sweep:
    (folder / "drive.yaml").write_text(DRIVE.replace("YAW", str(yaw)))
    (folder / "own.yaml").write_text(f"scenario: drive.yaml\naxes: {axes}\n{more}")
    return load_sweep(folder / "own.yaml")


def all_rows(sweep: Sweep) -> list[Row]:
    return run_chunk(sweep, list(sweep.cases()))


def column(found: list[Row], name: str) -> np.ndarray:
    return np.array([np.nan if row[name] is None else row[name] for row in found], dtype=float)


def test_a_row_is_what_simulate_run_says_of_the_same_conditions(tmp_path: Path) -> None:
    sweep = sweep_of(
        tmp_path,
        "{terrain: [loose_sand], friction: [0.5], slope_deg: [4], payload_kg: [5], speed_scale: [0.8]}",
    )
    (case,) = sweep.cases()
    (row,) = all_rows(sweep)
    summary = dataclasses.asdict(simulate_run(**arguments(sweep, case)).summary)
    shared = summary.keys() & row.keys()
    assert len(shared) >= 14
    assert {name: row[name] for name in shared} == {name: summary[name] for name in shared}
    assert (row["terrain"], row["friction"], row["slope_deg"]) == ("loose_sand", 0.5, 4.0)
    assert (row["payload_kg"], row["speed_scale"], row["speed_mps"]) == (5.0, 0.8, 0.8)
    assert row["mean_power_w"] == summary["energy_j"] / summary["duration_s"]
    assert tuple(row) == tuple(c.name for c in columns(sensors=False))


def test_more_friction_never_slips_more_and_never_gets_less_far(tmp_path: Path) -> None:
    found = all_rows(
        sweep_of(tmp_path, "{terrain: [medium_sand], friction: [0.3, 0.4, 0.6, 1.0], slope_deg: [8]}")
    )
    assert (np.diff(column(found, "mean_slip_ratio")) < 0.0).all()
    assert (np.diff(column(found, "travel_m")) > 0.0).all()


def test_slope_and_payload_cost_energy_a_metre(tmp_path: Path) -> None:
    found = all_rows(
        sweep_of(tmp_path, "{terrain: [medium_sand], slope_deg: [0, 4, 8], payload_kg: [0, 20]}")
    )
    energy = column(found, "energy_per_m_j").reshape(3, 2)
    assert (np.diff(energy, axis=0) > 0.0).all()
    assert (np.diff(energy, axis=1) > 0.0).all()
    weight_n = 9.80665 * (32.0 + np.array([0.0, 20.0]))
    climbed = weight_n * np.sin(np.radians([[0.0], [4.0], [8.0]]))
    assert (energy > climbed).all()  # at least the work against gravity


def test_no_ground_carries_a_robot_up_a_slope_steeper_than_its_friction(tmp_path: Path) -> None:
    grounds = "[asphalt, medium_sand, loose_sand]"
    found = all_rows(sweep_of(tmp_path, f"{{terrain: {grounds}, friction: [0.2, 0.3], slope_deg: [18, 22]}}"))
    assert len(found) == 12
    for row in found:
        assert np.tan(np.radians(row["slope_deg"])) > row["friction"]  # type: ignore[operator]
        assert row["status"] != DONE
        assert row["travel_ratio"] < 0.1  # type: ignore[operator]


def test_a_robot_without_drive_on_the_flat_is_immobilised_from_the_start(tmp_path: Path) -> None:
    (tmp_path / "drive.yaml").write_text("drive: [{duration_s: 10, v_mps: 1.0}]\n")
    (tmp_path / "own.yaml").write_text(
        "scenario: drive.yaml\naxes: {terrain: [loose_sand], friction: [0.01]}\n"
    )
    (row,) = all_rows(load_sweep(tmp_path / "own.yaml"))
    assert row["status"] == IMMOBILISED
    assert row["mean_abs_slip"] is None
    assert row["immobilised_at_s"] == pytest.approx(0.0, abs=0.5)


def test_odometry_turns_more_than_a_skidding_robot_and_equally_both_ways(tmp_path: Path) -> None:
    left = all_rows(sweep_of(tmp_path, "{terrain: [asphalt, loose_sand]}", yaw=0.3))
    right = all_rows(sweep_of(tmp_path, "{terrain: [asphalt, loose_sand]}", yaw=-0.3))
    straight = all_rows(sweep_of(tmp_path, "{terrain: [asphalt]}"))
    errors = column(left, "yaw_error_rad")
    assert (errors > 0.01).all()
    np.testing.assert_allclose(column(right, "yaw_error_rad"), -errors, rtol=1e-6)
    assert abs(column(straight, "yaw_error_rad")[0]) < 1e-9


def test_odometry_of_a_steered_robot_turns_as_its_rear_wheels_do() -> None:
    """Front wheels roll further in curves: in a circle on asphalt the heading was .26 rad off."""
    elevate = load_vehicle("elevate")
    scenario = Scenario("circle", 20.0, drive=(DriveSegment(20.0, v_mps=1.0, yaw_rate_radps=0.3),))
    errors = {}
    for drive in ("ackermann", "four_wheel_steer"):
        steered = dataclasses.replace(
            elevate,
            drive=dataclasses.replace(elevate.drive, type=drive),
            body=dataclasses.replace(elevate.body, wheelbase_m=1.5),
        )
        setup = set_up(scenario, vehicle=steered)
        errors[drive] = results(setup, setup.drive())["yaw_error_rad"]
    assert errors["ackermann"] == pytest.approx(0.0, abs=0.02)
    assert errors["four_wheel_steer"] is None


def test_seeds_change_sensors_only(tmp_path: Path) -> None:
    found = all_rows(sweep_of(tmp_path, "{terrain: [medium_sand], seed: [1, 2]}", "sensors: true\n"))
    assert found[0]["travel_m"] == found[1]["travel_m"]
    for name in ("odometry_error_pct", "imu_error_pct", "gnss_error_pct"):
        first, second = (float(row[name]) for row in found)  # type: ignore[arg-type]
        assert first != second
        assert min(first, second) > 0.0
    without = all_rows(sweep_of(tmp_path, "{terrain: [medium_sand], seed: [1]}"))
    assert without[0]["energy_j"] == found[0]["energy_j"]


@pytest.mark.parametrize("lost_s", [15.0, 9.5])
def test_a_run_without_fixes_has_its_other_results(tmp_path: Path, lost_s: float) -> None:
    sweep = sweep_of(tmp_path, "{terrain: [medium_sand]}", "sensors: true\n")
    dark = dataclasses.replace(sweep.scenario, gnss_outages=(Interval(0.0, lost_s),))
    (row,) = all_rows(dataclasses.replace(sweep, scenario=dark))
    assert row["status"] == DONE
    assert row["odometry_error_pct"] is not None
    assert (row["gnss_error_pct"] is None) == (lost_s > 12.0)


def test_a_run_that_fails_is_a_row_that_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_setup_at_6_deg(*args: Any, **kw: Any) -> Any:
        if kw["slope_deg"] == 6.0:
            raise ZeroDivisionError("float division by zero")
        return original_setup(*args, **kw)

    def second_diverges(*args: Any, **kw: Any) -> Any:
        motions = original(*args, **kw)
        if kw.get("t0_s", 0.0) == 0.0:
            motions[1][100:] = np.nan
        return motions

    original_setup, original = rows_module.set_up, rows_module.integrate_many
    monkeypatch.setattr(rows_module, "set_up", no_setup_at_6_deg)
    monkeypatch.setattr(rows_module, "integrate_many", second_diverges)
    found = all_rows(sweep_of(tmp_path, "{terrain: [asphalt], slope_deg: [0, 6, 5, 4]}"))
    assert [row["status"] for row in found] == [DONE, FAILED, FAILED, DONE]
    assert found[1]["error"] == "ZeroDivisionError: float division by zero"
    assert str(found[2]["error"]).startswith("t = 1.000 s: the simulation diverged")
    assert found[2]["distance_m"] is None
    assert found[2]["slope_deg"] == 5.0
    assert found[0]["error"] is None


def test_where_driving_together_fails_each_run_is_driven_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_memory(*args: Any, **kw: Any) -> Any:
        raise MemoryError

    sweep = sweep_of(tmp_path, "{terrain: [asphalt], slope_deg: [0, 5]}")
    together = all_rows(sweep)
    monkeypatch.setattr(rows_module, "integrate_many", out_of_memory)
    assert all_rows(sweep) == together


@pytest.mark.parametrize("scenario", ["straight", "mixed_terrain", "figure_eight", "waypoints"])
def test_runs_side_by_side_are_the_runs_one_by_one(scenario: str, tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(
        f"scenario: {scenario}\nrandom: 5\n"
        "axes: {friction: {from: 0.4, to: 1.0}, slope_deg: {from: 0, to: 8}, payload_kg: {from: 0, to: 60}, "
        "speed_scale: {from: 0.5, to: 1.2}}\n"
    )
    sweep = load_sweep(tmp_path / "own.yaml")
    sweep = dataclasses.replace(sweep, scenario=dataclasses.replace(sweep.scenario, duration_s=12.0))
    setups = [set_up(**arguments(sweep, case)) for case in sweep.cases()]
    for setup, found in zip(setups, rows_module.drive_many(setups), strict=True):
        assert isinstance(found, DrivenStates)
        alone = setup.drive()
        np.testing.assert_array_equal(found.commanded, alone.commanded)
        np.testing.assert_allclose(found.states, alone.states, rtol=1e-9, atol=1e-12)
