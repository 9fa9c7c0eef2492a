"""Scales: wheel speed against the speed over ground (unit, radius, slip, wheels that roll while the robot
stands or stand while it moves), and the gyro about z against the yaw of the truth, else against the shape of
the measured path.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair, changed_field, scaled
from terrafusion.datasets.checks.motion import common_span, runs, wheel_speed, yaw_angles
from terrafusion.datasets.checks.path import PathScale, dead_reckoned, measured_paths, scales
from terrafusion.datasets.checks.path_model import model_by_fixes, model_by_truth
from terrafusion.datasets.core.arrays import Array, Complex
from terrafusion.datasets.core.bootstrap import BootstrapInterval, interval_of, resampled_rows
from terrafusion.datasets.core.channels import TERRAINS
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.recording import Recording

MOST_SLIP_FREE, SIGNIFICANT_RATIO = 1.04, 1.02
"""Driven wheels are never slower than the ground: a ratio above the first whose interval excludes the
second is no slip, but a wheel larger than stated."""
LARGEST_RADIUS_ERROR = 2.2
SMALL, FIRM_SLIP = 0.8, 0.94
"""Ratio below which wheel and ground speed differ too much for firm ground, and the same for the end of its
interval: a Warthog that skids on asphalt has 0.955 (norlab_drive)."""
SOFT = ("medium_sand", "loose_sand", "ploughed_soil", "mud", "snow", "ice")
"""Grounds on which such slip is usual."""
UNIT_ERROR = 0.1
WIDEST_RADIUS = 0.2
"""A radius makes one ratio: with an interval, or a spread of stretches, beyond this none is offered."""
FAST_MPS, EVEN = 3.0, 0.1
"""A robot that crawls on spinning wheels does so at their usual speeds and unevenly; a unit does neither."""
LARGEST_WHEEL_M = 0.5
"""Radius up to which a robot's wheels are expected (assumed)."""
STEEPEST = 0.05
"""Mean descent above which a robot may roll faster than its braked wheels."""
YAW_WINDOW_S, LEAST_YAW_WINDOWS, LEAST_YAW_R = 4.0, 12, 0.95
"""Yaw rates are compared as means over windows so long that a delay hardly matters."""
PATH_WINDOWS, CLEAR_GYRO = 8, 0.05
"""Fewer windows of a path count where the whole interval lies beyond the second."""
LARGE_GYRO, SURE_GYRO, WIDEST_GYRO = 0.02, 0.01, 0.05
"""A scale error counts from the first on, with its interval beyond the second and narrower than the third."""
MOST_GYRO_MISSING = 0.01
"""With more empty cells, as where a range was exceeded, turns are missing: no scale."""
MOST_GYRO = 0.2
"""Beyond this it is no scale, but another unit or axis."""
NOT_INDEPENDENT = "scores against this truth are then not independent of it"
UNITS = {
    "radps": {"rev/min": 2.0 * np.pi / 60.0, "deg/s": np.pi / 180.0, "rev/s": 2.0 * np.pi},
    "mps": {"km/h": 1.0 / 3.6, "cm/s": 0.01, "mm/s": 0.001},
}
"""Units that speeds may be in, and the factors that convert them to that of their column."""


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
        evidence += f"; {NOT_INDEPENDENT}"
    known = 1.0 + context.known("wheel_scale")
    spread = float(np.sqrt(np.average((fits.scale / scale.ratio - 1.0) ** 2, weights=fits.weight)))
    units = _fitting_units(context, scale, spread)
    if units:
        factor, names = next(iter(units.values())), " or ".join(units)
        yield Finding(
            "wheel-unit", "error", "wheels",
            f"the speeds look like {names}: the ground speed is {scale.ratio:.3g} times as large",
            evidence,
            f"multiply them by {factor:.6g}" if len(units) == 1 else "give the unit: more than one fits",
            scaled("wheels", factor, "speed") if len(units) == 1 else None,
        )  # fmt: skip
    elif scale.ratio > MOST_SLIP_FREE * known and scale.low > SIGNIFICANT_RATIO * known:
        yield _too_slow(context, scale, spread, evidence, wheels.unit, radius)
    elif (scale.ratio < SMALL * known or scale.high < FIRM_SLIP * known) and is_firm(context.recording):
        fitting = f"radius ({radius * scale.ratio:.4f} m fits)" if wheels.unit == "radps" else "speeds"
        fix = f"it may be slip; if the ground is firm, check wheel {fitting} and unit"
        if wheels.unit == "mps" and scale.ratio < LARGEST_WHEEL_M:
            fix += f": rad/s of a wheel with a radius of {scale.ratio:.3f} m would read so"
        yield Finding(
            "wheel-scale", "warning", "wheels",
            f"the wheels read {1.0 / scale.ratio - 1.0:.1%} too much: ground speed is {scale.ratio:.3f} "
            "times the wheel speed",
            evidence,
            fix,
        )  # fmt: skip


