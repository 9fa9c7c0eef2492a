"""The numbers of a robot while it drives: one step of the smoother every few seconds."""

from __future__ import annotations

import dataclasses

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.fit import NODE, Nodes, Noise, refined, started
from terrafusion.fusion.calibration.motion import Drive, dead_reckoned, node_due
from terrafusion.fusion.calibration.numbers import GNSS_DELAY, Knowledge

STEP_S = 4.0
"""Time between steps while the robot drives; each costs a few milliseconds."""
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
    """

    def __init__(self, prior: Knowledge, noise: Noise, antenna_m: complex) -> None:
        self.prior = self.known = self._before = prior
        self._noise, self._antenna_m = noise, antenna_m
        self._begin()

    def start_from(self, prior: Knowledge) -> None:
        """Begin with what is known of the robot from earlier runs."""
        self.prior = self.known = self._before = prior

    def _begin(self) -> None:
        self._start_ns = 0
        self._t_s: list[float] = []
        self._distance_m: list[float] = []
        self._turn_rad: list[float] = []
        self._first: list[int] = [0]
        self._rolled_m, self._stepped_s = 0.0, 0.0
        self._start: tuple[complex, float] = (0j, 0.0)
        self._fix_t_s: list[float] = []
        self._fix: list[complex] = []
        self._fix_sigma_m: list[float] = []
        self._state: Array | None = None

    def restart(self, forget: bool = False) -> None:
        """Begin a new stretch: the path was interrupted; `forget` what the last one gave if it was wrong."""
        if forget:
            self.known = self._before
        self._before = self.known
        if self._t_s:
            self._begin()

    def drive(
        self, t_ns: int, distance_m: float | None, turn_rad: float, position_m: Array, yaw_rad: float
    ) -> None:
        """Motion since the last call, by the wheels and by the source of yaw as measured.

        `position_m` (2,) and `yaw_rad` are the estimate at `t_ns`, where a stretch begins.
        """
        if distance_m is None:
            self.restart()
            return
        if not self._t_s:
            self._start_ns, self._start = t_ns, (complex(*position_m[:2]), yaw_rad)
            self._t_s.append(0.0)
            return
        self._t_s.append((t_ns - self._start_ns) * 1e-9)
        self._distance_m.append(distance_m)
        self._turn_rad.append(turn_rad)
        self._rolled_m += abs(distance_m)
        sigma = float(np.median(self._fix_sigma_m[-USUAL_FIXES:])) if self._fix_sigma_m else 0.0
        if node_due(self._t_s[-1] - self._t_s[self._first[-1]], self._rolled_m, sigma):
            self._first.append(len(self._t_s) - 1)
            self._rolled_m = 0.0

    def fix(self, t_ns: int, enu_m: Array, sigma_m: float) -> None:
        """A fix by its own stamp."""
        t_s = (t_ns - self._start_ns) * 1e-9
        if self._t_s and t_s > 0.0 and (not self._fix_t_s or t_s - self._fix_t_s[-1] >= FIX_INTERVAL_S):
            self._fix_t_s.append(t_s)
            self._fix.append(complex(enu_m[0], enu_m[1]))
            self._fix_sigma_m.append(sigma_m)

    def step(self) -> bool:
        """Refine the numbers where that is due; True when they changed."""
        if min(len(self._first), len(self._fix)) < FEWEST_NODES or self._t_s[-1] - self._stepped_s < STEP_S:
            return False
        if self._rolled_m == 0.0 and self._state is not None and len(self._state) == len(self._first):
            return False
        self._stepped_s = self._t_s[-1]
        nodes = self._nodes()
        try:
            found = refined([nodes], self.known, self._before, self._noise)
        except np.linalg.LinAlgError:
            self.restart()
            return False
        if not np.isfinite(found.mean).all() or not np.isfinite(nodes.state).all():
            self.known = self._before
            self._begin()
            return False
        self._state, self.known = nodes.state, found
        if len(self._first) >= MOST_NODES:
            wider = dataclasses.replace(found, covariance=found.covariance * FORGOTTEN)
            limit = np.minimum(np.diag(wider.covariance), np.diag(self.prior.covariance))
            shrink = np.sqrt(limit / np.diag(wider.covariance))
            self._before = dataclasses.replace(wider, covariance=wider.covariance * np.outer(shrink, shrink))
            self._begin()
        return True

    def _nodes(self) -> Nodes:
        """The stretch with the nodes of the last step, and dead-reckoned new ones."""
        drive = Drive(
            np.array(self._t_s),
            np.array(self._distance_m),
            np.array(self._turn_rad),
            np.array(self._fix_t_s),
            np.array(self._fix, dtype=complex),
            np.array(self._fix_sigma_m),
            self._antenna_m,
            np.array(self._first),
        )
        if self._state is None:
            return started(drive, *self._start, self.known.mean)
        known = len(self._state)
        state = np.vstack([self._state, np.zeros((len(self._first) - known, NODE))])
        path, last = dead_reckoned(drive, self.known.mean), self._state[-1]
        base, new = self._first[known - 1], drive.first[known:]
        yaw = last[2] - path.yaw_rad[base]
        at = complex(last[0], last[1]) + (1.0 + last[3]) * np.exp(1j * yaw) * (path.z[new] - path.z[base])
        state[known:, 0], state[known:, 1], state[known:, 2] = at.real, at.imag, yaw + path.yaw_rad[new]
        state[known:, 3:] = last[3:]
        return Nodes(drive, state)

    @property
    def gnss_delay_s(self) -> float:
        """Lateness of the fixes' stamps."""
        return float(self.known.mean[GNSS_DELAY])
