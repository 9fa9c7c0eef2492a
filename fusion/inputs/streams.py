"""Buffers of sensor samples: checked, ordered by time, cut at keyframes."""

import bisect
import itertools
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array, Stamp
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.inputs.counter_noise import CounterNoise, drawn
from terrafusion.fusion.inputs.sample_stream import SampleStream
from terrafusion.fusion.inputs.time_jumps import Newest, median_step_ns
from terrafusion.fusion.inputs.validation import (
    MOST_MPS,
    MOST_MPS2,
    MOST_RADPS,
    MOST_TRAVEL_M,
    as_number,
    as_numbers,
    beyond,
    checked_time,
)


@dataclass(eq=False)
class ImuSegment:
    """A time (s) of constant angular rate (3,) and specific force (3,), never changed.

    `gyro_held`, `accel_held`: earlier samples replace a spike. A modelled force has its density on x, y.
    """

    # Not frozen: dozens are made for each keyframe, and frozen ones take three times as long.

    dt_s: float
    gyro_radps: Array
    accel_mps2: Array
    gyro_held: bool = False
    accel_held: bool = False
    accel_density_mps2: tuple[float, float] | None = None


def mean_yaw_rate_radps(segments: list[ImuSegment]) -> float:
    """Mean angular rate about z over the segments; 0 without any."""
    total_s = sum([segment.dt_s for segment in segments])
    turn_rad = sum([float(segment.gyro_radps[2]) * segment.dt_s for segment in segments])
    return turn_rad / total_s if total_s > 0.0 else 0.0


SPIN_RADPS, SHOCK_MPS2 = 10.0, 50.0
"""Beyond these, on any axis, a sample is a spike (assumed): held for 10 ms a shock would be 0.5 m/s."""
SPIKE_WINDOW_NS = 500_000_000
"""Where half the samples of this time are spikes, they are believed."""
REPLACED_BY = 10
"""Number of samples before a spike whose mean replaces it: fewer would contain too much vibration."""
LONGEST_PAUSE_NS = 20_000_000_000
"""A longer pause of the IMU has no keyframes: what a call computes is bounded."""
BEFORE_PAUSE_NS = 5_000_000_000
"""For so long the samples of a silent IMU may still come; then the wheels go on without it."""
USUAL_GAP_S = 0.5
"""Up to this time between samples no stream has a gap (assumed: lost messages of a 10 Hz sensor)."""
GAP_INTERVALS, SLOWEST_INTERVAL_S = 2.5, 2.0
"""A slow stream has a gap where samples are missing by its own interval, of at most 2 s."""
INTERVALS_SEEN = 21
HALF_NS = 50_000_000
"""Half of the time over which a speed is taken."""
MOST_INCOMPLETE = 1000
"""So many samples that miss an axis, and none that has all: the IMU is another than declared (assumed)."""
DECLARE = (
    "say what the robot has: Estimator.for_vehicle(vehicle, sensors=log), or a SensorConfig for `sensors`"
)
JUMP_M = 5.0
"""A counter that moves by this much more than a wheel of the fastest robot can has jumped (assumed)."""


def usual_interval_s(times: list[int]) -> float:
    """Median interval of the newest samples of a stream, s; 0 with fewer than three."""
    return median_step_ns(times[-INTERVALS_SEEN:]) * 1e-9


def longest_gap_s(times: list[int]) -> float:
    """Longest time between two samples of a stream over which it still shows the motion, s."""
    return max(USUAL_GAP_S, GAP_INTERVALS * min(usual_interval_s(times), SLOWEST_INTERVAL_S))


def is_gap(seconds: float, times: list[int]) -> bool:
    """Whether so long a time between two samples of a stream is a gap."""
    return seconds > USUAL_GAP_S and seconds > longest_gap_s(times)


