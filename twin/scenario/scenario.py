"""Scenarios: commands, ground, and reception of GNSS.

A scenario is a YAML file in `twin/params/scenarios` or the user's own, with
strict keys. Its numbers are choices, so they stand plain, unit in the key::

    description: two grounds
    duration_s: 60
    drive:
      - {duration_s: 5}
      - {duration_s: 55, v_mps: 1.0, yaw_rate_radps: 0.1}
    route:
      - {terrain: asphalt, length_m: 20}
      - {terrain: loose_sand}
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.quantity import Quantity, checked_number
from terrafusion.twin.model.ground import SoilPatches, Variation

MAX_SLOPE_DEG = 25.0
Start = Annotated[float, Quantity("s", 0.0, 36000.0)]
Duration = Annotated[float, Quantity("s", 0.01, 36000.0)]
Speed = Annotated[float, Quantity("m/s", -20.0, 20.0)]
YawRate = Annotated[float, Quantity("rad/s", -10.0, 10.0)]
Period = Annotated[float, Quantity("s", 0.05, 36000.0)]
PLACE = Quantity("m", -5.0, 5.0, size=3)
"""Where a payload may ride, body frame."""


@dataclass(frozen=True)
class DriveSegment:
    """Commanded twist over `duration_s`: v + v_amplitude sin(phase), likewise the yaw rate.

    `curvature_per_m` times the speed is added to the yaw rate.

    The phase is zero at the segment's start and runs with `period_s`; with
    `end_period_s` the frequency rises (or falls) linearly to 1/end_period_s.
    """

    duration_s: Duration
    v_mps: Speed = 0.0
    yaw_rate_radps: YawRate = 0.0
    v_amplitude_mps: Speed = 0.0
    yaw_rate_amplitude_radps: YawRate = 0.0
    period_s: Period = 60.0
    end_period_s: Period = 0.0
    curvature_per_m: Annotated[float, Quantity("1/m", -20.0, 20.0)] = 0.0

    def twist(self, t_s: Array) -> Array:
        """Twist (N, 2), m/s and rad/s, at times (N,) from the segment's start."""
        start = 1.0 / self.period_s
        sweep = (1.0 / self.end_period_s - start) / self.duration_s if self.end_period_s > 0 else 0.0
        wave = np.sin(2.0 * np.pi * (start * t_s + 0.5 * sweep * t_s**2))
        v = self.v_mps + self.v_amplitude_mps * wave
        rate = self.yaw_rate_radps + self.yaw_rate_amplitude_radps * wave
        return np.stack([v, rate + self.curvature_per_m * v if self.curvature_per_m else rate], axis=1)


@dataclass(frozen=True)
class RouteLeg:
    """Ground `terrain` for `length` metres (or seconds, see `Scenario.route_over`); the last has none.

    `moisture_percent`, where known, is checked against the range in which the soil was measured.
    """

    terrain: str
    length: float | None = None
    moisture_percent: float | None = None


@dataclass(frozen=True)
class Interval:
    """From `start_s` for `duration_s` seconds."""

    start_s: Start
    duration_s: Duration

    def covers(self, t_s: Array) -> NDArray[np.bool_]:
        """Which of the times lie inside."""
        return (t_s >= self.start_s) & (t_s < self.start_s + self.duration_s)


@dataclass(frozen=True)
class Stretch:
    """From `start_m` driven forward for `length_m` metres."""

    start_m: Annotated[float, Quantity("m", 0.0, 1e6)]
    length_m: Annotated[float, Quantity("m", 0.1, 1e6)]

    def covers(self, travel_m: Array) -> NDArray[np.bool_]:
        """Which of the distances lie inside."""
        return (travel_m >= self.start_m) & (travel_m < self.start_m + self.length_m)


Zone = Interval | Stretch
"""A part of the drive, by time or by travel."""


def inside(zone: Zone, t_s: Array, travel_m: Array) -> NDArray[np.bool_]:
    """Which samples (N,) at times and distances driven (N,) lie in the zone."""
    return zone.covers(t_s if isinstance(zone, Interval) else travel_m)


Density = Annotated[float, Quantity("", 0.0, 1.0)]
"""Of trees: from 0 (open sky) to 1 (no class of fix lasts)."""


@dataclass(frozen=True)
class CanopyInterval(Interval):
    """Trees from a time on."""

    density: Density


@dataclass(frozen=True)
class CanopyStretch(Stretch):
    """Trees from a distance driven on."""

    density: Density


Canopy = CanopyInterval | CanopyStretch
"""Trees over a part of the drive."""


