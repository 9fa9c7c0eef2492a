"""The standard deviations (sigmas) that the receiver reports.

A driver that knows no accuracy may write the HDOP in its place: about 1, in steps of a tenth, equal
to the east and to the north, and twice it for the height (the public NMEA drivers of ROS square it
into the covariance). It describes the geometry of the satellites, not metres.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, Finding, changed, scaled
from terrafusion.datasets.checks.motion import typical_sigma
from terrafusion.datasets.checks.path import scatter_m
from terrafusion.datasets.core.arrays import Array, Mask
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M

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
    usual = np.array([ASSUMED_SIGMA_M[Fix(k)] for k in range(len(Fix))])[gnss.fix]
    sigma = np.where(_with_sigma(gnss)[:, None], gnss.sigma_enu_m * usual[:, None], gnss.sigma_enu_m)
    return dataclasses.replace(gnss, sigma_enu_m=sigma)