def _too_slow(
    context: CheckContext, scale: PathScale, spread: float, evidence: str, unit: str, radius: float
) -> Finding:
    downhill = _descent(context.recording) > STEEPEST
    fitting = radius * scale.ratio
    repair: Repair | None = None
    uneven = max(scale.high / scale.ratio - scale.low / scale.ratio, spread) > WIDEST_RADIUS
    if scale.ratio > LARGEST_RADIUS_ERROR or downhill or uneven:
        fix = "check wheel radius and unit"
        if uneven:
            fix += ", that both are of one robot, and that it does not move sideways, as on mecanum wheels: "
            fix += f"the ratio changes by {spread:.0%} between stretches"
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


def _fitting_units(context: CheckContext, scale: PathScale, spread: float) -> dict[str, float]:
    """The units that explain the ratio, where slip does not."""
    wheels, radius = context.recording.wheels, context.wheel_radius_m()
    assert wheels is not None
    assert radius is not None
    units = dict(UNITS[wheels.unit])
    if wheels.unit == "radps":
        units["m/s"] = 1.0 / radius
    elif (true_radius := context.true_radius_m()) is not None:
        units["rad/s"] = true_radius
    fitting = {name: factor for name, factor in units.items() if abs(scale.ratio / factor - 1.0) < UNIT_ERROR}
    commanded = command_ratio(context)
    if commanded is not None:
        return {
            n: factor for n, factor in fitting.items() if abs(commanded / factor - 1.0) < 2.0 * UNIT_ERROR
        }
    rated = float(np.nanpercentile(np.abs(wheels.side_speeds_mps(radius)), 95))
    return fitting if scale.ratio > 1.0 or (rated > FAST_MPS and spread < EVEN) else {}


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


def check_gyro_scale(context: CheckContext) -> Iterator[Finding]:
    """The gyro must turn as far as the robot does."""
    imu = context.recording.imu
    if imu is None or np.isnan(imu.gyro_radps[:, 2]).mean() > MOST_GYRO_MISSING:
        return
    found = _by_truth(context) or _by_path(context)
    if found is None:
        return
    error, source = found
    if (
        not LARGE_GYRO < abs(error.value) < MOST_GYRO
        or not error.is_beyond(SURE_GYRO)
        or error.high - error.low > WIDEST_GYRO
    ):
        return
    factor = 1.0 / (1.0 + error.value)
    yield Finding(
        "gyro-scale", "warning", "imu",
        f"gyro z reads {abs(error.value):.1%} too {'much' if error.value > 0.0 else 'little'}",
        f"{1.0 + error.value:.4f} times the turns by {source}, 95 % interval {1.0 + error.low:.4f} to "
        f"{1.0 + error.high:.4f}" + (f"; {NOT_INDEPENDENT}" if "truth" in source else ""),
        f"multiply gyro z by {factor:.4f}",
        changed_field("imu", "gyro_radps", lambda rates: rates * (1.0, 1.0, factor)),
    )  # fmt: skip


def _by_truth(context: CheckContext) -> tuple[BootstrapInterval, str] | None:
    known = yaw_angles(context)
    if "gyro" not in known or "truth" not in known:
        return None
    gyro, truth = known["gyro"], known["truth"]
    start, end = common_span(gyro, truth)
    if not end - start >= (LEAST_YAW_WINDOWS + 1) * YAW_WINDOW_S:
        return None
    grid = np.arange(start, end, YAW_WINDOW_S)
    x, y = truth.rates(grid), gyro.rates(grid)
    if min(x.std(), y.std()) <= 0.0 or np.corrcoef(x, y)[0, 1] < LEAST_YAW_R:
        return None
    draws = np.concatenate([np.arange(len(x))[None], resampled_rows(len(x))])
    a, b = (values[draws] - values[draws].mean(axis=1, keepdims=True) for values in (x, y))
    slope = np.sqrt((b**2).sum(axis=1) / np.maximum((a**2).sum(axis=1), 1e-12)) - 1.0
    return interval_of(float(slope[0]), slope[1:], len(x)), "the truth's yaw"


def _by_path(context: CheckContext) -> tuple[BootstrapInterval, str] | None:
    paths = (model_by_fixes, "the path of the fixes"), (model_by_truth, "the path of the truth")
    for model_by, name in paths:
        model = model_by(context)
        if model is not None and (model.windows >= PATH_WINDOWS or model.gyro_scale.is_beyond(CLEAR_GYRO)):
            return model.gyro_scale, name
    return None


