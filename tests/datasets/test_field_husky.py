"""The public husky and jackal bags: mounting, signs and counts, checked against physics."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from terrafusion.datasets.doctor import examine
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.recording import Fix, Recording
from terrafusion.datasets.sensors import Rig
from terrafusion.datasets.writers import write_log_folder


def yaw_correlation(recording: Recording, track_m: float) -> float:
    """Correlation of gyro z (averaged over 0.5 s) with the wheels' yaw rate."""
    wheels, imu = recording.wheels, recording.imu
    assert wheels is not None
    assert imu is not None
    sides = wheels.side_speeds_mps(1.0)
    t = np.arange(wheels.t_ns[0], wheels.t_ns[-1], 5 * 10**8)
    rates = []
    for times, rate in (
        (wheels.t_ns, (sides[:, 1] - sides[:, 0]) / track_m),
        (imu.t_ns, imu.gyro_radps[:, 2]),
    ):
        angle = np.cumsum(rate * np.gradient(times * 1e-9))
        rates.append(np.diff(np.interp(t, times, angle)))
    return float(np.corrcoef(rates)[0, 1])


def test_husky_counts_and_span(field_logs: Path, husky_rig: Rig) -> None:
    recording = open_recording(field_logs / "test1.bag", rig=husky_rig)
    counts = {name: len(channel) for name, channel in recording.channels().items()}
    assert counts == {"imu": 11865, "wheels": 3952, "gnss": 989}
    assert 395.0 < recording.duration_s() < 396.0
    assert recording.gnss is not None
    assert set(recording.gnss.fix.tolist()) == {Fix.DGPS}
    assert recording.datum is not None
    assert abs(recording.datum[0] - 42.3758) < 1e-3


def test_husky_mounting(field_logs: Path, husky_rig: Rig) -> None:
    recording = open_recording(field_logs / "test1.bag", rig=husky_rig)
    assert recording.imu is not None
    mean = recording.imu.accel_mps2.mean(axis=0)
    assert abs(mean[2] - 9.8) < 0.1
    assert np.abs(mean[:2]).max() < 0.5
    assert yaw_correlation(recording, husky_rig.track_m) > 0.8
    assert examine(recording, husky_rig) == []


def test_a_flipped_husky_gyro_is_found(field_logs: Path, husky_rig: Rig) -> None:
    flipped = dataclasses.replace(husky_rig.sensors.imu, axes=("-z", "+x", "-y"))
    rig = dataclasses.replace(husky_rig, sensors=dataclasses.replace(husky_rig.sensors, imu=flipped))
    recording = open_recording(field_logs / "test1.bag", rig=rig)
    assert yaw_correlation(recording, husky_rig.track_m) < -0.8
    errors = [f.what for f in examine(recording, rig) if f.severity == "error"]
    assert any("against the wheels" in what for what in errors)
    assert any("gravity" in what for what in errors)


def test_husky_without_vehicle_is_diagnosed(field_logs: Path) -> None:
    findings = examine(open_recording(field_logs / "test1.bag"))
    assert next((f.severity, f.what) for f in findings) == ("error", "gravity stands on +y, not on +z")


def test_jackal(field_logs: Path, husky_rig: Rig) -> None:
    recording = open_recording(field_logs / "test2.bag", rig=husky_rig)
    counts = {name: len(channel) for name, channel in recording.channels().items()}
    assert counts == {"imu": 3061, "wheels": 3060}
    assert recording.imu is not None
    assert abs(recording.imu.accel_mps2[:, 2].mean() - 9.8) < 0.1
    assert any("not rotated" in note for note in recording.notes)


def test_bag_to_folder_keeps_every_bit(field_logs: Path, husky_rig: Rig, tmp_path: Path) -> None:
    recording = open_recording(field_logs / "test1.bag", rig=husky_rig)
    back = open_recording(write_log_folder(recording, tmp_path / "husky"))
    for name, channel in recording.channels().items():
        other = back.channels()[name]
        np.testing.assert_array_equal(channel.t_ns, other.t_ns)
        for column, values in channel.columns().items():
            np.testing.assert_array_equal(values, other.columns()[column])
    assert back.datum == recording.datum
