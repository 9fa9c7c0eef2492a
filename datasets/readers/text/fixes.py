"""Fixes in latitude and longitude -> the GNSS channel, with a note for everything assumed or left out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimeRows, TimesNs
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.clock import RowTimes
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import geodetic_to_enu
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig, with_assumed_sigma
from terrafusion.datasets.readers.formats import Request

Datum = tuple[float, float, float]

FIX_OF_CODE: dict[str, dict[int, Fix]] = {
    "nmea": dict(enumerate((Fix.NONE, Fix.SINGLE, Fix.DGPS, Fix.SINGLE, Fix.FIXED, Fix.FLOAT, Fix.NONE)))
    | {9: Fix.DGPS},
    "rtklib": dict(enumerate((Fix.NONE, Fix.FIXED, Fix.FLOAT, Fix.DGPS, Fix.DGPS, Fix.SINGLE, Fix.FLOAT))),
    "navsatfix": {-1: Fix.NONE, 0: Fix.SINGLE, 1: Fix.DGPS, 2: Fix.FIXED}
    | {18: Fix.DGPS, 19: Fix.FIXED, 20: Fix.FLOAT, 33: Fix.DGPS},
    "mavlink": dict(
        enumerate((Fix.NONE, Fix.NONE, Fix.SINGLE, Fix.SINGLE, Fix.DGPS, Fix.FLOAT, Fix.FIXED, Fix.FIXED))
    )
    | {8: Fix.FLOAT},
}
"""GGA: 1 GPS, 2 differential, 3 PPS, 4 RTK, 5 float RTK, 6 estimated. RTKLIB's Q: 1 fix, 2 float, 3 SBAS,
4 DGPS, 5 single, 6 PPP (taken as float). Status of sensor_msgs/NavSatFix: 0 fix, 1 SBAS, 2 ground-based; of
gps_msgs/GPSFix also 18 DGPS, 19 RTK, 20 float RTK, 33 WAAS. GPS_FIX_TYPE of MAVLink, as in logs of PX4 and
ArduPilot: 2 and 3 a fix, 4 DGPS, 5 float, 6 fixed, 7 static base, 8 PPP (taken as float)."""


@dataclass(frozen=True, eq=False)
class Fixes(TimeRows):
    """Fixes as a receiver reports them.

    Attributes:
        t_ns: (N,) int64, never decreasing.
        llh: (N, 3) latitude deg, longitude deg, ellipsoidal height m; NaN where unknown. With `local`
            they are east, north and up of the datum, m.
        fix: (N,) `Fix` values.
        sigma_enu_m: (N, 3), NaN where unknown; None where no fix has any.
        velocity_enu_mps: (N, 3), NaN where unknown, or None.
        sigma_v_mps: (N,), or None.
    """

    t_ns: TimesNs
    llh: Array
    fix: NDArray[np.uint8]
    sigma_enu_m: Array | None = None
    velocity_enu_mps: Array | None = None
    sigma_v_mps: Array | None = None
    local: bool = False


def gnss_channel(
    rig: Rig | None, fixes: Fixes, datum: Datum | None = None, *, rows: str = "rows", channel: str = "gnss"
) -> tuple[Gnss | None, Datum | None, list[str]]:
    """The fixes about `datum`, or about the first of them; unknown sigmas are assumed.

    Latitude and longitude 0, 0 is no position in a log that is elsewhere. `rows` and `channel` are what
    notes and errors call the fixes.

    Returns:
        The channel without the rows that hold no fix (None where none does), the datum, and notes.

    Raises:
        DataError: a latitude or longitude that is not on Earth.
    """
    held = np.isfinite(fixes.llh[:, :2]).all(axis=1) & (fixes.fix > Fix.NONE)
    if not fixes.local and held.any() and np.abs(fixes.llh[held, :2]).max() > 0.1:
        held &= (fixes.llh[:, :2] != 0.0).any(axis=1)
    notes = []
    if not held.all():
        notes.append(f"gnss: {int((~held).sum())} of {len(held)} {rows} hold no fix; left out")
    if not held.any():
        return None, datum, [*notes, f"gnss: none of the {rows} holds a fix; the channel is absent"]
    first_ns, fixes = fixes.t_ns[0], fixes.select(held)
    enu = fixes.llh
    if not fixes.local:
        llh = fixes.llh.copy()
        off = np.flatnonzero((np.abs(llh[:, 0]) > 90.0) | (np.abs(llh[:, 1]) > 180.0))
        if off.size:
            i = int(off[0])
            raise DataError(
                f"latitude {llh[i, 0]:g} deg, longitude {llh[i, 1]:g} deg is not on Earth",
                channel=channel,
                time_s=float(fixes.t_ns[i] - first_ns) * 1e-9,
                remedy="give degrees up to 90 and 180; are they swapped, or in another unit?",
            )
        flat = np.isnan(llh[:, 2])
        if datum is None:
            datum = float(llh[0, 0]), float(llh[0, 1]), 0.0 if flat.all() else float(llh[~flat, 2][0])
            latitude, longitude, height = datum
            notes.append(
                f"gnss: datum is the first fix, {latitude:.7f} deg, {longitude:.7f} deg, {height:.2f} m"
            )
        llh[flat, 2] = datum[2]
        enu = geodetic_to_enu(llh, datum)
        enu[flat, 2] = np.nan
    sigma = np.full(enu.shape, np.nan) if fixes.sigma_enu_m is None else fixes.sigma_enu_m
    sigma, note = with_assumed_sigma(rig, sigma, fixes.fix)
    velocity, sigma_v = fixes.velocity_enu_mps, fixes.sigma_v_mps
    if velocity is None or not np.isfinite(velocity[:, :2]).any():
        velocity = sigma_v = None
    return Gnss(fixes.t_ns, enu, sigma, fixes.fix, velocity, sigma_v), datum, [*notes, *note]


def gnss_recording(
    request: Request, fixes: Fixes, datum: Datum | None, source: str, notes: Sequence[str], times: RowTimes
) -> Recording:
    """The recording of a log of fixes alone, with what `gnss_channel` notes; a DataError without a fix."""
    gnss, datum, more = gnss_channel(request.rig, fixes, datum)
    if gnss is None:
        raise DataError("holds no fix", remedy="record it under open sky, or process it again")
    return Recording(
        name=request.path.stem,
        start_ns=max(int(gnss.t_ns[0]), 0),  # no recording starts before 1970
        gnss=gnss,
        datum=datum,
        source=source,
        notes=(*notes, *more),
        clock_jumps=times.jumps,
    )
