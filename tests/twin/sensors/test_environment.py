"""Barometer and magnetometer of the twin: absent unless asked for, exact when noiseless."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import terrafusion.twin.params
from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.atmosphere import height_of, height_per_pa, pressure_at
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import BarometerSpec, MagnetometerSpec
from terrafusion.twin.model.sensor_realism import BarometerRealism, MagnetometerRealism
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.run_recording import DATUM
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.sensors.environment import DECLINATION_RAD, FIELD_SIZE_T, earth_field_t
from terrafusion.twin.simulate import simulate
from tests.differences import differences

CIRCLE = Scenario("circle", 60.0, drive=(DriveSegment(60.0, 1.0, 0.2),), route=(RouteLeg("asphalt"),))


BAROMETER = BarometerSpec(10.0, 3.6, 0.2, (0.1, 0.0, 0.3))
MAGNETOMETER = MagnetometerSpec(50.0, 5e-8, 1e-6)
CALM, NO_IRON = BarometerRealism(), MagnetometerRealism()


def aided(
    barometer: BarometerSpec = BAROMETER,
    magnetometer: MagnetometerSpec = MAGNETOMETER,
    weather: BarometerRealism = CALM,
    iron: MagnetometerRealism = NO_IRON,
) -> VehicleParams:
    elevate = load_vehicle("elevate")
    return dataclasses.replace(
        elevate,
        sensors=dataclasses.replace(elevate.sensors, barometer=barometer, magnetometer=magnetometer),
        realism=dataclasses.replace(elevate.realism, barometer=weather, magnetometer=iron),
    )


@pytest.mark.parametrize(
    ("height_m", "pressure_pa"),
    [(0.0, 101_325.0), (1000.0, 89_874.6), (5000.0, 54_019.9), (11_000.0, 22_632.06)],
)
def test_the_standard_atmosphere_is_that_of_the_table(height_m: float, pressure_pa: float) -> None:
    """US Standard Atmosphere 1976, table I (geopotential heights)."""
    assert pressure_at(height_m) == pytest.approx(pressure_pa, rel=2e-6)


@given(st.floats(-500.0, 10_000.0))
def test_height_and_pressure_are_inverse_and_their_derivative_is_right(height_m: float) -> None:
    p = pressure_at(height_m)
    assert height_of(p) == pytest.approx(height_m, abs=1e-7)
    slope = (height_of(p + 1.0) - height_of(p - 1.0)) / 2.0
    assert height_per_pa(p) == pytest.approx(slope, rel=1e-6)


def test_they_are_absent_unless_the_vehicle_has_them() -> None:
    recording = simulate(CIRCLE, seed=3)
    assert recording.barometer is None
    assert recording.magnetometer is None


def test_they_change_no_other_channel() -> None:
    plain, more = simulate(CIRCLE, seed=3), simulate(CIRCLE, vehicle=aided(), seed=3)
    assert set(differences(plain, more)) <= {"barometer", "magnetometer", "notes"}
    again = simulate(CIRCLE, vehicle=aided(), seed=3)
    assert differences(more, again) == []
    other = simulate(CIRCLE, vehicle=aided(), seed=4)
    assert {"barometer.pressure_pa", "magnetometer.field_t"} <= set(differences(more, other))


def rotations(recording: Recording, t_ns: np.ndarray) -> np.ndarray:
    assert recording.truth is not None
    assert recording.truth.quaternion is not None
    rows = np.searchsorted(recording.truth.t_ns, t_ns)
    return np.asarray(quaternion_to_matrix(recording.truth.quaternion[rows]))


def test_noiseless_pressure_is_that_of_the_sensors_height() -> None:
    """Up a slope of 10 deg: the lever arm swings with the body."""
    drive = simulate(CIRCLE, vehicle=aided(), slope_deg=10.0, noiseless=True)
    assert drive.barometer is not None
    assert drive.truth is not None
    rows = np.searchsorted(drive.truth.t_ns, drive.barometer.t_ns)
    lever = rotations(drive, drive.barometer.t_ns) @ np.array([0.1, 0.0, 0.3])
    height = drive.truth.position_m[rows, 2] + lever[:, 2]
    assert np.ptp(height) > 0.5
    np.testing.assert_allclose(height_of(drive.barometer.pressure_pa) - DATUM[2], height, atol=1e-7)


def test_noiseless_field_is_earths_and_tells_the_heading() -> None:
    drive = simulate(CIRCLE, vehicle=aided(), slope_deg=10.0, noiseless=True)
    assert drive.magnetometer is not None
    field = drive.magnetometer.field_t
    np.testing.assert_allclose(np.linalg.norm(field, axis=1), FIELD_SIZE_T, rtol=1e-12)
    world = np.einsum("nij,nj->ni", rotations(drive, drive.magnetometer.t_ns), field)
    north = np.arctan2(world[:, 0], world[:, 1])
    np.testing.assert_allclose(north, DECLINATION_RAD, atol=1e-9)
    assert earth_field_t()[2] < 0.0, "the field points down on the northern half of the Earth"


def test_pressure_noise_is_as_stated() -> None:
    spec = BarometerSpec(50.0, 3.6, 0.5, (0.0, 0.0, 0.0))
    parked = Scenario("parked", 400.0, drive=(DriveSegment(400.0),), route=(RouteLeg("asphalt"),))
    pressure = simulate(parked, vehicle=aided(spec), seed=1).barometer.pressure_pa
    lag = 50 * 10
    short, long = np.diff(pressure), pressure[lag:] - pressure[:-lag]
    assert short.std() / np.sqrt(2.0) == pytest.approx(3.6, rel=0.02)
    walk = np.sqrt(max(long.var() - 2.0 * 3.6**2, 0.0) / 10.0)
    assert walk == pytest.approx(0.5, rel=0.35)  # 40 independent stretches of 10 s


def test_the_weather_differs_from_run_to_run() -> None:
    spec = BarometerSpec(10.0, 0.0, 0.0, (0.0, 0.0, 0.0))
    car = aided(spec, weather=BarometerRealism(500.0, 0.03))
    offsets, trends = [], []
    for seed in range(12):
        p = simulate(CIRCLE, vehicle=car, seed=seed).barometer.pressure_pa
        offsets.append(p[0] - pressure_at(DATUM[2]))
        trends.append((p[-1] - p[0]) / 60.0)
    assert 250.0 < np.std(offsets) < 900.0
    assert 0.015 < np.std(trends) < 0.055


def test_iron_is_as_stated() -> None:
    """Norm of the field over a turn: constant without iron, a circle off centre with it."""
    clean = simulate(CIRCLE, vehicle=aided(magnetometer=MagnetometerSpec(50.0, 5e-8, 0.0)), seed=0)
    assert np.std(np.linalg.norm(clean.magnetometer.field_t, axis=1)) == pytest.approx(5e-8, rel=0.1)
    hard = [
        simulate(CIRCLE, vehicle=aided(magnetometer=MagnetometerSpec(50.0, 0.0, 3e-6)), seed=s)
        for s in range(8)
    ]
    middle = [0.5 * (m.min(axis=0) + m.max(axis=0))[:2] for m in (d.magnetometer.field_t for d in hard)]
    assert 1.5e-6 < np.std(middle) < 4.5e-6
    assert any("hard-iron" in [f.code for f in run_checks(d)] for d in hard)


def test_disturbances_belong_to_the_place() -> None:
    """There and back on one line: the field at a place comes again, and its spread is as stated."""
    spec = MagnetometerSpec(50.0, 0.0, 0.0)
    car = aided(magnetometer=spec, iron=MagnetometerRealism(disturbance_t=2e-6, disturbance_length_m=1.0))
    legs = (DriveSegment(30.0, 1.0), DriveSegment(30.0, -1.0))
    line = Scenario("line", 60.0, drive=legs, route=(RouteLeg("asphalt"),))
    spread, repeat = [], []
    for seed in range(4):
        drive = simulate(line, vehicle=car, seed=seed)
        world = np.einsum("nij,nj->ni", rotations(drive, drive.magnetometer.t_ns), drive.magnetometer.field_t)
        disturbance = world - earth_field_t()
        spread.append(disturbance.std())
        rows = np.searchsorted(drive.truth.t_ns, drive.magnetometer.t_ns)
        xy = drive.truth.position_m[rows, :2]
        half = len(xy) // 2
        nearest = np.argmin(np.linalg.norm(xy[half:, None] - xy[None, :half], axis=2), axis=1)
        repeat.append(np.abs(disturbance[half:] - disturbance[:half][nearest]).mean())
    assert np.mean(spread) == pytest.approx(2e-6, rel=0.4)
    assert np.mean(repeat) < 0.2 * np.mean(spread)


SECTIONS = """
  barometer:
    rate_hz: {value: 10, source: "MTi-300 data sheet"}
    noise_pa: {value: 3.6, source: "MTi-300 data sheet: total RMS noise"}
    walk_paps_sqrthz: {value: 0.2, source: "assumed"}
    position_m: {value: [0, 0, 0.2], source: "assumed"}
realism:
"""


def test_the_vehicle_file_may_have_them(tmp_path: Path) -> None:
    folder = Path(terrafusion.twin.params.__path__[0])
    text = (folder / "vehicles" / "elevate.yaml").read_text(encoding="utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace("\nrealism:\n", SECTIONS))
    assert load_vehicle(path).sensors.barometer == BarometerSpec(10.0, 3.6, 0.2, (0.0, 0.0, 0.2))
    path.write_text(text.replace("\nrealism:\n", SECTIONS.replace("noise_pa", "noise_hpa")))
    with pytest.raises(ConfigError, match="noise_pa"):
        load_vehicle(path)
