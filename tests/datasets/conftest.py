"""A synthetic drive with every channel, and the husky's geometry by hand."""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from terrafusion.datasets.catalog.catalog import CATALOG_VARIABLE, FILE_COLUMNS, HERE, sha256_of
from terrafusion.datasets.core.channels import Command, Fix, Gnss, Imu, Motor, Terrain, Wheels
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import GnssSpec, ImuSpec, Rig, SensorSuite, WheelSpec
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.core.yaml_file import read_yaml

START_NS = 1_700_000_000_123_456_789
TRACK_M = 0.555
RADIUS_M = 0.1651


def clock(rate_hz: float, seconds: float = 60.0) -> np.ndarray:
    """Even times from START_NS."""
    return START_NS + np.rint(np.arange(0.0, seconds, 1.0 / rate_hz) * 1e9).astype(np.int64)


def motion(t_ns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Speed, yaw rate, yaw and position of a winding drive, from fine integration."""
    fine = np.arange(0.0, 60.0, 0.002)
    v, rate = 1.0 + 0.3 * np.sin(0.2 * fine), 0.15 * np.sin(0.15 * fine)
    yaw = np.cumsum(rate) * 0.002
    x, y = np.cumsum(v * np.cos(yaw)) * 0.002, np.cumsum(v * np.sin(yaw)) * 0.002
    s = (t_ns - START_NS) * 1e-9
    return tuple(np.interp(s, fine, column) for column in (v, rate, yaw, x, y))


def make_drive(seed: int = 0) -> Recording:
    """60 s with all channels, clean: noise but no fault."""
    rng = np.random.default_rng(seed)
    t_imu, t_wheels, t_gnss, t_truth = clock(100), clock(20), clock(5), clock(20)
    _, rate, _, _, _ = motion(t_imu)
    gyro = rng.normal(0.0, 0.01, (len(t_imu), 3))
    gyro[:, 2] += rate
    accel = rng.normal((0.0, 0.0, 9.81), 0.3, (len(t_imu), 3))
    v, rate, _, _, _ = motion(t_wheels)
    sides = np.stack([v - rate * TRACK_M / 2, v + rate * TRACK_M / 2], axis=1)
    sides += rng.normal(0.0, 0.005, sides.shape)
    v_g, _, yaw_g, x_g, y_g = motion(t_gnss)
    enu = np.stack([x_g, y_g, 0.0 * x_g], axis=1) + rng.normal(0.0, 0.05, (len(t_gnss), 3))
    velocity = np.stack([v_g * np.cos(yaw_g), v_g * np.sin(yaw_g), 0.0 * v_g], axis=1)
    v_t, rate_t, yaw_t, x_t, y_t = motion(t_truth)
    twist = np.full((len(t_truth), 6), np.nan)
    twist[:, 0], twist[:, 1], twist[:, 5] = v_t, 0.01, rate_t
    rpy = np.stack([0.0 * yaw_t, 0.0 * yaw_t, yaw_t], axis=1)
    truth = Trajectory(t_truth, np.stack([x_t, y_t, 0.1 + 0.0 * x_t], axis=1), rpy_to_quaternion(rpy), twist)
    return Recording(
        name="drive",
        start_ns=START_NS,
        vehicle="husky",
        command=Command(t_wheels, v, rate),
        wheels=Wheels(t_wheels, sides / RADIUS_M, ("left", "right"), "radps", np.cumsum(sides, axis=0)),
        imu=Imu(t_imu, gyro, accel),
        gnss=Gnss(
            t_gnss,
            enu,
            np.full((len(t_gnss), 3), 0.05),
            np.full(len(t_gnss), Fix.FIXED, dtype=np.uint8),
            velocity,
            np.full(len(t_gnss), 0.02),
        ),
        motor=Motor(t_wheels, rng.random((len(t_wheels), 2)), 24.0 - rng.random((len(t_wheels), 2))),
        terrain=Terrain(
            clock(0.1),
            np.array(["gravel", "mud", "mud", 'wet, "soft"', "grass", "snow"], dtype=object),
            "simulation",
            ("mud", "snow"),
            rng.random((6, 2)),
        ),
        truth=truth,
        datum=(48.1, 11.5, 520.25),
        truth_channels=("position", "yaw", "velocity"),
        terrain_name="gravel",
        description="synthetic",
        licence="MIT",
        source="tests",
    )


@pytest.fixture
def drive() -> Recording:
    return make_drive()


def make_husky_rig(**topics: str) -> Rig:
    """A husky: IMU turned, antenna raised."""
    imu = ImuSpec(
        rate_hz=30.0,
        gyro_noise_radps_sqrthz=1e-3,
        gyro_bias_walk_radps2_sqrthz=2e-5,
        gyro_bias_sigma_radps=5e-3,
        accel_noise_mps2_sqrthz=1e-2,
        accel_bias_walk_mps3_sqrthz=2e-4,
        accel_bias_sigma_mps2=0.1,
        position_m=(0.2351, -0.0687, 0.1919),
        axes=("-z", "-x", "+y"),
        frame_id="imu_link",
    )
    wheels = WheelSpec(rate_hz=10.0, quantum_rad=1e-4, speed_sigma_mps=0.02)
    gnss = GnssSpec(2.5, 1.2, 2.4, 0.1, 60.0, antenna_m=(0.2475, 0.0, 0.2231))
    return Rig(RADIUS_M, TRACK_M, SensorSuite(imu, wheels, gnss), dict(topics))


@pytest.fixture
def husky_rig() -> Rig:
    return make_husky_rig()


@pytest.fixture
def field_logs() -> Path:
    """Folder of the public field logs, where the environment names one."""
    root = os.environ.get("TERRAFUSION_DATA")
    if not root:
        pytest.skip("TERRAFUSION_DATA is not set: the field logs are not at hand")
    folder = Path(root) / "husky_parkinglot"
    if not folder.is_dir():
        pytest.skip("TERRAFUSION_DATA holds no husky_parkinglot")
    return folder


@pytest.fixture
def published() -> Path:
    """Folder of all public field logs, where the environment names one."""
    root = os.environ.get("TERRAFUSION_DATA")
    if not root:
        pytest.skip("TERRAFUSION_DATA is not set: the field logs are not at hand")
    return Path(root)


CatalogWith = Callable[..., None]
"""`catalog_with("norlab_drive", files={path: "grass/raw"}, gyro_z_sign=-1.0)`."""


@pytest.fixture
def catalog_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CatalogWith:
    """Puts a catalogue of one's own in force: a set of the library's, conventions changed and files added."""
    count = itertools.count()

    def put(set_name: str, files: dict[Path, str] | None = None, **conventions: Any) -> None:
        folder = tmp_path / f"catalog{next(count)}"
        folder.mkdir()
        own = read_yaml(HERE / "catalog.yaml")[set_name]
        for group in (own, *(own.get("cases") or {}).values()):
            kept = {k: v for k, v in (group.get("conventions") or {}).items() if k not in conventions}
            group["conventions"] = kept
        own["conventions"] |= {name: _sourced(value) for name, value in conventions.items()}
        with (folder / "catalog.yaml").open("w", encoding="utf-8") as text:
            YAML(typ="safe").dump({set_name: own}, text)
        rows = [FILE_COLUMNS] + [
            (
                set_name,
                name,
                path.name,
                "https://example.org",
                "",
                path.name,
                sha256_of(path),
                path.stat().st_size,
            )
            for path, name in (files or {}).items()
        ]
        with (folder / "catalog_files.csv").open("w", encoding="utf-8", newline="") as text:
            csv.writer(text).writerows(rows)
        monkeypatch.setenv(CATALOG_VARIABLE, str(folder))

    return put


def _sourced(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _sourced(item) for name, item in value.items()}
    return {"value": value, "source": "the test"} if isinstance(value, float) else value
