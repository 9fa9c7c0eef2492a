"""The fixes: their classes, jumps, repeats, and the standard deviations (sigmas) that the receiver reports.

A driver that knows no accuracy may write the HDOP in its place: about 1, in steps of a tenth, equal
to the east and to the north, and twice it for the height (the public NMEA drivers of ROS square it
into the covariance). It describes the geometry of the satellites, not metres.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, changed, scaled, without_rows
from terrafusion.datasets.checks.motion import cumulative, on_plane, runs, seconds, typical_sigma, wheel_speed
from terrafusion.datasets.checks.path import antenna, dead_reckoned, scatter_m
from terrafusion.datasets.checks.timing import GAP_PERIODS
from terrafusion.datasets.core.arrays import Array, Complex, Mask
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.printable import counted, times
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M, CLASS_SIGMA_M

FROZEN_S = 3.0
AROUND, LEAST_SHARE, SLIP_SHARE = 8, 0.5, 0.25
"""Steps around a jump that show how the wheels' path lies on the map. A step is explained where no more is
left of it than this share of the least jump, or 4 sigma and this share of the distance rolled."""
FLIGHT_FIXES, CLOSED = 25, 0.3
"""A jump is undone within this many fixes, up to this share of its size; else the path stays displaced."""


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
        "fix-none", "warning", "gnss",
        f"{int(none.sum())} of {len(gnss)} fixes have positions but the class 'none'",
        f"first at t = {context.since_start_s(gnss.t_ns[int(np.argmax(none))]):.2f} s",
        "give the class of fix, if the log only lacks it: as it is, none is used"
        if every
        else "drop them: they are not used",
        None if every else without_rows("gnss", none),
    )  # fmt: skip


def check_jumps(context: CheckContext) -> Iterator[Finding]:
    """Steps between fixes that the motion does not explain."""
    gnss = context.recording.gnss
    if gnss is None or len(gnss) < 10:
        return
    off, limit = _unexplained_steps(gnss)
    jumps = np.flatnonzero(np.abs(off) > limit)
    jumps = jumps[~_driven(context, gnss, jumps, limit)] if jumps.size else jumps
    if not jumps.size:
        return
    worst = int(jumps[np.argmax(np.abs(off[jumps]))])
    away, closed = _displaced(off, jumps, len(gnss))
    yield Finding(
        "gnss-jumps", "warning", "gnss",
        f"{counted(jumps.size, 'jump')} of position",
        f"largest {abs(off[worst]):.2f} m at t = {context.since_start_s(gnss.t_ns[worst + 1]):.2f} s",
        f"drop the {int(away.sum())} fixes that are away from the path"
        if closed
        else "multipath or a changed fix; the path does not come back: nothing shows which part is right",
        without_rows("gnss", away) if closed else None,
    )  # fmt: skip


def _unexplained_steps(gnss: Gnss) -> tuple[Complex, float]:
    """Steps (N - 1,) east + i north, less those of a running median; and the limit of their noise."""
    dt = np.diff(gnss.t_ns) * 1e-9
    step = np.diff(on_plane(gnss.enu_m))
    near = (dt > 0) & (dt <= GAP_PERIODS * np.median(dt)) & np.isfinite(step)
    speed = np.where(near, step, 0.0) / np.where(dt > 0, dt, 1.0)
    smooth = _running_median(speed.real, 9) + 1j * _running_median(speed.imag, 9)
    off = np.where(near, (speed - smooth) * dt, 0.0)
    noise = float(np.median(np.abs(off[near]))) if near.any() else 0.0
    return off, max(1.0, 8.0 * noise, 4.0 * typical_sigma(gnss))


def _driven(context: CheckContext, gnss: Gnss, jumps: NDArray[np.int64], limit: float) -> Mask:
    """Mask of the steps that wheels and gyro explain, but for sigma, slip and the antenna's arm.

    The step that they predict is turned and scaled as it fits the steps around; where there are too few, or
    no gyro, only its length counts.
    """
    reckoned = dead_reckoned(context, antenna(context))
    if reckoned is None:
        return np.zeros(len(jumps), dtype=bool)
    t, _, path = reckoned
    t_fix = seconds(gnss.t_ns, context.recording.start_ns)
    step, predicted = np.diff(on_plane(gnss.enu_m)), np.diff(np.interp(t_fix, t, path))
    sigma = np.nan_to_num(gnss.sigma_enu_m[:, :2]).max(axis=1)
    inside = (t_fix[:-1] >= t[0]) & (t_fix[1:] <= t[-1])
    explained = []
    for k in jumps.tolist():
        near = np.arange(max(k - AROUND, 0), min(k + AROUND + 1, len(step)))
        near = near[~np.isin(near, jumps) & np.isfinite(step[near]) & inside[near]]
        power = float(np.sum(np.abs(predicted[near]) ** 2))
        turn = complex(np.vdot(predicted[near], step[near])) / power if power > limit**2 else 0j
        rest = (
            abs(step[k] - turn * predicted[k]) if 0.5 < abs(turn) < 2.0 else abs(step[k]) - abs(predicted[k])
        )
        noise = float(np.hypot(sigma[k], sigma[k + 1]))
        most = max(limit * LEAST_SHARE, 4.0 * noise + SLIP_SHARE * abs(predicted[k]))
        explained.append(bool(inside[k]) and rest < most)
    return np.array(explained, dtype=bool)


def _running_median(values: Array, width: int) -> Array:
    padded = np.pad(values, width // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1))


def _displaced(off: Complex, jumps: NDArray[np.int64], count: int) -> tuple[Mask, bool]:
    """Mask (count,) of the fixes between a jump and the one that undoes it; whether all have one."""
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
    """A position must not repeat, digit for digit, while the wheels roll."""
    gnss = context.recording.gnss
    driven = wheel_speed(context)
    if gnss is None or driven is None or len(gnss) < 3:
        return
    rolled = cumulative(*driven, unsigned=True)
    t_fix = seconds(gnss.t_ns, context.recording.start_ns)
    begins, ends = runs((np.diff(gnss.enu_m[:, :2], axis=0) == 0.0).all(axis=1))  # both fixes included
    distance = np.interp(t_fix[ends], driven[0], rolled) - np.interp(t_fix[begins], driven[0], rolled)
    long = (t_fix[ends] - t_fix[begins] >= FROZEN_S) & (ends - begins >= 2)
    frozen = long & (distance > max(1.0, 3.0 * typical_sigma(gnss)))
    if not frozen.any():
        return
    repeats = np.zeros(len(gnss), dtype=bool)
    for begin, end in zip(begins[frozen].tolist(), ends[frozen].tolist(), strict=True):
        repeats[begin + 1 : end + 1] = True
    worst = int(np.flatnonzero(frozen)[np.argmax(distance[frozen])])
    yield Finding(
        "gnss-frozen", "warning", "gnss",
        f"the position stands still {times(int(frozen.sum()))} while the wheels roll",
        f"from t = {t_fix[begins[worst]]:.1f} s for {t_fix[ends[worst]] - t_fix[begins[worst]]:.1f} s "
        f"and {distance[worst]:.1f} m of wheel path",
        f"drop the {int(repeats.sum())} repeated fixes",
        without_rows("gnss", repeats),
    )  # fmt: skip


OVERCONFIDENT, LEAST_SCATTER_M = 5.0, 0.03
LEAST_FIXES, LEAST_VALUES, SHARE = 20, 3, 0.99
LEAST_DOP, LARGEST_DOP, STEP = 0.4, 50.0, 0.1
METRIC = 0.5
"""Fixes that scatter about the dead-reckoned path by this share of their sigma report metres."""
CARRIER_PHASE_M = 0.3
"""Fixes of class "fixed" are good to centimetres; with more than this, class and sigma contradict."""


def check_sigma(context: CheckContext) -> Iterator[Finding]:
    """The sigma of a fix must be a positive number."""
    gnss = context.recording.gnss
    if gnss is None or not len(gnss):
        return
    bad = _impossible(gnss)
    rows: Mask = np.asarray(bad.any(axis=1))
    if not rows.any():
        return
    first = int(np.argmax(rows))
    missing_only = bool(np.isnan(gnss.sigma_enu_m[bad]).all())  # such fixes are left out, others mislead
    usual = ", ".join(f"{fix.name.lower()} {sigma:g}" for fix, sigma in ASSUMED_SIGMA_M.items() if fix)
    yield Finding(
        "sigma-impossible", "warning" if missing_only else "error", "gnss",
        f"{int(rows.sum())} of {len(rows)} fixes have a sigma that is zero, negative or missing",
        f"first at t = {context.since_start_s(gnss.t_ns[first]):.2f} s: {gnss.sigma_enu_m[first].tolist()} m",
        "use the median of the other fixes of the class; where there is none, the usual value "
        f"({usual} m, heights twice), or the scatter about wheels and gyro where that is larger",
        changed("gnss", _with_usual_sigma, least_m=scatter_m(context) or 0.0),
    )  # fmt: skip


def _impossible(gnss: Gnss) -> Mask:
    """Mask (N, 3) of sigmas that are no positive number; those of heights only where there are heights."""
    placed = np.isfinite(gnss.enu_m[:, :2]).all(axis=1)
    counts = np.column_stack([placed, placed, placed & np.isfinite(gnss.enu_m[:, 2])])
    return np.asarray(counts & ~(gnss.sigma_enu_m > 0.0))


def _with_usual_sigma(gnss: Gnss, least_m: float) -> Gnss:
    sigma, bad = gnss.sigma_enu_m.copy(), _impossible(gnss)
    for fix in np.unique(gnss.fix).tolist():
        usual = max(ASSUMED_SIGMA_M[Fix(fix)], least_m)
        for k, factor in enumerate((1.0, 1.0, 2.0)):
            of_class = gnss.fix == fix
            good = sigma[of_class & (sigma[:, k] > 0.0), k]
            value = float(np.median(good)) if len(good) >= 10 else factor * usual
            sigma[of_class & bad[:, k], k] = value
    return dataclasses.replace(gnss, sigma_enu_m=sigma)


def check_velocity_sigma(context: CheckContext) -> Iterator[Finding]:
    """The sigma of a velocity must not be zero or negative; it may be missing."""
    gnss = context.recording.gnss
    if gnss is None or gnss.velocity_enu_mps is None or gnss.sigma_v_mps is None:
        return
    measured = np.isfinite(gnss.velocity_enu_mps[:, :2]).all(axis=1)
    bad = measured & (gnss.sigma_v_mps <= 0.0)
    if not bad.any():
        return
    first = int(np.argmax(bad))
    velocity = np.where(bad[:, None], np.nan, gnss.velocity_enu_mps)
    yield Finding(
        "velocity-sigma-impossible", "warning", "gnss",
        f"{int(bad.sum())} of {int(measured.sum())} velocities have a sigma that is zero or negative",
        f"first at t = {context.since_start_s(gnss.t_ns[first]):.2f} s: {gnss.sigma_v_mps[first]:g} m/s",
        "leave these velocities out, or give the receiver's own sigma in m/s",
        changed("gnss", dataclasses.replace, velocity_enu_mps=velocity),
    )  # fmt: skip


def check_scatter(context: CheckContext) -> Iterator[Finding]:
    """Fixes must not scatter far more than their sigma."""
    gnss = context.recording.gnss
    if gnss is None:
        return
    sigma, scatter = typical_sigma(gnss), scatter_m(context)
    if scatter is None or sigma <= 0.0 or scatter < max(LEAST_SCATTER_M, OVERCONFIDENT * sigma):
        return
    factor = scatter / sigma
    hint = ", as if variances were given for sigmas" if 0.5 < sigma / scatter**2 < 2.0 else ""
    yield Finding(
        "sigma-too-small", "warning", "gnss",
        f"the fixes scatter {factor:.0f} times more than their sigma{hint}",
        f"{scatter:.3f} m about the path by wheels and gyro, median sigma {sigma:.4f} m",
        f"multiply the sigmas by {factor:.1f}",
        scaled("gnss", factor, "sigma_enu_m"),
    )  # fmt: skip


def check_dilution(context: CheckContext) -> Iterator[Finding]:
    """Sigmas that look like dilutions of precision."""
    gnss = context.recording.gnss
    if gnss is None:
        return
    rows = _with_sigma(gnss)
    sigma = gnss.sigma_enu_m[rows]
    if len(sigma) < LEAST_FIXES:
        return
    fixed = gnss.fix[rows] == Fix.FIXED
    contradicts = bool(fixed.mean() > 0.5 and np.median(sigma[fixed, 0]) > CARRIER_PHASE_M)
    if not contradicts and not _in_steps(sigma):
        return
    scatter = scatter_m(context)
    if scatter is not None and scatter > METRIC * np.median(sigma[:, :2]):
        return
    classes = [Fix(k) for k in np.unique(gnss.fix[rows])]
    usual = ", ".join(f"{fix.name.lower()} {ASSUMED_SIGMA_M[fix]:g} m" for fix in classes)
    same = all(ASSUMED_SIGMA_M[fix] == 1.0 for fix in classes)
    yield Finding(
        "sigma-dilution", "warning", "gnss",
        "the sigmas look like dilutions of precision, not metres",
        f"{len(np.unique(sigma[:, 0]))} values from {sigma[:, 0].min():.3g} to {sigma[:, 0].max():.3g}, "
        + ("for fixes of class fixed" if contradicts else "in steps of a tenth, the same east and north"),
        "as metres they would be those of a receiver good to 1 m; give the accuracy of yours"
        if same
        else f"multiply them by the accuracy assumed for the class ({usual}); better, give the receiver's",
        None if same else changed("gnss", _times_class_sigma),
    )  # fmt: skip


def _with_sigma(gnss: Gnss) -> Mask:
    return np.asarray((gnss.fix > Fix.NONE) & (gnss.sigma_enu_m[:, :2] > 0.0).all(axis=1))


def _in_steps(sigma: Array) -> bool:
    """Whether all sigmas are a few multiples of a tenth, equal to the east and to the north."""
    east = sigma[:, 0]
    steps = east / STEP
    tenths = np.abs(steps - np.rint(steps)) < 1e-4
    equal = np.abs(sigma[:, 1] - east) < 1e-6 * east
    multiples = np.unique(np.rint(steps))
    return bool(
        (tenths & equal).mean() > SHARE
        and east.min() >= LEAST_DOP
        and east.max() <= LARGEST_DOP
        and len(multiples) >= LEAST_VALUES
        and np.gcd.reduce(multiples.astype(int)) == 1  # a repaired log has larger steps
    )


def _times_class_sigma(gnss: Gnss) -> Gnss:
    usual = CLASS_SIGMA_M[gnss.fix]
    sigma = np.where(_with_sigma(gnss)[:, None], gnss.sigma_enu_m * usual[:, None], gnss.sigma_enu_m)
    return dataclasses.replace(gnss, sigma_enu_m=sigma)
