"""Wheels as logs have them: angles that start again after each turn, sides sampled at different times.

A log wraps its angles where all of one wheel lie in one turn and jump by nearly a turn; steps in between are
small where samples follow each other fast enough.
"""

import numpy as np

from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.channels import Wheels
from terrafusion.datasets.core.errors import DataError

TURN_RAD = 2.0 * np.pi
NEARLY, LARGEST = 2.0 / 3.0, 1.0 / 3.0
"""Turns: a step beyond the first is a jump to the other end, one beyond the second leaves its sense open."""
MOST_LARGE = 2
"""Steps above a third of a turn that a wheel can do without leaving the turn, unless it rocks."""
WITHIN = 1.0 + 1e-6
"""Turns that angles of single precision take of one."""


def unwrapped(angle_rad: Array | None, names: tuple[str, ...]) -> tuple[Array | None, str]:
    """Angles (N, wheels) with whole turns, and a note where any were wrapped; others keep their bits.

    None where steps are too large to tell how far a wheel turned.
    """
    if angle_rad is None:
        return None, ""
    out, wrapped, rolled = angle_rad, [], []
    for k, name in enumerate(names):
        held = np.isfinite(angle_rad[:, k])
        angle = angle_rad[held, k]
        with np.errstate(over="ignore"):  # no wheel turns so far, and no log that holds it is wrapped
            steps, range_rad = np.diff(angle), np.ptp(angle) if len(angle) else 0.0
        jumps, large = (np.count_nonzero(np.abs(steps) > share * TURN_RAD) for share in (NEARLY, LARGEST))
        if range_rad > WITHIN * TURN_RAD:
            lost = _rolled_over(steps, float(range_rad))
            if lost.any():
                out = out.copy() if out is angle_rad else out
                out[held, k] = angle + np.concatenate([[0.0], np.cumsum(lost)])
                rolled.append(name)
            continue
        if not (jumps or large > MOST_LARGE):
            continue
        turns = np.rint(steps / TURN_RAD)
        if (np.abs(steps - TURN_RAD * turns) > LARGEST * TURN_RAD).any():
            return None, (
                f"the angles of {name} lie in one turn, and steps of more than a third of a turn leave open "
                "how far it turned"
            )
        out = out.copy() if out is angle_rad else out
        out[held, k] = angle - TURN_RAD * np.concatenate([[0.0], np.cumsum(turns)])
        wrapped.append(name)
    notes = [f"the angles of {', '.join(wrapped)} start again after each turn; whole turns are counted"]
    if rolled:
        what = f"the counters of {', '.join(rolled)} roll over, or were reset"
        notes = [*(notes if wrapped else []), f"{what}; the step there is taken to be as those beside it"]
    return out, "; ".join(notes) if wrapped or rolled else ""


def _rolled_over(steps: Array, range_rad: float) -> Array:
    """What to add to the steps (N,) of a counter that starts again beyond one turn; zero elsewhere.

    Such a step is most of the range, against the way that the wheel turns beside it; all others are small.
    """
    lost = np.zeros_like(steps)
    far = np.abs(steps) > NEARLY * range_rad
    if not far.any() or (np.abs(steps[~far]) > LARGEST * range_rad).any():
        return lost
    rows = np.flatnonzero(far)
    small = np.where(far, np.nan, steps)
    near = np.stack([np.concatenate([[np.nan], small])[rows], np.concatenate([small, [np.nan]])[rows + 1]])
    if np.isnan(near).all(axis=0).any():
        return lost
    beside = np.nanmean(near, axis=0)
    if (np.sign(beside) == -np.sign(steps[rows])).all():
        lost[rows] = beside - steps[rows]
    return lost


def unwrapped_beside_speeds(angle_rad: Array | None, names: tuple[str, ...]) -> tuple[Array | None, str]:
    """As `unwrapped`; the note says that speeds take the place of angles that do not tell."""
    angle, note = unwrapped(angle_rad, names)
    return angle, f"{note}; only the speeds are used" if note and angle is None else note


def unwrapped_alone(angle_rad: Array, names: tuple[str, ...], channel: str) -> tuple[Array, str]:
    """As `unwrapped`, of a log without speeds; a DataError where steps are too large to tell."""
    angle, note = unwrapped(angle_rad, names)
    if angle is None:
        remedy = "log wheel speeds, angles that count whole turns, or more samples a second"
        raise DataError(note, channel=channel, remedy=remedy)
    return angle, note


