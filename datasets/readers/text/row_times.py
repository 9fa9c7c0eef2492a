"""Times of the rows of a file: in order, or repaired on request, else refused."""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.clock import repair, sorting
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import ClockJump
from terrafusion.datasets.readers.formats import Request


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


def row_times(request: Request, channel: str, t_ns: TimesNs) -> RowTimes:
    """The times of a file's rows as a recording needs them.

    Args:
        request: the file, and whether clocks are repaired.
        channel: name of the channel or clock, for errors and jumps.
        t_ns: (N,) int64 in the order of the rows.

    Raises:
        DataError: time runs backwards, and no repair was asked for or none is possible.
    """
    back = np.flatnonzero(t_ns[1:] < t_ns[:-1])
    if not back.size:
        return RowTimes(t_ns)
    if not request.repair_clock:
        i = int(back[0])
        raise DataError(
            f"time runs backwards by {(int(t_ns[i]) - int(t_ns[i + 1])) * 1e-9:.6f} s after row {i + 1}",
            channel=channel,
            time_s=(int(t_ns[i]) - int(t_ns[0])) * 1e-9,
            remedy="sort the rows, split the log there, or have the clock repaired (--repair-clock)",
        )
    repaired, jumps = repair(t_ns, channel)
    late = sorting(repaired, channel)
    if late is None:
        return RowTimes(repaired, jumps=jumps)
    order, note = late
    return RowTimes(repaired[order], order, jumps, (note,))
