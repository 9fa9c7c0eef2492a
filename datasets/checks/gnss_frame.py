"""The frame and unit of the fixes: metres or degrees, and velocities against differenced positions."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.finding import (
    CheckContext,
    Finding,
    Repair,
    changed,
    changed_field,
    with_fields,
)
from terrafusion.datasets.checks.path import fit_windows, path_by
from terrafusion.datasets.checks.truth import UNITS
from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.frames import geodetic_to_enu
from terrafusion.datasets.core.recording import Recording

DEGREE_RATIO, RADIAN_RATIO = (6e-6, 5e-5), (1e-7, 9e-7)
"""Spread of the fixes over that of the wheels' path: 1 m is 9e-6 deg or 1.6e-7 rad, more on a parallel."""
SPEED_UNITS = {"km/h": 3.6, "knots": 1.943844, "miles/h": 2.236936, "cm/s": 100.0, "mm/s": 1000.0}
UNIT_ERROR, ANGLE_ERROR, SURE_R = 0.1, np.radians(20.0), 0.8
CHORD_S = (0.5, 10.0)
CLEARER = 3.0
"""Ratio of what is left of the positions from which on the path tells latitude from longitude."""
MOST_SIGMA_M = 10.0
"""No receiver that shows a unit has a larger sigma: it is in the unit of the positions."""


def check_degrees(context: CheckContext) -> Iterator[Finding]:
    """Positions must be metres, not latitude and longitude."""
    gnss, path = context.recording.gnss, path_by(context.recording, "gnss")
    if gnss is None or path is None:
        return
    largest = float(max(np.abs(path.place.real).max(), np.abs(path.place.imag).max()))
    fits = fit_windows(context, dataclasses.replace(path, sigma_m=0.0)) if largest <= 180.0 else None
    if fits is None:
        return
    ratio = float(np.median(fits.span_ratio))
    for unit, to_degrees, (low, high) in (
        ("degrees", 1.0, DEGREE_RATIO),
        ("radians", 180.0 / np.pi, RADIAN_RATIO),
    ):
        if low < ratio < high and largest * to_degrees <= 180.0:
            swapped, assumed = _latitude_east(context, gnss, to_degrees)
            yield Finding(
                "gnss-degrees", "error", "gnss",
                f"positions look like latitude and longitude in {unit}, not metres",
                f"they spread {ratio:.2g} times as far as the path of the wheels",
                f"convert to east and north about the first fix, using {'east' if swapped else 'north'} "
                f"as the latitude{' (assumed)' if assumed else ''}",
                partial(_to_metres, to_degrees=to_degrees, swapped=swapped),
            )  # fmt: skip
            return


def _latitude_east(context: CheckContext, gnss: Gnss, to_degrees: float) -> tuple[bool, bool]:
    """Whether the latitude is in the east column, and whether that is only assumed."""
    known = np.abs(gnss.enu_m[np.isfinite(gnss.enu_m[:, :2]).all(axis=1), :2]) * to_degrees
    if known.max(axis=0).max() > 90.0:
        return bool(known[:, 1].max() > 90.0), False
    yaw = motion.gyro_angle(context.recording)
    metric = _to_metres(context.recording, to_degrees, swapped=False).gnss
    if yaw is None or metric is None:
        return False, True
    both = motion.course_agreement(yaw, metric, context.recording.start_ns)
    if both is not None and abs(both.r) >= SURE_R:
        return both.r < 0.0, False
    north, east = (_left_by_path(context, to_degrees, swapped=swapped) for swapped in (False, True))
    if north is None or east is None:
        return False, True
    return east < north, max(north, east) < CLEARER * min(north, east)


def _left_by_path(context: CheckContext, to_degrees: float, *, swapped: bool) -> float | None:
    """Share of the converted positions' spread that the path of wheels and gyro does not explain."""
    metric = CheckContext(_to_metres(context.recording, to_degrees, swapped=swapped), context.rig)
    fits = fit_windows(metric, path_by(metric.recording, "gnss"))
    return None if fits is None else 1.0 - float(np.average(fits.coherence**2, weights=fits.weight))


def _to_metres(recording: Recording, to_degrees: float, *, swapped: bool) -> Recording:
    gnss = recording.gnss
    assert gnss is not None
    place = gnss.enu_m[:, [0, 1] if swapped else [1, 0]] * to_degrees
    first = int(np.argmax(np.isfinite(place).all(axis=1)))
    height = gnss.enu_m[:, 2]
    base = float(height[first]) if np.isfinite(height[first]) else 0.0
    datum = (float(place[first, 0]), float(place[first, 1]), base)
    enu = geodetic_to_enu(np.column_stack([place, np.nan_to_num(height, nan=base)]), datum)
    enu[~np.isfinite(height), 2] = np.nan
    return dataclasses.replace(with_fields(recording, "gnss", enu_m=enu), datum=datum)