def speeds_of(t_ns: TimesNs, angle_rad: Array) -> tuple[Mask, Array]:
    """Rows (N,) with a row before them at an earlier time, and the mean speeds (M, wheels) since, rad/s."""
    dt_s = np.diff(t_ns) * 1e-9
    later = dt_s > 0.0
    speed = np.diff(angle_rad, axis=0)[later] / dt_s[later, None]
    return np.concatenate([[False], later]), speed


FASTEST_RADPS = 100.0
"""A counter that steps back faster than this rolls over: no wheel of a ground robot turns so (assumed)."""


class TurnCounter:
    """Unwraps angles that come one after another, as `unwrapped` does of a log where steps are small."""

    def __init__(self) -> None:
        self._last: Array | None = None
        self._last_ns = 0
        self._least = self._most = self._turns = self._rolled = self._way = np.zeros(0)

    def counted(self, angle_rad: Array, t_ns: int) -> Array:
        """The angles (wheels,) at `t_ns` as turned since the first; the same array where nothing was lost."""
        before_ns, self._last_ns = self._last_ns, t_ns
        if self._last is None or self._last.shape != angle_rad.shape or not np.isfinite(angle_rad).all():
            self._last = self._least = self._most = angle_rad
            self._turns = self._rolled = self._way = np.zeros_like(angle_rad)
            return angle_rad
        self._least = np.minimum(self._least, angle_rad)
        self._most = np.maximum(self._most, angle_rad)
        step, self._last = angle_rad - self._last, angle_rad
        far, range_rad = np.abs(step), self._most - self._least
        jumps = (far > NEARLY * TURN_RAD) & (range_rad <= WITHIN * TURN_RAD)
        self._turns = self._turns + np.where(jumps, np.rint(step / TURN_RAD), 0.0)
        back = (step * self._way < 0.0) & (far * 1e9 > FASTEST_RADPS * (t_ns - before_ns))
        rolls = back & ~jumps & (range_rad > WITHIN * TURN_RAD) & (far > NEARLY * range_rad)
        self._rolled = self._rolled + np.where(rolls, step - self._way, 0.0)
        self._way = np.where(jumps | rolls | (step == 0.0), self._way, step)
        if not (self._turns.any() or self._rolled.any()):
            return angle_rad
        return angle_rad - TURN_RAD * self._turns - self._rolled


LEAST_SAMPLES, MOST_WHOLE = 10, 0.1
"""Samples that each wheel has at least, and the largest share of rows that hold all wheels."""
GAP_PERIODS = 5.0
"""Longer gaps of one wheel, in its own periods, are not interpolated over."""


def sampled_apart(wheels: Wheels) -> bool:
    """Whether hardly a row holds all wheels, while each of them has samples."""
    known = np.isfinite(wheels.speed)
    if len(wheels.names) < 2 or not len(wheels) or known.sum(axis=0).min() < LEAST_SAMPLES:
        return False
    return bool(known.all(axis=1).mean() < MOST_WHOLE)


def paired_sides(wheels: Wheels) -> Wheels:
    """The wheels at the times of the one that is sampled most, the others interpolated between their samples.

    Rows before the first or after the last sample of a wheel, and in its gaps, are left out.
    """
    known = np.isfinite(wheels.speed)
    t_s = (wheels.t_ns - wheels.t_ns[0]) * 1e-9
    rows = np.flatnonzero(known[:, int(np.argmax(known.sum(axis=0)))])
    speed, near = _at(t_s, wheels.speed, t_s[rows])
    angle = None if wheels.angle_rad is None else _at(t_s, wheels.angle_rad, t_s[rows])[0]
    return Wheels(
        wheels.t_ns[rows][near],
        speed[near],
        wheels.names,
        wheels.unit,
        None if angle is None else angle[near],
    )


def _at(t_s: Array, values: Array, wanted_s: Array) -> tuple[Array, Mask]:
    """Columns interpolated each over its own samples, and where all of them are near one."""
    out, near = np.full((len(wanted_s), values.shape[1]), np.nan), np.ones(len(wanted_s), dtype=bool)
    for k, column in enumerate(values.T):
        own = np.isfinite(column)
        if not own.any():
            continue
        t, v = t_s[own], column[own]
        out[:, k] = np.interp(wanted_s, t, v)
        after = np.clip(np.searchsorted(t, wanted_s), 1, len(t) - 1)
        gap = t[after] - t[after - 1]
        near &= (wanted_s >= t[0]) & (wanted_s <= t[-1]) & (gap < GAP_PERIODS * float(np.median(np.diff(t))))
    return out, near
