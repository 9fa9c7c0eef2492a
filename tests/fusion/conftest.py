"""A synthetic drive and a synthetic estimate of it, so that scores and reports are tested on known errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix, Gnss, Wheels
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.estimate.estimate import Estimate, Innovation, WeightChange

START_NS = 1_700_000_000_000_000_000
CLASSES = ("asphalt", "loose_sand", "mud", "unknown")


@dataclass(frozen=True)
class Drive:
    """A recording with truth, fixes and wheels, and an estimate with chosen errors."""

    recording: Recording
    estimate: Estimate
    fixes: Gnss


def planar(x: np.ndarray, y: np.ndarray, yaw: np.ndarray, t_ns: np.ndarray, **more: np.ndarray) -> Trajectory:
    zero = np.zeros(len(t_ns))
    quaternion = rpy_to_quaternion(np.stack([zero, zero, yaw], axis=1))
    return Trajectory(t_ns, np.stack([x, y, zero], axis=1), quaternion, **more)


def build_drive(
    *,
    seconds: float = 120.0,
    speed_mps: float = 1.0,
    turn_radps: float = 0.2,
    offset_m: tuple[float, float] = (0.0, 0.0),
    drift_mps: float = 0.0,
    drift_from_s: float = 0.0,
    yaw_drift_radps: float = 0.0,
    noise_m: float = 0.0,
    sigma_m: float = 0.1,
    fix_sigma_m: float = 0.0,
    truth_hz: int = 50,
    seed: int = 1,
) -> Drive:
    """A winding drive; the estimate is the truth plus the errors asked for."""
    rng = np.random.default_rng(seed)

    def path(hz: int) -> tuple[np.ndarray, ...]:
        fine = np.arange(round(seconds * 1000) + 1) * 1e-3
        yaw = 3.0 * turn_radps * np.sin(fine / 6.0)
        step = speed_mps * 1e-3
        x = np.concatenate([[0.0], np.cumsum(step * np.cos(yaw[:-1]))])
        y = np.concatenate([[0.0], np.cumsum(step * np.sin(yaw[:-1]))])
        return tuple(a[:: 1000 // hz] for a in (fine, x, y, yaw, 0.5 * turn_radps * np.cos(fine / 6.0)))

    t, x, y, yaw, rate = path(truth_hz)
    zero = np.zeros(len(t))
    twist = np.stack([zero + speed_mps, zero, zero, zero, zero, rate], axis=1)
    truth = planar(x, y, yaw, START_NS + np.rint(t * 1e9).astype(np.int64), twist_body=twist)
    recording = Recording(
        name="synthetic",
        start_ns=START_NS,
        vehicle="elevate",
        truth=truth,
        wheels=Wheels(
            truth.t_ns,
            np.full((len(t), 2), speed_mps * 1.1),
            ("left", "right"),
            "mps",
        ),
    )
    fixes = _fixes(truth, fix_sigma_m, rng)
    estimate = _estimate(
        path(10), speed_mps, offset_m, drift_mps, drift_from_s, yaw_drift_radps, noise_m, sigma_m, rng
    )
    return Drive(recording, estimate, fixes)


def _fixes(truth: Trajectory, sigma_m: float, rng: np.random.Generator) -> Gnss:
    t_ns = np.arange(int(truth.t_ns[0]), int(truth.t_ns[-1]) + 1, 1_000_000_000, dtype=np.int64)
    n = len(t_ns)
    return Gnss(
        t_ns,
        truth.positions_at(t_ns) + rng.normal(size=(n, 3)) * sigma_m,
        np.full((n, 3), sigma_m),
        np.full(n, Fix.DGPS, dtype=np.uint8),
    )


def _estimate(
    path: tuple[np.ndarray, ...],
    speed_mps: float,
    offset_m: tuple[float, float],
    drift_mps: float,
    drift_from_s: float,
    yaw_drift_radps: float,
    noise_m: float,
    sigma_m: float,
    rng: np.random.Generator,
) -> Estimate:
    t, x, y, yaw, rate = path
    n = len(t)
    zero = np.zeros(n)
    moved = drift_mps * np.maximum(0.0, t - drift_from_s)
    x = x + offset_m[0] + moved + rng.normal(size=n) * noise_m
    y = y + offset_m[1] + rng.normal(size=n) * noise_m
    t_ns = START_NS + np.rint(t * 1e9).astype(np.int64)
    covariance = np.tile(np.diag([sigma_m**2] * 3 + [1e-4, 1e-4, 4e-4]), (n, 1, 1))
    twist = np.stack([zero + speed_mps, zero, zero, zero, zero, rate], axis=1)
    body = planar(x, y, yaw + yaw_drift_radps * t, t_ns, twist_body=twist, covariance=covariance)
    velocity = np.stack([speed_mps * np.cos(yaw), speed_mps * np.sin(yaw), zero], axis=1)
    sand = 1.0 / (1.0 + np.exp(-(t - t[-1] / 2)))
    terrain = np.stack([0.9 * (1 - sand), 0.85 * sand, 0.05 * sand, 0.1 * (1 - sand) + 0.1 * sand], axis=1)
    return Estimate(
        trajectory=body,
        velocity_mps=velocity,
        velocity_covariance=np.tile(np.eye(3) * 0.01, (n, 1, 1)),
        gyro_bias_radps=np.tile([0.0, 0.0, 1e-3], (n, 1)),
        accel_bias_mps2=np.tile([0.01, -0.02, 0.0], (n, 1)),
        slip=0.02 + 0.25 * sand + 0.01 * np.sin(t),
        slip_sigma=0.01 + 0.05 * sand,
        terrain=terrain / terrain.sum(axis=1, keepdims=True),
        classes=CLASSES,
        weights={
            "slip_mean": 0.02 + 0.2 * sand,
            "slip_sigma": 0.02 + 0.1 * sand,
            "wheel_sigma_mps": 0.02 + 0.08 * sand,
            "side_slip_sigma": 0.02 + 0.05 * sand,
            "gyro_inflation": 2.0 + 3.0 * sand,
            "gyro_yaw_inflation": 1.5 + 2.0 * sand,
            "accel_inflation": 5.0 + 10.0 * sand,
            "gnss_inflation": 1.0 + 0.5 * sand,
        },
        changes=(
            WeightChange(int(t_ns[n // 2]), "wheels", 0.02, 0.06, "m/s", "loose_sand became likelier (0.50)"),
            WeightChange(
                int(t_ns[n // 2 + 20]), "imu", 2.0, 4.5, "times data sheet", "vibration of loose_sand"
            ),
        ),
        innovations=tuple(
            Innovation(int(when), "gnss", rng.normal(size=2), float(rng.chisquare(2)), 2, i % 17 != 16)
            for i, when in enumerate(t_ns[::10])
        ),
        status=np.full(n, "running", dtype=object),
        notes=("the antenna is taken to be at the body origin",),
    )


@pytest.fixture(scope="session")
def drive() -> Callable[..., Drive]:
    """The builder `build_drive`."""
    return build_drive
