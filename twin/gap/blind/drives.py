"""Drives of the trials: 60 s that excite much, or little. Their numbers vary from run to run."""

from __future__ import annotations

import numpy as np

from terrafusion.twin.gap.blind.plant.spec import Segment

KINDS = ("exciting", "gentle")
DURATION_S = 60.0
_VARIES = 0.15


def drive(kind: str, rng: np.random.Generator) -> tuple[Segment, ...]:
    """Segments of one run, `DURATION_S` long, from rest to rest.

    Raises:
        KeyError: there is no such kind.
    """
    segments = {"exciting": _exciting, "gentle": _gentle}[kind](rng)
    missing = DURATION_S - sum(segment.duration_s for segment in segments)
    return (*segments, Segment(missing))


def _exciting(rng: np.random.Generator) -> tuple[Segment, ...]:
    """Spins, arcs both ways, a fast stretch, oscillating speed and yaw rate, a stretch in reverse."""
    g = rng.uniform(1.0 - _VARIES, 1.0 + _VARIES, 9)
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    return (
        Segment(3.0),
        Segment(6.0, 1.0 * g[0]),
        Segment(6.0, 0.9 * g[1], 0.5 * side * g[2]),
        Segment(5.0, 0.0, 0.9 * side * g[3]),
        Segment(5.0, 1.55 * g[4]),
        Segment(7.0, 0.8, 0.0, 0.4 * g[5], 0.0, 0.5),
        Segment(3.0),
        Segment(5.0, 0.0, -0.9 * side * g[6]),
        Segment(6.0, 0.9 * g[7], -0.5 * side * g[2]),
        Segment(6.0, 0.7, 0.0, 0.0, 0.6 * g[8], 0.4),
        Segment(5.0, -0.6 * g[0]),
    )


def _gentle(rng: np.random.Generator) -> tuple[Segment, ...]:
    """Slow, nearly straight, two wide arcs, one stop."""
    g = rng.uniform(1.0 - _VARIES, 1.0 + _VARIES, 5)
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    return (
        Segment(3.0),
        Segment(14.0, 0.6 * g[0]),
        Segment(12.0, 0.55 * g[1], 0.15 * side * g[2]),
        Segment(3.0),
        Segment(12.0, 0.65 * g[3], -0.15 * side * g[4]),
        Segment(12.0, 0.7 * g[0]),
    )