@dataclass(frozen=True)
class VelocityFit:
    """Least squares of velocities on differenced positions: complex factor, correlation, and the same
    with the positions mirrored (east - i north)."""

    factor: complex
    r: float
    mirrored: complex
    mirrored_r: float

    def reflection(self) -> str | None:
        """Which reflection of the positions fits the velocities clearly better than none."""
        if not self.mirrored_r > max(SURE_R, self.r + 0.02):
            return None
        angle = float(np.angle(self.mirrored))
        if abs(angle) < ANGLE_ERROR:
            return "north"
        if abs(angle) > np.pi - ANGLE_ERROR:
            return "east"
        return "swap" if abs(angle - 0.5 * np.pi) < ANGLE_ERROR else None


SIGNS = {"north": (1.0, -1.0), "east": (-1.0, 1.0), "swap": (1.0, 1.0)}


def velocity_fit(gnss: Gnss) -> VelocityFit | None:
    """The receiver's velocities against its positions; None where it gives none, or hardly moves."""
    if gnss.velocity_enu_mps is None:
        return None
    velocity, place = motion.on_plane(gnss.velocity_enu_mps), motion.on_plane(gnss.enu_m)
    known = np.isfinite(velocity) & np.isfinite(place) & (gnss.fix > 0)
    if known.sum() < 20:
        return None
    t, velocity, place = motion.seconds(gnss.t_ns[known], int(gnss.t_ns[0])), velocity[known], place[known]
    if t[-1] <= t[0]:
        return None
    sigma = motion.typical_sigma(gnss)
    spread = float(np.abs(place - place.mean()).max())
    if spread < max(2.0, 10.0 * sigma):
        return None
    pace = spread / (t[-1] - t[0])
    grid = np.arange(t[0], t[-1], float(np.clip(10.0 * sigma / max(pace, 1e-3), *CHORD_S)))
    u, v = np.diff(np.interp(grid, t, place)), np.diff(np.interp(grid, t, motion.cumulative(t, velocity)))
    uu, vv = float(np.sum(np.abs(u) ** 2)), float(np.sum(np.abs(v) ** 2))
    if len(u) < 8 or np.sqrt(uu / len(u)) < max(0.05, 5.0 * sigma):
        return None
    straight, mirrored = complex(np.sum(v * np.conj(u))), complex(np.sum(v * u))
    power = np.sqrt(uu * vv) if vv > 0.0 else np.inf
    return VelocityFit(straight / uu, abs(straight) / power, mirrored / uu, abs(mirrored) / power)


def check_velocity(context: CheckContext) -> Iterator[Finding]:
    """The receiver's velocities must be the rate of its positions."""
    gnss = context.recording.gnss
    fit = velocity_fit(gnss) if gnss is not None else None
    if gnss is None or fit is None:
        return
    unit = _position_unit(fit)
    if unit is not None:
        sigmas = motion.typical_sigma(gnss) > MOST_SIGMA_M
        yield Finding(
            "gnss-unit", "error", "gnss",
            f"positions look like {unit}",
            f"they change {1.0 / abs(fit.factor):.4g} times as fast as the velocities say",
            f"divide them by {UNITS[unit]:.6g}" + ", and their sigmas" * sigmas,
            changed("gnss", _divided, factor=UNITS[unit], sigmas=sigmas),
        )  # fmt: skip
        return
    if _positions_mirrored(context, gnss):
        return
    found = _velocity_fault(fit)
    if found is None:
        return
    what, fix, repair = found
    evidence = (
        f"against differenced positions: factor {abs(fit.factor):.2f} at "
        f"{np.degrees(np.angle(fit.factor)):.0f} deg, correlation {fit.r:.2f}; "
        f"{fit.mirrored_r:.2f} if mirrored"
    )
    yield Finding("gnss-velocity", "warning", "gnss", f"velocities {what}", evidence, fix, repair)


def check_upward_velocity(context: CheckContext) -> Iterator[Finding]:
    """Upward velocities must be the rate of the heights; with z down, as in NED, they have the other sign."""
    gnss = context.recording.gnss
    if gnss is None or gnss.velocity_enu_mps is None:
        return
    first = np.array([1.0, 0.0, 0.0])
    upwards = dataclasses.replace(
        gnss,
        enu_m=gnss.enu_m[:, [2]] * first,
        velocity_enu_mps=gnss.velocity_enu_mps[:, [2]] * first,
        sigma_enu_m=gnss.sigma_enu_m[:, [2, 2, 2]],
    )
    fit = velocity_fit(upwards)
    if fit is None or fit.r < SURE_R or not -1.5 < fit.factor.real < -0.5:
        return
    yield Finding(
        "gnss-velocity", "warning", "gnss",
        "velocities count downwards, as in NED",
        f"against differenced heights: factor {fit.factor.real:.2f}, correlation {fit.r:.2f}",
        "change the sign of the upward velocity",
        changed_field("gnss", "velocity_enu_mps", lambda velocity: velocity * (1.0, 1.0, -1.0)),
    )  # fmt: skip


def _position_unit(fit: VelocityFit) -> str | None:
    """The unit that positions have if velocities are in m/s, where they run alike; None for metres."""
    if fit.r < SURE_R or abs(np.angle(fit.factor)) > ANGLE_ERROR:
        return None
    return next((u for u, factor in UNITS.items() if abs(abs(fit.factor) * factor - 1.0) < UNIT_ERROR), None)


