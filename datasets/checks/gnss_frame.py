"""What the fixes are given in: metres or degrees, and velocities beside the positions."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair
from terrafusion.datasets.checks.path import compare, places
from terrafusion.datasets.checks.yaw_signals import account, course_agreement, seconds, typical_sigma
from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.frames import geodetic_to_enu
from terrafusion.datasets.core.recording import Recording

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

DEGREE_RATIO, RADIAN_RATIO = (6e-6, 5e-5), (1e-7, 9e-7)
"""Spread of the fixes over that of the wheels' path: 1 m is 9e-6 deg or 1.6e-7 rad, more on a parallel."""
SPEED_UNITS = {"km/h": 3.6, "knots": 1.943844, "miles/h": 2.236936, "cm/s": 100.0, "mm/s": 1000.0}
UNIT_ERROR, ANGLE_ERROR, SURE_R = 0.1, np.radians(20.0), 0.8
CHORD_S = (0.5, 10.0)


def check_degrees(context: CheckContext) -> Iterator[Finding]:
    """Positions must be metres, not latitude and longitude."""
    gnss = context.recording.gnss
    true = next((one for one in places(context.recording) if one.source == "gnss"), None)
    if gnss is None or true is None:
        return
    largest = float(max(np.abs(true.place.real).max(), np.abs(true.place.imag).max()))
    windows = compare(context, dataclasses.replace(true, sigma_m=0.0)) if largest <= 180.0 else None
    if windows is None:
        return
    ratio = float(np.median(windows.span_ratio))
    for unit, to_degrees, (low, high) in (
        ("degrees", 1.0, DEGREE_RATIO),
        ("radians", 180.0 / np.pi, RADIAN_RATIO),
    ):
        if low < ratio < high and largest * to_degrees <= 180.0:
            swapped, assumed = _latitude_east(context, gnss, to_degrees)
            yield Finding(
                "gnss-degrees",
                "error",
                "gnss",
                f"positions look like latitude and longitude in {unit}, not metres",
                f"they spread {ratio:.2g} times as far as the path of the wheels",
                f"convert to east and north about the first fix, taking "
                f"{'east' if swapped else 'north'} for the latitude{' (assumed)' if assumed else ''}",
                partial(_to_metres, to_degrees=to_degrees, swapped=swapped),
            )
            return


def _latitude_east(context: CheckContext, gnss: Gnss, to_degrees: float) -> tuple[bool, bool]:
    """Whether the latitude stands in the east column, and whether that is only assumed."""
    known = np.abs(gnss.enu_m[np.isfinite(gnss.enu_m[:, :2]).all(axis=1), :2]) * to_degrees
    if known.max(axis=0).max() > 90.0:
        return bool(known[:, 1].max() > 90.0), False
    imu = context.recording.imu
    turned = None if imu is None else account(context.recording.start_ns, imu.t_ns, imu.gyro_radps[:, 2])
    if turned is None:
        return False, True
    metric = _to_metres(context.recording, to_degrees, swapped=False).gnss
    both = course_agreement(turned, metric, context.recording.start_ns) if metric is not None else None
    if both is None or abs(both.r) < SURE_R:
        return False, True
    return both.r < 0.0, False


def _to_metres(recording: Recording, to_degrees: float, *, swapped: bool) -> Recording:
    gnss = recording.gnss
    assert gnss is not None
    order = [0, 1] if swapped else [1, 0]
    place = gnss.enu_m[:, order] * to_degrees
    first = int(np.flatnonzero(np.isfinite(place).all(axis=1))[0])
    height = gnss.enu_m[:, 2]
    base = float(height[first]) if np.isfinite(height[first]) else 0.0
    datum = (float(place[first, 0]), float(place[first, 1]), base)
    enu = geodetic_to_enu(np.column_stack([place, np.nan_to_num(height, nan=base)]), datum)
    enu[~np.isfinite(height), 2] = np.nan
    return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, enu_m=enu), datum=datum)


@dataclass(frozen=True)
class VelocityFit:
    """Velocities by least squares from differenced positions: a factor on them, or on their mirror image
    (east - i north), each with its correlation."""

    factor: complex
    r: float
    mirrored: complex
    mirrored_r: float


def velocity_fit(gnss: Gnss) -> VelocityFit | None:
    """The receiver's velocities beside its positions; None where it gives none, or hardly moves."""
    if gnss.velocity_enu_mps is None:
        return None
    velocity = gnss.velocity_enu_mps[:, 0] + 1j * gnss.velocity_enu_mps[:, 1]
    place = gnss.enu_m[:, 0] + 1j * gnss.enu_m[:, 1]
    known = np.isfinite(velocity) & np.isfinite(place) & (gnss.fix > 0)
    if known.sum() < 20:
        return None
    t, velocity, place = seconds(gnss.t_ns[known], int(gnss.t_ns[0])), velocity[known], place[known]
    if t[-1] <= t[0]:
        return None
    sigma = typical_sigma(gnss)
    spread = float(np.abs(place - place.mean()).max())
    pace = spread / (t[-1] - t[0])
    chord_s = float(np.clip(10.0 * sigma / max(pace, 1e-3), *CHORD_S))
    if spread < max(2.0, 10.0 * sigma):
        return None
    grid = np.arange(t[0], t[-1], chord_s)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t))])
    u, v = np.diff(np.interp(grid, t, place)), np.diff(np.interp(grid, t, integral))
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
    if gnss is None or fit is None or _mirrored(context, gnss):
        return
    found = _velocity_fault(fit)
    if found is None:
        return
    what, fix, repair = found
    size, turn = abs(fit.factor), np.degrees(np.angle(fit.factor))
    evidence = (
        f"beside differenced positions: factor {size:.2f} at {turn:.0f} deg, correlation {fit.r:.2f}; "
        f"{fit.mirrored_r:.2f} if mirrored"
    )
    yield Finding("gnss-velocity", "warning", "gnss", f"velocities {what}", evidence, fix, repair)


