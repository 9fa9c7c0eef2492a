"""Wheel counters that are read out of step with their stamps, seen beside the speeds that come with them.

A count that belongs to another moment than its stamp makes increments that alternate about the speed. Taken
for motion they look like slip: of two sensors of a change of speed the one that is believed too much is
scaled down (errors in variables; Fuller 1987, Measurement Error Models, ch. 1).
"""

MEMORY = 30
"""Samples over which the noise is averaged, and that are seen before a decision."""
LEAST_M, MOST_M = 0.005, 0.2
"""Root mean square of second differences that no step of an encoder explains; a larger single one is a jump
(both assumed)."""
RATIO = 3.0
"""How much quieter the speeds must be (assumed)."""
GAIN = 0.1
"""Share of the difference to the counter that is taken over at each sample: over 10 samples the distance is
the counter's."""


class CounterNoise:
    """Compares second differences of counted and of integrated distances.

    Attributes:
        out_of_step: the counters are noisier than the speeds; it stays so.
    """

    def __init__(self) -> None:
        self.out_of_step = False
        self._last_m: tuple[float, float] | None = None
        self._squares_m2 = [0.0, 0.0]
        self._seen = 0

    def add(self, counted_m: float, integrated_m: float) -> None:
        """Mean increment of both sides, counted and by the speeds."""
        counted, integrated = self._squares_m2
        if self._last_m is not None and (counted_m or self._last_m[0]):
            self._seen += 1
            count, (last_counted_m, last_integrated_m) = min(self._seen, MEMORY), self._last_m
            counted += (min(abs(counted_m - last_counted_m), MOST_M) ** 2 - counted) / count
            integrated += (min(abs(integrated_m - last_integrated_m), MOST_M) ** 2 - integrated) / count
            self._squares_m2 = [counted, integrated]
        self._last_m = counted_m, integrated_m
        if self._seen >= MEMORY and counted > max(LEAST_M**2, RATIO**2 * integrated):
            self.out_of_step = True


def drawn(integrated_m: float, counted_m: float) -> float:
    """The integrated distance of a side, drawn to its counter unless that has jumped."""
    off_m = counted_m - integrated_m
    return integrated_m + (GAIN * off_m if abs(off_m) < MOST_M else 0.0)
