"""Tests whether fixes can be the robot's: by what it can have driven, by its motion and by its turns.

A receiver that is wrong is often wrong for many fixes in a row, which agree with each other (a reflected
signal, a wrong ambiguity, a position that it repeats). Wheels and gyro bound where the robot can be: a new
place is believed as soon as it could have been reached since the last fix that was used. A place beyond it is
believed only once the fixes there have traced, over tens of metres and seconds, the path that wheels and gyro
describe; until then, and for a while after, the covariance spans both places.
"""

import cmath
import dataclasses
import math
from collections import deque
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Complex
from terrafusion.datasets.core.planar_alignment import planar_rotation
from terrafusion.datasets.core.printable import counted, times
from terrafusion.fusion.estimate.estimate import JUMPED, State
from terrafusion.fusion.estimator.dead_reckoning import (
    LEAST_TURN_RAD,
    MARGIN,
    TOP_MPS,
    DeadReckoning,
    FixPair,
)
from terrafusion.fusion.estimator.fix_jump import SAME_PLACE, USED, FixJump
from terrafusion.fusion.inputs.streams import WheelStream
from terrafusion.fusion.inputs.validation import GnssFix

SLACK_M, SLACK_SIGMA = 1.0, 4.0
"""Beyond the reach of the wheels: lever arm and delay (assumed), and sigmas of both fixes."""
SHAPE_FIXES, EVIDENCE_S, EVIDENCE_M = 10, 20.0, 20.0
"""Fixes from which their path has a shape, and time and path that a place beyond reach must show."""
SHAPE_RATIO, SHAPE_SHARE, SHAPE_SIGMA = 0.15, 0.03, 3.0
"""How well the shape must be that of wheels and gyro: in scale, and in share of the path plus sigmas."""
CONTRADICTED = 5
"""Fixes in a row beyond reach that put the estimate in doubt."""
BRIEF_S, FORGOTTEN_S = 5.0, 10.0
"""Fixes that contradict for less than the one are forgotten after the other without any."""
DOUBT, DOUBT_M = 0.35, 30.0
"""Sigma over the distance of both places, and the path after a jump over which it decays by e (assumed)."""
JUMP_DOUBT, JUMP_DOUBT_M, HELD_S = 0.5, 100.0, 60.0
"""The same for fixes that jumped, and how long they are held off: their path says nothing of which place is
right; a receiver corrects a wrong ambiguity within a minute, mostly (assumed)."""
REMEMBERED_S = 90.0
"""For which used fixes are remembered: a reflected signal is gone after half of it, mostly (assumed)."""
SETTLED = 0.02
"""Share of the distance below which a jump is no longer in doubt."""
REPEATED_SIGMA, REPEATED_M = 0.1, 0.005
"""A position is repeated where it changes by less than this share of sigma, at most by so much."""
REPEATED_WAY_M = 0.1
"""Least motion that a repeated position contradicts; one sigma of the fix where that is more."""
MIRROR_GAIN = 5.0
"""Ratio of residuals from which the path fits its mirror image only."""
MIRROR_YAW_RAD = 1.8
"""Sigma of a heading of which nothing is known: pi / sqrt(3)."""
MIRROR_RATIO = 0.3
"""Driven over dead-reckoned distance may differ from 1 by so much."""
START_FIXES, START_SHARE, START_MOST = 5, 0.35, 20
"""Fixes, and share of all, of one place from which a robot is started among wild ones; with so many fixes and
no such place it is started from all (assumed)."""
MOST_RUNS, MOST_PAIRS = 8, 600
"""Runs, and fixes of a run, that are remembered."""

REPEATS = "the receiver repeats its position while wheels and gyro show motion"
MIRRORED = "the path of the fixes is the mirror image of that of wheels and gyro (axes swapped, or a sign)"
BEYOND = "the place lies beyond what the robot can have driven"
REASONS = (REPEATS, MIRRORED, BEYOND, JUMPED)


