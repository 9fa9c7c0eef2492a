"""Sigmas of fixes whose receiver reports none."""

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M, Rig

UP_FACTOR = 2.0


def with_assumed_sigma(rig: Rig | None, sigma: Array, fix: NDArray[np.uint8]) -> tuple[Array, list[str]]:
    """Sigmas (N, 3) with the unknown and the non-positive ones filled, and a note where any was."""
    unknown = ~(sigma > 0.0)
    if not unknown[:, :2].any():
        sigma = np.where(unknown, np.nan, sigma)
        return sigma, []
    filled = int(unknown[:, :2].any(axis=1).sum())
    spec = rig.sensors.gnss if rig else None
    if spec is not None:
        assumed = np.broadcast_to([spec.sigma_horizontal_m] * 2 + [spec.sigma_vertical_m], sigma.shape)
        origin = f"the vehicle's receiver, {spec.sigma_horizontal_m:g} m flat"
    else:
        flat = np.array([ASSUMED_SIGMA_M[Fix(k)] for k in range(len(Fix))])[fix]
        assumed = np.stack([flat, flat, UP_FACTOR * flat], axis=1)
        used = ", ".join(f"{Fix(k).name.lower()} {ASSUMED_SIGMA_M[Fix(k)]:g} m" for k in np.unique(fix))
        origin = f"assumed by class, flat: {used}"
    return np.where(unknown, assumed, sigma), [f"gnss: {filled} fixes have no sigma; taken from {origin}"]
