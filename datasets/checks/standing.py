"""Wheels that roll while the robot stands."""

from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.motion import runs
from terrafusion.datasets.checks.path import dead_reckoned, measured_paths
from terrafusion.datasets.checks.scale import is_firm
from terrafusion.datasets.core.arrays import Array, Complex

WINDOW_S, LEAST_EXTENT_M = (10.0, 120.0), 5.0
"""Windows last so long that noise matters little against the path by wheels and gyro, within these limits."""
SIGMAS, FURTHER, STANDING = 5.0, 3.0, 0.15
"""A robot stands where its positions spread by less than so many sigma or this share of the extent of the
path by wheels and gyro, and where that extent is so many times as long."""
FROZEN_M = 1e-4


def check_standing(context: CheckContext) -> Iterator[Finding]:
    """The robot must move when its wheels roll; on soft ground they may spin."""
    reckoned = dead_reckoned(context)
    if reckoned is None or not is_firm(context.recording):
        return
    t, rolled, path = reckoned
    pace = float(rolled[-1]) / max(float(t[-1] - t[0]), 1e-3)
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
        if not standing.any():
            continue
        begins, ends = runs(standing)
        longest = int(np.argmax(ends - begins))
        begin, end = int(begins[longest]), int(ends[longest])
        yield Finding(
            "standing", "warning", "wheels",
            "the wheels roll while the robot stands",
            f"by the {measured.source} it keeps within {spread[begin:end].max():.2f} m in each "
            f"{window_s:.0f} s from t = {grid[begin]:.0f} to {grid[end]:.0f} s; wheels and gyro move "
            f"by {far[begin:end].min():.1f} m and more",
            "leave these stretches out, or say that the ground is soft: nothing else tells how it slipped",
        )  # fmt: skip
        return


def _extents(t_s: Array, place: Complex, grid: Array) -> Array:
    """Diagonal of the box about the positions in each interval of the grid; nan with fewer than three."""
    edges = np.searchsorted(t_s, grid)
    extents = np.full(len(grid) - 1, np.nan)
    for k, (first, last) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)):
        if last - first >= 3:
            part = place[first:last]
            extents[k] = float(np.hypot(np.ptp(part.real), np.ptp(part.imag)))
    return extents
