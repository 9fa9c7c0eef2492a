"""Slip and immobilisation from the travel of the wheels against that of the estimate.

Both travels are compared over windows of one, two and four seconds, in which an encoder's quantum is
small. Slip is reported where they differ by more than `SIGMAS` of their uncertainty and by more than
`SLIP` of the wheels' travel.

A robot is immobilised where its wheels turn and it stays ("traction lost"), or where driving is commanded
and neither wheels nor robot move ("motors stalled"; at the wheels alone a stall looks like a stop).
"""

import bisect
import math
from typing import NamedTuple

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.graph.key_state import KeyState

WINDOWS_S = (1.0, 2.0, 4.0)
SIGMAS = 4.0
SLIP = 0.08
"""Least slip reported: above that of firm ground and of an unknown tyre radius (assumed 3 %) together."""
RELEASE = 0.5
"""Slip is over once the travels agree to this share of `SLIP` over `HOLD_S`."""
HOLD_S = 2.0
STUCK_S = 0.7
"""Window of immobilisation."""
STUCK_MPS = 0.05
"""A robot slower than this stands (as in the twin's summary)."""
SPIN_MPS, SPIN_SHARE = 0.1, 0.25
"""Wheels spin above SPIN_MPS while the robot makes less than SPIN_SHARE of it."""
COMMAND_MPS = 0.1
"""Least command that asks for motion."""
COMMAND_HOLD_NS = 500_000_000
"""A command holds for so long when no other comes."""
SPINNING, STALLED = "traction lost", "motors stalled"


class Travel(NamedTuple):
    """Sums over a window: time, wheel travel, estimated travel along the body, its 1 sigma, least command."""

    seconds: float
    rolled_m: float
    moved_m: float
    sigma_m: float
    command_mps: float


class MotionMonitor:
    """Compares wheels and estimate at every keyframe.

    Attributes:
        slipping: the wheels travel another distance than the robot.
        cause: why the robot is immobilised, SPINNING or STALLED; None while it is not.
    """

    def __init__(self, rig: Rig) -> None:
        # Mean of two counts a side, each up to one quantum off at either end of a window.
        self.quantum_m = rig.quantum_m
        # Both ends of a window are read off a line between samples: while the speed changes by 1 m/s2.
        self._stamp_m = 0.5 * 1.0 / rig.sensors.wheels.rate_hz**2
        self.slipping = False
        self.cause: str | None = None
        # Between keyframes (n, 5), the newest first: time, wheel travel (NaN: unknown), estimated travel, its
        # sigma, size of command.
        self._steps: Array | None = None
        self._command: tuple[int, float] | None = None
        self._t_ns: int | None = None
        self._agreed_s = 0.0
        self._speed_mps = 0.0

    @property
    def immobilised(self) -> bool:
        """Whether the robot is kept from moving."""
        return self.cause is not None

    def command(self, t_ns: int, v_mps: float) -> None:
        """The commanded forward speed, m/s; one older than the last is left out."""
        if not math.isfinite(v_mps):
            raise DataError(f"a commanded speed of {v_mps}", channel="command", remedy="leave it out")
        if self._command is None or t_ns >= self._command[0]:
            self._command = (t_ns, v_mps)

    def watch(self, t_ns: int, key: KeyState, velocity_covariance: Array, rolled_m: float | None) -> None:
        """`update` from a keyframe's state and the covariance (3, 3) of its velocity, world axes."""
        forward = key.rotation[:, 0]
        sigma = math.sqrt(float(forward @ velocity_covariance @ forward))
        self.update(t_ns, rolled_m, key.forward_mps, sigma)

    def update(self, t_ns: int, rolled_m: float | None, speed_mps: float, sigma_mps: float) -> None:
        """One keyframe: wheel travel since the last, before any gate; forward speed and its sigma."""
        dt = 0.0 if self._t_ns is None else (t_ns - self._t_ns) * 1e-9
        self._t_ns = t_ns
        if dt <= 0.0:
            self._speed_mps = speed_mps
            return
        mean_mps = 0.5 * (self._speed_mps + speed_mps)
        self._speed_mps = speed_mps
        rolled = math.nan if rolled_m is None else rolled_m
        step = np.array([[dt, rolled, mean_mps * dt, sigma_mps * dt, abs(self._commanded(t_ns))]])
        kept = int((WINDOWS_S[-1] + 2.0 * dt) / dt)
        self._steps = step if self._steps is None else np.concatenate([step, self._steps])[:kept]
        stuck, *windows = self.travels(STUCK_S, *WINDOWS_S)
        self._watch_slip(windows, dt)
        self.cause = None if stuck is None else self._cause(stuck)

    def travels(self, *windows_s: float) -> list[Travel | None]:
        """Travel over the last windows, the shortest first; None before so much is known or without wheels.

        Errors of the estimated speed outlast a window: their sigmas add up.
        """
        if self._steps is None:
            return [None] * len(windows_s)
        sums, commands = self._steps[:, :4].cumsum(axis=0), np.minimum.accumulate(self._steps[:, 4])
        seconds = sums[:, 0].tolist()
        found: list[Travel | None] = []
        for window_s in windows_s:
            last = bisect.bisect_left(seconds, window_s - 1e-6)
            total, rolled, moved, sigma = sums[last].tolist() if last < len(seconds) else [math.nan] * 4
            if math.isnan(rolled):
                found.append(None)
                continue
            noise = math.hypot(sigma, self.quantum_m, self._stamp_m)
            found.append(Travel(total, rolled, moved, noise, float(commands[last])))
        return found

    def _commanded(self, t_ns: int) -> float:
        if self._command is None or t_ns - self._command[0] > COMMAND_HOLD_NS:
            return 0.0
        return self._command[1]

    def _watch_slip(self, windows: list[Travel | None], dt_s: float) -> None:
        if any(window is not None and slips(window) for window in windows):
            self.slipping, self._agreed_s = True, 0.0
        elif self.slipping:
            recent = windows[0]
            agrees = recent is None or not differs(recent, RELEASE * SLIP)
            self._agreed_s = self._agreed_s + dt_s if agrees else 0.0
            self.slipping = self._agreed_s < HOLD_S

    def _cause(self, stuck: Travel) -> str | None:
        wheels = abs(stuck.rolled_m) / stuck.seconds
        robot = abs(stuck.moved_m) / stuck.seconds
        if robot > max(STUCK_MPS, SPIN_SHARE * wheels):
            return None
        if wheels > SPIN_MPS and robot < SPIN_SHARE * wheels and slips(stuck):
            return SPINNING
        if wheels < STUCK_MPS and stuck.command_mps > COMMAND_MPS:
            return STALLED
        return None


def slips(travel: Travel) -> bool:
    """Whether the travels differ by more than chance, the quantum and `SLIP` explain."""
    return differs(travel, SLIP) and abs(travel.rolled_m - travel.moved_m) > SIGMAS * travel.sigma_m


def differs(travel: Travel, share: float) -> bool:
    """Whether the travels differ by more than a share of the wheels' one."""
    return abs(travel.rolled_m - travel.moved_m) > share * abs(travel.rolled_m)