@dataclass
class FixRun:
    """Fixes, each within reach of the one before; `reachable`: the first was within reach of a used fix.

    `jump`: the jump from the used fixes to these, where they make one.
    """

    reachable: bool
    pairs: list[FixPair]
    jump: FixJump | None = None

    @property
    def held(self) -> bool:
        """Whether its fixes jumped as no robot moves."""
        return self.jump is not None and self.jump.impossible

    def follows(self, pair: FixPair) -> bool:
        """Whether a fix continues the jump of the run."""
        return self.jump is not None and self.jump.continued(self.pairs[-1], pair)

    def append(self, pair: FixPair) -> None:
        """Continue the run."""
        self.pairs.append(pair)
        del self.pairs[:-MOST_PAIRS]

    def seconds(self) -> float:
        """Time from its first to its last fix."""
        return (self.pairs[-1].t_ns - self.pairs[0].t_ns) * 1e-9

    def is_evidence(self, scale: float, heading: complex) -> bool:
        """Whether the fixes trace the path of wheels and gyro, long enough; sigmas times `scale`.

        `heading` turns the path as the estimate has it; a straight path must have that heading.
        """
        shape = PathShape.of(self.pairs, scale)
        if self.seconds() < EVIDENCE_S or shape.path_m < EVIDENCE_M or not shape.fits(shape.own, SHAPE_RATIO):
            return False
        turn, left_m = shape.own
        other = abs(cmath.phase(turn / heading)) > LEAST_TURN_RAD
        return not other or shape.mirrored[1] > MIRROR_GAIN * max(left_m, shape.sigma_m)


@dataclass
class RepeatedPosition:
    """A receiver that repeats a position: the first fix there, and where path and estimate were then."""

    first: complex | None = None
    z: complex = 0j
    estimate: complex = 0j

    def moved_m(self, pair: FixPair, estimate: complex) -> float:
        """Motion since the position was new, by wheels and by the estimate, whichever is less; 0 where it is.

        A robot whose wheels spin on the spot does not move by its estimate.
        """
        near_m = min(REPEATED_SIGMA * pair.sigma_m, REPEATED_M)
        if self.first is None or abs(pair.fix - self.first) > near_m:
            self.first, self.z, self.estimate = pair.fix, pair.z, estimate
            return 0.0
        return min(abs(pair.z - self.z), abs(estimate - self.estimate))


