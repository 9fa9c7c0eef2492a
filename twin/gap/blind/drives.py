"""Drives of the trials: commanded segments whose numbers vary from run to run."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from terrafusion.twin.gap.blind.plant.spec import Segment

KINDS = ("exciting", "gentle", "waypoints")
DURATION_S, SHORT_S = 60.0, 30.0
_VARIES = 0.15
_PACES = {"exciting": 0.6, "gentle": 1.6, "waypoints": 1.5}
"""Speed on drives that differ from the references' in speed alone, beside theirs."""
_STEP_S, _AREA_M, _REACHED_M = (
    0.5,
    8.0,
    0.8,
)  # commands of a drive by way points; its points, at most so far off
_REST_S = 3.0


def drive(kind: str, rng: np.random.Generator, differs: str = "") -> tuple[Segment, ...]:
    """Segments of one run, from rest to rest.

    Args:
        differs: "speed" (slower or faster throughout) or "length" (`SHORT_S` instead of `DURATION_S`).

    Raises:
        KeyError: there is no such kind.
    """
    segments = {"exciting": _exciting, "gentle": _gentle, "waypoints": _waypoints}[kind](rng)
    duration_s = DURATION_S
    if differs == "speed":
        pace = _PACES[kind]
        segments = [
            dataclasses.replace(s, v_mps=pace * s.v_mps, v_amplitude_mps=pace * s.v_amplitude_mps)
            for s in segments
        ]
    if differs == "length":
        duration_s = SHORT_S
    return _to_rest(segments, duration_s)


def _to_rest(segments: Sequence[Segment], duration_s: float) -> tuple[Segment, ...]:
    """The segments up to the last seconds, which the robot stands."""
    left, out = duration_s - _REST_S, list[Segment]()
    for segment in segments:
        if left > 0.0:
            out.append(dataclasses.replace(segment, duration_s=min(segment.duration_s, left)))
            left -= segment.duration_s
    return (*out, Segment(duration_s - sum(segment.duration_s for segment in out)))


def _exciting(rng: np.random.Generator) -> list[Segment]:
    """Spins, arcs both ways, a fast stretch, oscillating speed and yaw rate, a stretch in reverse."""
    g = rng.uniform(1.0 - _VARIES, 1.0 + _VARIES, 9)
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    return [
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
    ]


def _gentle(rng: np.random.Generator) -> list[Segment]:
    """Slow, nearly straight, two wide arcs, one stop."""
    g = rng.uniform(1.0 - _VARIES, 1.0 + _VARIES, 5)
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    return [
        Segment(3.0),
        Segment(14.0, 0.6 * g[0]),
        Segment(12.0, 0.55 * g[1], 0.15 * side * g[2]),
        Segment(3.0),
        Segment(12.0, 0.65 * g[3], -0.15 * side * g[4]),
        Segment(13.0, 0.7 * g[0]),
    ]


def _waypoints(rng: np.random.Generator) -> list[Segment]:
    """From point to point of a square as a path follower steers: towards the next one, slower in turns."""
    at, heading, goal, pace = np.zeros(2), 0.0, np.zeros(2), 0.0
    out = [Segment(3.0)]
    for _ in range(round((DURATION_S - 6.0) / _STEP_S)):
        while np.hypot(*(goal - at)) < _REACHED_M:
            goal, pace = rng.uniform(-_AREA_M, _AREA_M, 2), float(rng.uniform(0.5, 1.2))
        ahead = np.arctan2(*(goal - at)[::-1]) - heading
        ahead = float((ahead + np.pi) % (2.0 * np.pi) - np.pi)
        v, rate = pace * max(0.3, np.cos(ahead)), float(np.clip(1.2 * ahead, -0.8, 0.8))
        out.append(Segment(_STEP_S, float(v), rate))
        heading += rate * _STEP_S
        at = at + v * _STEP_S * np.array([np.cos(heading), np.sin(heading)])
    return out
