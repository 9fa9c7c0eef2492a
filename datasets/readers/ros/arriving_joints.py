"""Wheels of JointStates as they arrive: by angles alone, and in messages of single wheels."""

import itertools
from collections import deque
from typing import NamedTuple

import numpy as np

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import WheelSample
from terrafusion.datasets.core.wrapped_angles import TurnCounter
from terrafusion.datasets.readers.ros.joints import joint_names, joint_values, wheel_joints
from terrafusion.datasets.readers.ros.streams import Stream

MOST_HELD = 200
LONGEST_GAP_NS = 500_000_000
"""A longer time between two messages of a wheel is not interpolated over (assumed)."""


class _Joint(NamedTuple):
    """Time, speed (rad/s) and counted angle (rad; NaN where there is none) of one wheel."""

    t_ns: int
    speed: float
    angle_rad: float


class ArrivingJoints:
    """Brings wheels to the times of the first of them.

    Args:
        named: wheel -> joint, as the user says.
    """

    def __init__(self, named: dict[str, str]) -> None:
        self._named = named
        self._seen: dict[str, None] = {}
        self._wheels: dict[str, str] = {}
        self._held: list[deque[_Joint]] = []
        self._turns: list[TurnCounter] = []
        self._angles: list[tuple[int, float]] = []

    def are_whole(self, stream: Stream) -> bool:
        """Whether a message holds all wheels that messages so far have named, and their speeds."""
        names = joint_names(stream)
        if not self._seen.keys() >= set(names):
            self._seen |= dict.fromkeys(names)
            wheels = wheel_joints([*self._seen], self._named)
            if wheels != self._wheels:
                self._wheels = wheels
                self._held = [deque(maxlen=MOST_HELD) for _ in wheels]
                self._turns = [TurnCounter() for _ in wheels]
                self._angles = [(0, np.nan)] * len(wheels)
        moved = stream.blocks[0].columns["velocity"].shape[1] > 0
        return moved and bool(self._wheels) and set(self._wheels.values()) <= set(names)

    def samples(self, stream: Stream, t_ns: int) -> list[WheelSample]:
        """What a message completes: the wheels at times of the first one, interpolated between theirs.

        Raises:
            DataError: it names a wheel, and has no number of it.
        """
        joints = [*self._wheels.values()]
        if set(joints).isdisjoint(joint_names(stream)):
            return []  # of other joints
        speeds, angles = (joint_values(stream, joints, path) for path in ("velocity", "position"))
        if speeds is None and angles is None:
            raise DataError("joints have neither velocity nor position", channel=stream.topic)
        for k in range(len(joints)):
            speed, angle = (np.nan if values is None else float(values[0, k]) for values in (speeds, angles))
            if np.isfinite(angle):
                angle = float(self._turns[k].counted(np.array([angle]), t_ns)[0])
                before_ns, before = self._angles[k]
                self._angles[k] = t_ns, angle
                if speeds is None and t_ns > before_ns:
                    speed = (angle - before) / ((t_ns - before_ns) * 1e-9)
            held = self._held[k]
            if held and held[-1].t_ns - t_ns > LONGEST_GAP_NS:
                held.clear()  # the clock was set back
            if np.isfinite(speed) and not (held and t_ns <= held[-1].t_ns):
                held.append(_Joint(t_ns, speed, angle))
        return self._completed()

    def _completed(self) -> list[WheelSample]:
        first, *others = self._held
        found = []
        while first and all(held and held[-1].t_ns >= first[0].t_ns for held in others):
            one = first.popleft()
            at = [one, *(_at(held, one.t_ns) for held in others)]
            if None not in at:
                _, speed, angle = np.array([joint[:] for joint in at if joint is not None]).T
                angles = angle if np.isfinite(angle).all() else None
                found.append(WheelSample(one.t_ns, speed, tuple(self._wheels), "radps", angles))
        return found


def _at(held: deque[_Joint], t_ns: int) -> _Joint | None:
    """A wheel at a time, interpolated; None in a gap. Messages before it are dropped but for the last."""
    while len(held) > 1 and held[1].t_ns <= t_ns:
        held.popleft()
    if held[0].t_ns == t_ns:
        return held[0]
    for before, after in itertools.pairwise(itertools.islice(held, 2)):
        if before.t_ns < t_ns and after.t_ns - before.t_ns <= LONGEST_GAP_NS:
            share = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)
            values = np.array(before[1:]) + share * (np.array(after[1:]) - np.array(before[1:]))
            return _Joint(t_ns, *values.tolist())
    return None
