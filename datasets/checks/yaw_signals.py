"""How far the robot has turned, by every channel that tells it, and who contradicts whom.

A channel's account is an angle that grows with time (rad; for the wheels metres, right less left).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.core.channels import Gnss

Array = NDArray[np.float64]

WINDOW_S, TRUTH_WINDOW_S, LEAST_WINDOWS = 0.5, 1.0, 10
LEAST_RATE = 0.02
"""Standard deviation of a rate (rad/s, m/s) below which the drive is straight: nothing is compared."""
SURE_R = 0.5
CHORDS_S = (1.0, 2.0, 4.0, 8.0)
"""Lengths of the chords whose course is compared; the shortest that the noise allows is taken."""
FINE_S, REACH_S, LATE_GAIN = 0.1, 5.0, 0.1
"""Step and reach of the search for a lag, and by how much it must correlate better than a changed sign."""
STRIDES = 4
"""Chords overlap: a new one begins so many times in the length of one."""
SUSPECTS = ("gyro", "wheels", "gnss", "truth", "command", "accelerometer")
"""Channels in the order in which they are suspected where the data leave it open."""


@dataclass(frozen=True)
class Account:
    """Times (N,) s since the start of the recording, and the angle (N,) turned until then."""

    t_s: Array
    angle: Array

    def rates(self, grid_s: Array) -> Array:
        """Mean rates over the intervals of the grid, (len(grid_s) - 1,)."""
        return np.asarray(np.diff(np.interp(grid_s, self.t_s, self.angle)) / np.diff(grid_s))


@dataclass(frozen=True)
class Agreement:
    """Correlation `r` of two accounts' rates, and rate of the first over rate of the second."""

    r: float
    slope: float
    windows: int
    spread: tuple[float, float]

    def is_sure(self) -> bool:
        """Whether the correlation is far from 0: high, and beyond three standard errors (Fisher's z)."""
        z = np.arctanh(min(abs(self.r), 1.0 - 1e-9)) * np.sqrt(max(self.windows - 3, 0))
        return abs(self.r) > SURE_R and bool(z > 3.0)


def seconds(t_ns: NDArray[np.int64], start_ns: int) -> Array:
    """Times in seconds since the start of the recording."""
    return np.asarray((t_ns - start_ns) * 1e-9, dtype=np.float64)


def account(start_ns: int, t_ns: NDArray[np.int64], rate: Array) -> Account | None:
    """The integral of a rate; None where fewer than two values are known."""
    known = np.isfinite(rate)
    if known.sum() < 2:
        return None
    t_s, rate = seconds(t_ns[known], start_ns), rate[known]
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t_s)
    return Account(t_s, np.concatenate([[0.0], np.cumsum(steps)]))


def accounts(context: CheckContext) -> dict[str, Account]:
    """The accounts of gyro z, wheels, truth and command, where the recording has them."""
    recording = context.recording
    found: dict[str, Account | None] = {}
    start, truth = recording.start_ns, recording.truth
    if recording.imu is not None:
        found["gyro"] = account(start, recording.imu.t_ns, recording.imu.gyro_radps[:, 2])
    if recording.wheels is not None and recording.wheels.has_sides():
        sides = recording.wheels.side_speeds_mps(context.wheel_radius_m() or 0.15)
        found["wheels"] = account(start, recording.wheels.t_ns, sides[:, 1] - sides[:, 0])
    if truth is not None and truth.quaternion is not None:
        yaw = truth.yaw_rad()
        known = np.isfinite(yaw)
        if known.sum() > 1:
            found["truth"] = Account(seconds(truth.t_ns[known], start), np.unwrap(yaw[known]))
    if recording.command is not None:
        found["command"] = account(start, recording.command.t_ns, recording.command.yaw_rate_radps)
    return {name: one for name, one in found.items() if one is not None}


def agreement(a: Account, b: Account, window_s: float = WINDOW_S) -> Agreement | None:
    """How the rates of two accounts agree; None on a straight drive, or one of few windows in common."""
    start, end = max(a.t_s[0], b.t_s[0]), min(a.t_s[-1], b.t_s[-1])
    if not end - start >= LEAST_WINDOWS * window_s:
        return None
    grid = np.arange(start, end, window_s)
    rate_a, rate_b = a.rates(grid), b.rates(grid)
    spread = float(rate_a.std()), float(rate_b.std())
    if min(spread) < LEAST_RATE:
        return None
    r = float(np.corrcoef(rate_a, rate_b)[0, 1])
    return Agreement(r, r * spread[0] / spread[1], len(grid) - 1, spread)