class ImuStream(SampleStream):
    """IMU samples; the sample at t stands for the time since the one before it.

    Without `six_axis` only the yaw rate is used: any other axis may be NaN, and `segments` has in their
    place the readings of a robot that drives straight on level ground.

    `level` (3, 3) turns the readings of a tilted IMU into the level, `turn_scale` is the true over the
    measured yaw rate, less one, and `mounting_rad` the angle about z at which the IMU is mounted. Samples are
    held as measured; `segments`, `levelled` and `window` correct them by what is known when they are called.

    A single rate or force beyond `SPIN_RADPS` or `SHOCK_MPS2` is replaced by the mean of the samples
    before; `spikes` counts them, `impossible` those beyond what any sensor measures, which are left out.

    `silent_ns` is a time up to which no more samples are expected of an IMU that has fallen silent, else 0.
    """

    COLUMNS = ("t_ns", "gyro", "accel")
    BEFORE = 1  # that a silent IMU keeps its last one

    def __init__(self, six_axis: bool = True, newest: Newest | None = None) -> None:
        super().__init__("imu", newest)
        self.six_axis = six_axis
        self.turn_scale = self.mounting_rad = 0.0
        self.level: Array | None = None
        self.spikes = self.left_out = self.silent_ns = 0
        self._spike_ns: list[int] = []
        self._gyro_held_ns: list[int] = []
        self._accel_held_ns: list[int] = []
        self.gyro: list[Array] = []
        self.accel: list[Array] = []

    def leave_out(self, gyro_radps: ArrayLike) -> None:
        """Count a sample that turns about z (rates (3,), rad/s) but misses another axis, or all force.

        Raises:
            DataError: `MOST_INCOMPLETE` came, and none that misses none.
        """
        self.left_out += bool(np.isfinite(np.asarray(gyro_radps, dtype=float)[2]))
        if not self.t_ns and self.left_out >= MOST_INCOMPLETE:
            raise DataError(
                f"none of the first {MOST_INCOMPLETE} samples has all six axes, which the estimator expects",
                channel="imu",
                remedy=DECLARE,
            )

    def add(self, t_ns: Stamp, gyro_radps: ArrayLike, accel_mps2: ArrayLike) -> None:
        """A sample: rates (3,) and specific forces (3,).

        Raises:
            DataError: it has no time, a number is missing, or the clock was set back.
        """
        t_ns = checked_time(t_ns, "imu")
        gyro, accel = as_numbers(gyro_radps, "gyro", "imu"), as_numbers(accel_mps2, "accel", "imu")
        known = gyro.shape == accel.shape == (3,) and math.isfinite(
            sum(gyro.tolist()) + sum(accel.tolist()) if self.six_axis else gyro[2]
        )
        if not known:
            wanted = "six finite numbers" if self.six_axis else "six numbers with a finite yaw rate"
            raise DataError(
                f"sample is not {wanted}: gyro {gyro.tolist()}, accel {accel.tolist()}",
                channel="imu",
                remedy="leave out samples with missing axes",
            )
        spike = beyond(gyro, SPIN_RADPS), beyond(accel, SHOCK_MPS2)
        if self.six_axis and not accel.any():  # not even in free fall: the driver has lost the sensor
            self.leave_out(gyro)
            return
        if any(spike) and (beyond(gyro, MOST_RADPS) or beyond(accel, MOST_MPS2)):
            self.impossible += 1
            return
        for sample in self.late.jump.admitted((t_ns, gyro, accel, spike)):
            self._insert(*sample)

    def _insert(self, t_ns: int, gyro: Array, accel: Array, spike: tuple[bool, bool]) -> None:
        i = self.place(t_ns)
        if i is not None:
            if any(spike):
                if self._is_spike(i, t_ns):
                    recent = slice(max(i - REPLACED_BY, 0), i)
                    if spike[0]:
                        gyro = np.mean(self.gyro[recent], axis=0)
                        self._gyro_held_ns.append(t_ns)
                    if spike[1]:
                        accel = np.mean(self.accel[recent], axis=0)
                        self._accel_held_ns.append(t_ns)
                    self.spikes += 1
                self._spike_ns.append(t_ns)
            self.t_ns.insert(i, t_ns)
            self.gyro.insert(i, gyro)
            self.accel.insert(i, accel)

    def _is_spike(self, i: int, t_ns: int) -> bool:
        """Whether most samples before an extreme one at index i are not extreme."""
        since = bisect.bisect_left(self.t_ns, t_ns - SPIKE_WINDOW_NS, hi=i)
        return 2 * sum(t_ns - SPIKE_WINDOW_NS <= t < t_ns for t in self._spike_ns) < i - since

    def next_ns(self, now_ns: int, step_ns: int) -> int:
        """Time of the keyframe after one at `now_ns`: a step on, or at the end of a pause in the samples."""
        if not self.t_ns or max(self.t_ns[-1], self.silent_ns) - now_ns <= LONGEST_PAUSE_NS:
            return now_ns + step_ns
        i = bisect.bisect_right(self.t_ns, now_ns)
        ahead_ns = (self.t_ns[i] if i < len(self.t_ns) else self.silent_ns) - now_ns
        return now_ns + (ahead_ns // step_ns if ahead_ns > LONGEST_PAUSE_NS else 1) * step_ns

    def covers(self, t_ns: int) -> bool:
        return self.silent_ns >= t_ns or super().covers(t_ns)

    def go_on_without(self, wheels_ns: list[int]) -> None:
        """Expect no more samples up to the last wheel sample but one, where that is far ahead."""
        far = len(wheels_ns) > 1 and bool(self.t_ns) and wheels_ns[-2] - self.t_ns[-1] > BEFORE_PAUSE_NS
        self.silent_ns = wheels_ns[-2] if far else 0

    def segments(self, start_ns: int, end_ns: int) -> list[ImuSegment]:
        """The samples between two times, the last one cut at `end_ns`; the stream must cover it.

        A silent IMU reads what it read last.
        """
        i, newest = bisect.bisect_right(self.t_ns, start_ns), len(self.t_ns) - 1
        segments, t = [], start_ns
        while t < end_ns:
            j = min(i, newest)
            until = min(self.t_ns[i], end_ns) if i == j else end_ns
            if until > t:
                held = self.t_ns[j] in self._gyro_held_ns, self.t_ns[j] in self._accel_held_ns
                readings = self._for_graph(self.gyro[j], self.accel[j])
                segments.append(ImuSegment((until - t) * 1e-9, *readings, *held))
            t = until
            i += 1
        return segments

    def _for_graph(self, gyro: Array, accel: Array) -> tuple[Array, Array]:
        """Readings (..., 3) by body axes; without `six_axis` the yaw rate alone, on level ground."""
        if self.six_axis:
            return self._corrected(gyro, accel)
        rate, force = np.zeros(gyro.shape), np.zeros(gyro.shape)
        rate[..., 2], force[..., 2] = (1.0 + self.turn_scale) * gyro[..., 2], GRAVITY_MPS2
        return rate, force

    def _corrected(self, gyro: Array, accel: Array) -> tuple[Array, Array]:
        """Readings (..., 3) by body axes, with their turns as they are."""
        if self.level is not None:
            gyro, accel = gyro @ self.level.T, accel @ self.level.T
        if self.turn_scale:
            gyro = gyro * np.array([1.0, 1.0, 1.0 + self.turn_scale])
        if self.mounting_rad and self.six_axis:  # about z: the yaw rate alone stays as it is
            gyro, accel = turned(gyro, self.mounting_rad), turned(accel, self.mounting_rad)
        return gyro, accel

    def levelled(self, start_ns: int, end_ns: int) -> tuple[Array, Array]:
        """Rates (n, 3) and forces (n, 3) of a window, as `segments` has them."""
        _, *readings = self._measured(start_ns, end_ns)
        return self._for_graph(*readings)

    def largest_gap_s(self, start_ns: int, end_ns: int) -> float:
        """Longest time between samples that touch the interval, s."""
        i = max(bisect.bisect_right(self.t_ns, start_ns) - 1, 0)
        j = bisect.bisect_left(self.t_ns, end_ns)
        times = self.t_ns[i : j + 1]
        if j == len(self.t_ns):
            times.append(end_ns)
        return max((b - a for a, b in itertools.pairwise(times)), default=0) * 1e-9

    def window(self, start_ns: int, end_ns: int) -> tuple[Array, Array, Array]:
        """Times (n,) s from `start_ns`, rates (n, 3) and forces (n, 3) with start <= t < end, body axes."""
        times, *readings = self._measured(start_ns, end_ns)
        t_s = np.array([t_ns - start_ns for t_ns in times], dtype=float) * 1e-9
        return t_s, *self._corrected(*readings)

    def _measured(self, start_ns: int, end_ns: int) -> tuple[list[int], Array, Array]:
        """Times (n,) ns, and readings (n, 3) as measured, with start <= t < end."""
        i, j = bisect.bisect_left(self.t_ns, start_ns), bisect.bisect_left(self.t_ns, end_ns)
        gyro, accel = (np.array(held[i:j]).reshape(-1, 3) for held in (self.gyro, self.accel))
        return self.t_ns[i:j], gyro, accel

    def forget(self, before_ns: int) -> None:
        super().forget(before_ns)
        if self._spike_ns and self.t_ns:
            for times in (self._spike_ns, self._gyro_held_ns, self._accel_held_ns):
                times[:] = [t for t in times if t >= self.t_ns[0]]


def turned(vectors: Array, angle_rad: float) -> Array:
    """Vectors (..., 3) turned about z."""
    return np.asarray(vectors @ axes_turned(angle_rad))


def axes_turned(angle_rad: float) -> Array:
    """The matrix (3, 3) to axes that are turned about z by an angle."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


class WheelStream(SampleStream):
    """Travelled distance of the left and right side over time.

    Samples with a speed or travel that no robot has are left out; `impossible` counts them. Over a jump of
    the counters (a reset) the speeds give the distance; `jumps` counts these.
    """

    COLUMNS = ("t_ns", "left_m", "right_m", "_speeds", "_counted")
    BEFORE = 1  # from which to interpolate

    def __init__(self, newest: Newest | None = None) -> None:
        super().__init__("wheels", newest)
        self.jumps = 0
        self._offset_m = 0.0, 0.0
        self.left_m: list[float] = []
        self.right_m: list[float] = []
        self.noise = CounterNoise()
        self._speeds: list[tuple[float, float]] = []
        self._counted: list[tuple[float, float] | None] = []

    def add(
        self,
        t_ns: Stamp,
        left_mps: float,
        right_mps: float,
        left_m: float | None = None,
        right_m: float | None = None,
    ) -> None:
        """Side speeds and, where encoders count angle, the travelled distances, used instead.

        Raises:
            DataError: it has no time, a number is missing, or the clock was set back.
        """
        t_ns = checked_time(t_ns, "wheels")
        left_mps = as_number(left_mps, "wheel speed", "wheels")
        right_mps = as_number(right_mps, "wheel speed", "wheels")
        left = 0.0 if left_m is None else as_number(left_m, "wheel travel", "wheels")
        right = 0.0 if right_m is None else as_number(right_m, "wheel travel", "wheels")
        moved = left, right, left_mps, right_mps
        if not all(map(math.isfinite, moved)):
            raise DataError("a wheel speed is not finite", channel="wheels", remedy="leave the sample out")
        if max(abs(left_mps), abs(right_mps)) > MOST_MPS or max(map(abs, moved)) > MOST_TRAVEL_M:
            self.impossible += 1
            return
        counted = None if left_m is None or right_m is None else moved[:2]
        for sample in self.late.jump.admitted((t_ns, left_mps, right_mps, counted)):
            self._insert(*sample)

    def _insert(
        self, t_ns: int, left_mps: float, right_mps: float, counted: tuple[float, float] | None
    ) -> None:
        i = self.place(t_ns)
        if i is None:
            return
        self.t_ns.insert(i, t_ns)
        self._speeds.insert(i, (left_mps, right_mps))
        counted = self._continued(i, counted)
        self._counted.insert(i, counted)
        self.left_m.insert(i, counted[0] if counted else 0.0)
        self.right_m.insert(i, counted[1] if counted else 0.0)
        if counted is not None and i > 0 and i == len(self.t_ns) - 1:
            self._watch(i)
        if counted is None or self.noise.out_of_step:
            self._integrate_from(max(i, 1))

    def _continued(self, i: int, counted: tuple[float, float] | None) -> tuple[float, float] | None:
        """Counters of sample `i` without the jumps before it."""
        if counted is None:
            return None
        left, right = counted[0] + self._offset_m[0], counted[1] + self._offset_m[1]
        if i > 0:
            before = self.left_m[i - 1], self.right_m[i - 1]
            most_m = JUMP_M + MOST_MPS * (self.t_ns[i] - self.t_ns[i - 1]) * 1e-9
            if max(abs(left - before[0]), abs(right - before[1])) > most_m:
                left, right = (m + rolled for m, rolled in zip(before, self._by_speeds(i), strict=True))
                if i == len(self.t_ns) - 1:  # a late sample may be from before a jump that is known
                    self.jumps += 1
                    self._offset_m = left - counted[0], right - counted[1]
        return left, right

    def _watch(self, i: int) -> None:
        """Compare the increment of the counters that ends at sample `i` with that of the speeds."""
        now, before = self._counted[i], self._counted[i - 1]
        if now is not None and before is not None:
            counted_m = 0.5 * (now[0] - before[0] + now[1] - before[1])
            self.noise.add(counted_m, 0.5 * sum(self._by_speeds(i)))

    def _by_speeds(self, j: int) -> tuple[float, float]:
        """Distances of the sides up to sample `j` from the one before, by the trapezoid rule."""
        half_s = 0.5e-9 * (self.t_ns[j] - self.t_ns[j - 1])
        (left, right), (left_now, right_now) = self._speeds[j - 1], self._speeds[j]
        return half_s * (left + left_now), half_s * (right + right_now)

    def _integrate_from(self, first: int) -> None:
        """Distances by the speeds, drawn to the counters where there are any, from sample `first` on."""
        for j in range(first, len(self.t_ns)):
            left_m, right_m = self._by_speeds(j)
            self.left_m[j], self.right_m[j] = self.left_m[j - 1] + left_m, self.right_m[j - 1] + right_m
            counted = self._counted[j]
            if counted is not None:
                self.left_m[j] = drawn(self.left_m[j], counted[0])
                self.right_m[j] = drawn(self.right_m[j], counted[1])

    def travelled(self, start_ns: int, end_ns: int) -> tuple[float, float] | None:
        """Distance of the left and right side between two times, m; None where samples are missing."""
        a, b = self._at(start_ns), self._at(end_ns)
        if a is None or b is None:
            return None
        return b[0] - a[0], b[1] - a[1]

    def _at(self, t_ns: int) -> tuple[float, float] | None:
        j = bisect.bisect_left(self.t_ns, t_ns)
        if j == len(self.t_ns) or (j == 0 and self.t_ns[0] != t_ns):
            return None
        if self.t_ns[j] == t_ns:
            return self.left_m[j], self.right_m[j]
        span = self.t_ns[j] - self.t_ns[j - 1]
        if span * 1e-9 > 1.0 and is_gap(span * 1e-9, self.t_ns):
            return None
        w = (t_ns - self.t_ns[j - 1]) / span
        left = self.left_m[j - 1] + w * (self.left_m[j] - self.left_m[j - 1])
        right = self.right_m[j - 1] + w * (self.right_m[j] - self.right_m[j - 1])
        return left, right

    def count_m(self) -> float:
        """Travel of the smallest step between the last speeds of the left side over one interval, m."""
        speeds = sorted({round(left, 6) for left, _ in self._speeds[-INTERVALS_SEEN:]})
        steps = [b - a for a, b in itertools.pairwise(speeds)]
        return min(steps, default=0.0) * usual_interval_s(self.t_ns)

    def speed_change_mps(self, start_ns: int, end_ns: int) -> float:
        """Speed of both sides at the end less that at the start, m/s; 0 where samples are missing.

        Each speed is a mean about its time; where the newest sample cuts the last one short, the change is
        that of a steady acceleration between the two middles.
        """
        half, newest = HALF_NS, self.t_ns[-1] if self.t_ns else 0
        if newest <= end_ns - half:
            return 0.0
        windows = [(t - half, min(t + half, newest)) for t in (start_ns, end_ns)]
        (a, b), (c, d) = windows
        first, last = self.travelled(a, b), self.travelled(c, d)
        if first is None or last is None:
            return 0.0
        change = 0.5e9 * (sum(last) / (d - c) - sum(first) / (b - a))
        return change * (end_ns - start_ns) / (0.5 * (c + d - a - b))


class Forgetful(Protocol):
    """Holds samples of which those before a time can be dropped."""

    def forget(self, before_ns: int) -> None: ...


def forget_in_pause(imu: ImuStream, wheels: WheelStream, *others: Forgetful) -> None:
    """Drop what keyframes cannot use while the IMU is silent: the next one comes after the pause."""
    before_ns = wheels.t_ns[-1] - LONGEST_PAUSE_NS - BEFORE_PAUSE_NS if wheels.t_ns else 0
    if imu.t_ns and imu.t_ns[-1] >= before_ns:
        return
    held = len(wheels.t_ns)
    wheels.forget(before_ns)
    if len(wheels.t_ns) < held:
        for samples in others:
            samples.forget(before_ns)