def _mirrored(context: CheckContext, gnss: Gnss) -> bool:
    """Whether it is the positions that turn the wrong way, by the gyro: see turns.check_turns."""
    imu, start = context.recording.imu, context.recording.start_ns
    turned = None if imu is None else account(start, imu.t_ns, imu.gyro_radps[:, 2])
    both = course_agreement(turned, gnss, start) if turned is not None else None
    return both is not None and both.r < -0.5


def _velocity_fault(fit: VelocityFit) -> tuple[str, str, Repair] | None:
    turn, flip = float(np.angle(fit.factor)), float(np.angle(fit.mirrored))
    if fit.r > SURE_R and abs(turn) < ANGLE_ERROR:
        size = abs(fit.factor)
        for unit, factor in SPEED_UNITS.items():
            if abs(size / factor - 1.0) < UNIT_ERROR:
                return f"look like {unit}", f"divide by {factor:g}", _velocities(scale=1.0 / factor)
        if 0.5 < size < 1.5:
            return None
    if fit.mirrored_r > max(SURE_R, fit.r + 0.02) and 0.5 < abs(fit.mirrored) < 1.5:
        if abs(flip - 0.5 * np.pi) < ANGLE_ERROR:
            return "have east and north swapped", "swap them", _velocities(swap=True)
        if abs(flip) < ANGLE_ERROR:
            return "have the wrong sign of north", "change the sign of north", _velocities(signs=(1.0, -1.0))
        if abs(flip) > np.pi - ANGLE_ERROR:
            return "have the wrong sign of east", "change the sign of east", _velocities(signs=(-1.0, 1.0))
    if fit.r > fit.mirrored_r + 0.02 and abs(turn) > np.pi - ANGLE_ERROR and 0.5 < abs(fit.factor) < 1.5:
        return "have the wrong sign", "change the sign of east and north", _velocities(signs=(-1.0, -1.0))
    return "do not follow the positions", "leave the velocities out", _without_velocities


def _velocities(*, scale: float = 1.0, swap: bool = False, signs: tuple[float, float] = (1.0, 1.0)) -> Repair:
    def mended(recording: Recording) -> Recording:
        gnss = recording.gnss
        assert gnss is not None
        assert gnss.velocity_enu_mps is not None
        velocity = gnss.velocity_enu_mps[:, [1, 0, 2]] if swap else gnss.velocity_enu_mps
        velocity = velocity * (scale * signs[0], scale * signs[1], scale)
        sigma = None if gnss.sigma_v_mps is None else gnss.sigma_v_mps * scale
        changed = dataclasses.replace(gnss, velocity_enu_mps=velocity, sigma_v_mps=sigma)
        return dataclasses.replace(recording, gnss=changed)

    return mended


def _without_velocities(recording: Recording) -> Recording:
    assert recording.gnss is not None
    bare = dataclasses.replace(recording.gnss, velocity_enu_mps=None, sigma_v_mps=None)
    return dataclasses.replace(recording, gnss=bare)


def reflection(recording: Recording) -> tuple[str, Repair]:
    """What undoes mirrored positions: what the velocities show, else a swap of east and north."""
    gnss = recording.gnss
    fit = velocity_fit(gnss) if gnss is not None else None
    if fit is not None and fit.mirrored_r > max(SURE_R, fit.r + 0.02):
        flip = float(np.angle(fit.mirrored))
        if abs(flip) < ANGLE_ERROR:
            return "change the sign of north, as the velocities say", _places([0, 1, 2], (1.0, -1.0, 1.0))
        if abs(flip) > np.pi - ANGLE_ERROR:
            return "change the sign of east, as the velocities say", _places([0, 1, 2], (-1.0, 1.0, 1.0))
        if abs(flip - 0.5 * np.pi) < ANGLE_ERROR:
            return "swap east and north, as the velocities say", _places([1, 0, 2], (1.0, 1.0, 1.0))
    said = "swap east and north (assumed: one of them may have the wrong sign instead, which turns the map)"
    return said, _places([1, 0, 2], (1.0, 1.0, 1.0))


def _places(order: list[int], signs: tuple[float, float, float]) -> Repair:
    def mended(recording: Recording) -> Recording:
        gnss = recording.gnss
        assert gnss is not None
        enu, sigma = gnss.enu_m[:, order] * signs, gnss.sigma_enu_m[:, order]
        return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, enu_m=enu, sigma_enu_m=sigma))

    return mended
