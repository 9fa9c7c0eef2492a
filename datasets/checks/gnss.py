"""The fixes: their classes, their sigmas, their jumps and stops."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair
from terrafusion.datasets.checks.path import ANY_RADIUS_M, compare, places, wheel_speed
from terrafusion.datasets.checks.timing import GAP_PERIODS
from terrafusion.datasets.checks.yaw_signals import seconds, typical_sigma
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OVERCONFIDENT, LEAST_SCATTER_M = 5.0, 0.03
FROZEN_S = 3.0
FLIGHT_FIXES, CLOSED = 25, 0.3
"""A jump is taken back within so many fixes, up to this share of its size; else the path stays displaced."""


def check_classes(context: CheckContext) -> Iterator[Finding]:
    """Positions of class "none" are no fixes, and are not used."""
    gnss = context.recording.gnss
    if gnss is None:
        return
    placed = np.isfinite(gnss.enu_m[:, :2]).all(axis=1)
    none = placed & (gnss.fix == Fix.NONE)
    if not none.any():
        return
    every = bool(none.sum() == placed.sum())
    yield Finding(
        "fix-none",
        "warning",
        "gnss",
        f"{int(none.sum())} of {len(gnss)} fixes have positions but the class 'none'",
        f"first at t = {context.since_start_s(gnss.t_ns[int(np.flatnonzero(none)[0])]):.2f} s",
        "give the class of fix, if the log only lacks it: as it is, none is used"
        if every
        else "drop them: they are not used",
        None if every else _dropping(none),
    )


def check_sigma(context: CheckContext) -> Iterator[Finding]:
    """A sigma of a fix must be a positive number."""
    gnss = context.recording.gnss
    if gnss is None or not len(gnss):
        return
    bad = _impossible(gnss)
    rows: Mask = np.asarray(bad.any(axis=1))
    if rows.any():
        first = int(np.flatnonzero(rows)[0])
        missing_only = bool(np.isnan(gnss.sigma_enu_m[bad]).all())  # such fixes are left out, others mislead
        at_s, said = context.since_start_s(gnss.t_ns[first]), gnss.sigma_enu_m[first].tolist()
        usual = ", ".join(f"{fix.name.lower()} {sigma:g}" for fix, sigma in ASSUMED_SIGMA_M.items() if fix)
        yield Finding(
            "sigma-impossible",
            "warning" if missing_only else "error",
            "gnss",
            f"{int(rows.sum())} of {len(rows)} fixes have a sigma that is zero, negative or missing",
            f"first at t = {at_s:.2f} s: {said} m",
            "take the median of the other fixes of the class; where there is none, the usual value "
            f"({usual} m, heights twice), or the scatter about wheels and gyro where that is larger",
            functools.partial(_with_usual_sigma, least_m=scatter_m(context) or 0.0),
        )


def check_velocity_sigma(context: CheckContext) -> Iterator[Finding]:
    """The sigma of a velocity must not be zero or negative; one that is not told is no fault."""
    gnss = context.recording.gnss
    if gnss is None or gnss.velocity_enu_mps is None or gnss.sigma_v_mps is None:
        return
    told = np.isfinite(gnss.velocity_enu_mps[:, :2]).all(axis=1)
    bad = told & (gnss.sigma_v_mps <= 0.0)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        at_s = context.since_start_s(gnss.t_ns[first])
        yield Finding(
            "velocity-sigma-impossible",
            "warning",
            "gnss",
            f"{int(bad.sum())} of {int(told.sum())} velocities have a sigma that is zero or negative",
            f"first at t = {at_s:.2f} s: {gnss.sigma_v_mps[first]:g} m/s",
            "leave these velocities out, or give the receiver's own sigma in m/s",
            functools.partial(_without_velocity, rows=bad),
        )


def _without_velocity(recording: Recording, rows: Mask) -> Recording:
    gnss = recording.gnss
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    velocity = np.where(rows[:, None], np.nan, gnss.velocity_enu_mps)
    return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, velocity_enu_mps=velocity))


def _impossible(gnss: Gnss) -> Mask:
    """Mask (N, 3) of sigmas that are no positive number; heights count only where there are any."""
    placed = np.isfinite(gnss.enu_m[:, :2]).all(axis=1)
    counts = np.column_stack([placed, placed, placed & np.isfinite(gnss.enu_m[:, 2])])
    return np.asarray(counts & ~(gnss.sigma_enu_m > 0.0))


def _with_usual_sigma(recording: Recording, least_m: float) -> Recording:
    gnss = recording.gnss
    assert gnss is not None
    sigma, bad = gnss.sigma_enu_m.copy(), _impossible(gnss)
    for fix in np.unique(gnss.fix).tolist():
        usual = max(ASSUMED_SIGMA_M[Fix(fix)], least_m)
        for k, factor in enumerate((1.0, 1.0, 2.0)):
            of_class = gnss.fix == fix
            good = sigma[of_class & (sigma[:, k] > 0.0), k]
            value = float(np.median(good)) if len(good) >= 10 else factor * usual
            sigma[of_class & bad[:, k], k] = value
    return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, sigma_enu_m=sigma))


def check_scatter(context: CheckContext) -> Iterator[Finding]:
    """Fixes must not scatter far more than their sigma says."""
    gnss = context.recording.gnss
    if gnss is None:
        return
    sigma, scatter = typical_sigma(gnss), scatter_m(context)
    if scatter is None or sigma <= 0.0 or scatter < max(LEAST_SCATTER_M, OVERCONFIDENT * sigma):
        return
    factor = scatter / sigma
    hint = ", as if variances were given for sigmas" if 0.5 < sigma / scatter**2 < 2.0 else ""
    yield Finding(
        "sigma-too-small",
        "warning",
        "gnss",
        f"the fixes scatter {factor:.0f} times more than their sigma says{hint}",
        f"{scatter:.3f} m about the path by wheels and gyro, median sigma {sigma:.4f} m",
        f"multiply the sigmas by {factor:.1f}",
        lambda recording: _with_scaled_sigma(recording, factor),
    )


def scatter_m(context: CheckContext) -> float | None:
    """Scatter of the fixes about the path by wheels and gyro, 1 sigma along one axis, without slow errors."""
    true = next((one for one in places(context.recording) if one.source == "gnss"), None)
    windows = compare(context, true) if true is not None else None
    return float(np.median(windows.scatter_m)) if windows is not None else None


def _with_scaled_sigma(recording: Recording, factor: float) -> Recording:
    gnss = recording.gnss
    assert gnss is not None
    scaled = dataclasses.replace(gnss, sigma_enu_m=gnss.sigma_enu_m * factor)
    return dataclasses.replace(recording, gnss=scaled)


def check_jumps(context: CheckContext) -> Iterator[Finding]:
    """Steps between fixes that no drive explains."""
    gnss = context.recording.gnss
    if gnss is None or len(gnss) < 10:
        return
    off, limit = _steps_off(gnss)
    jumps = np.flatnonzero(np.abs(off) > limit)
    if not jumps.size:
        return
    worst = int(jumps[np.argmax(np.abs(off[jumps]))])
    away, closed = _flights(off, jumps, len(gnss))
    yield Finding(
        "gnss-jumps",
        "warning",
        "gnss",
        f"{jumps.size} jump{'s' if jumps.size > 1 else ''} of position",
        f"largest {abs(off[worst]):.2f} m at t = {context.since_start_s(gnss.t_ns[worst + 1]):.2f} s",
        f"drop the {int(away.sum())} fixes that are away from the path"
        if closed
        else "multipath or a changed fix; the path does not come back: nothing tells which part is right",
        _dropping(away) if closed else None,
    )


def _steps_off(gnss: Gnss) -> tuple[NDArray[np.complex128], float]:
    """Steps (N - 1,) east + i north, less those of a running median; and what noise explains of them."""
    dt = np.diff(gnss.t_ns) * 1e-9
    step = np.diff(gnss.enu_m[:, 0] + 1j * gnss.enu_m[:, 1])
    near = (dt > 0) & (dt <= GAP_PERIODS * np.median(dt)) & np.isfinite(step)
    speed = np.where(near, step, 0.0) / np.where(dt > 0, dt, 1.0)
    smooth = _running_median(speed.real, 9) + 1j * _running_median(speed.imag, 9)
    off = np.where(near, (speed - smooth) * dt, 0.0)
    noise = float(np.median(np.abs(off[near]))) if near.any() else 0.0
    return off, max(1.0, 8.0 * noise, 4.0 * typical_sigma(gnss))


def _running_median(values: Array, width: int) -> Array:
    padded = np.pad(values, width // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1))


def _flights(off: NDArray[np.complex128], jumps: NDArray[np.int64], count: int) -> tuple[Mask, bool]:
    """Mask (count,) of the fixes between a jump and the one that takes it back; whether all have one."""
    away, k, closed = np.zeros(count, dtype=bool), 0, True
    while k < len(jumps):
        first = jumps[k]
        ends = jumps[k + 1 :][jumps[k + 1 :] - first <= FLIGHT_FIXES]
        summed = np.abs(off[first] + np.cumsum(off[ends]))
        back = np.flatnonzero(summed < CLOSED * abs(off[first]))
        if not back.size:
            closed, k = False, k + 1
            continue
        away[first + 1 : ends[back[0]] + 1] = True
        k += int(back[0]) + 2
    return away, closed


def check_frozen(context: CheckContext) -> Iterator[Finding]:
    """A position must not stand still, digit for digit, while the wheels roll."""
    gnss = context.recording.gnss
    driven = wheel_speed(context, context.wheel_radius_m() or ANY_RADIUS_M)
    if gnss is None or driven is None or len(gnss) < 3:
        return
    t, v = driven
    rolled = np.concatenate([[0.0], np.cumsum(0.5 * np.abs(v[1:] + v[:-1]) * np.diff(t))])
    t_fix = seconds(gnss.t_ns, context.recording.start_ns)
    same = (np.diff(gnss.enu_m[:, :2], axis=0) == 0.0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    begins, ends = edges[::2], edges[1::2]  # runs of fixes begins .. ends, both included
    way = np.interp(t_fix[ends], t, rolled) - np.interp(t_fix[begins], t, rolled)
    long = (t_fix[ends] - t_fix[begins] >= FROZEN_S) & (ends - begins >= 2)
    frozen = long & (way > max(1.0, 3.0 * typical_sigma(gnss)))
    if not frozen.any():
        return
    repeats = np.zeros(len(gnss), dtype=bool)
    for begin, end in zip(begins[frozen].tolist(), ends[frozen].tolist(), strict=True):
        repeats[begin + 1 : end + 1] = True
    worst = int(np.flatnonzero(frozen)[np.argmax(way[frozen])])
    yield Finding(
        "gnss-frozen",
        "warning",
        "gnss",
        f"the position stands still {_times(int(frozen.sum()))} while the wheels roll",
        f"from t = {t_fix[begins[worst]]:.1f} s for {t_fix[ends[worst]] - t_fix[begins[worst]]:.1f} s "
        f"and {way[worst]:.1f} m of wheel path",
        f"drop the {int(repeats.sum())} repeated fixes",
        _dropping(repeats),
    )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _dropping(rows: Mask) -> Repair:
    def mended(recording: Recording) -> Recording:
        assert recording.gnss is not None
        return dataclasses.replace(recording, gnss=recording.gnss.select(~rows))

    return mended
