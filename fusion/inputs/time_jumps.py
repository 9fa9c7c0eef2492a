"""Stamps far ahead of all others: a clock that was wrong, or a pause of the log.

A sample ahead is held until others confirm its time. If IMU and wheel stamps jump together, the next fixes
decide between a pause and a wrong clock.
"""

import itertools
import math
import statistics
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.inputs.validation import GnssFix, checked_time

JUMP_NS, LONGEST_JUMP_NS, JUMP_STEPS = 1_000_000_000, 10_000_000_000, 10
"""A sample this much newer than all others, and by so many of the steps before, is no next sample, unless
others confirm its time; beyond the longest always."""
STEPS_SEEN = 8
CONFIRMED, CONFIRMED_NS = 3, 500_000_000
"""Samples that show that time has jumped, and the time that they must span: in it another stream that goes on
would have shown that it has not."""
FIX_STEPS, LONGEST_FIX_WAIT_NS = 2, 5_000_000_000
"""Intervals of the fixes within which they show whether time has jumped; a slower receiver has no say
(assumed)."""
LONGEST_REFUTED_NS = 5_000_000_000
"""A clock that has gone ahead of the fixes for so long does not return (assumed)."""


class ClockJumpError(DataError):
    """The clock of IMU and wheels was set, ahead of the fixes or back: an estimator must start anew."""


def median_step_ns(times: Iterable[int]) -> int:
    """Median of the steps between times, ns, the upper one of two; 0 with fewer than three times."""
    steps = [b - a for a, b in itertools.pairwise(times)]
    return statistics.median_high(steps) if len(steps) > 1 else 0


@dataclass
class Newest:
    """Time of the newest sample of IMU and wheels; None before the first.

    Attributes:
        refused: by channel, the number of samples far ahead of it, or too old.
        steps_ns: the last steps of time.
        used_count: number of samples that are used.
        fixes_ns: times of the last fixes, as they came; `fix_count` counts all.
        alone_ns: time of the first fix since the last sample that is used; None where none has come.
    """

    t_ns: int | None = None
    refused: dict[str, int] = field(default_factory=dict)
    steps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=STEPS_SEEN))
    used_count: int = 0
    fixes_ns: deque[int] = field(default_factory=lambda: deque(maxlen=STEPS_SEEN))
    fix_count: int = 0
    alone_ns: int | None = None

    def advance(self, t_ns: int) -> None:
        """Take the time of a sample that is used."""
        self.used_count += 1
        self.alone_ns = None
        if self.t_ns is None or t_ns > self.t_ns:
            if self.t_ns is not None:
                self.steps_ns.append(t_ns - self.t_ns)
            self.t_ns = t_ns

    def is_jump(self, t_ns: int) -> bool:
        """Whether a time lies far ahead of all samples."""
        if self.t_ns is None or t_ns - self.t_ns <= JUMP_NS:
            return False
        # Of the first steps one that was wrong would permit any that follow.
        return len(self.steps_ns) < STEPS_SEEN or t_ns - self.t_ns > self.jump_ns()

    def jump_ns(self) -> int:
        """Step of time that is a jump, by the largest step but one: one may have been a jump itself."""
        if len(self.steps_ns) < STEPS_SEEN:
            return LONGEST_JUMP_NS
        return min(max(JUMP_NS, JUMP_STEPS * sorted(self.steps_ns)[-2]), LONGEST_JUMP_NS)

    def fix(self, t_ns: int) -> None:
        """Take the time of a fix, whether it is used or not."""
        self.fixes_ns.append(t_ns)
        self.fix_count += 1
        self.alone_ns = t_ns if self.alone_ns is None else self.alone_ns

    def fixes_alone_ns(self) -> int:
        """Time over which fixes alone have come, by their stamps; 0 before two of them."""
        return 0 if self.alone_ns is None else self.fixes_ns[-1] - self.alone_ns

    def fix_wait_ns(self) -> int:
        """Time within which another fix shows whether time has jumped; 0 where it does not."""
        wait_ns = FIX_STEPS * median_step_ns(self.fixes_ns)
        return wait_ns if 0 < wait_ns <= LONGEST_FIX_WAIT_NS else 0

    def admitted(self, t_ns: Any, channel: str, oldest_ns: float = math.inf) -> int | None:
        """The time of a sample of another channel, ns; None, and counted, where it lies far ahead, or further
        behind than `oldest_ns`.

        Raises:
            DataError: the time is none.
        """
        t_ns = checked_time(t_ns, channel)
        if self.t_ns is None or -oldest_ns <= t_ns - self.t_ns <= LONGEST_JUMP_NS:
            return t_ns
        self.refused[channel] = self.refused.get(channel, 0) + 1
        return None


