"""Samples in the order of `Recording.messages()`, whatever the order in which a robot sends them.

A sample waits until the IMU is a little ahead of it. Samples that come later than that are passed on at once:
the estimator copes with them, but its result is then not that of a replay.
"""

import heapq
from collections.abc import Iterator
from typing import Any

from terrafusion.datasets.core.recording import Recording

LONGEST_WAIT_S = 0.5
"""An IMU that sends nothing for so long, by the wall clock, holds up the others no more."""
RANK = {
    name: rank
    for rank, name in enumerate(
        [*(n for n in Recording.CHANNELS if n not in ("wheels", "imu")), "wheels", "imu"]
    )
}


class OrderedSamples:
    """Holds samples back until those of the same time have come.

    Args:
        wait_s: how far the newest sample of the IMU must be ahead.
    """

    def __init__(self, wait_s: float) -> None:
        self._wait_ns = round(wait_s * 1e9)
        self._heap: list[tuple[int, int, int, Any]] = []
        self._number = 0
        self.newest_ns: int | None = None
        self._moved: tuple[int | None, float] | None = None

    def add(self, t_ns: int, channel: str, sample: Any) -> None:
        """Take a sample of a channel."""
        heapq.heappush(self._heap, (t_ns, RANK[channel], self._number, sample))
        self._number += 1
        if channel == "imu":
            self.newest_ns = t_ns if self.newest_ns is None else max(self.newest_ns, t_ns)

    def silent_s(self, now_s: float) -> float:
        """How long the IMU had sent nothing newer when `released` was last called, at `now_s`, s."""
        return 0.0 if self._moved is None else now_s - self._moved[1]

    def released(self, now_s: float) -> Iterator[Any]:
        """The samples that wait no longer, at `now_s` by the wall clock."""
        if self._moved is None or self._moved[0] != self.newest_ns:
            self._moved = self.newest_ns, now_s
        stopped = self.silent_s(now_s) > LONGEST_WAIT_S
        while self._heap and (stopped or self._is_covered()):
            yield heapq.heappop(self._heap)[-1]

    def rest(self) -> Iterator[Any]:
        """All that are left, but those after the last of the IMU, which can make no keyframe."""
        while self._heap and self.newest_ns is not None and self._heap[0][0] <= self.newest_ns:
            yield heapq.heappop(self._heap)[-1]
        self._heap.clear()

    def _is_covered(self) -> bool:
        return self.newest_ns is not None and self._heap[0][0] + self._wait_ns < self.newest_ns