@dataclass
class FixPlausibility:
    """Tests of fixes that overrule the gate.

    Attributes:
        anchors: last fixes used, before and after a jump of the estimate.
        runs: fixes refused since then; run: the newest one's.
        mirrored: east and north are swapped, or one is reversed.
        jump_m: from the place left to the place believed, and the reach then; None where there is no doubt.
        unused: by reason, how many fixes were not used.
        jumps, returns: how often a place beyond reach was believed, and the one before it again.
        skids: jumps that may be a skid, too, and were followed.
    """

    anchors: list[FixPair] = field(default_factory=list)
    runs: list[FixRun] = field(default_factory=list)
    run: FixRun | None = None
    mirrored: bool = False
    jump_m: complex | None = None
    jump_at_m: float = 0.0
    unused: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REASONS, 0))
    skids: int = 0
    jumps: int = 0
    returns: int = 0
    _position: RepeatedPosition = field(default_factory=RepeatedPosition)
    _in_a_row: int = 0
    _refused_ns: int | None = None
    _doubt_m: complex = 0j
    _since: list[FixPair] = field(default_factory=list)
    _used: deque[FixPair] = field(default_factory=deque)
    _believed: bool = False
    _back: bool = False
    _fades: tuple[float, float] = (DOUBT, DOUBT_M)

    def refusal(self, pair: FixPair, estimate: complex) -> str | None:
        """Why a fix must not be used whatever the gate says; None where it may be.

        `estimate` is the antenna (east + i north, m) by the estimate at the fix.
        """
        moved_m = self._position.moved_m(pair, estimate)
        if moved_m > max(REPEATED_WAY_M, pair.sigma_m):
            return self._refused(pair, REPEATS)
        if self.mirrored:
            self._since.append(pair)
        if self.mirrored and PathShape.of(self._since).is_own():
            self.mirrored = False
            self._since.clear()
        if self.mirrored:
            del self._since[:-MOST_PAIRS]
            return self._refused(pair, MIRRORED)
        run = self.run
        if run is not None and run.held and run.follows(pair):
            return self._held(run, pair, estimate)
        return None

    def _held(self, run: FixRun, pair: FixPair, estimate: complex) -> str | None:
        """Hold a fix off that follows a jump, until these fixes are evidence."""
        run.append(pair)
        self._doubt_m = pair.fix - estimate
        if run.seconds() >= HELD_S and run.is_evidence(1.0, run.jump.heading if run.jump else 1.0):
            self._move(run, pair, JUMP_DOUBT, JUMP_DOUBT_M)
            self._believed = True
            return None
        pair.usable = False
        return self._refused(pair, JUMPED)

    def _move(self, run: FixRun, pair: FixPair, share: float, fades_m: float) -> None:
        """Believe a place, with doubt."""
        self.jumps += 1
        self.jump_m, self.jump_at_m, self._fades = self._doubt_m, pair.reach_m, (share, fades_m)
        for one in run.pairs:
            one.usable = True

    def rejected(
        self, pair: FixPair, estimate: complex, track: DeadReckoning, scale: float, white: float
    ) -> bool:
        """Take a fix that the gate rejects; True where its place is now believed although beyond reach.

        Sigmas are taken times `scale`; `white` is the share of their squares that is white.
        """
        if not self.anchors:
            self.anchors.append(dataclasses.replace(pair, fix=estimate))
        if self._believed:
            return True
        self.run = self._continued(pair, scale)
        if self.run.reachable and self._jumped(self.run, track.heading, scale, white):
            return True
        pair.usable = self.run.reachable
        pair.alone = not pair.usable and len(self.run.pairs) == 1
        if len(self.run.pairs) == 2:
            self.run.pairs[0].alone = False
        if any(PathShape.of(pairs).is_mirrored() for pairs in (track.pairs, self.run.pairs)):
            self.mirrored, self._since = True, []
            self._refused(pair, MIRRORED)
            return False
        if self.run.reachable:
            return False
        self._doubt_m = pair.fix - estimate
        if self.run.held:
            self._refused(pair, JUMPED)
            return False
        self._refused(pair, BEYOND)
        if not self.run.is_evidence(scale, track.heading):
            return False
        self._move(self.run, pair, DOUBT, DOUBT_M)
        return True

    def _jumped(self, run: FixRun, heading: complex, scale: float, white: float) -> bool:
        """Test a run for a jump; True where it undoes the last one, or leads back to where most fixes lay."""
        run.jump = jump = FixJump.of(list(self._used)[-USED:], run.pairs, heading, scale, white)
        if jump is None:
            return False
        undone = self.jump_m is not None and abs(jump.offset_m + self.jump_m) < SAME_PLACE * abs(self.jump_m)
        if undone or (jump.impossible and jump.leads_back(self._used, run.pairs[0])):
            run.jump, self._back = None, True
            return True
        if jump.impossible:
            run.reachable = False
            for one in run.pairs:
                one.usable = False
        return False

    def accepted(self, pair: FixPair, anew: bool) -> None:
        """A fix is used; `anew`: the estimate was moved there."""
        known, jump = self.run is not None and self.run.reachable, self.run.jump if self.run else None
        far = anew and known and self.jump_m is not None and not within_reach(self.anchors[-1], pair, 1.0)
        if far or self._back:
            self.jump_m, self.returns = None, self.returns + 1
        elif jump is not None and not jump.impossible and self.run is not None and self.run.follows(pair):
            self.skids += 1
            self.jump_m, self.jump_at_m = jump.offset_m, pair.reach_m
            self._fades = JUMP_DOUBT, JUMP_DOUBT_M
        if self.jump_m is not None and self._share(pair.reach_m) < SETTLED:
            self.jump_m = None
        self.anchors = [*self.anchors[-1 if anew else -2 : None if anew else -1], pair]
        if self.jump_m is None and pair.reach_m - self.anchors[0].reach_m > EVIDENCE_M:
            self.anchors = [pair]
        self.runs.clear()
        self.run, self._in_a_row, self._refused_ns = None, 0, None
        self._believed = self._back = False
        if not self._used or pair.t_ns > self._used[-1].t_ns:
            self._used.append(pair)
            while pair.t_ns - self._used[0].t_ns > REMEMBERED_S * 1e9 and len(self._used) > USED:
                self._used.popleft()

    def watch(self, t_ns: int) -> None:
        """Forget a brief contradiction once no fix has come for a time."""
        if self._refused_ns is None or (t_ns - self._refused_ns) * 1e-9 < FORGOTTEN_S:
            return
        if self.run is None or self.run.seconds() < BRIEF_S:
            self._in_a_row, self._refused_ns = 0, None

    def widened(self, state: State, reach_m: float) -> State:
        """A state whose covariance spans both places and whose status says so, where there is doubt."""
        away_m, share = self._doubt(reach_m)
        if share == 0.0 and self._in_a_row < CONTRADICTED:
            return state
        covariance = state.covariance.copy()
        d = np.array([away_m.real, away_m.imag])
        covariance[:2, :2] += share**2 * (np.outer(d, d) + 1e-4 * float(d @ d) * np.eye(2))
        if self.mirrored:  # place and heading of the start may have come from wrong axes, too
            covariance[:2, :2] += float(np.sum(state.position_m[:2] ** 2)) * np.eye(2)
            covariance[5, 5] += MIRROR_YAW_RAD**2
        return dataclasses.replace(state, covariance=covariance, status="doubtful")

    def notes(self) -> list[str]:
        """What was made of the fixes, in sentences."""
        unused = [(counted(n, "GNSS fix", "GNSS fixes"), why) for why, n in self.unused.items() if n]
        out = [f"{fixes} not used: {why}" for fixes, why in unused]
        if self.jumps:
            out.append(
                f"{self.jumps} times fixes beyond reach traced the path of wheels and gyro for so long that "
                "the position was moved to them; its sigma spanned both places for a while"
            )
        if self.returns:
            out.append(f"{times(self.returns)} the position went back to where most fixes before had it")
        if self.skids:
            out.append(
                f"{times(self.skids)} fixes jumped to one side and stayed there: a skid between two fixes, "
                "or a wrong fix; the position followed them, and its sigma spanned both places for a while"
            )
        return out

    def _refused(self, pair: FixPair, why: str) -> str:
        self.unused[why] += 1
        self._in_a_row += 1
        self._refused_ns = pair.t_ns
        return why

    def _continued(self, pair: FixPair, scale: float) -> FixRun:
        """The run that a rejected fix continues, or a new one."""
        for run in reversed(self.runs):
            if run.follows(pair) if run.held else within_reach(run.pairs[-1], pair, scale):
                run.append(pair)
                self.runs.remove(run)
                self.runs.append(run)
                return run
        reachable = any(within_reach(anchor, pair, scale) for anchor in self.anchors)
        self.runs.append(FixRun(reachable, [pair]))
        if len(self.runs) > MOST_RUNS:
            self.runs.remove(min(self.runs[:-1], key=lambda run: len(run.pairs)))
        return self.runs[-1]

    def _share(self, reach_m: float) -> float:
        """Sigma over the length of the jump."""
        share, fades_m = self._fades
        return share * math.exp(-(reach_m - self.jump_at_m) / fades_m)

    def _doubt(self, reach_m: float) -> tuple[complex, float]:
        """Distance between both places, and sigma over its length."""
        if self.run is not None and not self.run.reachable and len(self.run.pairs) >= CONTRADICTED:
            share = JUMP_DOUBT if self.run.held else DOUBT
            return self._doubt_m, share if self._refused_ns is not None else 0.0
        if self.jump_m is not None:
            return self.jump_m, self._share(reach_m)
        return 0j, 0.0