WINDOW_S, LEAST_EXTENT_M = (10.0, 120.0), 5.0
"""Windows last so long that noise matters little against the path by wheels and gyro, within these limits."""
SIGMAS, FURTHER, STANDING = 5.0, 3.0, 0.15
"""A robot stands where its positions spread by less than so many sigma or this share of the extent of the
path by wheels and gyro, and where that extent is so many times as long."""
FROZEN_M = 1e-4


def check_standing(context: CheckContext) -> Iterator[Finding]:
    """The robot must move when its wheels roll, on soft ground they may spin, and stand when they stand."""
    reckoned = dead_reckoned(context)
    if reckoned is None:
        return
    t, rolled, path = reckoned
    pace = float(np.sum(np.diff(rolled) ** 2 / np.diff(t).clip(1e-3))) / max(
        float(rolled[-1]), 1e-3
    )  # moving
    named: set[str] = set()
    for measured in measured_paths(context.recording):
        least_m = max(LEAST_EXTENT_M, FURTHER * SIGMAS * measured.sigma_m)
        window_s = float(np.clip(1.5 * least_m / max(pace, 1e-3), *WINDOW_S))
        grid = np.arange(max(t[0], measured.t_s[0]), min(t[-1], measured.t_s[-1]), window_s)
        if len(grid) < 2:
            continue
        rolled_to = np.interp(measured.t_s, t, path.real) + 1j * np.interp(measured.t_s, t, path.imag)
        far, spread = (_extents(measured.t_s, place, grid) for place in (rolled_to, measured.place))
        still = spread < np.maximum(STANDING * far, SIGMAS * measured.sigma_m)
        standing = (far > least_m) & still & (spread > FROZEN_M)  # frozen fixes are another finding
        moves = _keeps_moving(measured.t_s, measured.place, grid, spread) & (spread > least_m)
        carried = _longest((far < STANDING * spread) & moves)
        if carried and carried.stop - carried.start > 1 and "carried" not in named:
            named.add("carried")
            yield _carried(measured.source, window_s, grid, carried, far, spread)
        longest = _longest(standing)
        if longest and "standing" not in named and is_firm(context.recording):
            named.add("standing")
            yield Finding(
                "standing", "warning", "wheels",
                "the wheels roll while the robot stands",
                f"by the {measured.source} it keeps within {spread[longest].max():.2f} m "
                f"{_in_each(window_s, grid, longest)}; wheels and gyro move by {far[longest].min():.1f} m "
                "and more",
                "leave these stretches out, or say that the ground is soft: nothing else tells how it "
                "slipped",
            )  # fmt: skip


def _carried(source: str, window_s: float, grid: Array, windows: slice, far: Array, spread: Array) -> Finding:
    return Finding(
        "carried", "warning", "wheels",
        "the wheels stand while the robot moves",
        f"by the {source} it moves by {spread[windows].min():.1f} m and more "
        f"{_in_each(window_s, grid, windows)}; wheels and gyro move by {far[windows].max():.1f} m at most",
        "leave these stretches out if it was pushed, towed or carried; else check the encoders there",
    )  # fmt: skip


def _in_each(window_s: float, grid: Array, windows: slice) -> str:
    return f"in each {window_s:.0f} s from t = {grid[windows.start]:.0f} to {grid[windows.stop]:.0f} s"


def _longest(found: NDArray[np.bool_]) -> slice | None:
    """The longest run of windows; None where there is none."""
    if not found.any():
        return None
    begins, ends = runs(found)
    longest = int(np.argmax(ends - begins))
    return slice(int(begins[longest]), int(ends[longest]))


def _keeps_moving(t_s: Array, place: Complex, grid: Array, extents: Array) -> NDArray[np.bool_]:
    """Whether positions (N,) move on in all quarters of each window: jumps, as by reflections, do not."""
    edges = np.searchsorted(t_s, np.interp(np.arange(4 * len(grid) - 3) / 4.0, np.arange(len(grid)), grid))
    total = np.concatenate([[0.0], np.cumsum(place - place[0])])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (np.diff(total[edges]) / np.diff(edges)).reshape(-1, 4)
    return np.asarray((np.abs(np.diff(mean, axis=1)) > 0.1 * extents[:, None]).all(axis=1))


def _extents(t_s: Array, place: Complex, grid: Array) -> Array:
    """Diagonal of the box about the positions in each interval of the grid; nan with fewer than three."""
    edges = np.searchsorted(t_s, grid)
    extents = np.full(len(grid) - 1, np.nan)
    for k, (first, last) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)):
        if last - first >= 3:
            part = place[first:last]
            extents[k] = float(np.hypot(np.ptp(part.real), np.ptp(part.imag)))
    return extents