def is_late(a: Account, b: Account, r: float) -> bool:
    """Whether two accounts that contradict each other (correlation `r` below 0) agree clearly better as they
    are, if one of them is moved in time: then it is a clock, not a sign."""
    start, end = max(a.t_s[0], b.t_s[0]), min(a.t_s[-1], b.t_s[-1])
    grid = np.arange(start, end, FINE_S)
    if len(grid) < 3:
        return False
    kernel = np.ones(round(WINDOW_S / FINE_S)) * FINE_S / WINDOW_S
    one, other = (np.convolve(x.rates(grid), kernel, "valid") for x in (a, b))
    reach = min(round(REACH_S / FINE_S), len(one) // 4)
    if reach < 1 or min(one.std(), other.std()) <= 0.0:
        return False
    one, other = (one - one.mean()) / one.std(), (other - other.mean()) / other.std()
    middle = one[reach:-reach]
    best = float(np.correlate(other, middle, "valid").max()) / len(middle)
    return best > LATE_GAIN - r


def course_agreement(turned: Account, gnss: Gnss, start_ns: int) -> Agreement | None:
    """How the changes of an account agree with those of the course of the fixes, each over one chord.

    A chord counts where it is longer than 1 m and than five sigma of a fix. Changes near half a turn
    are left out: there the robot reverses. None where fewer than eight chords count, or on a straight drive.
    """
    fixed = np.isfinite(gnss.enu_m[:, :2]).all(axis=1) & (gnss.fix > 0)
    if fixed.sum() < 20:
        return None
    t, place = seconds(gnss.t_ns[fixed], start_ns), gnss.enu_m[fixed, 0] + 1j * gnss.enu_m[fixed, 1]
    shortest = max(1.0, 5.0 * typical_sigma(gnss))
    start, end = max(t[0], turned.t_s[0]), min(t[-1], turned.t_s[-1])
    for chord_s in CHORDS_S:
        grid = np.arange(start, end, chord_s / STRIDES)
        if len(grid) < 12 * STRIDES:
            return None
        points = np.interp(grid, t, place)
        chord = points[STRIDES:] - points[:-STRIDES]
        long = np.abs(chord) > shortest
        by_fixes = np.angle(chord[STRIDES:] * np.conj(chord[:-STRIDES]))
        heading = np.interp(grid[: len(chord)] + 0.5 * chord_s, turned.t_s, turned.angle)
        by_account = heading[STRIDES:] - heading[:-STRIDES]
        use = long[STRIDES:] & long[:-STRIDES] & (np.abs(by_fixes) < 2.5) & (np.abs(by_account) < 2.5)
        a, b = by_account[use], by_fixes[use]
        if use.sum() >= 8 * STRIDES and min(a.std(), b.std()) > 0.1:
            r = float(np.corrcoef(a, b)[0, 1])
            spread = float(a.std()) / chord_s, float(b.std()) / chord_s
            return Agreement(r, r * spread[0] / spread[1], int(use.sum()) // STRIDES, spread)
    return None


def typical_sigma(gnss: Gnss) -> float:
    """Median horizontal sigma (m) of the fixes that have one, else 0."""
    sigma = gnss.sigma_enu_m[:, :2]
    sigma = sigma[np.isfinite(sigma) & (sigma > 0.0)]
    return float(np.median(sigma)) if sigma.size else 0.0


def agreements(context: CheckContext) -> dict[tuple[str, str], Agreement]:
    """Agreement of every pair of channels that can be compared, in the order of `SUSPECTS`."""
    known = accounts(context)
    found: dict[tuple[str, str], Agreement | None] = {}
    for one, other in combinations(SUSPECTS, 2):
        if one in known and other in known:
            window_s = TRUTH_WINDOW_S if "truth" in (one, other) else WINDOW_S
            found[one, other] = agreement(known[one], known[other], window_s)
    gnss, track_m = context.recording.gnss, context.rig.track_m if context.rig else 1.0
    if gnss is not None:
        for name, unit in (("gyro", 1.0), ("wheels", track_m)):
            if name in known:
                turned = Account(known[name].t_s, known[name].angle / unit)
                found[name, "gnss"] = course_agreement(turned, gnss, context.recording.start_ns)
    return {pair: both for pair, both in found.items() if both is not None}


def contradictors(signs: dict[tuple[str, str], float]) -> list[frozenset[str]]:
    """The smallest sets of channels whose turns, if reversed, make all pairs agree; [] where none does.

    Args:
        signs: by pair of channels 1 where they turn alike, -1 where they turn against each other.

    Returns:
        One set: the data determine who is wrong. Several: the first is the most suspect.
        [frozenset()]: nobody contradicts.
    """
    names = [name for name in SUSPECTS if any(name in pair for pair in signs)]
    consistent = []
    for flips in product((1.0, -1.0), repeat=len(names)):
        sign = dict(zip(names, flips, strict=True))
        if all(sign[a] * sign[b] == s for (a, b), s in signs.items()):
            consistent.append(frozenset(name for name in names if sign[name] < 0.0))
    fewest = min((len(flipped) for flipped in consistent), default=0)
    smallest = [flipped for flipped in consistent if len(flipped) == fewest]
    return sorted(smallest, key=lambda flipped: sorted(SUSPECTS.index(name) for name in flipped))