def within_reach(a: FixPair, b: FixPair, scale: float) -> bool:
    """Whether the robot can have gone from one fix to the other."""
    reach_m = abs(b.reach_m - a.reach_m) + SLACK_M + SLACK_SIGMA * scale * math.hypot(a.sigma_m, b.sigma_m)
    return abs(b.fix - a.fix) <= reach_m


def similarity(z: Complex, fix: Complex) -> tuple[complex, float]:
    """Turn and scale, as a complex number, that bring a path onto fixes, and the median distance left, m."""
    rotation, information = planar_rotation(z, fix)
    turn = rotation / max(information, 1e-12)
    left = fix - turn * z
    return turn, float(np.median(np.abs(left - left.mean())))


@dataclass(frozen=True)
class PathShape:
    """How well fixes trace the path of wheels and gyro, and its mirror image.

    Attributes:
        own, mirrored: `similarity` of the path, and of its image, to the fixes.
        sigma_m: the largest of the fixes.
        path_m: length of the path; 0 with too few fixes.
    """

    own: tuple[complex, float] = (0j, 0.0)
    mirrored: tuple[complex, float] = (0j, 0.0)
    sigma_m: float = 0.0
    path_m: float = 0.0

    @classmethod
    def of(cls, pairs: list[FixPair], scale: float = 1.0) -> Self:
        """The shape of fixes, their sigmas times `scale`."""
        if len(pairs) < SHAPE_FIXES:
            return cls()
        z, fix = (np.array([getattr(p, name) for p in pairs]) for name in ("z", "fix"))
        sigma_m = scale * max(p.sigma_m for p in pairs)
        path_m = float(np.abs(np.diff(z)).sum())
        return cls(similarity(z, fix), similarity(z.conj(), fix), sigma_m, path_m)

    def fits(self, one: tuple[complex, float], ratio: float) -> bool:
        """Whether the path, or its image, fits: its scale within `ratio` of 1."""
        turn, left_m = one
        allowed_m = SHAPE_SIGMA * self.sigma_m + SHAPE_SHARE * self.path_m
        return abs(abs(turn) - 1.0) <= ratio and left_m <= allowed_m

    def is_mirrored(self) -> bool:
        """Whether only the image fits, clearly."""
        return self._fits_alone(self.mirrored, self.own)

    def is_own(self) -> bool:
        """Whether only the path itself fits, clearly."""
        return self._fits_alone(self.own, self.mirrored)

    def _fits_alone(self, one: tuple[complex, float], other: tuple[complex, float]) -> bool:
        clearly_m = max(MIRROR_GAIN * one[1], 2.0 * SHAPE_SIGMA * self.sigma_m)
        return self.fits(one, MIRROR_RATIO) and other[1] > clearly_m


