"""Curvature of the path by the steering angles."""

import bisect
import math

from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.inputs.streams import Lateness, Newest
from terrafusion.fusion.inputs.validation import as_number, checked_time

LONGEST_HOLD_S = 1.0
"""An angle holds for so long, or for three intervals of slower samples."""


class SteeringStream:
    """Steering angles over time, as the curvature (tan front - tan rear) / wheelbase of the bicycle model.

    Angles that no wheel has are left out; `impossible` counts them.
    """

    def __init__(self, rig: Rig, newest: Newest | None = None) -> None:
        self.late = Lateness("steering", newest)
        self.impossible = 0
        self.t_ns: list[int] = []
        self.per_m: list[float] = []
        self._wheelbase_m = rig.wheelbase_m

    def add(self, t_ns: int, front_rad: float, rear_rad: float = 0.0) -> None:
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
        per_m = (math.tan(front_rad) - math.tan(rear_rad)) / self._wheelbase_m
        for at_ns, value in self.late.jump.admitted((t_ns, per_m)):
            for _ in range(self.late.from_future(at_ns, self.t_ns)):
                self.t_ns.pop()
                self.per_m.pop()
            i = self.late.place(at_ns, self.t_ns)
            if i is not None:
                self.t_ns.insert(i, at_ns)
                self.per_m.insert(i, value)

    def curvature_per_m(self, start_ns: int, end_ns: int) -> float | None:
        """Mean curvature between two times, 1/m; None where no angle is near."""
        values = [self._at(t) for t in (start_ns, (start_ns + end_ns) // 2, end_ns)]
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if known else None

    def _at(self, t_ns: int) -> float | None:
        """Linear between samples; the last one holds."""
        i = bisect.bisect_right(self.t_ns, t_ns)
        if i == 0:
            return None
        before_ns = self.t_ns[i - 1]
        hold_s = max(LONGEST_HOLD_S, 3e-9 * (before_ns - self.t_ns[i - 2]) if i > 1 else 0.0)
        if i == len(self.t_ns):
            return self.per_m[-1] if (t_ns - before_ns) * 1e-9 <= hold_s else None
        if (self.t_ns[i] - before_ns) * 1e-9 > hold_s:
            return None
        share = (t_ns - before_ns) / (self.t_ns[i] - before_ns)
        return self.per_m[i - 1] + share * (self.per_m[i] - self.per_m[i - 1])

    def forget(self, before_ns: int) -> None:
        """Drop angles older than `before_ns`, in blocks so that it stays cheap."""
        i = bisect.bisect_left(self.t_ns, before_ns)
        if i > 256:
            del self.t_ns[:i], self.per_m[:i]
