"""Barometer and magnetometer: log folder, bags, and their log checks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.checks import repair, run_checks
from terrafusion.datasets.checks.environment import circle
from terrafusion.datasets.checks.summary import summarise
from terrafusion.datasets.core.channels import Barometer, Imu, Magnetometer
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_log_folder, write_mcap
from tests.datasets.ros_bags import MAKE1, MAKE2, T0, Make, Message, imu_messages, write_ros1, write_ros2
from tests.differences import differences

HORIZONTAL_T, VERTICAL_T = 19.1e-6, -45.7e-6


def turning(offset_t: tuple[float, float] = (0.0, 0.0), turns: float = 2.0) -> Recording:
    """A robot that turns on the spot: field of Germany, pressure of 100 m."""
    t_ns = 10**18 + np.arange(400) * 50_000_000
    yaw = np.linspace(0.0, 2.0 * np.pi * turns, 400)
    body = HORIZONTAL_T * np.stack([np.sin(yaw), np.cos(yaw)], axis=1) + offset_t  # magnetic north along +y
    field = np.column_stack([body, np.full(400, VERTICAL_T)])
    field += np.random.default_rng(0).normal(0.0, 5e-8, field.shape)
    pressure = 100_130.0 + np.random.default_rng(1).normal(0.0, 3.6, 400)
    return Recording(
        "turning", 10**18, barometer=Barometer(t_ns, pressure), magnetometer=Magnetometer(t_ns, field)
    )


def codes(recording: Recording) -> list[str]:
    return [finding.code for finding in run_checks(recording)]


def test_the_log_folder_has_a_file_for_each(tmp_path: Path) -> None:
    recording = turning()
    folder = write_log_folder(recording, tmp_path / "log")
    assert {p.name for p in folder.iterdir()} == {"meta.yaml", "barometer.csv", "magnetometer.csv"}
    assert (folder / "barometer.csv").read_text().startswith("t_s,pressure_pa\n0.000000000,")
    assert (folder / "magnetometer.csv").read_text().startswith("t_s,field_x_t,field_y_t,field_z_t\n")
    assert differences(open_recording(folder), recording) == []


@pytest.mark.parametrize(
    ("file", "text", "word"),
    [
        ("barometer.csv", "t_s,altitude_m\n0,100\n", "altitude_m"),
        ("magnetometer.csv", "t_s,field_x_t,field_y_t\n0,1e-5,1e-5\n", "field_z_t"),
        ("magnetometer.csv", "t_s,field_x_t,field_y_t,field_z_t\n0,1e-5,x,1e-5\n", "field_y_t"),
    ],
)
def test_a_broken_file_is_refused(tmp_path: Path, file: str, text: str, word: str) -> None:
    folder = write_log_folder(turning(), tmp_path / "log")
    (folder / file).write_text(text)
    with pytest.raises(DataError, match=word):
        open_recording(folder)


def bag_messages(make: Make, pressures: list[float], frame: str) -> list[Message]:
    out = imu_messages(make, n=len(pressures), frame=frame)
    for i, p in enumerate(pressures):
        t = T0 + i * 50_000_000
        header = make.header(t, frame)
        kind = "sensor_msgs/msg/FluidPressure"
        out.append(("/imu/pressure", kind, t, make.new(kind, header, p, 0.0)))
        field = make.vector(1e-5, 2e-5, 3e-5)
        kind = "sensor_msgs/msg/MagneticField"
        out.append(("/imu/mag", kind, t, make.new(kind, header, field, np.zeros(9))))
    return out


@pytest.mark.parametrize("ros", [1, 2])
def test_bags(tmp_path: Path, ros: int, husky_rig: Rig) -> None:
    """Both types of message are read; the field turns with the IMU; what is no number is left out."""
    pressures = [101_325.0, float("nan"), 101_300.0]
    make = MAKE1 if ros == 1 else MAKE2
    messages = bag_messages(make, pressures, "imu_link")
    path = write_ros1(tmp_path / "a.bag", messages) if ros == 1 else write_ros2(tmp_path / "a", messages)
    recording = open_recording(path, rig=husky_rig)
    assert recording.barometer is not None
    assert recording.magnetometer is not None
    assert recording.barometer.pressure_pa.tolist() == [101_325.0, 101_300.0]
    assert recording.magnetometer.field_t.tolist() == [[-3e-5, -1e-5, 2e-5]] * 3
    assert any("1 of 3 messages of /imu/pressure hold no number" in note for note in recording.notes)
    assert "magnetometer /imu/mag" in recording.source


def test_the_mcap_holds_standard_messages(tmp_path: Path) -> None:
    recording = turning()
    assert write_mcap(recording, tmp_path / "a.mcap") == ()
    assert differences(open_recording(tmp_path / "a.mcap"), recording) == []
    plain = open_recording(tmp_path / "a.mcap", topics={"mag": "/imu/mag", "pressure": "/pressure"})
    for name in ("barometer", "magnetometer"):
        assert differences(getattr(plain, name), getattr(recording, name)) == []


def test_a_field_is_as_long_as_its_clock() -> None:
    with pytest.raises(ValueError, match="not \\(2, 3\\)"):
        Magnetometer(np.array([0, 1]), np.zeros((2, 2)))


def test_inspect_shows_them() -> None:
    from terrafusion.datasets.checks.measures import measure

    recording = turning()
    page = summarise(recording, measure([recording]), [])
    assert page["channels"]["barometer"]["samples"] == 400
    assert page["channels"]["magnetometer"]["ranges"].keys() == {"field_x_t", "field_y_t", "field_z_t"}
    low, high = page["channels"]["barometer"]["ranges"]["pressure_pa"]
    assert 100_110.0 < low < high < 100_150.0


def test_a_sound_log_has_no_finding() -> None:
    assert codes(turning()) == []


@pytest.mark.parametrize(("name", "factor"), [("hPa", 1e-2), ("kPa", 1e-3)])
def test_pressure_units_are_found_and_repaired(name: str, factor: float) -> None:
    good = turning()
    assert good.barometer is not None
    corrupted = dataclasses.replace(
        good, barometer=Barometer(good.barometer.t_ns, good.barometer.pressure_pa * factor)
    )
    [finding] = run_checks(corrupted)
    assert (finding.code, finding.severity) == ("pressure-unit", "warning")
    assert finding.what == f"the pressure looks like {name}, not Pa"
    repaired, _ = repair(corrupted)
    assert repaired.barometer is not None
    np.testing.assert_allclose(repaired.barometer.pressure_pa, good.barometer.pressure_pa, rtol=1e-12)
    assert codes(repaired) == []


@pytest.mark.parametrize(
    ("name", "factor"), [("uT", 1e6), ("gauss", 1e4), ("milligauss", 1e7), ("nT", 1e9), ("", 1.0 / 49.5e-6)]
)
def test_field_units_are_found_and_repaired(name: str, factor: float) -> None:
    """A field divided by its own size (Xsens) cannot be repaired: only its direction is left."""
    good = turning()
    assert good.magnetometer is not None
    own = good.magnetometer
    corrupted = dataclasses.replace(good, magnetometer=Magnetometer(own.t_ns, own.field_t * factor))
    [finding] = run_checks(corrupted)
    assert (finding.code, finding.severity) == ("field-unit", "warning")
    if not name:
        assert finding.repair is None
        assert "only its direction" in finding.fix
        return
    assert finding.what == f"the field looks like {name}, not T"
    repaired, _ = repair(corrupted)
    assert repaired.magnetometer is not None
    np.testing.assert_allclose(repaired.magnetometer.field_t, own.field_t, rtol=1e-12)


def test_single_pressures_are_left_out() -> None:
    good = turning()
    assert good.barometer is not None
    p = good.barometer.pressure_pa.copy()
    p[7] = 0.0
    corrupted = dataclasses.replace(good, barometer=Barometer(good.barometer.t_ns, p))
    assert codes(corrupted) == ["pressure-range"]
    repaired, _ = repair(corrupted)
    assert repaired.barometer is not None
    assert len(repaired.barometer) == 399


def test_hard_iron_is_found_and_taken_off() -> None:
    corrupted = turning(offset_t=(6e-6, -3e-6))
    [finding] = run_checks(corrupted)
    assert finding.code == "hard-iron"
    assert "up to 21 deg" in finding.what  # asin(6.71 / 19.1) = 20.6 deg
    repaired, _ = repair(corrupted)
    assert repaired.magnetometer is not None
    good = turning().magnetometer
    assert good is not None
    np.testing.assert_allclose(repaired.magnetometer.field_t, good.field_t, atol=2e-8)


def test_without_a_full_turn_there_is_no_offset_finding() -> None:
    """Half a turn about an offset is also a part of some other circle: no guess."""
    assert codes(turning(offset_t=(6e-6, -3e-6), turns=0.5)) == []


def test_circle_is_exact_and_refuses_what_is_none() -> None:
    angle = np.linspace(-np.pi, np.pi, 50)
    points = np.stack([3.0 + 2.0 * np.cos(angle), -1.0 + 2.0 * np.sin(angle)], axis=1)
    found = circle(points)
    assert found is not None
    assert found[0] == pytest.approx([3.0, -1.0], abs=1e-12)
    assert found[1] == pytest.approx(2.0, abs=1e-12)
    assert circle(np.zeros((50, 2))) is None
    assert circle(np.stack([angle, angle], axis=1)) is None
    assert circle(points[:10]) is None


def test_a_nan_field_is_no_finding() -> None:
    t = np.arange(30) * 10**8
    recording = Recording(
        "nan",
        0,
        imu=Imu(t, np.zeros((30, 3)), np.tile([0.0, 0.0, 9.81], (30, 1))),
        barometer=Barometer(t, np.full(30, np.nan)),
        magnetometer=Magnetometer(t, np.full((30, 3), np.nan)),
    )
    assert not {"pressure-unit", "field-unit", "hard-iron"} & set(codes(recording))
