"""The tilt of an IMU from made readings: of turns on a plane and in hills, and of climbs beside heights."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.calibration.tilt import MountingTilt

ROLL, PITCH = math.radians(3.0), math.radians(-4.0)
TILTED = gtsam.Rot3.RzRyRx(ROLL, PITCH, 0.0).matrix().T
STEP_S, SPEED_MPS = 0.1, 1.5


def driven(
    seed: int,
    seconds: float,
    *,
    mounted: np.ndarray | None = None,
    hills_rad: float = 0.0,
    slope: float = 0.0,
    turning: float = 0.4,
    height_sigma_m: float = math.nan,
    claimed_m: float = math.nan,
    height_time_s: float = 100.0,
    bias_mps2: float = 0.02,
) -> MountingTilt:
    """A robot that stands on its ground, a slope towards east with hills on it, and turns at random.

    `mounted` (3, 3) turns body axes into those of the IMU; heights wander by `height_sigma_m`.
    """
    rng, tilt = np.random.default_rng(seed), MountingTilt(bias_mps2)
    waves, phases = rng.normal(0.0, 1.0 / 6.0, (20, 2)), rng.uniform(0.0, math.tau, 20)
    steep = hills_rad / math.sqrt(20.0) / np.linalg.norm(waves, axis=1)
    place, yaw, rate, wander_m, before = np.zeros(2), 0.0, 0.0, rng.normal() * height_sigma_m, np.eye(3)
    for k in range(round(seconds / STEP_S)):
        if k % 40 == 0:
            rate = turning * rng.uniform(-1.0, 1.0)
        yaw += rate * STEP_S
        angles = waves @ place + phases
        gradient = np.array([slope, 0.0]) + (steep * np.cos(angles)) @ waves
        normal = np.array([*-gradient, 1.0]) / math.hypot(1.0, *gradient)
        ahead = np.cross(normal, np.cross([math.cos(yaw), math.sin(yaw), 0.0], normal))
        ahead /= np.linalg.norm(ahead)
        body = np.column_stack([ahead, np.cross(normal, ahead), normal])
        gyro = gtsam.Rot3.Logmap(gtsam.Rot3(before.T @ body)) / STEP_S if k else np.zeros(3)
        force = body.T @ [0.0, 0.0, GRAVITY_MPS2] + [0.0, SPEED_MPS * gyro[2], 0.0]
        readings = np.array([gyro + rng.normal(0.0, 0.01, 3) + 0.02, force + rng.normal(0.0, 0.3, 3)])
        readings[1, 0] += bias_mps2
        if mounted is not None:
            readings = readings @ mounted.T
        tilt.add(STEP_S, SPEED_MPS, *readings)
        place, before = place + SPEED_MPS * STEP_S * ahead[:2], body
        if math.isfinite(height_sigma_m) and k % 10 == 0:
            kept = math.exp(-1.0 / height_time_s)
            wander_m = kept * wander_m + math.sqrt(1.0 - kept**2) * height_sigma_m * rng.normal()
            up_m = slope * place[0] + float(steep @ np.sin(waves @ place + phases))
            claim_m = height_sigma_m if math.isnan(claimed_m) else claimed_m
            tilt.height(up_m + wander_m + 0.2 * claim_m * rng.normal(), claim_m)
    return tilt


@pytest.mark.parametrize("hills_rad", [0.0, 0.05])
def test_turns_tell_roll_and_pitch_and_hills_do_not_look_like_them(hills_rad: float) -> None:
    off = []
    for seed in range(4):
        for mounted, truth in ((None, (0.0, 0.0)), (TILTED, (ROLL, PITCH))):
            roll, pitch = driven(seed, 200.0, mounted=mounted, hills_rad=hills_rad).angles()
            assert max(roll.sigma_rad, pitch.sigma_rad) < math.radians(2.0)
            off += [(a.rad - true) / a.sigma_rad for a, true in zip((roll, pitch), truth, strict=True)]
    assert max(map(abs, off)) < 3.0


def test_heights_tell_pitch_of_a_straight_drive_and_a_slope_is_none() -> None:
    for seed in range(3):
        for mounted, truth in ((None, 0.0), (TILTED, PITCH)):
            tilt = driven(seed, 600.0, mounted=mounted, slope=0.12, turning=0.02, height_sigma_m=3.0)
            assert tilt.heights.sigma_rad < math.radians(1.0)
            assert abs(tilt.heights.rad - truth) < 3.0 * tilt.heights.sigma_rad


def test_heights_count_where_the_axis_ahead_is_known() -> None:
    tilt = driven(1, 40.0, mounted=TILTED, turning=0.02, height_sigma_m=0.02)
    assert tilt.turns is None
    _, pitch = tilt.angles()
    assert abs(pitch.rad - PITCH) < 3.0 * pitch.sigma_rad < math.radians(3.0)
    assert tilt.angles(ahead_known=False)[1].sigma_rad > math.radians(10.0)


def test_a_bias_of_the_accelerometer_that_its_data_sheet_allows_is_no_tilt() -> None:
    tilt = driven(2, 600.0, turning=0.02, height_sigma_m=3.0, bias_mps2=0.5)
    assert abs(tilt.heights.rad) > math.radians(2.0)
    assert abs(tilt.angles()[1].rad) < 2.0 * tilt.angles()[1].sigma_rad


def test_a_short_drive_beside_wandering_heights_tells_nothing() -> None:
    tilt = driven(1, 40.0, turning=0.02, height_sigma_m=3.0)
    assert tilt.turns is None
    assert tilt.angles()[1].sigma_rad > math.radians(3.0)


def test_heights_worse_than_their_claim_count_for_less() -> None:
    for seed in range(4):
        tilt = driven(seed, 400.0, turning=0.02, height_sigma_m=20.0, claimed_m=1.6)
        assert abs(tilt.heights.rad) < 3.0 * tilt.heights.sigma_rad
