"""Whether a yaw gyro reports degrees per second: it then turns 57 times as far as the wheels say."""

from collections import deque

from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.inputs.streams import WheelStream

WINDOW_NS, LONGEST_STEP_NS, WAIT_NS = 1_000_000_000, 200_000_000, 500_000_000
"""Time over which turns are compared, between two samples of the gyro beyond which it is begun anew, and for
which wheels are waited for."""
WINDOWS, LEAST_TURN_RAD = 6, 0.03
"""Windows compared, and turn by the wheels from which on one counts: noise and slip are small beside it."""
LEAST_RATIO = 10.0
"""Turn by the gyro over that by the wheels. In rad/s it is 0.4 to 1 (skid-steered robots turn less than their
wheels say), in deg/s 23 to 57."""


class GyroUnit:
    """Compares the turns of gyro and wheels while a robot drives.

    Attributes:
        in_degrees: the last `WINDOWS` turns were those of a gyro in deg/s, or two before a breakdown.
    """

    def __init__(self, track_m: float) -> None:
        self.in_degrees = False
        self._track_m = track_m
        self._begin_ns: int | None = None
        self._last_ns = 0
        self._turn = 0.0
        self._waiting: tuple[int, int, float] | None = None
        self._ratios: deque[float] = deque(maxlen=WINDOWS)

    def check(self, t_ns: int, yaw_rate_radps: float, wheels: WheelStream) -> None:
        """Take a reading.

        Raises:
            DataError: the readings are in degrees per second.
        """
        step_ns = t_ns - self._last_ns
        if self._begin_ns is None or not 0 <= step_ns <= LONGEST_STEP_NS or yaw_rate_radps != yaw_rate_radps:
            self._begin_ns, self._turn = t_ns, 0.0
        else:
            self._turn += yaw_rate_radps * step_ns * 1e-9
            if t_ns - self._begin_ns >= WINDOW_NS:
                self._waiting = self._begin_ns, t_ns, self._turn
                self._begin_ns, self._turn = t_ns, 0.0
        self._last_ns = t_ns
        if self._waiting is not None and t_ns - self._waiting[1] >= WAIT_NS:
            self._compare(*self._waiting, wheels)
            self._waiting = None
        if self.in_degrees:
            raise self._error()

    def blamed(self) -> DataError | None:
        """The error to raise where the estimate broke down: two windows are then enough to tell the unit."""
        if len(self._ratios) >= 2 and self._far():
            self.in_degrees = True
            return self._error()
        return None

    def _error(self) -> DataError:
        return DataError(
            f"the gyro turns {min(map(abs, self._ratios)):.0f} times as far as the wheels, as in deg/s",
            channel="imu",
            remedy="give rad/s",
        )

    def _far(self) -> bool:
        return min(self._ratios) > LEAST_RATIO or max(self._ratios) < -LEAST_RATIO

    def _compare(self, begin_ns: int, end_ns: int, by_gyro: float, wheels: WheelStream) -> None:
        travelled = wheels.travelled(begin_ns, end_ns)
        turn = 0.0 if travelled is None else float(travelled[1] - travelled[0]) / self._track_m
        if abs(turn) < LEAST_TURN_RAD:
            return
        self._ratios.append(by_gyro / turn)
        self.in_degrees = self._far() and (self.in_degrees or len(self._ratios) == WINDOWS)
