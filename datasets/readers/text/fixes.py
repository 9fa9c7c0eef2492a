"""Fixes in latitude and longitude -> the GNSS channel, with a note for everything assumed or left out."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import geodetic_to_enu
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M
from terrafusion.datasets.readers.formats import Request

Array = NDArray[np.float64]
Datum = tuple[float, float, float]

UP_FACTOR = 2.0


@dataclass(frozen=True, eq=False)
class Fixes:
    """Fixes as a receiver tells them.

    Attributes:
        t_ns: (N,) int64, never decreasing.
        llh: (N, 3) latitude deg, longitude deg, ellipsoidal height m; NaN where unknown.
        fix: (N,) `Fix` values.
        sigma_enu_m: (N, 3), NaN where unknown.
        velocity_enu_mps: (N, 3), NaN where unknown, or None.
        sigma_v_mps: (N,), or None.
    """

    t_ns: NDArray[np.int64]
    llh: Array
    fix: NDArray[np.uint8]
    sigma_enu_m: Array
    velocity_enu_mps: Array | None = None
    sigma_v_mps: Array | None = None

    def select(self, rows: Any) -> Fixes:
        """The fixes of a boolean mask, slice or index array."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        chosen: dict[str, Any] = {name: None if v is None else v[rows] for name, v in values.items()}
        return Fixes(**chosen)


def gnss_channel(
    request: Request, fixes: Fixes, datum: Datum | None = None
) -> tuple[Gnss | None, Datum | None, list[str]]:
    """The fixes about `datum`, or about the first of them.

    Returns:
        The channel without the rows that hold no fix (None where none does), the datum, and notes.

    Raises:
        DataError: a latitude or longitude that is not on Earth.
    """
    held = np.isfinite(fixes.llh[:, :2]).all(axis=1) & (fixes.fix > Fix.NONE)
    null = (fixes.llh[:, 0] == 0.0) & (fixes.llh[:, 1] == 0.0)
    if held.any() and np.abs(np.median(fixes.llh[held, :2], axis=0)).max() > 0.1:
        held &= ~null
    notes = []
    if not held.all():
        notes.append(f"gnss: {int((~held).sum())} of {len(held)} rows hold no fix; left out")
    if not held.any():
        return None, datum, [*notes, "gnss: no row holds a fix; the channel is absent"]
    fixes = fixes.select(held)
    _check_on_earth(request, fixes)
    if datum is None:
        datum = first_fix(fixes.llh)
        notes.append(
            f"gnss: datum is the first fix, {datum[0]:.7f} deg, {datum[1]:.7f} deg, {datum[2]:.2f} m"
        )
    flat = np.isnan(fixes.llh[:, 2])
    llh = fixes.llh.copy()
    llh[flat, 2] = datum[2]
    enu = geodetic_to_enu(llh, datum)
    enu[flat, 2] = np.nan
    sigma, note = with_assumed_sigma(request, fixes.sigma_enu_m, fixes.fix)
    velocity = fixes.velocity_enu_mps
    known = velocity is not None and np.isfinite(velocity[:, :2]).any()
    channel = Gnss(
        fixes.t_ns, enu, sigma, fixes.fix, velocity if known else None, fixes.sigma_v_mps if known else None
    )
    return channel, datum, [*notes, *note]


def first_fix(llh: Array) -> Datum:
    """Latitude, longitude and the first known height, 0 where there is none."""
    heights = llh[np.isfinite(llh[:, 2]), 2]
    return float(llh[0, 0]), float(llh[0, 1]), float(heights[0]) if heights.size else 0.0


def with_assumed_sigma(request: Request, sigma: Array, fix: NDArray[np.uint8]) -> tuple[Array, list[str]]:
    """Sigmas (N, 3) with the unknown and the non-positive ones filled, and a note where any was."""
    unknown = ~(sigma > 0.0)
    if not unknown[:, :2].any():
        sigma = np.where(unknown, np.nan, sigma)
        return sigma, []
    filled = int(unknown[:, :2].any(axis=1).sum())
    spec = request.rig.sensors.gnss if request.rig else None
    if spec is not None:
        assumed = np.broadcast_to([spec.sigma_horizontal_m] * 2 + [spec.sigma_vertical_m], sigma.shape)
        origin = f"the vehicle's receiver, {spec.sigma_horizontal_m:g} m flat"
    else:
        flat = np.array([ASSUMED_SIGMA_M[Fix(k)] for k in range(len(Fix))])[fix]
        assumed = np.stack([flat, flat, UP_FACTOR * flat], axis=1)
        used = ", ".join(f"{Fix(k).name.lower()} {ASSUMED_SIGMA_M[Fix(k)]:g} m" for k in np.unique(fix))
        origin = f"assumed by class, flat: {used}"
    return np.where(unknown, assumed, sigma), [f"gnss: {filled} fixes tell no sigma; taken from {origin}"]


def _check_on_earth(request: Request, fixes: Fixes) -> None:
    llh = fixes.llh
    bad = np.flatnonzero((np.abs(llh[:, 0]) > 90.0) | (np.abs(llh[:, 1]) > 180.0))
    if bad.size:
        i = int(bad[0])
        raise DataError(
            f"latitude {llh[i, 0]:g} deg, longitude {llh[i, 1]:g} deg is not on Earth",
            file=request.path,
            channel="gnss",
            time_s=float(fixes.t_ns[i] - fixes.t_ns[0]) * 1e-9,
            remedy="latitudes end at 90 deg, longitudes at 180 deg; are they swapped, or in another unit?",
        )