def _divided(gnss: Gnss, factor: float, sigmas: bool) -> Gnss:
    sigma = gnss.sigma_enu_m / factor if sigmas else gnss.sigma_enu_m
    return dataclasses.replace(gnss, enu_m=gnss.enu_m / factor, sigma_enu_m=sigma)


def _positions_mirrored(context: CheckContext, gnss: Gnss) -> bool:
    """Whether the positions turn against the gyro: see yaw_agreement.check_turns."""
    yaw = motion.gyro_angle(context.recording)
    both = motion.course_agreement(yaw, gnss, context.recording.start_ns) if yaw is not None else None
    return both is not None and both.r < -0.5


def _velocity_fault(fit: VelocityFit) -> tuple[str, str, Repair] | None:
    size, turn = abs(fit.factor), float(np.angle(fit.factor))
    if fit.r > SURE_R and abs(turn) < ANGLE_ERROR:
        for unit, factor in SPEED_UNITS.items():
            if abs(size / factor - 1.0) < UNIT_ERROR:
                return f"look like {unit}", f"divide by {factor:g}", _velocities(scale=1.0 / factor)
        if 0.5 < size < 1.5:
            return None
    reflection = fit.reflection() if 0.5 < abs(fit.mirrored) < 1.5 else None
    if reflection == "swap":
        return "have east and north swapped", "swap them", _velocities(swap=True)
    if reflection is not None:
        repair = _velocities(signs=SIGNS[reflection])
        return f"have the wrong sign of {reflection}", f"change the sign of {reflection}", repair
    if fit.r > fit.mirrored_r + 0.02 and abs(turn) > np.pi - ANGLE_ERROR and 0.5 < size < 1.5:
        repair = _velocities(signs=(-1.0, -1.0))
        return "have the wrong sign", "change the sign of east and north", repair
    left_out = changed("gnss", dataclasses.replace, velocity_enu_mps=None, sigma_v_mps=None)
    return "do not follow the positions", "leave the velocities out", left_out


def _velocities(scale: float = 1.0, *, swap: bool = False, signs: tuple[float, float] = (1.0, 1.0)) -> Repair:
    """A repair that scales the velocities, swaps east and north, and changes their signs."""

    def repaired(gnss: Gnss) -> Gnss:
        assert gnss.velocity_enu_mps is not None
        velocity = gnss.velocity_enu_mps[:, _order(swap)] * (scale * signs[0], scale * signs[1], scale)
        sigma = None if gnss.sigma_v_mps is None else gnss.sigma_v_mps * scale
        return dataclasses.replace(gnss, velocity_enu_mps=velocity, sigma_v_mps=sigma)

    return changed("gnss", repaired)


def _order(swap: bool) -> list[int]:
    return [1, 0, 2] if swap else [0, 1, 2]


def reflection(recording: Recording) -> tuple[str, Repair]:
    """What undoes mirrored positions: what the velocities show, else a swap of east and north."""
    fit = velocity_fit(recording.gnss) if recording.gnss is not None else None
    axis = fit.reflection() if fit is not None else None
    both = axis is None and _velocities_mirrored(recording)
    if axis is None:
        fix = "swap east and north" + ", of the velocities, too" * both
        fix += " (assumed: one of them may have the wrong sign instead, turning the map)"
    elif axis == "swap":
        fix = "swap east and north, as the velocities show"
    else:
        fix = f"change the sign of {axis}, as the velocities show"
    swap = axis in (None, "swap")
    return fix, changed("gnss", _reflected, swap=swap, signs=SIGNS[axis or "swap"], velocities=both)


def _velocities_mirrored(recording: Recording) -> bool:
    """Whether the course of the velocities turns against the gyro, as that of the positions does."""
    gnss, yaw = recording.gnss, motion.gyro_angle(recording)
    if gnss is None or yaw is None or gnss.velocity_enu_mps is None:
        return False
    known = np.isfinite(gnss.velocity_enu_mps[:, :2]).all(axis=1)
    moved, velocity = gnss.select(known), motion.on_plane(gnss.velocity_enu_mps[known])
    path = motion.cumulative(motion.seconds(moved.t_ns, recording.start_ns), velocity)
    enu = np.column_stack([path.real, path.imag, np.zeros(len(path))])
    moved = dataclasses.replace(moved, enu_m=enu, sigma_enu_m=np.zeros_like(enu))
    both = motion.course_agreement(yaw, moved, recording.start_ns)
    return both is not None and both.r < -SURE_R


def _reflected(gnss: Gnss, swap: bool, signs: tuple[float, float], velocities: bool) -> Gnss:
    enu, sigma = gnss.enu_m[:, _order(swap)] * (*signs, 1.0), gnss.sigma_enu_m[:, _order(swap)]
    velocity = gnss.velocity_enu_mps
    if velocities and velocity is not None:
        velocity = velocity[:, _order(swap)] * (*signs, 1.0)
    return dataclasses.replace(gnss, enu_m=enu, sigma_enu_m=sigma, velocity_enu_mps=velocity)
