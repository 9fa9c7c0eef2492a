"""Conventions of the Michigan Husky's logs: signs, axes, scales and clocks, checked by physics."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.catalog.catalog import load_catalog
from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.imu import heading
from terrafusion.datasets.checks.measures import measure
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.lag import lag_between
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers import open_recording

START_S = 1_652_300_000
SECONDS = 60.0
FAMILY = ("trial4_wheel_imu.txt", "trial4_wheel_vel.txt", "trial4_loop_center.txt", "trial4_loop_front.txt")


def motion(t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Speed, yaw rate, yaw, x and y of a winding drive with stops, at seconds from its start."""
    fine = np.arange(-1.0, SECONDS + 2.0, 0.002)
    v = 0.8 * np.clip(np.sin(0.25 * fine), 0.0, 0.7)
    rate = 0.5 * np.sin(0.9 * fine) * (v > 0)
    yaw = np.cumsum(rate) * 0.002
    x, y = np.cumsum(v * np.cos(yaw)) * 0.002, np.cumsum(v * np.sin(yaw)) * 0.002
    return tuple(np.interp(t, fine, column) for column in (v, rate, yaw, x, y))


def save(path: Path, t_s: np.ndarray, columns: list[np.ndarray]) -> None:
    """Rows as the set has them: Unix seconds with ten decimals, then numbers."""
    rows = np.stack(columns, axis=1)
    lines = [
        f"{START_S + int(t)}.{round((t - int(t)) * 1e10):010d} {' '.join(f'{x:.17g}' for x in row)}\n"
        for t, row in zip(t_s.tolist(), rows.tolist(), strict=True)
    ]
    path.write_text("".join(lines))


def write_trial(folder: Path) -> Path:
    """The four files of a trial, all on one clock."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, SECONDS, 0.01)
    v, rate, *_ = motion(t)
    noise = rng.normal(0.0, 0.02, (6, len(t)))
    zero = np.zeros_like(t)
    imu = [zero, zero, rate, np.gradient(v, t), v * rate, zero + 9.8]
    save(folder / FAMILY[0], t, [c + n for c, n in zip(imu, noise, strict=True)])
    t = np.arange(0.1, SECONDS, 0.1)
    v, *_ = motion(t)
    save(folder / FAMILY[1], t, [v / 0.97, 0.0 * v, 0.0 * v])
    t = np.arange(0.5, SECONDS - 0.5, 1.0 / 60.0)
    _, _, yaw, x, y = motion(t)
    x, y = x - x[0], y - y[0]
    x, y = x * np.cos(yaw[0]) + y * np.sin(yaw[0]), y * np.cos(yaw[0]) - x * np.sin(yaw[0])
    yaw = yaw - yaw[0]
    quaternion = [0.0 * t, 0.0 * t, np.sin(yaw / 2), np.cos(yaw / 2)]
    save(folder / FAMILY[2], t, [x, y, 0.0 * t, *quaternion])
    ahead = 0.47 * np.stack([np.cos(yaw) - 1.0, np.sin(yaw)])
    save(folder / FAMILY[3], t, [x + ahead[0], y + ahead[1], 0.0 * t, *quaternion])
    return folder


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trial(tmp_path_factory.mktemp("umich"))


@pytest.fixture
def mocap_logs() -> Path:
    """The trials with motion capture, where the environment names the field logs."""
    root = os.environ.get("TERRAFUSION_DATA")
    if not root or not (Path(root) / "umich_husky" / "mair_mocap").is_dir():
        pytest.skip("TERRAFUSION_DATA names no folder with umich_husky/mair_mocap")
    return Path(root) / "umich_husky" / "mair_mocap"


# --- physics: what must hold of a recording whose signs, axes, scales and clocks are right


def forward_speed(truth: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Speed along the body's x, and along its y, of the truth (m/s), over 0.3 s."""
    n = 9
    dt = (truth.t_ns[2 * n :] - truth.t_ns[: -2 * n]) * 1e-9
    velocity = (truth.position_m[2 * n :] - truth.position_m[: -2 * n])[:, :2] / dt[:, None]
    yaw = truth.yaw_rad()[n:-n]
    ahead = velocity[:, 0] * np.cos(yaw) + velocity[:, 1] * np.sin(yaw)
    return ahead, velocity[:, 1] * np.cos(yaw) - velocity[:, 0] * np.sin(yaw)


