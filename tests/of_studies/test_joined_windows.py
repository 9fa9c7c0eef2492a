"""Windows that are joined to drives: the path they were cut from comes out."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.open import open_recordings
from terrafusion.twin.simulate import simulate
from tests.studies.joined_windows import joined_runs

WINDOW_S = 2.0


def windows(drive: Recording, seconds: float) -> list[Recording]:
    """The drive cut into windows, each with a truth of 10 Hz that starts at its own origin."""
    out = []
    for k in range(int(seconds / WINDOW_S)):
        low = drive.start_ns + round(k * WINDOW_S * 1e9)
        high = low + round(WINDOW_S * 1e9)
        parts = {name: channel.between(low, high) for name, channel in drive.channels().items()}
        truth = drive.truth
        assert truth is not None
        inside = np.flatnonzero((truth.t_ns >= low) & (truth.t_ns < high))
        truth = truth.select(inside[:: round(0.1e9 / np.diff(truth.t_ns).mean())])
        cut = dataclasses.replace(drive, **parts, truth=own_origin(truth), start_ns=low)
        out.append(dataclasses.replace(cut, gnss=None))
    return out


def own_origin(truth: Trajectory) -> Trajectory:
    assert truth.quaternion is not None
    R = quaternion_to_matrix(truth.quaternion[0])
    yaw = truth.yaw_rad() - truth.yaw_rad()[0]
    quaternion = np.stack([0 * yaw, 0 * yaw, np.sin(0.5 * yaw), np.cos(0.5 * yaw)], axis=1)
    return Trajectory(truth.t_ns, (truth.position_m - truth.position_m[0]) @ R, quaternion)


@pytest.fixture(scope="module")
def drive() -> Recording:
    return simulate("figure_eight", terrain="asphalt", noiseless=True)


def test_the_joined_path_is_that_of_the_drive(drive: Recording) -> None:
    (joined,) = joined_runs("cut", windows(drive, 40.0))
    assert joined.truth is not None
    assert joined.imu is not None
    assert joined.wheels is not None
    assert joined.name == "cut#0"
    assert 39.5 < joined.duration_s() <= 40.1
    for channel in (joined.imu, joined.wheels, joined.truth):
        assert (np.diff(channel.t_ns) > 0).all()
    t = joined.truth.t_ns
    assert drive.truth is not None
    there = drive.truth.positions_at(drive.start_ns + t)[:, :2]
    # Up to where it starts and which way it heads there.
    a, b = (x[:, 0] + 1j * x[:, 1] for x in (joined.truth.position_m, there))
    a, b = a - a.mean(), b - b.mean()
    off = np.abs(b - a * np.vdot(a, b) / abs(np.vdot(a, b)))
    way = float(np.abs(np.diff(b)).sum())
    assert way > 15.0
    assert off.max() < 0.01 * way
    turned = np.unwrap(joined.truth.yaw_rad())
    told = np.unwrap(drive.truth.yaw_rad())
    assert turned[-1] - turned[0] == pytest.approx(
        np.interp(t[-1] + drive.start_ns, drive.truth.t_ns, told)
        - np.interp(t[0] + drive.start_ns, drive.truth.t_ns, told),
        abs=0.01,
    )


def test_windows_that_do_not_follow_each_other_are_not_joined(drive: Recording) -> None:
    cut = windows(drive, 12.0)
    wheels = cut[3].wheels
    assert wheels is not None
    faster = dataclasses.replace(wheels, speed=wheels.speed + 3.0)
    cut[3] = dataclasses.replace(cut[3], wheels=faster)
    assert [d.duration_s() for d in joined_runs("cut", cut)] == pytest.approx([6.0, 4.0], abs=0.1)


def test_a_hole_in_the_truth_is_not_bridged(drive: Recording) -> None:
    cut = windows(drive, 20.0)
    blind = [dataclasses.replace(w, truth=None) if k in (4, 5) else w for k, w in enumerate(cut)]
    (joined,) = joined_runs("cut", blind)
    assert joined.truth is None


def test_the_ice_rink_makes_drives_of_a_minute() -> None:
    root = os.environ.get("TERRAFUSION_DATA")
    if not root or not (Path(root) / "norlab_drive").is_dir():
        pytest.skip("TERRAFUSION_DATA names no folder with norlab_drive: the field logs are not at hand")
    name = "norlab_drive/ice_2024_7_30_16h30s21/windows"
    drives = joined_runs(name, open_recordings(name))
    assert sum(d.duration_s() > 39.0 for d in drives) >= 6
    for d in drives:
        assert d.truth is None or np.isfinite(d.truth.position_m).all()
        assert any("windows joined" in note for note in d.notes)
