"""The grounds of one robot: recognised from signatures, learned without labels, never with positions.

A filter over the known grounds and *new ground* follows the drive, as `terrain.sequence` does. Windows that
no ground explains, `DWELL` in a row, make a new one, as in DP-means (Kulis and Jordan 2012, ICML); grounds
that came to look alike are merged.
"""

import dataclasses
import hashlib
import math
from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Wheels
from terrafusion.datasets.core.printable import counted
from terrafusion.fusion.grounds.ground import SPREAD, WINDOW_VARIANCE, Ground, is_given
from terrafusion.fusion.grounds.signature import FELT, SIGNATURE

PATCH_M = 25.0
"""Expected length of a patch, as of the detector."""
NOVEL = 5.0
"""Log-likelihood by which new ground is less likely than the middle of a known one (chosen on learn runs)."""
SLOW, FAST = 8, 2
"""Windows whose mean is compared with the grounds, and newest ones that raise the alarm of a change."""
ALARM = 3.0
"""Mean squared distance of the newest windows to those before, in spreads of a mean, that is a change."""
NEW_SHARE = 0.1
"""Prior probability that a new patch is ground never met."""
TEMPER = 0.6
"""Exponent on likelihoods: windows overlap, and bands are correlated (chosen on learn runs)."""
DWELL = 8
"""Windows in a row that new ground takes: 4 s."""
MOST_GROUNDS = 12
MOST_DRIVES = 1000
ALIKE = 0.5
"""Mean squared distance of two signatures, in their spreads, below which they are one ground."""
LEAST_WINDOWS = 30.0
"""Windows from which a ground may be compared with others."""
SLIP = SIGNATURE.index("slip")