def physics(recording: Recording) -> dict[str, bool]:
    """Every check by name: whether it holds."""
    assert recording.truth is not None
    assert recording.imu is not None
    measures = measure([recording])
    late = {lag.quantity: lag.seconds for lag in measures.lags if "truth" in (lag.earlier, lag.later)}
    ahead, aside = forward_speed(recording.truth)
    moving = ahead**2 + aside**2 > 0.04
    tilt = recording.truth.quaternion[:, :2] if recording.truth.quaternion is not None else np.ones((1, 2))
    checks = {
        "gravity": measures.gravity is not None and measures.gravity.axis == "+z",
        "yaw": late.get("yaw rate", 9.0) < 9.0,
        "yaw clock": late.get("yaw rate", 9.0) < 0.02,
        "forward": bool(np.abs(np.median(np.arctan2(aside[moving], ahead[moving]))) < np.radians(3.0)),
        "up": bool(np.abs(tilt).max() < 0.2),
    }
    if recording.wheels is not None:
        t = recording.truth.t_ns[9:-9]
        rolled = np.interp(t, recording.wheels.t_ns, recording.wheels.speed[:, 0])
        found = heading(CheckContext(recording, None))
        angle = found.angle if found is not None and found.angle is not None else np.pi
        checks["imu forward"] = abs(angle) < np.radians(15.0)
        checks["wheel sign"] = bool(np.corrcoef(rolled, ahead)[0, 1] > 0.5)
        checks["wheel scale"] = 0.94 < measures.path_m["truth"] / measures.path_m["wheels"] < 1.0
        checks["wheel clock"] = late.get("speed", 9.0) < 0.06
    return checks


def turned(axes: tuple[str, ...]) -> Callable[[Recording], Recording]:
    return lambda recording: apply(recording, Conventions(imu_axes=axes))


def moved(channel: str, seconds: float) -> Callable[[Recording], Recording]:
    return lambda recording: apply(recording, Conventions(lag_s={channel: seconds}))


def reposed(quaternion: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recording], Recording]:
    def flip(recording: Recording) -> Recording:
        assert recording.truth is not None
        assert recording.truth.quaternion is not None
        truth = dataclasses.replace(recording.truth, quaternion=quaternion(recording.truth.quaternion))
        return dataclasses.replace(recording, truth=truth, truth_channels=())

    return flip


def scaled(factor: float) -> Callable[[Recording], Recording]:
    def flip(recording: Recording) -> Recording:
        assert recording.wheels is not None
        wheels = dataclasses.replace(recording.wheels, speed=recording.wheels.speed * factor)
        return dataclasses.replace(recording, wheels=wheels)

    return flip


def quarter_turn(q: np.ndarray) -> np.ndarray:
    """The orientations of a body whose x axis is what was y."""
    x, y, z, w = q.T
    return np.stack([x + y, y - x, z + w, w - z], axis=1) * np.sqrt(0.5)


FLIPS: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "IMU upside down": (turned(("+x", "-y", "-z")), "gravity"),
    "IMU on its side": (turned(("+x", "+z", "-y")), "gravity"),
    "IMU to the back": (turned(("-x", "-y", "+z")), "imu forward"),
    "IMU to the left": (turned(("-y", "+x", "+z")), "imu forward"),
    "IMU to the right": (turned(("+y", "-x", "+z")), "imu forward"),
    "yaw rate to the right": (lambda r: apply(r, Conventions(gyro_z_sign=-1.0)), "yaw"),
    "wheels backwards": (scaled(-1.0), "wheel sign"),
    "diameter for radius": (scaled(2.0), "wheel scale"),
    "quaternion w first": (reposed(lambda q: q[:, [3, 0, 1, 2]]), "up"),
    "mocap x to the left": (reposed(quarter_turn), "forward"),
    "mocap 0.1 s late": (moved("truth", -0.1), "yaw clock"),
    "wheels 0.15 s late": (moved("wheels", -0.15), "wheel clock"),
}  # fmt: skip