@dataclass(frozen=True)
class Scenario:
    """One drive.

    `route_over` is "travel" (legs in metres driven) or "time" (in seconds);
    grounds join smoothly over `transition` metres or seconds. `variation` and `patches`
    make the whole plane uneven, differently for each seed (see `ground`). With `waypoints`
    ((x, y) m in the plane from the start, x east on flat ground) the robot steers by
    its true pose at `waypoint_speed_mps` instead of following `drive`. Commands accelerate by at most
    `max_accel_mps2`; the vehicle's own limit holds in any case.

    The ground rises by `slope_deg` towards `aspect_deg` (0 east, left positive) and by
    `cross_slope_deg` to the left of the start heading; both make one plane. The payload's
    centre of gravity is at `payload_at_m` (body frame), None for the vehicle's own.
    `gnss_fix` is the receiver's fix class, None for its best; it is degraded under `canopy` and
    silent in `gnss_outages`.
    """

    name: str
    duration_s: float
    description: str = ""
    drive: tuple[DriveSegment, ...] = ()
    stops: tuple[Interval, ...] = ()
    waypoints: tuple[tuple[float, float], ...] = ()
    waypoint_speed_mps: float = 1.0
    max_accel_mps2: float = math.inf
    route: tuple[RouteLeg, ...] = (RouteLeg("asphalt"),)
    route_over: str = "travel"
    transition: float = 0.3
    variation: Variation | None = None
    patches: SoilPatches | None = None
    slope_deg: float = 0.0
    cross_slope_deg: float = 0.0
    aspect_deg: float = 0.0
    heading_deg: float = 0.0
    payload_kg: float = 0.0
    payload_at_m: tuple[float, float, float] | None = None
    gnss_fix: Fix | None = None
    gnss_outages: tuple[Zone, ...] = ()
    canopy: tuple[Canopy, ...] = ()

    def commanded(self, t_s: Array) -> Array:
        """Wanted twist (N, 2) at times (N,) from the start, m/s and rad/s, before any slew limit."""
        twist = np.zeros((len(t_s), 2))
        start = 0.0
        for segment in self.drive:
            inside = (t_s >= start) & (t_s < start + segment.duration_s)
            twist[inside] = segment.twist(t_s[inside] - start)
            start += segment.duration_s
        for stop in self.stops:
            twist[stop.covers(t_s)] = 0.0
        return twist

    def plane(self) -> tuple[float, float]:
        """Slope and aspect (direction uphill), rad, of the plane that `slope_deg` and `cross_slope_deg` make.

        Their tangents add as vectors: heading uphill, gravity along and across the robot, over
        gravity into the ground, is tan(slope) and tan(cross slope).
        """
        if self.cross_slope_deg == 0.0:
            return math.radians(self.slope_deg), math.radians(self.aspect_deg)
        along, across = (math.tan(math.radians(a)) for a in (self.slope_deg, self.cross_slope_deg))
        uphill, left = math.radians(self.aspect_deg), math.radians(self.heading_deg + 90.0)
        east = along * math.cos(uphill) + across * math.cos(left)
        north = along * math.sin(uphill) + across * math.sin(left)
        return math.atan(math.hypot(east, north)), math.atan2(north, east)

    def with_ground(
        self, terrain: str | None, slope_deg: float | None, cross_slope_deg: float | None = None
    ) -> Self:
        """The same drive on one terrain throughout and on another slope, where given.

        Raises:
            ConfigError: slope outside 0 to 25 deg, or cross-slope outside -25 to 25 deg.
        """
        changed = self
        if terrain is not None:
            changed = dataclasses.replace(changed, route=(RouteLeg(terrain),))
        if slope_deg is not None:
            _check_slope("slope", slope_deg, 0.0)
            changed = dataclasses.replace(changed, slope_deg=slope_deg)
        if cross_slope_deg is not None:
            _check_slope("cross-slope", cross_slope_deg, -MAX_SLOPE_DEG)
            changed = dataclasses.replace(changed, cross_slope_deg=cross_slope_deg)
        return changed

    def with_payload(self, payload_kg: float | None, payload_at_m: tuple[float, float, float] | None) -> Self:
        """The same drive with another payload, at another place, where given.

        Raises:
            ConfigError: the place is not three numbers within 5 m of the body origin, or has no payload.
        """
        changed = self
        if payload_kg is not None:
            changed = dataclasses.replace(changed, payload_kg=payload_kg)
        if payload_at_m is not None:
            checked_number(payload_at_m, PLACE, file="the run", key="payload_at_m")
            # A mass of 0 that is given is a level of a batch; one that is not was forgotten.
            if payload_kg is None and self.payload_kg == 0.0:
                raise ConfigError(
                    "the payload has a place but no mass", file=self.name, remedy="give its mass in kg, too"
                )
            changed = dataclasses.replace(changed, payload_at_m=payload_at_m)
        return changed


def _check_slope(name: str, value_deg: float, low_deg: float) -> None:
    if not low_deg <= value_deg <= MAX_SLOPE_DEG:
        raise ConfigError(
            f"{name} {value_deg:g} deg is out of range", remedy=f"give {low_deg:g} to {MAX_SLOPE_DEG:g} deg"
        )