class GroundMemory:
    """Grounds of a robot, and the belief which of them it is on.

    Attributes:
        grounds: in the order in which they were met.
        robot: name or type of the robot, "" where not known.
        drives: marks of the drives that are counted (`drive_mark`), the newest `MOST_DRIVES`.
        left_out: windows on new ground for which there was no place.
    """

    def __init__(self, grounds: Sequence[Ground] = (), robot: str = "", drives: Iterable[str] = ()) -> None:
        self.grounds: list[Ground] = list(grounds)
        self.robot, self.drives = robot, tuple(dict.fromkeys(drives))[-MOST_DRIVES:]
        self._belief: list[float] = self._prior().tolist()
        self._recent: deque[Array] = deque(maxlen=SLOW)
        self._waiting: list[Array] = []
        self.left_out = 0
        self._today = [0.0] * len(self.grounds)  # windows of this drive, with fixes
        self._earlier = len(self.grounds)

    def __repr__(self) -> str:
        """A line a ground."""
        lines = [
            f"  {g.name}: slip {float(g.motion.mean[0]):.2f}, {0.5 * g.windows:.0f} s" for g in self.grounds
        ]
        return "\n".join([f"GroundMemory({self.robot!r}, {counted(len(lines), 'ground')})", *lines])

    def __len__(self) -> int:
        return len(self.grounds)

    @property
    def belief(self) -> Array:
        """(1 + K,) probability of new ground, then of each ground."""
        return np.array(self._belief)

    @belief.setter
    def belief(self, probabilities: Array) -> None:
        self._belief = probabilities.tolist()

    def most_probable(self) -> str:
        """Name of the ground that the robot most probably is on; "" where it is new."""
        best = int(self.belief.argmax())
        return self.grounds[best - 1].name if best else ""

    def copy(self) -> "GroundMemory":
        """The same grounds, at the begin of a drive."""
        return GroundMemory(self.grounds, self.robot, self.drives)

    def _prior(self) -> Array:
        k = len(self.grounds)
        return np.array([NEW_SHARE if k else 1.0, *[(1.0 - NEW_SHARE) / max(k, 1)] * k])

    def recognise(self, signature: Array, distance_m: float) -> Array:
        """Belief (1 + K,) after one more window (11,), `distance_m` after the last."""
        signature = self._mean(signature)
        drawn = -math.expm1(-distance_m / PATCH_M)
        belief = (1.0 - drawn) * self.belief + drawn * self._prior()
        if self.grounds and np.isfinite(signature).any():
            log_p = self._log_likelihoods(signature)
            belief = belief * np.exp(TEMPER * (log_p - log_p.max()))
        self.belief = np.asarray(np.maximum(belief, 1e-4) / np.maximum(belief, 1e-4).sum())
        return self.belief

    def _mean(self, signature: Array) -> Array:
        """Mean signature of the newest windows, of fewer after a change of ground."""
        self._recent.append(signature)
        if len(self._recent) > 2 * FAST:
            all_of = list(self._recent)
            off = nan_mean(all_of[-FAST:]) - nan_mean(all_of[:-FAST])
            square = (off / SPREAD) ** 2 / (1.0 + WINDOW_VARIANCE / FAST)
            if np.isfinite(square).any() and float(np.nanmean(square)) > ALARM:
                self._recent = deque(all_of[-FAST:], maxlen=SLOW)
                self._waiting.clear()
        return nan_mean(list(self._recent))

    def _log_likelihoods(self, signature: Array) -> Array:
        """(1 + K,) of new ground, then of each; new is what lies `NOVEL` from the nearest one.

        Distance is counted from the middle of the nearest: beside that of a ground known for long, whose
        spread is small, what lies in the middle of a young one would seem far.
        """
        wider = 1.0 + WINDOW_VARIANCE * (1.0 / len(self._recent) - 1.0 / SLOW)
        found = np.array([g.log_likelihood(signature, wider) for g in self.grounds])
        if np.isnan(signature[SLIP]):
            found[self._changed()] = -np.inf
        nearest = self.grounds[int(found.argmax())]
        middle = np.where(np.isfinite(signature), nearest.signature.mean, np.nan)
        return np.append(nearest.log_likelihood(middle, wider) - NOVEL, found)

    def contradicted(self) -> bool:
        """Whether a ground that is new in this drive feels like one of an earlier drive: its slip changed."""
        new = range(self._earlier, len(self))
        return any(place < self._earlier for place in self._changed(new))

    def _changed(self, by: Iterable[int] | None = None) -> list[int]:
        """Places of grounds that feel like one that this drive has shown, and that it has not shown: tyres or
        weather may have changed since they slipped otherwise, and without fixes today's slip is expected.

        `by`: places of the ones shown that count, all where None.
        """
        shown = [i for i, windows in enumerate(self._today) if windows >= LEAST_WINDOWS]
        among = shown if by is None else [i for i in by if i in shown]
        return [
            i
            for i, ground in enumerate(self.grounds)
            if i not in shown and any(distance(ground, self.grounds[j], FELT) < ALIKE for j in among)
        ]

    def learn(self, date: str, friction: Array | None = None) -> int | None:
        """Add the newest windows to their ground; to a new one where none explains them for long enough.

        `friction` (10,) are probabilities of friction limits by the fixes, where they are known.

        Returns:
            place of a ground that was seen too little to be kept, and that a new one has taken.
        """
        if not self._recent:
            return None
        signature = nan_mean(list(self._recent))
        best = int(self.belief.argmax())
        place, full = len(self), len(self) >= MOST_GROUNDS
        if full:
            place = min(range(place), key=lambda i: self.grounds[i].windows)
        if best == 0 and not (full and self.grounds[place].windows >= LEAST_WINDOWS):
            self._waiting.append(signature)
            if len(self._waiting) < DWELL:
                return None
            self._found(date, place)
            return place if full else None
        self._waiting.clear()
        self.left_out += best == 0
        if best:
            weight = float(self.belief[best])
            ground = self.grounds[best - 1].seen(signature, weight, date)
            self.grounds[best - 1] = ground if friction is None else ground.with_friction(friction, weight)
            self._today[best - 1] += weight
        return None

    def forget_slip(self, place: int) -> None:
        """Learn the slip of a ground anew, as it is no more what it was."""
        self.grounds[place] = self.grounds[place].without_slip()

    def _found(self, date: str, place: int) -> None:
        """Make the waiting windows a ground at a place: that of another, or behind all."""
        names = {g.name for g in self.grounds}
        name = next(f"ground {i}" for i in range(1, MOST_GROUNDS + 2) if f"ground {i}" not in names)
        origin = hashlib.sha256(np.array(self._waiting).tobytes()).hexdigest()[:16]
        ground = Ground.new(name, origin)
        for signature in self._waiting:
            ground = ground.seen(signature, 1.0, date)
        self._waiting.clear()
        self.grounds[place : place + 1], self._today[place : place + 1] = [ground], [ground.windows]
        belief = self.belief.tolist()
        belief[1 + place : 2 + place] = belief[:1]
        belief[0] *= NEW_SHARE
        self.belief = np.array(belief) / np.array(belief).sum()

    def named(self, names: dict[str, str]) -> "GroundMemory":
        """With grounds renamed: old name -> new name; two of one name become one ground."""
        found: dict[str, Ground] = {}
        for ground in self.grounds:
            name = names.get(ground.name, ground.name)
            other = dataclasses.replace(ground, name=name)
            found[name] = found[name].merged(other) if name in found else other
        return GroundMemory(list(found.values()), self.robot, self.drives)

    def condensed(self) -> "GroundMemory":
        """With grounds merged that look alike; without those of which too little was seen, or of which too
        many others were seen longer.
        """
        kept: list[Ground] = []
        for ground in sorted(self.grounds, key=lambda g: -g.windows):
            if ground.windows < LEAST_WINDOWS:
                continue
            twin = next((i for i, other in enumerate(kept) if alike(ground, other)), None)
            if twin is None:
                kept.append(ground)
            else:
                kept[twin] = kept[twin].merged(ground)
        return GroundMemory(kept[:MOST_GROUNDS], self.robot, self.drives)


