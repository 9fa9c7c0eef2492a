"""Detection and removal of clock steps in recorded times.

A clock that is set while it records makes time run back, or jump ahead. A step is removed by shifting
all later times so that the interval at the step is the nominal one; the repaired clock is off by less
than a sampling period, and exact where a counter wrapped. Messages that arrived out of order have correct
times; `in_order` sorts them.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import ClockJump

Step = tuple[int, int]
"""First row after a step, and the nanoseconds to add to its time and all later ones."""

NEAR_ROWS = 25
"""Intervals on either side of a step whose median is the nominal interval."""
DISORDER_ROWS = 50
"""Rows out of order over a longer stretch did not merely arrive late."""
SHUFFLED_SHARE = 0.1
"""Share of intervals that run back from which all rows around arrived out of order (assumed)."""
MARGIN_ROWS = 5
"""Periods before and after a stretch that count as part of it."""
SHARED_ROWS = 3
"""Rows around a step of one channel in which another channel of that clock shows it."""
LEAP_PERIODS, LEAP_S = 10, 0.5
"""An interval longer than both is a jump ahead, where those are removed."""
TURNS_NS = (2**32 * 10**6, 2**32 * 10**3, 604_800 * 10**9, 3600 * 10**9)
"""After so long a clock starts again: counters of ms and us, GPS weeks, hours where summer time ends."""
MAX_STEPS = 1000


def repair_together(
    times: Mapping[str, TimesNs], beside: Mapping[str, TimesNs] | None = None
) -> tuple[dict[str, TimesNs], tuple[ClockJump, ...]]:
    """Remove the clock steps of channels that may share a clock.

    The step is measured on the fastest channel that shows it. Every other one whose interval there
    fits the step better than its own period shares the clock and gets the same shift, even where its
    times do not run back; the others are unchanged.

    Args:
        times: (N,) int64 by channel, in the order of the rows.
        beside: times of the same rows on another clock of the same rate. A jump ahead of the first
            that this one does not have is a step and is removed too; without it, a jump ahead cannot
            be distinguished from a gap in the data.

    Returns:
        Repaired times by channel (the same arrays where nothing changed), and all jumps. Rows that
        arrived out of order stay so: sort them by `in_order`.

    Raises:
        DataError: more than 1000 steps, or steps too large for 64 bits.
    """
    other_clock = beside or {}
    steps = {name: _steps(t, name, other_clock.get(name)) for name, t in times.items()}
    fixed = {name: _shifted(t, steps[name], name) for name, t in times.items()}
    fastest_first = sorted(times, key=lambda name: _period_ns(np.diff(times[name]), len(times[name]) // 2))
    for i, name in enumerate(fastest_first):
        for row, lack in steps[name]:
            for other in fastest_first[i + 1 :]:
                shared = _shared_row(times[other], fixed[other], int(fixed[name][row]), lack)
                if shared is not None:
                    remaining = [step for step in steps[other] if step[0] != shared]
                    steps[other] = sorted([*remaining, (shared, lack)])
                    fixed[other] = _shifted(times[other], steps[other], other)
    return fixed, tuple(
        ClockJump(name, int(fixed[name][row]), -lack / 1e9) for name in times for row, lack in steps[name]
    )


@dataclass(frozen=True, eq=False)
class RowTimes:
    """Times that never decrease.

    Attributes:
        t_ns: (N,) int64.
        order: rows of the file in the order of `t_ns`, a slice where nothing changed places.
        jumps, notes: what was repaired.
    """

    t_ns: TimesNs
    order: Any = field(default_factory=lambda: slice(None))
    jumps: tuple[ClockJump, ...] = ()
    notes: tuple[str, ...] = ()

    def jumps_of(self, channels: Iterable[str]) -> tuple[ClockJump, ...]:
        """The jumps as those of each of the channels that are in these rows."""
        return tuple(dataclasses.replace(jump, channel=name) for name in channels for jump in self.jumps)


def repaired_rows(times: Mapping[str, TimesNs]) -> dict[str, RowTimes]:
    """Times of channels that may share a clock, as `repair_together` repairs them, and in order."""
    fixed, jumps = repair_together(times)
    found = {}
    for name, t_ns in fixed.items():
        own, late = tuple(jump for jump in jumps if jump.channel == name), sorting(t_ns, name)
        found[name] = RowTimes(t_ns[late[0]], late[0], own, (late[1],)) if late else RowTimes(t_ns, jumps=own)
    return found


def set_back(t_ns: TimesNs, name: str) -> int | None:
    """First row whose clock was set back before it; rows that merely arrived out of order are not meant."""
    steps = _steps(t_ns, name, None)
    return steps[0][0] if steps else None


def in_order(t_ns: TimesNs) -> NDArray[np.intp] | None:
    """Stable order (N,) that sorts rows by time; None where they are sorted."""
    return np.argsort(t_ns, kind="stable") if (t_ns[1:] < t_ns[:-1]).any() else None


def sorting(t_ns: TimesNs, name: str, rows: str = "rows") -> tuple[NDArray[np.intp], str] | None:
    """`in_order`, with a note on how many of the rows of channel `name` change places."""
    order = in_order(t_ns)
    if order is None:
        return None
    moved = int((order != np.arange(len(order))).sum())
    return order, f"{name}: {moved} {rows} out of order were sorted"


def _shifted(t_ns: TimesNs, steps: list[Step], channel: str) -> TimesNs:
    if not steps:
        return t_ns
    total = sum(abs(lack) for _, lack in steps) + max(abs(int(t_ns.min())), abs(int(t_ns.max())))
    if total >= 2**63:
        raise DataError("the clock's steps are larger than a time can be", channel=channel)
    lacks = np.zeros(len(t_ns), dtype=np.int64)
    for row, lack in steps:
        lacks[row] += lack
    return np.asarray(t_ns + np.cumsum(lacks))


def _steps(t_ns: TimesNs, channel: str, beside: TimesNs | None) -> list[Step]:
    interval = np.diff(t_ns)
    suspects = np.flatnonzero(interval < 0)
    if beside is not None and (interval > 0).any():
        leap = max(LEAP_PERIODS * float(np.median(interval[interval > 0])), LEAP_S * 1e9)
        suspects = np.union1d(suspects, np.flatnonzero(interval - np.diff(beside) > leap))
    steps: list[Step] = []
    for row in (suspects + 1).tolist():
        period = _period_ns(interval, row)
        first = steps[-1][0] if steps else 0  # rows before an earlier step have another offset
        if interval[row - 1] < 0 and _is_disorder(t_ns[first:], row - first, period):
            continue
        back_ns = -int(interval[row - 1])
        turn = next((turn for turn in TURNS_NS if 0 <= turn - back_ns < LEAP_S * 1e9), None)
        steps.append((row, round(period) + back_ns if turn is None else turn))
        if len(steps) > MAX_STEPS:
            raise DataError(
                f"time jumps more than {MAX_STEPS} times: no clock that could be repaired",
                channel=channel,
                remedy="use other time stamps (of a bag: --stamps receipt)",
            )
    return steps


def _period_ns(interval: TimesNs, row: int) -> float:
    """Median of the intervals around a row."""
    near = interval[max(row - 1 - NEAR_ROWS, 0) : row + NEAR_ROWS]
    return max(float(np.median(near)), 0.0) if near.size else 0.0


def _is_disorder(t_ns: TimesNs, row: int, period: float) -> bool:
    """Whether time runs back at `row` only because rows arrived out of order.

    Then the rows around that time span as many periods as they count. After a step of the clock the
    same time is covered twice, and they span less by the step.
    """
    start, stop = max(row - DISORDER_ROWS, 0), min(row + DISORDER_ROWS, len(t_ns))
    t, at = t_ns[start:stop] - t_ns[row], row - start
    steady = np.diff(t)
    if (steady < 0).mean() > SHUFFLED_SHARE:  # between neighbours in the file is not the period
        steady = np.diff(np.sort(t))
        period = float(np.median(steady))
    steady = steady[np.abs(steady - period) < 0.5 * period]
    if steady.size:  # over many rows the mean is exact, the error of the median adds up
        period = float(steady.mean())
    high = int(t[:at].max())
    has_earlier, has_later = bool((t[:at] < 0).any()), bool((t[at:] > high).any())
    if (not has_earlier and start > 0) or (not has_later and stop < len(t_ns)):
        return False  # time does not come back to where it was, not within a few rows
    if not has_earlier and not has_later:
        return False  # all rows before are later than all rows after
    step = high + period
    if not has_earlier:  # only the rows before bound the step
        step = min(step, at * period)
    if not has_later:
        step = min(step, (len(t) - at) * period)
    near = t[(t >= -MARGIN_ROWS * period) & (t <= high + MARGIN_ROWS * period)]
    missing = (len(near) - 1) * period - float(near.max() - near.min())
    return missing < step / 2


def _shared_row(t_ns: TimesNs, fixed_ns: TimesNs, at_ns: int, lack: int) -> int | None:
    """The row at which a channel shows a step that another one made at `at_ns` (repaired time)."""
    middle = int(np.searchsorted(fixed_ns, at_ns))
    rows = np.arange(max(middle - SHARED_ROWS, 1), min(middle + SHARED_ROWS + 1, len(t_ns)))
    if not rows.size:
        return None
    interval = np.diff(t_ns)
    period = _period_ns(interval, middle)
    stepped = np.abs(interval[rows - 1] + lack - period)
    best = int(np.argmin(stepped))
    return int(rows[best]) if stepped[best] < abs(interval[rows[best] - 1] - period) else None
