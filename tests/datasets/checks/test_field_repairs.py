"""The checks recover from the data alone the conventions that the catalogue lists for public logs."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.checks import repair, run_checks
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.readers import open as opening


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> Path:
    """The field logs, opened without the conventions of the catalogue."""
    root = os.environ.get("TERRAFUSION_DATA")
    if not root:
        pytest.skip("TERRAFUSION_DATA is not set: the field logs are not at hand")
    monkeypatch.setattr(opening, "apply", lambda recording, conventions: recording)
    return Path(root)


def log(path: Path) -> Path:
    if not path.exists():
        pytest.skip(f"TERRAFUSION_DATA holds no {path.name}")
    return path


def joined(recordings: list[Recording]) -> Recording:
    """Windows of 2 s as one drive of wheels, IMU and command, one after the other."""
    parts: dict[str, list[dict[str, np.ndarray]]] = {"wheels": [], "imu": [], "command": []}
    for k, recording in enumerate(recordings):
        for name, tables in parts.items():
            channel = getattr(recording, name)
            arrays = {f.name: getattr(channel, f.name) for f in dataclasses.fields(channel)}
            arrays = {n: a for n, a in arrays.items() if isinstance(a, np.ndarray)}
            tables.append(arrays | {"t_ns": channel.t_ns - recording.start_ns + k * 2 * 10**9})
    first = recordings[0]
    whole = {
        name: dataclasses.replace(
            getattr(first, name), **{n: np.concatenate([t[n] for t in tables]) for n in tables[0]}
        )
        for name, tables in parts.items()
    }
    return Recording("joined", 0, **whole, overrides=Overrides(wheel_radius_m=0.3))


def test_husky_mounting_is_found(unread: Path) -> None:
    bag = opening.open_recording(log(unread / "husky_parkinglot" / "test1.bag"))
    repaired, done = repair(bag)
    assert [finding.code for finding in done] == ["imu-axes"]
    assert "-z, -x, +y point forward, left, up" in done[0].fix
    assert "acceleration follows the wheels along -z" in done[0].evidence
    # Its covariances are the HDOP squared: 9 values of sigma from 0.8 to 1.7, up twice that.
    assert [(finding.code, finding.severity) for finding in run_checks(repaired)] == [
        ("sigma-dilution", "warning")
    ]


@pytest.mark.parametrize("name", ["s5t1", "test17run"])
def test_pathfinder_signs_are_found(unread: Path, name: str) -> None:
    rover = opening.open_recording(log(unread / "wvu_pathfinder" / f"{name}.mat"))
    repaired, done = repair(rover)
    found = {finding.code: finding for finding in done}
    assert "left side" in found["wheel-sign"].fix
    assert "+x, -y, -z point forward, left, up" in found["imu-axes"].fix
    assert "acceleration follows the wheels along +x" in found["imu-axes"].evidence
    assert not {"wheel-sign", "imu-axes", "yaw-sign"} & {finding.code for finding in run_checks(repaired)}


def test_pathfinder_radius_is_found(unread: Path) -> None:
    rover = opening.open_recording(log(unread / "wvu_pathfinder" / "test17run.mat"))
    repaired, done = repair(dataclasses.replace(rover, overrides=Overrides(wheel_radius_m=0.110)))
    assert "wheel-radius" in [finding.code for finding in done]
    assert 0.114 < repaired.overrides.wheel_radius_m < 0.119


@pytest.mark.parametrize(
    ("folder", "flipped"),
    [
        ("warthog_wheels_gravel_2024_8_6_11h37s32", True),
        ("warthog_wheels_ice_2024_7_30_16h30s21", True),
        ("warthog_wheels_asphalt_2024_9_20_9h27s52", False),
    ],
)
def test_norlab_yaw_sign_is_found_in_joined_windows(unread: Path, folder: str, flipped: bool) -> None:
    windows = opening.open_recordings(log(unread / "norlab_drive" / folder / "slip_dataset_all.pkl"))
    codes = [finding.code for finding in run_checks(joined(windows[:120]))]
    assert ("yaw-sign" in codes) == flipped
