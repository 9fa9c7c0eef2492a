"""Sensor samples on their way into the graph: buffered, checked, cut at keyframes."""

from __future__ import annotations

import bisect
import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafusion.datasets.errors import DataError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ImuSegment:
    """A piece of time (s) with constant angular rate (3,) and specific force (3,)."""

    dt_s: float
    gyro_radps: Array
    accel_mps2: Array


@dataclass(frozen=True, eq=False)
class GnssFix:
    """One fix: antenna position (3,) and sigma (3,), ENU m; velocity (3,) m/s and its sigma where known."""

    t_ns: int
    enu_m: Array
    sigma_m: Array
    velocity_mps: Array | None = None
    sigma_v_mps: float = float("nan")


def _in_order(channel: str, t_ns: int, times: list[int]) -> None:
    if times and t_ns < times[-1]:
        raise DataError(
            f"sample at {t_ns} ns comes {(times[-1] - t_ns) * 1e-9:.3f} s after a newer one",
            channel=channel,
            remedy="feed each sensor in time order",
        )


class ImuStream:
    """IMU samples; the sample at t stands for the time since the one before it."""

    def __init__(self) -> None:
        self.t_ns: list[int] = []
        self.gyro: list[Array] = []
        self.accel: list[Array] = []

    def add(self, t_ns: int, gyro_radps: ArrayLike, accel_mps2: ArrayLike) -> None:
        gyro, accel = np.asarray(gyro_radps, dtype=float), np.asarray(accel_mps2, dtype=float)
        if gyro.shape != (3,) or accel.shape != (3,) or not np.isfinite(gyro.sum() + accel.sum()):
            raise DataError(
                f"sample is not six finite numbers: gyro {gyro.tolist()}, accel {accel.tolist()}",
                channel="imu",
                remedy="leave out samples with missing axes",
            )
        _in_order("imu", t_ns, self.t_ns)
        self.t_ns.append(t_ns)
        self.gyro.append(gyro)
        self.accel.append(accel)

    def covers(self, t_ns: int) -> bool:
        return bool(self.t_ns) and self.t_ns[-1] >= t_ns

    def segments(self, start_ns: int, end_ns: int) -> list[ImuSegment]:
        """The samples between two times, the last one cut at `end_ns`; the stream must cover it."""
        i = bisect.bisect_right(self.t_ns, start_ns)
        pieces, t = [], start_ns
        while t < end_ns:
            until = min(self.t_ns[i], end_ns)
            if until > t:
                pieces.append(ImuSegment((until - t) * 1e-9, self.gyro[i], self.accel[i]))
            t = until
            i += 1
        return pieces

    def largest_gap_s(self, start_ns: int, end_ns: int) -> float:
        """Longest time between samples that touch the interval, s."""
        i = max(bisect.bisect_right(self.t_ns, start_ns) - 1, 0)
        j = bisect.bisect_left(self.t_ns, end_ns)
        times = self.t_ns[i : j + 1]
        return max((b - a for a, b in itertools.pairwise(times)), default=0) * 1e-9

    def window(self, start_ns: int, end_ns: int) -> tuple[Array, Array, Array]:
        """Times (n,) s from `start_ns`, rates (n, 3) and forces (n, 3) with start <= t < end."""
        i, j = bisect.bisect_left(self.t_ns, start_ns), bisect.bisect_left(self.t_ns, end_ns)
        t = np.array([x - start_ns for x in self.t_ns[i:j]], dtype=float) * 1e-9
        return t, np.array(self.gyro[i:j]).reshape(-1, 3), np.array(self.accel[i:j]).reshape(-1, 3)

    def forget(self, before_ns: int) -> None:
        """Drop samples older than `before_ns`, in blocks so that it stays cheap."""
        i = bisect.bisect_left(self.t_ns, before_ns)
        if i > 256:
            del self.t_ns[:i], self.gyro[:i], self.accel[:i]


class WheelStream:
    """Travelled distance of the left and right side over time."""

    def __init__(self) -> None:
        self.t_ns: list[int] = []
        self.left_m: list[float] = []
        self.right_m: list[float] = []
        self._last: tuple[float, float] | None = None

    def add(
        self,
        t_ns: int,
        left_mps: float,
        right_mps: float,
        left_m: float | None = None,
        right_m: float | None = None,
    ) -> None:
        """Side speeds, and, where encoders count angle, the travelled distances, used instead."""
        if not np.isfinite(left_mps + right_mps + (left_m or 0.0) + (right_m or 0.0)):
            raise DataError("a wheel speed is not finite", channel="wheels", remedy="leave the sample out")
        _in_order("wheels", t_ns, self.t_ns)
        if left_m is None or right_m is None:
            left_m, right_m = self._integrated(t_ns, left_mps, right_mps)
        self.t_ns.append(t_ns)
        self.left_m.append(left_m)
        self.right_m.append(right_m)
        self._last = (left_mps, right_mps)

    def _integrated(self, t_ns: int, left_mps: float, right_mps: float) -> tuple[float, float]:
        if self._last is None:
            return 0.0, 0.0
        dt = (t_ns - self.t_ns[-1]) * 1e-9
        left, right = self._last
        return self.left_m[-1] + 0.5 * (left + left_mps) * dt, self.right_m[-1] + 0.5 * (
            right + right_mps
        ) * dt

    def covers(self, t_ns: int) -> bool:
        return bool(self.t_ns) and self.t_ns[-1] >= t_ns

    def travelled(self, start_ns: int, end_ns: int, longest_gap_s: float = 1.0) -> tuple[float, float] | None:
        """Distance of the left and right side between two times, m; None where samples are missing."""
        a, b = self._at(start_ns, longest_gap_s), self._at(end_ns, longest_gap_s)
        if a is None or b is None:
            return None
        return b[0] - a[0], b[1] - a[1]

    def _at(self, t_ns: int, longest_gap_s: float) -> tuple[float, float] | None:
        j = bisect.bisect_left(self.t_ns, t_ns)
        if j == len(self.t_ns) or (j == 0 and self.t_ns[0] != t_ns):
            return None
        if self.t_ns[j] == t_ns:
            return self.left_m[j], self.right_m[j]
        span = self.t_ns[j] - self.t_ns[j - 1]
        if span * 1e-9 > longest_gap_s:
            return None
        w = (t_ns - self.t_ns[j - 1]) / span
        left = self.left_m[j - 1] + w * (self.left_m[j] - self.left_m[j - 1])
        right = self.right_m[j - 1] + w * (self.right_m[j] - self.right_m[j - 1])
        return left, right

    def speed_change_mps(self, start_ns: int, end_ns: int, over_ns: int = 100_000_000) -> float:
        """Speed of both sides about the end less that about the start, m/s; 0 where samples are missing."""
        half = over_ns // 2
        at = [self.travelled(t - half, min(t + half, self.t_ns[-1])) for t in (start_ns, end_ns)]
        if at[0] is None or at[1] is None:
            return 0.0
        spans = [min(t + half, self.t_ns[-1]) - t + half for t in (start_ns, end_ns)]
        first, last = (0.5 * sum(a or ()) / (span * 1e-9) for a, span in zip(at, spans, strict=True))
        return last - first

    def forget(self, before_ns: int) -> None:
        i = bisect.bisect_left(self.t_ns, before_ns) - 1
        if i > 256:
            del self.t_ns[:i], self.left_m[:i], self.right_m[:i]