@dataclass
class TimeJump:
    """Samples far ahead of all others; they distinguish a clock that was wrong from a pause of the log.

    Attributes:
        newest: of all streams.
        held: samples ahead, each beginning with its time.
        used_count, fix_count: samples used and fixes that had come when the first of `held` came.
        dropped: number of samples whose time no other confirmed, or another stream contradicted.
        refuted_ns: time of the first sample in a row that fixes or another stream contradict.
        others: number of samples used until then.
    """

    newest: Newest
    channel: str = "imu"
    held: list[tuple[Any, ...]] = field(default_factory=list)
    used_count: int = 0
    fix_count: int = 0
    dropped: int = 0
    refuted_ns: int | None = None
    others: int = 0

    def admitted(self, sample: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        """The samples to use now: this one, none while it is far ahead, or all held once they agree.

        Raises:
            ClockJumpError: for seconds they have been ahead of fixes that go on as before.
            DataError: for seconds they have been ahead of another stream that does.
        """
        t_ns, before, newest = sample[0], [], self.newest
        if not self.held and newest.t_ns is not None and t_ns - newest.t_ns <= JUMP_NS:  # as most are
            self.refuted_ns = None
            newest.advance(t_ns)
            return [sample]
        if self.held and not self.newest.is_jump(self.held[-1][0]):  # another stream has confirmed them
            before = self.held[:]
            self.held.clear()
        another = bool(self.held) and self.newest.used_count != self.used_count
        refuted = self._fixes_go_on() or another
        if self.held and not (
            self.newest.is_jump(t_ns)
            and abs(t_ns - self.held[-1][0]) <= self.newest.jump_ns()
            and not refuted
        ):
            self.dropped += len(self.held)
            self.held.clear()
        self._refuse_for_long(t_ns, refuted)
        samples = [*before, sample]
        if self.newest.is_jump(t_ns):
            if not self.held:
                self.used_count, self.fix_count = self.newest.used_count, self.newest.fix_count
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
        newest, least_ns = self.newest, self.held[0][0] - JUMP_NS
        by_fix = newest.fix_count > self.fix_count and newest.fixes_ns[-1] >= least_ns
        return by_fix or span_ns >= newest.fix_wait_ns()

    def _fixes_go_on(self) -> bool:
        """Whether a fix has come since that was measured after all other samples, and has not jumped."""
        newest = self.newest
        if not self.held or newest.fix_count == self.fix_count or newest.t_ns is None:
            return False
        return newest.t_ns < newest.fixes_ns[-1] < self.held[0][0] - JUMP_NS

    def _refuse_for_long(self, t_ns: int, refuted: bool) -> None:
        """Raise where fixes or another stream have contradicted all samples for long."""
        newest = self.newest
        if not newest.is_jump(t_ns):
            self.refuted_ns = None
        elif self.refuted_ns is None:
            self.refuted_ns, self.others = (t_ns if refuted else None), newest.used_count
        elif t_ns - self.refuted_ns > LONGEST_REFUTED_NS:
            self.dropped += 1
            if newest.used_count - self.others > CONFIRMED or not newest.fixes_ns:
                ahead_s = (t_ns - (newest.t_ns or t_ns)) * 1e-9
                raise DataError(
                    f"sample at {t_ns} ns is {ahead_s:.1f} s ahead of other sensors, which go on as before",
                    channel=self.channel,
                    remedy="set its clock right; until then its samples are left out",
                )
            ahead_s = (t_ns - newest.fixes_ns[-1]) * 1e-9
            raise ClockJumpError(
                f"sample at {t_ns} ns is {ahead_s:.1f} s ahead of the fixes, which go on as before",
                channel=self.channel,
                remedy="start anew where the clock of IMU and wheels jumps",
            )


@dataclass
class EarlyFixes:
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
        if now_ns is None or t_ns - now_ns <= JUMP_NS or len(fixes) >= CONFIRMED:
            self.held.clear()
            return fixes
        self.held = fixes
        return []

    def reached(self) -> list[tuple[int, Any]]:
        """Those that IMU and wheels have nearly reached meanwhile."""
        now_ns = self.newest.t_ns
        if not self.held or now_ns is None or self.held[0][0] - now_ns > JUMP_NS:
            return []
        fixes = self.held[:]
        self.held.clear()
        return fixes
