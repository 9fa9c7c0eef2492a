"""The public husky and jackal bags: mounting, signs and counts, checked against physics."""

from __future__ import annotations

import dataclasses
import functools
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.checks.measures import measure
from terrafusion.datasets.core.channels import Fix, Imu
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.sensors import AXES, Rig, axes_matrix
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_log_folder
from tests.differences import differences

TRACK_M = 0.555
HUSKY_AXES = ("-z", "-x", "+y")


@functools.cache
def catalogued(bag: Path) -> Recording:
    """The bag as the catalogue has it, read once."""
    return open_recording(bag)


def mountings() -> list[tuple[str, ...]]:
    """All 24 ways to mount a sensor along the body's axes."""
    named = [tuple(s + a for s, a in zip(signs, order, strict=True))
             for order in permutations("xyz") for signs in product("+-", repeat=3)]  # fmt: skip
    return [axes for axes in named if np.linalg.det([AXES[a] for a in axes]) > 0]


def means(t_ns: np.ndarray, values: np.ndarray, edges_ns: np.ndarray) -> np.ndarray:
    """Means of a signal between the edges."""
    t, edges = (t_ns - edges_ns[0]) * 1e-9, (edges_ns - edges_ns[0]) * 1e-9
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t))])
    return np.diff(np.interp(edges, t, area)) / np.diff(edges)


def fits(recording: Recording) -> dict[str, float]:
    """The IMU against gravity and the wheels: positive where its axes are the body's.

    Means of half a second: gravity on z (share of g), gyro z with the wheels' yaw rate, x with the change
    of the wheels' speed, y with speed times yaw rate (correlations).
    """
    wheels, imu = recording.wheels, recording.imu
    assert wheels is not None
    assert imu is not None
    sides = wheels.side_speeds_mps(1.0)
    edges = np.arange(max(wheels.t_ns[0], imu.t_ns[0]), min(wheels.t_ns[-1], imu.t_ns[-1]), 5 * 10**8)
    turn = means(wheels.t_ns, sides[:, 1] - sides[:, 0], edges)
    speed = means(wheels.t_ns, sides.mean(axis=1), edges)
    gain = np.diff(np.interp(edges, wheels.t_ns, sides.mean(axis=1))) / 0.5
    x, y = (means(imu.t_ns, imu.accel_mps2[:, k], edges) for k in range(2))
    rate = means(imu.t_ns, imu.gyro_radps[:, 2], edges)

    def r(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.corrcoef(a, b)[0, 1])

    return {
        "up": float(imu.accel_mps2[:, 2].mean()) / 9.8,
        "yaw": r(rate, turn),
        "ahead": r(x, gain),
        "aside": r(y, speed * rate),
    }


def remounted(recording: Recording, axes: tuple[str, ...], true_axes: tuple[str, ...]) -> Recording:
    """The recording as if its sensor, mounted by `true_axes`, were taken to be mounted by `axes`."""
    assert recording.imu is not None
    back = axes_matrix(true_axes)  # body = back @ sensor, so rows of body @ back are the sensor's
    imu = recording.imu
    raw = Imu(imu.t_ns, imu.gyro_radps @ back, imu.accel_mps2 @ back)
    return apply(dataclasses.replace(recording, imu=raw), Conventions(imu_axes=axes))


def unknown_copy(bag: Path, folder: Path) -> Path:
    """The same bag with other bytes, which the catalogue does not know: its header's padding is changed."""
    content = bag.read_bytes()
    spare = content.index(b"        ")
    copy = folder / bag.name
    copy.write_bytes(content[:spare] + b"\t" + content[spare + 1 :])
    return copy


def test_husky_counts_and_span(field_logs: Path, husky_rig: Rig) -> None:
    recording = open_recording(field_logs / "test1.bag", rig=husky_rig)
    counts = {name: len(channel) for name, channel in recording.channels().items()}
    assert counts == {"imu": 11865, "wheels": 3952, "gnss": 989}
    assert 395.0 < recording.duration_s() < 396.0
    assert recording.gnss is not None
    assert set(recording.gnss.fix.tolist()) == {Fix.DGPS}
    assert recording.datum is not None
    assert abs(recording.datum[0] - 42.3758) < 1e-3
    path = measure([recording]).path_m
    assert path["wheels"] == pytest.approx(358.9, abs=0.5)


