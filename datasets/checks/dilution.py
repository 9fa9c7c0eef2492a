"""Dilutions of precision that stand where sigmas should.

A driver that knows no accuracy may write the HDOP in its place: a number about 1, in steps of a tenth,
the same to the east and to the north, and twice it for the height (the public NMEA drivers of ROS square
it into the covariance). It tells the geometry of the satellites, not metres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.gnss import scatter_m
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M

LEAST_FIXES, LEAST_VALUES, SHARE = 20, 3, 0.99
LEAST_DOP, LARGEST_DOP, STEP = 0.4, 50.0, 0.1
HONEST = 0.5
"""Fixes that scatter by this share of what they claim, about the path by wheels and gyro, claim metres."""
CARRIER_PHASE_M = 0.3
"""Fixes of class "fixed" are good to centimetres; with more than this, class and sigma contradict."""


def check_dilution(context: CheckContext) -> Iterator[Finding]:
    """Sigmas that look like dilutions of precision."""
    gnss = context.recording.gnss
    if gnss is None:
        return
    rows = _told(gnss)
    sigma = gnss.sigma_enu_m[rows]
    if len(sigma) < LEAST_FIXES:
        return
    fixed = gnss.fix[rows] == Fix.FIXED
    contradicts = bool(fixed.mean() > 0.5 and np.median(sigma[fixed, 0]) > CARRIER_PHASE_M)
    if not contradicts and not _in_steps(sigma):
        return
    scatter = scatter_m(context)
    if scatter is not None and scatter > HONEST * np.median(sigma[:, :2]):
        return
    classes = [Fix(k) for k in np.unique(gnss.fix[rows])]
    worth = ", ".join(f"{fix.name.lower()} {ASSUMED_SIGMA_M[fix]:g} m" for fix in classes)
    same = all(ASSUMED_SIGMA_M[fix] == 1.0 for fix in classes)
    yield Finding(
        "sigma-dilution",
        "warning",
        "gnss",
        "the sigmas look like dilutions of precision, not metres",
        f"{len(np.unique(sigma[:, 0]))} values from {sigma[:, 0].min():.3g} to {sigma[:, 0].max():.3g}, "
        + ("for fixes of class fixed" if contradicts else "in steps of a tenth, the same east and north"),
        "as metres they would be those of a receiver good to 1 m; give the accuracy of yours"
        if same
        else f"multiply them by what the class is assumed to be worth ({worth}); better, give the receiver's",
        None if same else _scaled,
    )


def _told(gnss: Gnss) -> NDArray[np.bool_]:
    return np.asarray((gnss.fix > Fix.NONE) & (gnss.sigma_enu_m[:, :2] > 0.0).all(axis=1))


def _in_steps(sigma: NDArray[np.float64]) -> bool:
    """Whether all sigmas are some few multiples of a tenth, equal to the east and to the north."""
    east = sigma[:, 0]
    steps = east / STEP
    tenths = np.abs(steps - np.rint(steps)) < 1e-4
    equal = np.abs(sigma[:, 1] - east) < 1e-6 * east
    return bool(
        (tenths & equal).mean() > SHARE
        and east.min() >= LEAST_DOP
        and east.max() <= LARGEST_DOP
        and len(np.unique(np.rint(steps))) >= LEAST_VALUES
        and np.gcd.reduce(np.unique(np.rint(steps)).astype(int)) == 1  # a mended log has larger steps
    )


def _scaled(recording: Recording) -> Recording:
    gnss = recording.gnss
    assert gnss is not None
    worth = np.array([ASSUMED_SIGMA_M[Fix(k)] for k in range(len(Fix))])[gnss.fix]
    sigma = np.where(_told(gnss)[:, None], gnss.sigma_enu_m * worth[:, None], gnss.sigma_enu_m)
    return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, sigma_enu_m=sigma))
