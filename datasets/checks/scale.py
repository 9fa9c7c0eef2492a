"""Wheel speed compared with the speed over ground: unit, radius, slip."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair, scaled
from terrafusion.datasets.checks.motion import wheel_speed
from terrafusion.datasets.checks.path import PathScale, scales
from terrafusion.datasets.core.channels import TERRAINS
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.recording import Recording

MOST_SLIP_FREE, SURELY_MORE = 1.04, 1.02
"""Driven wheels are never slower than the ground: a ratio above the first whose interval excludes the
second is no slip, but a wheel larger than stated."""
LARGEST_RADIUS_ERROR = 2.2
SMALL, FIRM_SLIP = 0.8, 0.94
"""Ratio below which wheel and ground speed differ too much for firm ground, and the same for the end of its
interval: a Warthog that skids on asphalt has 0.955 (norlab_drive)."""
SOFT = ("medium_sand", "loose_sand", "ploughed_soil", "mud", "snow", "ice")
"""Grounds on which such slip is usual."""
UNIT_ERROR = 0.1
FAST_MPS, EVEN = 3.0, 0.1
"""A robot that crawls on spinning wheels does so at their usual speeds and unevenly; a unit does neither."""
STEEPEST = 0.05
"""Mean descent above which a robot may roll faster than its braked wheels."""


@dataclass(frozen=True)
class SpeedUnit:
    """A unit that speeds may be in, and the factor that converts them to that of their column."""

    name: str
    factor: float


UNITS = {
    "radps": (
        SpeedUnit("rev/min", 2.0 * np.pi / 60.0),
        SpeedUnit("deg/s", np.pi / 180.0),
        SpeedUnit("rev/s", 2.0 * np.pi),
    ),
    "mps": (SpeedUnit("km/h", 1.0 / 3.6), SpeedUnit("cm/s", 0.01), SpeedUnit("mm/s", 0.001)),
}


def check_speed_scale(context: CheckContext) -> Iterator[Finding]:
    """Wheel speed against the speed over ground."""
    wheels, radius = context.recording.wheels, context.wheel_radius_m()
    found = scales(context)
    if wheels is None or radius is None or not found:
        return
    scale, fits = min(found, key=lambda both: both[0].high - both[0].low)
    evidence = (
        f"{scale.low:.3f} to {scale.high:.3f} (95 %) in {scale.windows} stretches by the {scale.source}"
    )
    if scale.source == "truth":
        evidence += "; scores against this truth are then not independent of it"
    known = 1.0 + context.known("wheel_scale")
    units = _fitting_units(context, scale, float(np.std(fits.scale) / np.median(fits.scale)))
    if units:
        factor = units[0].factor
        names = " or ".join(unit.name for unit in units)
        yield Finding(
            "wheel-unit", "error", "wheels",
            f"the speeds look like {names}: the ground speed is {scale.ratio:.3g} times as large",
            evidence,
            f"multiply them by {factor:.6g}" if len(units) == 1 else "give the unit: more than one fits",
            scaled("wheels", factor, "speed") if len(units) == 1 else None,
        )  # fmt: skip
    elif scale.ratio > MOST_SLIP_FREE * known and scale.low > SURELY_MORE * known:
        yield _too_slow(context, scale, evidence, wheels.unit, radius)
    elif (scale.ratio < SMALL * known or scale.high < FIRM_SLIP * known) and is_firm(context.recording):
        fitting = f"radius ({radius * scale.ratio:.4f} m fits)" if wheels.unit == "radps" else "speeds"
        yield Finding(
            "wheel-scale", "warning", "wheels",
            f"the wheels read {1.0 / scale.ratio - 1.0:.1%} too much: ground speed is {scale.ratio:.3f} "
            "times the wheel speed",
            evidence,
            f"it may be slip; if the ground is firm, check wheel {fitting} and unit",
        )  # fmt: skip


def _too_slow(context: CheckContext, scale: PathScale, evidence: str, unit: str, radius: float) -> Finding:
    downhill = _descent(context.recording) > STEEPEST
    fitting = radius * scale.ratio
    repair: Repair | None = None
    if scale.ratio > LARGEST_RADIUS_ERROR or downhill:
        fix = "check wheel radius and unit"
        fix += ", or did it roll downhill on braked wheels?" if downhill else ""
    elif unit == "mps":
        repair = scaled("wheels", scale.ratio, "speed")
        fix = f"multiply the speeds by {scale.ratio:.3f}"
    else:
        repair = partial(apply, conventions=Conventions(wheel_radius_m=fitting))
        fix = f"use a wheel radius of {fitting:.4f} m instead of {radius:.4f} m"
    what = f"ground speed is {scale.ratio:.3f} times the wheel speed, which slip does not explain"
    return Finding("wheel-radius", "warning", "wheels", what, evidence, fix, repair)


def command_ratio(context: CheckContext) -> float | None:
    """Commanded speed over wheel speed, by least squares; None without a command that they follow."""
    driven, command = wheel_speed(context, metric=True), context.recording.command
    if driven is None or command is None:
        return None
    known = np.isfinite(command.v_mps)
    if known.sum() < 10:
        return None
    t, v = driven
    commanded = np.interp(t, (command.t_ns[known] - context.recording.start_ns) * 1e-9, command.v_mps[known])
    power = float(np.sum(v**2)), float(np.sum(commanded**2))
    if min(power) <= 0.0:
        return None
    r = float(np.sum(commanded * v)) / np.sqrt(power[0] * power[1])
    return float(np.sqrt(power[1] / power[0])) if r > 0.8 else None


def _fitting_units(context: CheckContext, scale: PathScale, spread: float) -> list[SpeedUnit]:
    """The units that explain the ratio, where slip does not."""
    wheels, radius = context.recording.wheels, context.wheel_radius_m()
    assert wheels is not None
    assert radius is not None
    units = list(UNITS[wheels.unit])
    if wheels.unit == "radps":
        units.append(SpeedUnit("m/s", 1.0 / radius))
    elif (true_radius := context.true_radius_m()) is not None:
        units.append(SpeedUnit("rad/s", true_radius))
    fitting = [unit for unit in units if abs(scale.ratio / unit.factor - 1.0) < UNIT_ERROR]
    commanded = command_ratio(context)
    if commanded is not None:
        return [unit for unit in fitting if abs(commanded / unit.factor - 1.0) < 2.0 * UNIT_ERROR]
    rated = float(np.nanpercentile(np.abs(wheels.side_speeds_mps(radius)), 95))
    return fitting if scale.ratio > 1.0 or (rated > FAST_MPS and spread < EVEN) else []


def _descent(recording: Recording) -> float:
    """Height lost over horizontal distance, between the first and last fix; 0 where heights are unknown."""
    gnss = recording.gnss
    if gnss is None:
        return 0.0
    enu = gnss.enu_m[np.isfinite(gnss.enu_m).all(axis=1)]
    if len(enu) < 2:
        return 0.0
    distance = float(np.hypot(*(enu[-1] - enu[0])[:2]))
    return float(enu[0, 2] - enu[-1, 2]) / distance if distance > 1.0 else 0.0


def is_firm(recording: Recording) -> bool:
    """Whether the ground is not known to be soft."""
    if recording.terrain_name in TERRAINS:
        return recording.terrain_name not in SOFT
    labels = {recording.terrain_name}
    if recording.terrain is not None:
        labels |= set(map(str, recording.terrain.label.tolist()))
    return not labels & set(SOFT)
