"""GNSS receiver: fix classes that come and go, noise, multipath under trees, outages and latency."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.sensors import GnssSpec
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.sensor_realism import GnssRealism
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.scenario.scenario import Canopy, Scenario, Zone, inside
from terrafusion.twin.sensors.noise import (
    PLANE_WAVES,
    NoiseStreams,
    gauss_markov,
    place_field,
    rows_at_rate,
    sample_rate_hz,
)

RTK_SIGMA_M, DGPS_SIGMA_M = 0.05, 0.5
"""A receiver whose best sigma is at most this reports fixed, or differential, fixes."""
FIX_LEVELS = {
    Fix.SINGLE: (Fix.NONE, Fix.SINGLE),
    Fix.DGPS: (Fix.NONE, Fix.SINGLE, Fix.DGPS),
    Fix.FLOAT: (Fix.NONE, Fix.SINGLE, Fix.FLOAT),
    Fix.FIXED: (Fix.NONE, Fix.SINGLE, Fix.FLOAT, Fix.FIXED),
}
"""Classes a receiver passes until it reaches its best one."""


@dataclass(frozen=True, eq=False)
class Sky:
    """Sky view at the epochs (N,): canopy density from 0 to 1, and whether there is any signal."""

    density: Array
    visible: NDArray[np.bool_]

    @classmethod
    def over(cls, t_s: Array, travel_m: Array, canopy: tuple[Canopy, ...], outages: tuple[Zone, ...]) -> Self:
        """The sky over a drive; where canopies overlap, the densest counts."""
        density, visible = np.zeros_like(t_s), np.ones(len(t_s), dtype=bool)
        for trees in canopy:
            under = inside(trees, t_s, travel_m)
            density = np.where(under, np.maximum(density, trees.density), density)
        for outage in outages:
            visible &= ~inside(outage, t_s, travel_m)
        return cls(density, visible)


def best_fix(spec: GnssSpec) -> Fix:
    """The fix class a receiver of this accuracy reports."""
    if spec.sigma_horizontal_m <= RTK_SIGMA_M:
        return Fix.FIXED
    return Fix.DGPS if spec.sigma_horizontal_m <= DGPS_SIGMA_M else Fix.SINGLE


def gnss_channel(
    t_ns: TimesNs,
    motion: BodyMotion,
    travel_m: Array,
    vehicle: VehicleParams,
    scenario: Scenario,
    noise: NoiseStreams,
) -> Gnss:
    """Antenna position and velocity with the sigma the receiver reports; no row where it has no fix.

    `travel_m` (N,) is the distance driven. A latency makes the stamp late against the motion.
    """
    spec, real = vehicle.sensors.gnss, vehicle.realism
    rows = rows_at_rate(len(t_ns), sample_rate_hz(motion.t_s), spec.rate_hz)
    sky = Sky.over(motion.t_s[rows], travel_m[rows], scenario.canopy, scenario.gnss_outages)
    best = best_fix(spec)
    top = best if scenario.gnss_fix is None else min(best, scenario.gnss_fix)
    position = motion.point_position_m(spec.antenna_m)[rows]
    velocity = motion.point_velocity_mps(spec.antenna_m)[rows]
    stamps, n = t_ns[rows], len(rows)
    if noise.noiseless:
        fix = np.where(sky.visible, int(top), int(Fix.NONE)).astype(np.uint8)
        sigma, sigma_v = _class_sigma(fix, vehicle), np.full(n, spec.sigma_velocity_mps)
    else:
        interval_s = float(np.mean(np.diff(motion.t_s[rows]))) if n > 1 else 1.0
        fix = fix_classes(sky, top, interval_s, real.gnss, noise.stream("gnss fix"))
        weaker = 10.0 ** (real.gnss.canopy_attenuation_db * sky.density / 20.0)
        error, sigma = _position_error(fix, weaker, interval_s, vehicle, noise)
        position = position + error + _multipath(position, fix, sky, vehicle, noise)
        sigma_v = spec.sigma_velocity_mps * weaker
        velocity = velocity + sigma_v[:, None] * noise.stream("gnss velocity").normal(size=velocity.shape)
        sigma, sigma_v = real.gnss.reported_share * sigma, real.gnss.reported_share * sigma_v
        stamps = stamps + round(real.gnss_latency_s * 1e9)
    return Gnss(stamps, position, sigma, fix, velocity, sigma_v).select(fix != Fix.NONE)


def fix_classes(
    sky: Sky, best: Fix, interval_s: float, real: GnssRealism, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Fix class (N,) at epochs `interval_s` apart: a Markov chain over the levels of the receiver.

    A step down comes at the rate `canopy_loss_per_s` times the density; a step up at
    (1 - density) / `reacquire_s` from no fix, and from there at (1 - density) steps / `refix_s`.
    The robot starts with its best class; an outage loses all.
    """
    fixes = np.full(len(sky.density), int(best), dtype=np.uint8)
    if not sky.density.any() and sky.visible.all():
        return fixes
    levels = FIX_LEVELS[best]
    steps = len(levels) - 2
    rise_s = [real.reacquire_s, *[real.refix_s / steps] * steps] if steps else [real.reacquire_s]
    drawn = rng.uniform(size=len(fixes)).tolist()
    step = len(levels) - 1
    for i, (density, visible, u) in enumerate(
        zip(sky.density.tolist(), sky.visible.tolist(), drawn, strict=True)
    ):
        lost = 1.0 - math.exp(-real.canopy_loss_per_s * density * interval_s)
        if not visible:
            step = 0
        elif u < lost:
            step = max(step - 1, 0)
        else:
            step = _risen(step, rise_s, 1.0 - density, interval_s, 1.0 - u)
        fixes[i] = levels[step]
    return fixes


