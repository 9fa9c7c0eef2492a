"""`terrafusion allan`: tables for a vehicle and for a log, and its errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from terrafusion.datasets.writers.log_folder import write_log_folder
from terrafusion.twin.analysis.allan import vehicle_at_rest
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, Scenario
from terrafusion.twin.simulate import simulate


def parked(folder: Path, seconds: float) -> Path:
    scenario = Scenario("parked", seconds, drive=(DriveSegment(seconds),))
    write_log_folder(simulate(scenario, seed=4), folder)
    return folder


def test_a_log_at_rest_shows_the_noise_of_its_imu(terrafusion, tmp_path: Path) -> None:
    done = terrafusion("allan", parked(tmp_path / "parked", 120.0))
    assert done.status == 0, done.err
    lines = done.out.splitlines()
    assert lines[0].startswith("parked: IMU, 120 s at 100.0 Hz")
    density = next(line for line in lines if line.startswith("  density: estimated "))
    spec = load_vehicle("elevate").sensors.imu
    assert float(density.split()[2]) == pytest.approx(spec.gyro_noise_radps_sqrthz, rel=0.1)


def test_a_vehicle_has_its_parameters_beside_it() -> None:
    lines = vehicle_at_rest("elevate", hours=0.2, seeds=1).lines()
    assert lines[0].startswith("elevate: IMU at rest, 0.2 h, 1 seeds x 3 axes")
    assert sum("specified" in line for line in lines) == 6


def test_one_line_errors(terrafusion, tmp_path: Path) -> None:
    assert terrafusion("allan", "nope").refused("nope")
    short = parked(tmp_path / "short", 5.0)
    assert terrafusion("allan", short).refused("too short for an Allan deviation", "at rest")
