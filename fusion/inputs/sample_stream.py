"""Samples of a sensor in the order of their times; they may come late, out of order, or far ahead."""

import bisect
from typing import Any, ClassVar

from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.inputs.time_jumps import CONFIRMED, JUMP_NS, Newest, TimeJump

MOST_LATE_S = 5.0
"""A sample this much older than its stream's newest is no late message: the clock has jumped."""
LONGEST_WAIT_S = 0.5
BLOCK = 256
"""Old samples are dropped so many at a time, so that it stays cheap."""


class Lateness:
    """Disorder of a stream in time, and samples that came too late.

    A keyframe waits for as long as the stream has been late (an ordered stream costs no waiting). A sample
    before it is then too late.

    Attributes:
        wait_ns: longest lateness so far, of those up to `LONGEST_WAIT_S`.
        used_ns: end of what the keyframes have used.
        too_late: number of samples left out because their keyframe had been made.
        jump: samples that come far ahead.
    """

    def __init__(self, channel: str, newest: Newest | None = None) -> None:
        self.channel = channel
        self.jump = TimeJump(newest or Newest(), channel)
        self.wait_ns = 0
        self.used_ns: int | None = None
        self.too_late = 0

    def from_future(self, t_ns: int, times: list[int]) -> int:
        """How many of the newest samples, too few for a jump, have wrong times; before the start only."""
        if self.used_ns is not None:
            return 0
        ahead = len(times) - bisect.bisect_right(times, t_ns + JUMP_NS)
        if not 0 < ahead < CONFIRMED:
            return 0
        self.jump.dropped += ahead
        self.jump.newest.t_ns = t_ns
        return ahead

    def place(self, t_ns: int, times: list[int]) -> int | None:
        """Index in `times` where a sample belongs, or None when it is too late.

        Raises:
            DataError: the sample is so old that the clock must have jumped.
        """
        if not times or t_ns >= times[-1]:
            return len(times)
        late_ns = times[-1] - t_ns
        if late_ns > MOST_LATE_S * 1e9:
            raise DataError(
                f"sample at {t_ns} ns comes {late_ns * 1e-9:.3f} s after a newer one",
                channel=self.channel,
                remedy=f"more than {MOST_LATE_S:g} s is no late message: start anew where a clock jumps",
            )
        if late_ns <= LONGEST_WAIT_S * 1e9:  # no waiting would have helped a later one
            self.wait_ns = max(self.wait_ns, late_ns)
        if self.used_ns is not None and t_ns <= self.used_ns:
            self.too_late += 1
            return None
        return bisect.bisect_right(times, t_ns)


class SampleStream:
    """Samples in the order of their times, in lists: the times and, in each other one of `COLUMNS`, values.

    Attributes:
        late: samples that come late or ahead.
        impossible: number of samples left out because no robot has such numbers.
    """

    COLUMNS: ClassVar[tuple[str, ...]] = ("t_ns",)
    BEFORE = 0

    def __init__(self, channel: str, newest: Newest | None) -> None:
        self.late = Lateness(channel, newest)
        self.impossible = 0
        self.t_ns: list[int] = []

    def _columns(self) -> list[list[Any]]:
        return [getattr(self, name) for name in self.COLUMNS]

    def place(self, t_ns: int) -> int | None:
        """Index where a sample belongs, or None when it is too late; newer ones whose times were wrong are
        dropped.

        Raises:
            DataError: the sample is so old that the clock must have jumped.
        """
        if wrong := self.late.from_future(t_ns, self.t_ns):
            for column in self._columns():
                del column[-wrong:]
        return self.late.place(t_ns, self.t_ns)

    def covers(self, t_ns: int) -> bool:
        """Whether a keyframe at `t_ns` need not wait for samples."""
        return bool(self.t_ns) and self.t_ns[-1] >= t_ns + self.late.wait_ns

    def forget(self, before_ns: int) -> None:
        """Drop samples older than `before_ns`, but for `BEFORE` of them."""
        i = bisect.bisect_left(self.t_ns, before_ns) - self.BEFORE
        if i > BLOCK:
            for column in self._columns():
                del column[:i]
