"""Samples of a sensor in the order of their times; they may come late, out of order, or far ahead."""

import bisect
from dataclasses import dataclass
from typing import Any, ClassVar

from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.inputs.time_jumps import (
    CONFIRMED,
    CONFIRMED_NS,
    JUMP_NS,
    ClockJumpError,
    Newest,
    TimeJump,
)

MOST_LATE_S = 5.0
"""A sample this much older than its stream's newest is no late message: the clock has jumped."""
LONGEST_WAIT_S = 0.5
SILENT_NS = 2_000_000_000
"""A stream that another one is so far ahead of is silent (assumed)."""
MANY, LEAST_SPAN_NS = 1000, 50_000_000
"""So many samples last for longer: no sensor has 20 kHz (assumed), but times in microseconds look so."""
MOST_WAITING = 10_000
"""So many samples wait for an IMU or wheels that do not come (100 s of the fastest; assumed)."""
BLOCK = 256
"""Old samples are dropped so many at a time, so that it stays cheap."""


@dataclass
class SetBack:
    """Samples in order that are older than their stream's newest: times of the first and the last, how late
    the first was, time of the newest sample of all streams then, and their number.
    """

    first_ns: int
    last_ns: int
    late_ns: int
    others_ns: int
    count: int = 1

    @property
    def is_clock(self) -> bool:
        """Whether they show a clock that was set back: no messages are late like that."""
        long = self.last_ns - self.first_ns >= CONFIRMED_NS
        return self.late_ns > JUMP_NS and self.count >= CONFIRMED and long


class Lateness:
    """Disorder of a stream in time, and samples that came too late.

    A keyframe waits for as long as the stream has been late (an ordered stream costs no waiting). A sample
    before it is then too late.

    Attributes:
        wait_ns: longest lateness so far, of those up to `LONGEST_WAIT_S`.
        used_ns: end of what the keyframes have used.
        too_late: number of samples left out because their keyframe had been made.
        jump: samples that come far ahead.
        back: late ones in a row.
    """

    def __init__(self, channel: str, newest: Newest | None = None) -> None:
        self.channel = channel
        self.jump = TimeJump(newest or Newest(), channel)
        self.wait_ns = 0
        self.used_ns: int | None = None
        self.too_late = 0
        self.back: SetBack | None = None

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
            DataError: the sample is so old that its clock must be another.
            ClockJumpError: all are for half a second, and no other stream has gone on.
        """
        if not times or t_ns >= times[-1]:
            self.back = None
            if self.used_ns is not None and self.used_ns - t_ns > JUMP_NS:
                raise DataError(
                    f"sample at {t_ns} ns comes {(self.used_ns - t_ns) * 1e-9:.3f} s after its time has been "
                    "estimated",
                    channel=self.channel,
                    remedy="set its clock to that of the IMU, or send it earlier; it is left out",
                )
            return len(times)
        late_ns = times[-1] - t_ns
        self._watch_clock(t_ns, late_ns)
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

    def _watch_clock(self, t_ns: int, late_ns: int) -> None:
        """Raise where samples go on in order, far behind the newest."""
        newest_ns, run = self.jump.newest.t_ns or t_ns, self.back
        if run is None or t_ns < run.last_ns:
            self.back = SetBack(t_ns, t_ns, late_ns, newest_ns)
            return
        run.last_ns, run.count = t_ns, run.count + 1
        if not run.is_clock:
            return
        what = f"sample at {t_ns} ns: its clock was set back by {run.late_ns * 1e-9:.1f} s"
        if newest_ns - run.others_ns > CONFIRMED_NS // 2:
            raise DataError(
                f"{what}, those of the other sensors were not",
                channel=self.channel,
                remedy="set its clock right; until then its samples are left out",
            )
        raise ClockJumpError(what, channel=self.channel, remedy="start anew where a clock jumps")


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
            DataError: the sample is so old that the clock must have jumped, or the first ones span no time.
        """
        if self.late.used_ns is None and len(self.t_ns) >= MANY:
            span_ns = max(t_ns, self.t_ns[-1]) - self.t_ns[-MANY]
            if span_ns < LEAST_SPAN_NS:
                raise DataError(
                    f"sample at {t_ns} ns is the last of {MANY + 1} within {span_ns * 1e-6:.3g} ms",
                    channel=self.late.channel,
                    remedy="give times in nanoseconds, not in us, ms or s; it is left out",
                )
        if wrong := self.late.from_future(t_ns, self.t_ns):
            for column in self._columns():
                del column[-wrong:]
        return self.late.place(t_ns, self.t_ns)

    @property
    def stalled(self) -> bool:
        """Whether its samples do not come while those of another stream do, or are not used."""
        newest, back = self.late.jump.newest, self.late.back
        refused = self.late.jump.refuted_ns is not None or (back is not None and back.is_clock)
        behind_ns = (newest.t_ns or 0) - self.t_ns[-1]
        return refused or max(behind_ns, newest.fixes_alone_ns()) > SILENT_NS

    def covers(self, t_ns: int) -> bool:
        """Whether a keyframe at `t_ns` need not wait for samples."""
        return bool(self.t_ns) and self.t_ns[-1] >= t_ns + self.late.wait_ns

    def forget(self, before_ns: int) -> None:
        """Drop samples older than `before_ns`, but for `BEFORE` of them."""
        i = bisect.bisect_left(self.t_ns, before_ns) - self.BEFORE
        if i > BLOCK:
            for column in self._columns():
                del column[:i]
