"""Stamps far ahead of all others: a clock that was wrong, or a pause of the log.

A sample ahead is held until others confirm its time. Whether IMU and wheels that leap together have paused,
or have a clock that is wrong, the fixes tell where they go on.
"""

import itertools
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.inputs.door import GnssFix, checked_time

LEAP_NS, LONGEST_LEAP_NS, LEAP_STEPS = 1_000_000_000, 10_000_000_000, 10
"""A sample this much newer than all others, and by so many of the steps before, is no next sample, unless
others confirm its time; beyond the longest always."""
STEPS_SEEN = 8
CONFIRMED, CONFIRMED_NS = 3, 500_000_000
"""Samples that show that time has leapt, and the time that they must span: in it another stream that goes on
would have shown that it has not."""
FIX_STEPS, LONGEST_FIX_WAIT_NS = 2, 5_000_000_000
"""Intervals of the fixes within which they show whether time has leapt; a receiver that is slower has no
say (assumed)."""
LONGEST_REFUTED_NS = 5_000_000_000
"""A clock that has gone ahead of the fixes for so long does not return (assumed)."""


@dataclass
class Newest:
    """Time of the newest sample of IMU and wheels; None before the first.

    Attributes:
        refused: by channel, the number of samples far ahead of it.
        steps_ns: the last steps of time.
        taken: number of samples that are used.
        fixes_ns: times of the last fixes, as they came; `fixed` counts all.
    """

    t_ns: int | None = None
    refused: dict[str, int] = field(default_factory=dict)
    steps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=STEPS_SEEN))
    taken: int = 0
    fixes_ns: deque[int] = field(default_factory=lambda: deque(maxlen=STEPS_SEEN))
    fixed: int = 0

    def advance(self, t_ns: int) -> None:
        """Take the time of a sample that is used."""
        self.taken += 1
        if self.t_ns is None or t_ns > self.t_ns:
            if self.t_ns is not None:
                self.steps_ns.append(t_ns - self.t_ns)
            self.t_ns = t_ns

    def leaps(self, t_ns: int) -> bool:
        """Whether a time lies far ahead of all samples."""
        if self.t_ns is None or t_ns - self.t_ns <= LEAP_NS:
            return False
        # Of the first steps one that was wrong would permit any that follow.
        return len(self.steps_ns) < STEPS_SEEN or t_ns - self.t_ns > self.leap_ns()

    def leap_ns(self) -> int:
        """Step of time that is a leap, by the largest step but one: one may have been a leap itself."""
        if len(self.steps_ns) < STEPS_SEEN:
            return LONGEST_LEAP_NS
        return min(max(LEAP_NS, LEAP_STEPS * sorted(self.steps_ns)[-2]), LONGEST_LEAP_NS)

    def fix(self, t_ns: int) -> None:
        """Take the time of a fix, whether it is used or not."""
        self.fixes_ns.append(t_ns)
        self.fixed += 1

    def fix_wait_ns(self) -> int:
        """Time within which another fix shows whether time has leapt; 0 where it does not."""
        usual = sorted(b - a for a, b in itertools.pairwise(self.fixes_ns))
        wait_ns = FIX_STEPS * usual[len(usual) // 2] if len(usual) > 1 else 0
        return wait_ns if 0 < wait_ns <= LONGEST_FIX_WAIT_NS else 0

    def admitted(self, t_ns: Any, channel: str) -> int | None:
        """The time of a sample of another channel, ns; None, and counted, where it lies far ahead.

        Raises:
            DataError: the time is none.
        """
        t_ns = checked_time(t_ns, channel)
        if self.t_ns is None or t_ns - self.t_ns <= LONGEST_LEAP_NS:
            return t_ns
        self.refused[channel] = self.refused.get(channel, 0) + 1
        return None


@dataclass
class Leap:
    """Samples far ahead of all others; they distinguish a clock that was wrong from a pause of the log.

    Attributes:
        newest: of all streams.
        held: samples ahead, each beginning with its time.
        taken, fixed: samples that had been used, and fixes that had come, when the first of `held` came.
        dropped: number of samples whose time no other confirmed, or another stream contradicted.
        refuted_ns: time of the first sample in a row that fixes contradict.
    """

    newest: Newest
    channel: str = "imu"
    held: list[tuple[Any, ...]] = field(default_factory=list)
    taken: int = 0
    fixed: int = 0
    dropped: int = 0
    refuted_ns: int | None = None

    def admitted(self, sample: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        """The samples to use now: this one, none while it leaps ahead, or all held once they agree.

        Raises:
            DataError: for seconds they have been ahead of fixes that go on as before.
        """
        t_ns, before, newest = sample[0], [], self.newest
        if not self.held and newest.t_ns is not None and t_ns - newest.t_ns <= LEAP_NS:  # as most are
            self.refuted_ns = None
            newest.advance(t_ns)
            return [sample]
        if self.held and not self.newest.leaps(self.held[-1][0]):  # another stream has confirmed them
            before = self.held[:]
            self.held.clear()
        refuted = self._fixes_go_on()
        if self.held and not (
            self.newest.leaps(t_ns)
            and abs(t_ns - self.held[-1][0]) <= self.newest.leap_ns()
            and self.newest.taken == self.taken  # else another stream goes on as before
            and not refuted
        ):
            self.dropped += len(self.held)
            self.held.clear()
        self._refuse_for_long(t_ns, refuted)
        samples = [*before, sample]
        if self.newest.leaps(t_ns):
            if not self.held:
                self.taken, self.fixed = self.newest.taken, self.newest.fixed
            self.held.append(sample)
            if not self._is_confirmed(t_ns):
                return []
            samples = sorted(self.held, key=lambda one: one[0])
            self.held.clear()
        for one in samples:
            self.newest.advance(one[0])
        return samples

    def _is_confirmed(self, t_ns: int) -> bool:
        span_ns = abs(t_ns - self.held[0][0])
        if len(self.held) < CONFIRMED or span_ns < CONFIRMED_NS:
            return False
        fixed = self.newest.fixed > self.fixed and self.newest.fixes_ns[-1] >= self.held[0][0] - LEAP_NS
        return fixed or span_ns >= self.newest.fix_wait_ns()

    def _fixes_go_on(self) -> bool:
        """Whether a fix has come since that was measured after all other samples, and has not leapt."""
        newest = self.newest
        if not self.held or newest.fixed == self.fixed or newest.t_ns is None:
            return False
        return newest.t_ns < newest.fixes_ns[-1] < self.held[0][0] - LEAP_NS

    def _refuse_for_long(self, t_ns: int, refuted: bool) -> None:
        """Raise where fixes have contradicted all samples for long."""
        if not self.newest.leaps(t_ns):
            self.refuted_ns = None
        elif refuted and self.refuted_ns is None:
            self.refuted_ns = t_ns
        elif self.refuted_ns is not None and t_ns - self.refuted_ns > LONGEST_REFUTED_NS:
            self.dropped += 1
            ahead_s = (t_ns - self.newest.fixes_ns[-1]) * 1e-9
            raise DataError(
                f"sample at {t_ns} ns is {ahead_s:.1f} s ahead of the fixes, which go on as before",
                channel=self.channel,
                remedy="start anew where the clock of IMU and wheels jumps",
            )


@dataclass
class FixesAhead:
    """Fixes that IMU and wheels are far from having reached: held until the next ones show their order.

    Attributes:
        held: times and fixes ahead, in the order in which they came.
        dropped: number of those that an earlier fix followed.
    """

    newest: Newest
    held: list[tuple[int, Any]] = field(default_factory=list)
    dropped: int = 0

    def admitted(self, fix: GnssFix | None) -> list[GnssFix]:
        """The fixes to use now."""
        if fix is None:
            return []
        self.newest.fix(fix.t_ns)
        if self.newest.admitted(fix.t_ns, "gnss") is None:
            return []
        return [one for _, one in self.in_order(fix.t_ns, fix)]

    def in_order(self, t_ns: int, fix: Any) -> list[tuple[int, Any]]:
        """The fixes, with their times, that are not ahead or have shown their order."""
        if self.held and t_ns < self.held[-1][0]:
            self.dropped += len(self.held)
            self.held.clear()
        fixes = [*self.held, (t_ns, fix)]
        now_ns = self.newest.t_ns
        if now_ns is None or t_ns - now_ns <= LEAP_NS or len(fixes) >= CONFIRMED:
            self.held.clear()
            return fixes
        self.held = fixes
        return []

    def reached(self) -> list[tuple[int, Any]]:
        """Those that IMU and wheels have nearly reached meanwhile."""
        now_ns = self.newest.t_ns
        if not self.held or now_ns is None or self.held[0][0] - now_ns > LEAP_NS:
            return []
        fixes = self.held[:]
        self.held.clear()
        return fixes
