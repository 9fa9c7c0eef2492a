"""Strict errors in outages: how they are laid out, and what is scored.

After 60 s (or 40 % of a short log) fixes are withheld again and again. Outages of one pass are as far
apart as they are long, so that an estimator finds its way back between them. Scored is the horizontal error
at the last reference before the end of the outage. All times are s from the start of the recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.field_logs import reference_of
from terrafusion.twin.model.vehicle import VehicleParams

Array = NDArray[np.float64]

WARM_S, WARM_SHARE = 60.0, 0.4
LEAST_APART_S = 20.0
LEAST_M = 2.0
"""Outages with a shorter path of the wheels are not scored."""
LEAST_WHEELS = 20

Blocked = Callable[[float], bool]


@dataclass(frozen=True, eq=False)
class Streams:
    """What a planar estimator needs: speed and yaw rate at `t_s` (N,), fixes (M, 4), reference (K, 3).

    The yaw rate is the mean of the gyro since the sample before. Fixes are time, east, north, sigma; the
    reference is time, x, y. Outages begin every `apart_s`, by default every two lengths.
    """

    t_s: Array
    v_mps: Array
    w_radps: Array
    fixes: Array
    reference: Array
    apart_s: float | None = None

    def starts(self, seconds: float) -> Array:
        """Starts of outages of one length."""
        first, last = self.t_s[0], self.t_s[-1]
        warm = min(WARM_S, WARM_SHARE * (last - first))
        return np.arange(first + warm, last - seconds, self.apart_s or _usually_apart_s(seconds))

    def driven_m(self, start_s: float, seconds: float) -> float:
        """Path of the wheels in an outage."""
        inside = (self.t_s >= start_s) & (self.t_s < start_s + seconds)
        return float(np.sum(np.abs(self.v_mps[inside][1:]) * np.diff(self.t_s[inside])))

    def passes(self, seconds: float) -> list[list[float]]:
        """Starts of the scored outages, pass by pass."""
        starts, usual_s = self.starts(seconds).tolist(), _usually_apart_s(seconds)
        passes = math.ceil(2.0 * usual_s / (self.apart_s or usual_s))
        parts = [starts[k::passes] for k in range(passes)]
        scored = [[a for a in part if self.driven_m(a, seconds) > LEAST_M] for part in parts]
        return [part for part in scored if part]

    def reference_at(self, start_s: float, seconds: float) -> Array | None:
        """Time, x and y of the last reference in an outage; None without one."""
        k = int(np.searchsorted(self.reference[:, 0], start_s + seconds - 1e-6)) - 1
        return self.reference[k] if k >= 0 and self.reference[k, 0] >= start_s else None

    def error_m(self, t_s: Array, path_m: Array, start_s: float, seconds: float) -> float | None:
        """Error of a path (N, 2) at times (N,), nothing after the outage used."""
        reference = self.reference_at(start_s, seconds)
        if reference is None:
            return None
        before = t_s < start_s + seconds
        at = [np.interp(reference[0], t_s[before], path_m[before, c]) for c in (0, 1)]
        return float(np.hypot(at[0] - reference[1], at[1] - reference[2]))


def _usually_apart_s(seconds: float) -> float:
    return max(2.0 * seconds, LEAST_APART_S)


def streams_of(recording: Recording, vehicle: VehicleParams) -> Streams | None:
    """The streams of a recording with wheels, yaw rate and fixes; None where they are too short."""
    wheels, imu, gnss = recording.wheels, recording.imu, recording.gnss
    assert wheels is not None
    assert imu is not None
    assert gnss is not None

    def seconds(t_ns: NDArray[np.int64]) -> Array:
        return np.asarray((t_ns - recording.start_ns) * 1e-9)

    fixes = np.column_stack([seconds(gnss.t_ns), gnss.enu_m[:, :2], gnss.sigma_enu_m[:, 0]])
    fixes = fixes[np.isfinite(fixes).all(axis=1)]
    rolled = np.isfinite(wheels.speed).any(axis=1)
    t = seconds(wheels.t_ns)[rolled]
    v = np.nanmean(wheels.speed[rolled], axis=1)
    v = v * (vehicle.rig().wheel_radius_m if wheels.unit == "radps" else 1.0)
    turned = np.isfinite(imu.gyro_radps[:, 2])
    ti, gz = seconds(imu.t_ns)[turned], imu.gyro_radps[turned, 2]
    area = np.r_[0.0, np.cumsum(0.5 * (gz[1:] + gz[:-1]) * np.diff(ti))]
    w = np.r_[0.0, np.diff(np.interp(t, ti, area)) / np.maximum(np.diff(t), 1e-6)]
    if len(fixes) < LEAST_WHEELS // 2:
        return None
    inside = (t >= fixes[0, 0]) & (t <= fixes[-1, 0])
    if inside.sum() < LEAST_WHEELS:
        return None
    reference = fixes[:, :3]
    truth = recording.truth
    if truth is not None and reference_of(recording) == "truth":
        reference = np.column_stack([seconds(truth.t_ns), truth.position_m[:, :2]])
        reference = reference[np.isfinite(reference).all(axis=1)]
    return Streams(t[inside], v[inside], w[inside], fixes, reference)


@dataclass(frozen=True)
class Row:
    """One outage: its start, the error at its end and the path of the wheels in it."""

    start_s: float
    error_m: float
    distance_m: float


def scored(streams: Streams, seconds: float, run: Callable[[Blocked], tuple[Array, Array]]) -> list[Row]:
    """Rows of an estimator: `run(blocked)` gives times (N,) and path (N, 2), without the blocked fixes."""
    rows = []
    for starts in streams.passes(seconds):
        t_s, path = run(blocked_in(starts, seconds))
        for a in starts:
            error = streams.error_m(t_s, path, a, seconds)
            if error is not None:
                rows.append(Row(a, error, streams.driven_m(a, seconds)))
    return rows


def blocked_in(starts: list[float], seconds: float) -> Blocked:
    """Whether a time lies in an outage of that length."""
    return lambda t: any(a <= t < a + seconds for a in starts)