def merged(memories: Iterable[GroundMemory]) -> GroundMemory:
    """The grounds of several robots of one type as one memory; those that look alike become one.

    What is there twice counts once: a memory given twice, or one of Monday beside that of Tuesday, which
    began with it.
    """
    found = list(memories)
    grounds: list[Ground] = []
    names = set[str]()
    for memory in found:
        for ground in memory.grounds:
            same = next((i for i, other in enumerate(grounds) if ground.same_as(other)), None)
            if same is not None:
                if ground.windows > grounds[same].windows:
                    grounds[same] = dataclasses.replace(ground, name=grounds[same].name)
                continue
            name, i = ground.name, 1
            while name in names and not is_given(name):
                name, i = f"ground {i}", i + 1
            names.add(name)
            grounds.append(dataclasses.replace(ground, name=name))
    robot, drives = next((m.robot for m in found if m.robot), ""), [d for m in found for d in m.drives]
    return GroundMemory(grounds, robot, drives).named({}).condensed()


def drive_mark(wheels: Wheels) -> str:
    """Mark of a drive: of its wheel speeds and their times, which no option of a replay changes."""
    return hashlib.sha256(wheels.t_ns.tobytes() + wheels.speed.tobytes()).hexdigest()[:16]


def after_drive(before: GroundMemory | None, learned: GroundMemory, mark: str) -> GroundMemory:
    """What a memory `learned` in a drive; as it was `before`, where that has counted the drive already."""
    if before is not None and mark in before.drives:
        return before
    return GroundMemory(learned.grounds, learned.robot, (*learned.drives, mark))


def alike(a: Ground, b: Ground) -> bool:
    """Whether two signatures are those of one ground; two that were named differently never are."""
    named = [g.name for g in (a, b) if is_given(g.name)]
    if len(set(named)) == 2:
        return False
    return distance(a, b) < ALIKE


def distance(a: Ground, b: Ground, numbers: slice = slice(None)) -> float:
    """Mean square distance of two signatures in their spreads, over `numbers` that both have; infinite where
    there are none.
    """
    both = np.zeros(len(SIGNATURE), dtype=bool)
    both[numbers] = ((a.signature.count > 0.0) & (b.signature.count > 0.0))[numbers]
    if not both.any():
        return math.inf
    square = (a.signature.mean - b.signature.mean)[both] ** 2 / (a.variance() + b.variance())[both]
    return float(square.mean())


def nan_mean(rows: Sequence[Array]) -> Array:
    """Mean (d,) of rows (n, d) without their gaps."""
    stacked = np.array(rows)
    seen = np.isfinite(stacked)
    count = seen.sum(axis=0)
    total = np.where(seen, stacked, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