def test_the_catalogue_mounts_the_imu_as_the_vehicle_file_does(field_logs: Path, husky_rig: Rig) -> None:
    """With the rig the reader turns the IMU, without it the catalogue does: the same bits either way."""
    by_rig = open_recording(field_logs / "test1.bag", rig=husky_rig)
    by_catalogue = open_recording(field_logs / "test1.bag")
    assert by_catalogue.vehicle == "husky"
    assert by_catalogue.overrides == Overrides(
        None, TRACK_M, (0.2475, 0.0, 0.2231), (0.2351, -0.0687, 0.1919)
    )
    assert by_catalogue.overrides == by_rig.overrides
    for name, channel in by_rig.channels().items():
        assert differences(channel, by_catalogue.channels()[name]) == []
    assert by_rig.imu is not None
    assert by_catalogue.imu is not None
    assert by_rig.imu.accel_mps2.tobytes() == by_catalogue.imu.accel_mps2.tobytes()
    assert by_rig.imu.gyro_radps.tobytes() == by_catalogue.imu.gyro_radps.tobytes()
    for recording in (by_rig, by_catalogue):
        assert sum("-z, -x, +y" in note for note in recording.notes) == 1
        assert not any("no vehicle given" in note for note in recording.notes)


@pytest.mark.parametrize("axes", mountings())
def test_one_mounting_alone_fits_the_husky(field_logs: Path, axes: tuple[str, ...]) -> None:
    recording = catalogued(field_logs / "test1.bag")
    found = fits(remounted(recording, axes, HUSKY_AXES))
    right = found["up"] > 0.9 and found["yaw"] > 0.8 and found["ahead"] > 0.2 and found["aside"] > 0.2
    assert right == (axes == HUSKY_AXES), found


@pytest.mark.parametrize("axes", mountings())
def test_the_jackals_imu_lies_along_the_body(field_logs: Path, axes: tuple[str, ...]) -> None:
    """The drive slips so much that the yaw rates agree by r 0.6 only; the other three are as clear."""
    recording = catalogued(field_logs / "test2.bag")
    found = fits(remounted(recording, axes, ("+x", "+y", "+z")))
    right = found["up"] > 0.9 and found["yaw"] > 0.4 and found["ahead"] > 0.2 and found["aside"] > 0.2
    assert right == (axes == ("+x", "+y", "+z")), found


def test_a_healthy_husky_has_no_errors(field_logs: Path, husky_rig: Rig) -> None:
    for recording in (
        open_recording(field_logs / "test1.bag", rig=husky_rig),
        open_recording(field_logs / "test1.bag"),
    ):
        assert [f for f in run_checks(recording, husky_rig) if f.severity == "error"] == []


def test_a_flipped_husky_gyro_is_found(field_logs: Path, husky_rig: Rig) -> None:
    flipped = dataclasses.replace(husky_rig.sensors.imu, axes=("-z", "+x", "-y"))
    rig = dataclasses.replace(husky_rig, sensors=dataclasses.replace(husky_rig.sensors, imu=flipped))
    recording = open_recording(field_logs / "test1.bag", rig=rig)
    assert fits(recording)["yaw"] < -0.8
    errors = {f.code for f in run_checks(recording, rig) if f.severity == "error"}
    assert errors


def test_an_unknown_husky_without_vehicle_is_diagnosed(field_logs: Path, tmp_path: Path) -> None:
    recording = open_recording(unknown_copy(field_logs / "test1.bag", tmp_path))
    assert recording.vehicle is None
    assert recording.overrides.track_m == 1.0
    assert any(f.severity == "error" and f.channel == "imu" for f in run_checks(recording))


def test_jackal(field_logs: Path, husky_rig: Rig) -> None:
    recording = open_recording(field_logs / "test2.bag", rig=husky_rig)
    counts = {name: len(channel) for name, channel in recording.channels().items()}
    assert counts == {"imu": 3061, "wheels": 3060}
    assert any("not rotated" in note for note in recording.notes)
    assert any("simulated" in note for note in recording.notes)
    assert recording.start_ns < 100 * 10**9  # simulation time, not the epoch
    assert recording.vehicle is None


def test_bag_to_folder_keeps_every_bit(field_logs: Path, husky_rig: Rig, tmp_path: Path) -> None:
    recording = open_recording(field_logs / "test1.bag", rig=husky_rig)
    back = open_recording(write_log_folder(recording, tmp_path / "husky"))
    for name, channel in recording.channels().items():
        other = back.channels()[name]
        np.testing.assert_array_equal(channel.t_ns, other.t_ns)
        for column, values in channel.columns().items():
            np.testing.assert_array_equal(values, other.columns()[column])
    assert back.datum == recording.datum
