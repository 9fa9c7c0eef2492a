"""What was known of the robot before a skid: as long as it lasts, the wheels tell wrong numbers."""

from collections import deque

from terrafusion.fusion.calibration.numbers import Knowledge

SKID_DETECTION_NS, STEPS_KEPT = 15_000_000_000, 8
"""A skid shows within this time (assumed); so many steps of learning reach further back."""


class KnownBeforeSkid:
    """The last steps of learning, and what was known before the skid under way.

    Attributes:
        held: what was known before it; None while the robot does not skid.
    """

    def __init__(self) -> None:
        self.held: Knowledge | None = None
        self._steps = deque[tuple[int, Knowledge]](maxlen=STEPS_KEPT)

    def learned(self, t_ns: int, known: Knowledge) -> None:
        """A step of learning that ended at `t_ns`."""
        self._steps.append((t_ns, known))

    def at(self, t_ns: int, otherwise: Knowledge) -> Knowledge:
        """What was known before a skid that shows at `t_ns` began; `otherwise` if no step is as old."""
        until_ns = t_ns - SKID_DETECTION_NS
        return next((known for at_ns, known in reversed(self._steps) if at_ns <= until_ns), otherwise)

    def clear(self) -> None:
        """Learning begins anew."""
        self.held = None
        self._steps.clear()