def _risen(step: int, rise_s: list[float], openness: float, interval_s: float, u: float) -> int:
    """The level after an interval in which it may rise; levels that take no time come at once."""
    if openness <= 0.0:
        return step
    while step < len(rise_s) and rise_s[step] == 0.0:
        step += 1
    if step < len(rise_s) and u < 1.0 - math.exp(-openness * interval_s / rise_s[step]):
        step += 1
    return step


def _class_sigma(fix: NDArray[np.uint8], vehicle: VehicleParams) -> Array:
    """1-sigma (N, 3) of fix classes: the data sheet's for the best, geometric means down to single."""
    spec = vehicle.sensors.gnss
    best = np.array([spec.sigma_horizontal_m, spec.sigma_horizontal_m, spec.sigma_vertical_m])
    worse = vehicle.realism.gnss_single_sigma_m / spec.sigma_horizontal_m
    top = int(best_fix(spec))
    grown = np.where(fix == top, 1.0, np.where(fix <= int(Fix.SINGLE), worse, math.sqrt(worse)))
    return np.asarray(grown[:, None] * best)


def _position_error(
    fix: NDArray[np.uint8], weaker: Array, interval_s: float, vehicle: VehicleParams, noise: NoiseStreams
) -> tuple[Array, Array]:
    """Error (N, 3) of the position and its 1-sigma (N, 3), white in part and Gauss-Markov in the rest.

    Weak signals raise the white part. Fixes below the receiver's best have their own correlated error.
    """
    spec, real = vehicle.sensors.gnss, vehicle.realism
    top = (fix == int(best_fix(spec)))[:, None]
    slow = np.where(
        top,
        gauss_markov(noise.stream("gnss correlated"), len(fix), interval_s, spec.correlation_time_s),
        gauss_markov(noise.stream("gnss degraded"), len(fix), interval_s, real.gnss_single_correlation_s),
    )
    times = np.where(top, spec.correlation_time_s, real.gnss_single_correlation_s)
    share = np.where(times > 0.0, real.gnss_white_share, 1.0)
    white = noise.stream("gnss white").normal(size=(len(fix), 3)) * weaker[:, None]
    sigma = _class_sigma(fix, vehicle)
    error = sigma * (np.sqrt(share) * white + np.sqrt(1.0 - share) * slow)
    return error, sigma * np.sqrt(share * weaker[:, None] ** 2 + 1.0 - share)


def _multipath(
    position_m: Array, fix: NDArray[np.uint8], sky: Sky, vehicle: VehicleParams, noise: NoiseStreams
) -> Array:
    """Displacement (N, 3) by reflections under canopy: a fixed field of the place, not in the reported sigma.

    It shrinks with the sigma of the fix class: carrier phase is displaced by centimetres, code by metres.
    """
    real = vehicle.realism
    if real.gnss.canopy_multipath_m == 0.0 or not sky.density.any():
        return np.zeros_like(position_m)
    field = place_field(position_m, real.gnss.multipath_length_m, noise.stream("gnss multipath"))
    size = real.gnss.canopy_multipath_m * _class_sigma(fix, vehicle) / real.gnss_single_sigma_m
    return np.asarray(math.sqrt(2.0 / PLANE_WAVES) * sky.density[:, None] * size * field)