def plausible_fixes(fixes: list[GnssFix], wheels: WheelStream) -> list[GnssFix]:
    """The largest set of fixes before the start of which each can be reached from the one before it.

    None yet where no set is large, and all of them where none has been among many.
    """
    runs: list[list[FixPair]] = []
    of: dict[int, GnssFix] = {}
    reach_m = 0.0
    for before, fix in zip([fixes[:1], *([f] for f in fixes)], fixes, strict=False):
        travelled = wheels.travelled(before[0].t_ns, fix.t_ns)
        seconds = (fix.t_ns - before[0].t_ns) * 1e-9
        reach_m += TOP_MPS * seconds if travelled is None else MARGIN * max(map(abs, travelled))
        place = complex(fix.enu_m[0], fix.enu_m[1])
        pair = FixPair(fix.t_ns, 0j, place, float(np.max(fix.sigma_m[:2])), reach_m)
        of[id(pair)] = fix
        run = next((run for run in reversed(runs) if within_reach(run[-1], pair, 1.0)), None)
        if run is None:
            runs.append([pair])
        else:
            run.append(pair)
    largest = max(reversed(runs), key=len, default=[])
    if 2 * len(largest) > len(fixes) or len(largest) >= max(START_FIXES, START_SHARE * len(fixes)):
        return [of[id(pair)] for pair in largest]
    return fixes if len(fixes) >= START_MOST else []
