"""The fixes: their sigmas, their jumps, the course they take."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.doctor.finding import Finding, Patient
from terrafusion.datasets.doctor.motion import course_correlation
from terrafusion.datasets.doctor.timing import GAP_PERIODS

Array = NDArray[np.float64]


def check_sigma(patient: Patient) -> Iterator[Finding]:
    """A sigma of a fix must be a positive number."""
    gnss = patient.recording.gnss
    if gnss is None:
        return
    sigma = gnss.sigma_enu_m[:, :2]
    if np.isfinite(gnss.enu_m[:, 2]).any():
        sigma = gnss.sigma_enu_m
    bad = ~np.all(sigma > 0.0, axis=1)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        missing_only = not (sigma <= 0.0).any()  # such fixes are left out, the others would mislead
        at_s, said = patient.since_start_s(gnss.t_ns[first]), gnss.sigma_enu_m[first].tolist()
        yield Finding(
            "sigma-impossible",
            "warning" if missing_only else "error",
            "gnss",
            f"{int(bad.sum())} of {len(bad)} fixes have a sigma that is zero, negative or missing",
            f"first at t = {at_s:.2f} s: {said} m",
            "give the receiver's accuracy; such fixes cannot be weighted",
        )


def check_jumps(patient: Patient) -> Iterator[Finding]:
    """Steps between fixes that no drive explains."""
    gnss = patient.recording.gnss
    if gnss is None or len(gnss) < 10:
        return
    dt = np.diff(gnss.t_ns) * 1e-9
    step = np.diff(gnss.enu_m[:, :2], axis=0)
    near = (dt > 0) & (dt <= GAP_PERIODS * np.median(dt)) & np.isfinite(step).all(axis=1)
    speed = np.where(near[:, None], step, 0.0) / np.where(dt > 0, dt, 1.0)[:, None]
    smooth = np.stack([_running_median(speed[:, k], 9) for k in range(2)], axis=1)
    off = np.hypot(*((speed - smooth) * dt[:, None]).T) * near
    limit = max(1.0, 8.0 * float(np.median(off[near]))) if near.any() else np.inf
    jumps = np.flatnonzero(off > limit)
    if jumps.size:
        worst = int(jumps[np.argmax(off[jumps])])
        yield Finding(
            "gnss-jumps",
            "warning",
            "gnss",
            f"{jumps.size} jump{'s' if jumps.size > 1 else ''} of position",
            f"largest {off[worst]:.2f} m at t = {patient.since_start_s(gnss.t_ns[worst + 1]):.2f} s",
            "multipath or a changed fix; the estimator's gate should reject them",
        )


def _running_median(values: Array, width: int) -> Array:
    padded = np.pad(values, width // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1))


def check_course(patient: Patient) -> Iterator[Finding]:
    """The path of the fixes must turn the way the gyro does."""
    gnss, imu = patient.recording.gnss, patient.recording.imu
    if gnss is None or imu is None:
        return
    r = course_correlation(gnss, imu)
    if r is not None and r < -0.5:
        yield Finding(
            "gnss-course",
            "error",
            "gnss",
            "the path of the fixes turns against the gyro",
            f"correlation {r:.2f} of their changes of course",
            "east and north may be swapped, or one of them or gyro z may have the wrong sign",
        )
