"""The numbers of a robot while it drives: a step of the smoother every few seconds, in slices."""

import dataclasses
import statistics
from collections import deque
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.fit import combined, started
from terrafusion.fusion.calibration.motion import MotionSegment, dead_reckoned, node_due
from terrafusion.fusion.calibration.numbers import GYRO_BIAS, Knowledge
from terrafusion.fusion.calibration.reduction import BIAS, NODE, Nodes, Noise, Reduction

STEP_S = 4.0
"""Time between the begins of steps while the robot drives."""
FAR_MISFIT, BETTER = 4.0, 0.9
"""From this misfit on, if a step has brought it below this share of what it was, the next begins at once."""
FEWEST_NODES, MOST_NODES = 4, 60
"""Nodes before the first step, and those of a stretch: the numbers of a full one are the next one's prior."""
FORGOTTEN = 1.1
"""Growth of the variances from one stretch to the next: tyres warm up, loads shift (assumed)."""
FIX_INTERVAL_S = 0.45
"""Fixes closer together are left out: their errors are alike."""
USUAL_FIXES = 50


class SelfCalibration:
    """Collects wheels, turns and fixes, and estimates `numbers.NUMBERS` from them.

    Attributes:
        prior: what was known before the first drive.
        known: the numbers by now.
        before: the numbers when the stretch under way began.
        usual_sigma_m: median 1 sigma of the newest fixes.
        turned_rad: turns of the stretch under way, of either sign.
    """

    def __init__(self, prior: Knowledge, noise: Noise, antenna_m: complex) -> None:
        self.prior = self.known = self.before = prior
        self._noise, self._antenna_m = noise, antenna_m
        self._begin()

    def start_from(self, prior: Knowledge) -> None:
        """Begin with what is known of the robot from earlier runs."""
        self.prior = self.known = self.before = prior

    def _begin(self) -> None:
        self._start_ns: int | None = None
        self._start: tuple[complex, float] = (0j, 0.0)
        none = np.zeros(0)
        self._drive = MotionSegment(
            np.zeros(1), none, none, antenna_m=self._antenna_m, course_rad=none, climb_m=none
        )
        self._first: list[int] = [0]
        self._now_s, self._node_s, self._stepped_s, self._rolled_m = 0.0, 0.0, 0.0, 0.0
        # Newer than `_drive`: time, distance, turn, course, climb; of fixes time, east, north, sigma.
        self._samples: list[tuple[float, float, float, float, float]] = []
        self._fixes: list[tuple[float, float, float, float]] = []
        self._last_fix_s, self._sigmas_m = -np.inf, deque[float](maxlen=USUAL_FIXES)
        self.usual_sigma_m = self.turned_rad = 0.0
        self._state: Array | None = None
        self._work: Reduction | None = None
        self._reduced = False
        self._far, self._step_misfit = False, np.inf

    def restart(self, known: Knowledge | None = None) -> None:
        """Begin a new stretch, as the path was interrupted; from `known` if what came since is wrong."""
        self.known = self._wandered(self.known) if known is None else known
        self.before = self.known
        if self._start_ns is not None:
            self._begin()

    def drive(
        self,
        t_ns: int,
        distance_m: float | None,
        turn_rad: float,
        position_m: Array,
        yaw_rad: float,
        course_rad: float = 0.0,
        grade: float = 0.0,
    ) -> None:
        """Motion since the last call, by the wheels and by the source of yaw as measured.

        `position_m` (2,) and `yaw_rad` are the estimate at `t_ns`, where a stretch begins; `course_rad` is of
        `MotionSegment`, `grade` the sine of the body's slope, x axis up.
        """
        if distance_m is None:
            self.restart()
            return
        if self._start_ns is None:
            self._start_ns, self._start = t_ns, (complex(*position_m[:2]), yaw_rad)
            return
        self._now_s = (t_ns - self._start_ns) * 1e-9
        self._samples.append((self._now_s, distance_m, turn_rad, course_rad, abs(distance_m) * grade))
        self._rolled_m += abs(distance_m)
        self.turned_rad += abs(turn_rad)
        apart_s = self._now_s - self._node_s
        if node_due(apart_s, self._rolled_m, self.usual_sigma_m):
            self._first.append(len(self._drive.distance_m) + len(self._samples))
            self._node_s, self._rolled_m = self._now_s, 0.0

    def fix(self, t_ns: int, enu_m: Array, sigma_m: float) -> None:
        """A fix by its own stamp."""
        if self._start_ns is None:
            return
        t_s = (t_ns - self._start_ns) * 1e-9
        if t_s > 0.0 and t_s - self._last_fix_s >= FIX_INTERVAL_S:
            self._fixes.append((t_s, float(enu_m[0]), float(enu_m[1]), sigma_m))
            self._last_fix_s = t_s
            self._sigmas_m.append(sigma_m)
            self.usual_sigma_m = statistics.median(self._sigmas_m)

    def advance(self) -> bool:
        """A slice of the step under way, or of the next due one; True when it ends with other numbers."""
        try:
            if self._work is None:
                if self._due():
                    self._stepped_s = self._now_s
                    nodes = self._nodes()
                    self._work = Reduction.of(nodes, self.known.mean, self.known.slip_spread, self._noise)
                return False
            if not self._reduced:
                self._reduced = self._work.advance()
                return False
            return self._end(self._work)
        except np.linalg.LinAlgError:
            self.restart()
            return False

    def _due(self) -> bool:
        fixes = len(self._drive.fix) + len(self._fixes)
        if fixes < FEWEST_NODES and len(self._first) > MOST_NODES:  # without fixes there is nothing to learn
            self.restart()
            return False
        wait_s = 0.0 if self._far else STEP_S
        if min(len(self._first), fixes) < FEWEST_NODES or self._now_s - self._stepped_s < wait_s:
            return False
        standing = self._rolled_m == 0.0
        return not (standing and self._state is not None and len(self._state) == len(self._first))

    def _end(self, work: Reduction) -> bool:
        """The numbers by a step whose normal equations are done; True unless they are useless."""
        found = combined([work], self.known, self.before)
        self._work, self._reduced = None, False
        if not np.isfinite(found.mean).all() or not np.isfinite(work.part.state).all():
            self.known = self.before
            self._begin()
            return False
        self._state, self.known = work.part.state, found
        self._far = FAR_MISFIT < work.misfit < BETTER * self._step_misfit
        self._step_misfit = work.misfit
        if len(self._state) >= MOST_NODES:
            self.known = found = self._wandered(found)
            self.before = found.with_covariance(found.covariance * FORGOTTEN, self.prior)
            self._begin()
        return True

    def _wandered(self, known: Knowledge) -> Knowledge:
        """With the bias of the newest node, which is known less well by its walk over the stretch."""
        if self._state is None or self._noise.bias_walk_radps == 0.0:
            return known
        mean, covariance = known.mean.copy(), known.covariance.copy()
        mean[GYRO_BIAS] += self._state[-1, BIAS]
        covariance[GYRO_BIAS, GYRO_BIAS] += self._noise.bias_walk_radps**2 * self._now_s
        return dataclasses.replace(known, mean=mean, covariance=covariance)

    def _nodes(self) -> Nodes:
        """The stretch with the nodes of the last step, and dead-reckoned new ones."""
        self._drive = drive = _extended(self._drive, self._samples, self._fixes, self._first)
        self._samples, self._fixes = [], []
        if self._state is None:
            return started(drive, *self._start, self.known.mean)
        known = len(self._state)
        state = np.vstack([self._state, np.zeros((len(self._first) - known, NODE))])
        base, last = self._first[known - 1], self._state[-1]
        numbers = self.known.mean.copy()
        numbers[GYRO_BIAS] += last[BIAS]
        path, new = dead_reckoned(drive, numbers, base), drive.first[known:] - base
        yaw = last[2]
        at = complex(last[0], last[1]) + (1.0 + last[3]) * np.exp(1j * yaw) * path.z[new]
        state[known:, 0], state[known:, 1], state[known:, 2] = at.real, at.imag, yaw + path.yaw_rad[new]
        state[known:, 3:] = last[3:]
        return Nodes(drive, state)


def _extended(
    drive: MotionSegment,
    samples: Sequence[tuple[float, float, float, float, float]],
    fixes: Sequence[tuple[float, float, float, float]],
    first: Sequence[int],
) -> MotionSegment:
    """A drive with what came since."""
    t_s, distance_m, turn_rad, course_rad, climb_m = np.array(samples).reshape(-1, 5).T
    if drive.course_rad is not None and drive.climb_m is not None:
        course_rad = np.concatenate([drive.course_rad, course_rad])
        climb_m = np.concatenate([drive.climb_m, climb_m])
    fix_t_s, east_m, north_m, sigma_m = np.array(fixes).reshape(-1, 4).T
    return MotionSegment(
        np.concatenate([drive.t_s, t_s]),
        np.concatenate([drive.distance_m, distance_m]),
        np.concatenate([drive.turn_rad, turn_rad]),
        np.concatenate([drive.fix_t_s, fix_t_s]),
        np.concatenate([drive.fix, east_m + 1j * north_m]),
        np.concatenate([drive.fix_sigma_m, sigma_m]),
        drive.antenna_m,
        np.array(first),
        course_rad,
        climb_m,
    )
