"""Curvature and course of the path by the steering angles."""

import bisect
import math

from terrafusion.datasets.core.arrays import Stamp
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.inputs.sample_stream import MOST_WAITING, SampleStream
from terrafusion.fusion.inputs.time_jumps import Newest
from terrafusion.fusion.inputs.validation import as_number, checked_time

LONGEST_HOLD_S = 1.0
"""An angle holds for so long, or for three intervals of slower samples."""


class SteeringStream(SampleStream):
    """Steering angles over time, as the curvature (tan front - tan rear) / wheelbase of the bicycle model.

    The point that follows the wheels (`Rig.ahead_m`) moves (tan front + tan rear) / 2 to the left per metre
    ahead, or tan rear where it is the middle of the rear axle.
    Angles that no wheel has are left out; `impossible` counts them.
    """

    COLUMNS = ("t_ns", "per_m", "course")

    def __init__(self, rig: Rig, newest: Newest | None = None) -> None:
        super().__init__("steering", newest)
        self.per_m: list[float] = []
        self.course: list[float] = []
        self._wheelbase_m, self._by_rear = rig.wheelbase_m, rig.ahead_m > 0.0

    def add(self, t_ns: Stamp, front_rad: float, rear_rad: float = 0.0) -> None:
        """Mean angle of the front and of the rear wheels, rad, positive to the left.

        Raises:
            DataError: it has no time, an angle is no number, or the clock was set back.
        """
        t_ns = checked_time(t_ns, "steering")
        front_rad, rear_rad = (
            as_number(angle, "steering angle", "steering") for angle in (front_rad, rear_rad)
        )
        if not max(abs(front_rad), abs(rear_rad)) < 0.5 * math.pi:
            self.impossible += 1
            return
        front, rear = math.tan(front_rad), math.tan(rear_rad)
        sample = t_ns, (front - rear) / self._wheelbase_m, rear if self._by_rear else 0.5 * (front + rear)
        for at_ns, per_m, course in self.late.jump.admitted(sample):
            i = self.place(at_ns)
            if i is not None:
                self.t_ns.insert(i, at_ns)
                self.per_m.insert(i, per_m)
                self.course.insert(i, course)
        if len(self.t_ns) > MOST_WAITING:
            self.forget(self.t_ns[-MOST_WAITING // 2])

    def curvature_per_m(self, start_ns: int, end_ns: int) -> float | None:
        """Mean curvature between two times, 1/m; None where no angle is near."""
        return self._mean(self.per_m, start_ns, end_ns)

    def course_rad(self, start_ns: int, end_ns: int) -> float:
        """Mean angle of that point's velocity from body x, positive to the left; 0 without an angle near."""
        return math.atan(self._mean(self.course, start_ns, end_ns) or 0.0)

    def _mean(self, values: list[float], start_ns: int, end_ns: int) -> float | None:
        found = [self._at(values, t) for t in (start_ns, (start_ns + end_ns) // 2, end_ns)]
        known = [value for value in found if value is not None]
        return sum(known) / len(known) if known else None

    def _at(self, values: list[float], t_ns: int) -> float | None:
        """Linear between samples; the last one holds."""
        i = bisect.bisect_right(self.t_ns, t_ns)
        if i == 0:
            return None
        before_ns = self.t_ns[i - 1]
        hold_s = max(LONGEST_HOLD_S, 3e-9 * (before_ns - self.t_ns[i - 2]) if i > 1 else 0.0)
        if i == len(self.t_ns):
            return values[-1] if (t_ns - before_ns) * 1e-9 <= hold_s else None
        if (self.t_ns[i] - before_ns) * 1e-9 > hold_s:
            return None
        share = (t_ns - before_ns) / (self.t_ns[i] - before_ns)
        return values[i - 1] + share * (values[i] - values[i - 1])
