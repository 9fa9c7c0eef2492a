"""Left against right: sides sampled at different times, and one wheel smaller than the other."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.bootstrap_interval import RESAMPLES, SEED, BootstrapInterval, interval_of
from terrafusion.datasets.checks.finding import CheckContext, Finding, changed
from terrafusion.datasets.checks.imu import at_rest
from terrafusion.datasets.checks.path import scales
from terrafusion.datasets.checks.scale import is_firm
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.bootstrap import resampled_rows
from terrafusion.datasets.core.channels import Wheels
from terrafusion.datasets.core.paired_sides import paired_sides, sampled_apart

WINDOW_S, BLOCK, LEAST_BLOCKS = 1.0, 10, 8
"""Rates are averaged over windows; as many of them are one block of the bootstrap."""
LEAST_R, LEAST_MPS, LEAST_TRACK_M = 0.6, 0.1, 0.2
BIAS_RADPS, REST_BIAS_RADPS, MOST_BIAS_RADPS = 0.005, 0.0005, 0.02
"""1 sigma of the gyro's bias where the log shows no rest, and where it does; more is no bias."""
LARGE, SIGNIFICANT, WIDEST, MOST = 0.025, 0.015, 0.05, 0.3
"""A difference of radii counts from the first on, with its interval beyond the second and narrower than the
third: in one long bend it cannot be distinguished from the track. Tyres of one robot
differ by up to that much: a Warthog's by 1.7 % (norlab_drive)."""
SLIP_FREE = 1.005


def check_apart(context: CheckContext) -> Iterator[Finding]:
    """Both sides must be known at one time."""
    wheels = context.recording.wheels
    if wheels is None or not sampled_apart(wheels):
        return
    whole = np.asarray(np.isfinite(wheels.speed).all(axis=1))
    yield Finding(
        "sides-apart", "error", "wheels",
        "left and right are sampled at different times",
        f"{int(whole.sum())} of {len(whole)} rows have both",
        "interpolate each side between its own samples",
        changed("wheels", paired_sides),
    )  # fmt: skip


def check_radii(context: CheckContext) -> Iterator[Finding]:
    """Both sides must roll as far on straights, where the gyro shows no turn."""
    found = radius_difference(context)
    if found is None or not LARGE < abs(found.value) < MOST:
        return
    if not found.is_beyond(SIGNIFICANT) or found.high - found.low > WIDEST:
        return
    fast, slow = ("right", "left") if found.value > 0.0 else ("left", "right")
    known = [scale.ratio for scale, _ in scales(context)]
    raised = bool(known) and min(known) > SLIP_FREE  # both would be too slow with the fast side reduced
    ends = sorted([abs(found.low), abs(found.high)])
    side = slow if raised else fast
    factor = 1.0 + abs(found.value) if raised else 1.0 / (1.0 + abs(found.value))
    yield Finding(
        "wheel-sides", "warning", "wheels",
        f"{fast} rolls {abs(found.value):.1%} further than {slow} where the gyro shows no turn",
        f"95 % interval {ends[0]:.1%} to {ends[1]:.1%}: a deflated tyre, or another radius",
        f"multiply the {side} speeds by {factor:.4f}",
        changed("wheels", _scaled, side=side, factor=factor),
    )  # fmt: skip


def radius_difference(context: CheckContext) -> BootstrapInterval | None:
    """Right over left wheel speed on straights, less 1.

    Right minus left speed is regressed on yaw rate (the effective track), speed (the difference of the radii)
    and a constant (the gyro's bias, which a rest shows). None on soft ground, where the sides slip.
    """
    known, wheels = motion.yaw_angles(context), context.recording.wheels
    if wheels is None or "gyro" not in known or "wheels" not in known or not is_firm(context.recording):
        return None
    gyro, apart, bias = known["gyro"], known["wheels"], _rest_bias(context)
    both = motion.agreement(gyro, apart)
    driven = motion.wheel_speed(context)
    if (
        both is None
        or both.r < LEAST_R
        or driven is None
        or (bias is not None and abs(bias) > MOST_BIAS_RADPS)
    ):
        return None
    rolled = motion.Integral(driven[0], motion.cumulative(*driven))  # mean of both sides, as `yaw_angles`
    start, end = motion.common_span(gyro, apart)
    grid = np.arange(start, end, WINDOW_S)
    columns = np.stack([rolled.rates(grid), gyro.rates(grid), np.ones(len(grid) - 1)], axis=1)
    difference = apart.rates(grid)
    blocks = np.arange(len(difference)) // BLOCK
    moving = np.abs(columns[:, 0]) > LEAST_MPS
    if moving.sum() < LEAST_BLOCKS * BLOCK or len(np.unique(blocks[moving])) < LEAST_BLOCKS:
        return None
    columns, difference, blocks = columns[moving], difference[moving], blocks[moving]
    fit, *_ = np.linalg.lstsq(columns, difference, rcond=None)
    track, noise = max(float(fit[1]), LEAST_TRACK_M), float(np.std(difference - columns @ fit))
    sigma = track * (BIAS_RADPS if bias is None else REST_BIAS_RADPS)
    weight = np.diag([1e-9, 1e-9, (noise / sigma) ** 2])
    pulled = weight @ np.array([0.0, 0.0, -track * (bias or 0.0)])
    rows = [blocks == block for block in np.unique(blocks)]
    H = np.array([columns[r].T @ columns[r] for r in rows])
    h = np.array([columns[r].T @ difference[r] for r in rows])
    draws = np.concatenate([np.arange(len(rows))[None], resampled_rows(len(rows), RESAMPLES, SEED)])
    right = h[draws].sum(axis=1) + pulled
    drawn = np.linalg.solve(H[draws].sum(axis=1) + weight, right[..., None])[:, 0, 0]
    return interval_of(float(drawn[0]), drawn[1:], len(rows))


def _rest_bias(context: CheckContext) -> float | None:
    resting, imu = at_rest(context), context.recording.imu
    if imu is None or resting.sum() < 50:
        return None
    values = imu.gyro_radps[resting, 2]
    return float(np.nanmean(values)) if np.isfinite(values).any() else None


def _scaled(wheels: Wheels, side: str, factor: float) -> Wheels:
    factors: Array = np.array([factor if side in name else 1.0 for name in wheels.names])
    angle = None if wheels.angle_rad is None else wheels.angle_rad * factors
    return dataclasses.replace(wheels, speed=wheels.speed * factors, angle_rad=angle)