@pytest.mark.parametrize("name", FLIPS)
def test_a_flipped_convention_breaks_physics(trial: Path, name: str) -> None:
    recording = open_recording(trial / FAMILY[0])
    assert all(physics(recording).values()), physics(recording)
    flip, check = FLIPS[name]
    assert not physics(flip(recording))[check]


@pytest.mark.parametrize(
    "file", ["trial1_wheel_imu.txt", "trial7_wheel_imu.txt", "2_test_imu.txt", "3_test_imu.txt"]
)
def test_the_trials_obey_physics(mocap_logs: Path, file: str) -> None:
    recording = open_recording(mocap_logs / file)
    assert recording.vehicle == "husky"
    assert all(physics(recording).values()), physics(recording)


@pytest.mark.parametrize("name", FLIPS)
@pytest.mark.parametrize("file", ["trial1_wheel_vel.txt", "trial7_wheel_vel.txt"])
def test_a_flipped_trial_breaks_physics(mocap_logs: Path, file: str, name: str) -> None:
    flip, check = FLIPS[name]
    assert not physics(flip(open_recording(mocap_logs / file)))[check]


@pytest.mark.parametrize("number", [1, 2, 3, 7])
def test_every_trial_needs_its_lags(mocap_logs: Path, number: int) -> None:
    """The catalogue's lags of the motion capture: without them, or with the other sign, clocks disagree."""
    known = load_catalog().sets["umich_husky"]
    lags = known.conventions_of(f"mair_mocap/trial{number}").lag_s
    recording = open_recording(f"umich_husky/mair_mocap/trial{number}")
    assert physics(recording)["yaw clock"]
    for factor in (1.0, 2.0):
        assert not physics(moved("truth", -factor * lags["truth"])(recording))["yaw clock"]


def wheels_ahead_s(recording: Recording) -> float:
    """By how much the change of the wheels' speed is ahead of the accelerometer's x, s."""
    wheels, imu = recording.wheels, recording.imu
    assert wheels is not None
    assert imu is not None
    t_wheels, t_imu = ((channel.t_ns - recording.start_ns) * 1e-9 for channel in (wheels, imu))
    gain = np.gradient(wheels.speed[:, 0], t_wheels)
    lag = lag_between(t_wheels, gain, t_imu, imu.accel_mps2[:, 0], reach_s=0.5)
    assert lag is not None
    return lag.seconds


@pytest.mark.parametrize(
    "name",
    [
        "mair_mocap/trial1",
        "mair_mocap/trial7",
        "field/sand_small_pebble",
        "field/slip_detect1",
        "field/slip_detect2",
    ],
)
def test_the_wheels_need_their_lag(mocap_logs: Path, name: str) -> None:
    recording = open_recording(f"umich_husky/{name}")
    lag_s = load_catalog().sets["umich_husky"].conventions_of(name).lag_s["wheels"]
    assert abs(wheels_ahead_s(recording)) < 0.03
    assert wheels_ahead_s(moved("wheels", -lag_s)(recording)) > 0.045  # as the file has it
    assert wheels_ahead_s(moved("wheels", -2.0 * lag_s)(recording)) > 0.1


@pytest.mark.parametrize(("stem", "path_m"), [("trial1", 20.36), ("trial7", 40.05)])
def test_ground_over_wheel_path(mocap_logs: Path, stem: str, path_m: float) -> None:
    recording = open_recording(mocap_logs / f"{stem}_wheel_vel.txt")
    found = measure([recording]).path_m
    assert found["truth"] == pytest.approx(path_m, rel=0.01)
    assert 0.95 < found["truth"] / found["wheels"] < 0.98


@pytest.mark.parametrize(
    "name", ["mars_sand2_no_disturbance", "sand_small_pebble", "slip_detect1", "slip_detect2", "up_to_hill1"]
)
def test_the_drives_in_the_field(mocap_logs: Path, name: str) -> None:
    recording = open_recording(f"umich_husky/field/{name}")
    assert set(recording.channels()) == {"wheels", "imu"}
    gravity = measure([recording]).gravity
    assert gravity is not None
    assert gravity.axis == "+z"
    assert abs(gravity.size_mps2 - 9.8) < 0.15
    assert recording.imu is not None
    assert 195 < (len(recording.imu) - 1) / recording.duration_s() < 201
    assert recording.licence == "MIT"
