"""Delay of the fixes and scale of the gyro, from the shape of the measured path.

The path by wheels and gyro is laid onto the positions window by window. What shifts, turns or scales a
window, and a constant bias of the gyro, is free in each; common to all are the delay of the positions, the
scale of the gyro about z and the lever arm of the antenna. They are found by Gauss-Newton steps with Huber
weights, their intervals by bootstrap over windows: errors of fixes last for many seconds.
"""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, once
from terrafusion.datasets.checks.motion import cumulative
from terrafusion.datasets.checks.path import MeasuredPath, driven_and_turned, path_by
from terrafusion.datasets.core.arrays import Array, Complex
from terrafusion.datasets.core.bootstrap import BootstrapInterval, interval_of, resampled_rows

LEAST_WINDOWS, LEAST_CONTRIBUTING, LEAST_ROWS, MOST_HZ = 5, 2.0, 8, 5.0
"""Windows that are needed, those of them that show a number, positions in each, and the rate that more would
not add to."""
SIGMAS, WINDOW_S = 30.0, (20.0, 60.0)
"""A window spans this many sigma of a position, within these limits."""
STARTS_S, FAR_STARTS_S, CLEARLY = np.arange(-1.0, 5.1, 0.5), np.arange(5.5, 20.1, 0.5), 0.6
"""Delays from which the steps start: the best of them. One of the second counts where it leaves less than
this share of what the first leave: fixes with the seconds of GPS are 18 s late."""
LONGEST_S, LONGEST_FAR_S = 6.0, 21.0
PRIOR = np.array([0.2, 3.0, 0.5, 0.5, 0.02])
"""1 sigma of scale, delay (s) and lever arm (m) before the data: what they do not show stays near zero, a
delay of many seconds near where it was found."""
STEPS, HUBER = 6, 2.0
SPIKES_S = 0.2
"""Speeds sampled faster than this lose spikes of one sample."""
MOST_SCALE, MOST_NOISE, MOST_CLEAR_NOISE = 0.3, 0.1, 0.25
"""Beyond this scale, or with this scatter over the size of a window, the paths are unlike; the third where a
delay fits clearly better than none."""


@dataclass(frozen=True)
class PathModel:
    """Scale error of the gyro (0.1: it reads 1.1 times the turns), and seconds by which positions are late.

    `rest` is what a delay leaves of the residuals, over what none leaves.
    """

    gyro_scale: BootstrapInterval
    delay_s: BootstrapInterval
    windows: int
    rest: float = 0.0


@dataclass(frozen=True)
class _Windows:
    """Dead reckoning (wheels and gyro, on the wheels' times) and the positions, window by window."""

    t: Array
    v: Array
    turned: Array
    t_fix: Array
    place: Complex
    rows: list[slice]

    @functools.cached_property
    def _measured(self) -> list[Complex]:
        """Dead reckoning by the gyro as it is, from which all delays are tried."""
        return self._dead_reckoned(0.0, 0.0)

    def _dead_reckoned(self, scale: float, bias: float) -> list[Complex]:
        """Path, its derivatives by scale and bias, velocity and heading, each (N,) on the wheels' times."""
        ahead = np.exp(1j * ((1.0 + scale) * self.turned + bias * self.t))
        velocity = self.v * ahead
        rates = velocity, 1j * self.turned * self.v * ahead, 1j * self.t * self.v * ahead
        return [*(cumulative(self.t, rate) for rate in rates), velocity, ahead]

    def steps(self, unknown: Array) -> Iterator[tuple[Array, Array]]:
        """For each window the normal equations of the common unknowns: columns (2n, 5) and residual (2n,)."""
        scale, delay_s, forward, left, bias = unknown.tolist()
        lever = complex(forward, left)
        columns = self._measured if scale == bias == 0.0 else self._dead_reckoned(scale, bias)
        at = self.t_fix - delay_s
        P, K, B, V, E = (np.interp(at, self.t, column) for column in columns)
        for rows in self.rows:
            p, g = P[rows] + lever * E[rows], self.place[rows]
            p, g = p - p.mean(), g - g.mean()
            power = float(np.vdot(p, p).real)
            factor = np.vdot(p, g) / power if power > 0.0 else 0j
            if abs(factor) < 0.2 or abs(factor) > 5.0:
                continue
            # These are orthogonal, as the positions are about their mean.
            free = _real(np.stack([np.ones_like(p), 1j * np.ones_like(p), p, 1j * p], axis=1))
            Q = free / np.linalg.norm(free, axis=0)
            common = _real(np.stack([K[rows], -V[rows], E[rows], 1j * E[rows], B[rows]], axis=1))
            residual = _real(((g / factor) - p)[:, None])[:, 0]
            yield common - Q @ (Q.T @ common), residual - Q @ (Q.T @ residual)


def _real(columns: Complex) -> Array:
    return np.concatenate([columns.real, columns.imag])


@once
def model_by_fixes(context: CheckContext) -> PathModel | None:
    """By the path of the fixes; None where wheels, gyro or windows are too few, or the paths are unlike."""
    return _path_model(context, path_by(context.recording, "gnss"))


@once
def model_by_truth(context: CheckContext) -> PathModel | None:
    """By the path of the truth; None likewise."""
    return _path_model(context, path_by(context.recording, "truth"))


def _path_model(context: CheckContext, measured: MeasuredPath | None) -> PathModel | None:
    if measured is None:
        return None
    wide = _windows(context, measured, LONGEST_FAR_S)
    far_s = _far_start(wide) if wide is not None else None
    if wide is not None and far_s is not None:
        return _fitted(wide, far_s, far_s, CLEARLY)
    windows = _windows(context, measured, LONGEST_S)
    if windows is None:
        return None
    rest, start_s = min((_rest(windows, s), s) for s in STARTS_S.tolist())
    return _fitted(windows, start_s, 0.0, rest / max(_rest(windows, 0.0), 1e-9))


def _far_start(windows: _Windows) -> float | None:
    """A delay of many seconds that fits clearly better than a usual one, also of a mirrored path: a figure of
    eight looks like its own mirror image half a round later."""
    mirrored = dataclasses.replace(windows, place=windows.place.conj())
    near = min(_rest(one, s) for one in (windows, mirrored) for s in STARTS_S.tolist())
    rest, far_s = min((_rest(windows, s), s) for s in FAR_STARTS_S.tolist())
    return far_s if rest < CLEARLY * near else None


def _fitted(windows: _Windows, start_s: float, usual_s: float, rest: float) -> PathModel | None:
    """The model by steps from a delay; None where they lead too far, or the paths are unlike."""
    unknown, usual = np.array([0.0, start_s, 0.0, 0.0, 0.0]), np.array([0.0, usual_s, 0.0, 0.0, 0.0])
    for _ in range(STEPS):
        H, h, noise = _normal(windows, unknown)
        if len(H) < LEAST_WINDOWS:
            return None
        prior = np.diag(noise**2 / PRIOR**2)
        unknown = unknown + np.linalg.solve(H.sum(axis=0) + prior, h.sum(axis=0) - prior @ (unknown - usual))
        if abs(unknown[1] - usual_s) > LONGEST_S or abs(unknown[0]) > MOST_SCALE:
            return None
    H, h, noise = _normal(windows, unknown)
    most_noise = MOST_CLEAR_NOISE if rest <= CLEARLY else MOST_NOISE
    size_m = np.median([np.std(windows.place[rows]) for rows in windows.rows])
    if len(H) < LEAST_WINDOWS or noise > most_noise * size_m:
        return None
    prior = np.diag(noise**2 / PRIOR**2)
    draws = resampled_rows(len(H))
    right = h[draws].sum(axis=1) - prior @ (unknown - usual)
    drawn = unknown + np.linalg.solve(H[draws].sum(axis=1) + prior, right[..., None])[..., 0]
    # The unknown multiplies what the gyro reads; its error is what it reads over the turns, less one.
    unknown[0], drawn[:, 0] = 1.0 / (1.0 + unknown[0]) - 1.0, 1.0 / (1.0 + drawn[:, 0]) - 1.0
    scale, delay = (
        interval_of(float(unknown[k]), drawn[:, k], len(H))
        if _contributing(H[:, k, k]) >= LEAST_CONTRIBUTING
        else BootstrapInterval(float(unknown[k]), -np.inf, np.inf)
        for k in range(2)
    )
    return PathModel(scale, delay, len(H), rest)


def _contributing(information: Array) -> float:
    """How many windows share the information (W,) on a number, if they did so equally."""
    total = float(information.sum())
    return total**2 / float(np.sum(information**2)) if total > 0.0 else 0.0


def _windows(context: CheckContext, measured: MeasuredPath, longest_s: float) -> _Windows | None:
    from scipy.ndimage import median_filter

    driven = driven_and_turned(context)
    if driven is None:
        return None
    t, v, turned = driven
    inside = (measured.t_s >= t[0] + longest_s) & (measured.t_s <= t[-1] - longest_s)
    t_fix, place = measured.t_s[inside], measured.place[inside]
    if turned is None or len(t_fix) < LEAST_WINDOWS * LEAST_ROWS:
        return None
    stride = max(1, int(1.0 / (MOST_HZ * max(float(np.median(np.diff(t_fix))), 1e-3))))
    t_fix, place = t_fix[::stride], place[::stride]
    length_s = float(np.clip(SIGMAS * measured.sigma_m / max(float(np.abs(v).mean()), 1e-3), *WINDOW_S))
    length_s = min(length_s, float(t_fix[-1] - t_fix[0]) / (LEAST_WINDOWS + 1))
    number = ((t_fix - t_fix[0]) / length_s).astype(int)
    edges = np.flatnonzero(np.diff(number, prepend=-1, append=number[-1] + 1))
    rows = [slice(a, b) for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)]
    far = max(2.0, 5.0 * measured.sigma_m)
    rows = [
        row
        for row in rows
        if row.stop - row.start >= LEAST_ROWS and np.ptp(place[row].real) + np.ptp(place[row].imag) > far
    ]
    if np.median(np.diff(t)) < SPIKES_S:
        v = median_filter(v, 3)
    return _Windows(t, v, turned, t_fix, place, rows) if len(rows) >= LEAST_WINDOWS else None


def _rest(windows: _Windows, delay_s: float) -> float:
    """Sum of the residuals' sizes at a delay, after the best scale and lever arm of each window."""
    total = 0.0
    for common, residual in windows.steps(np.array([0.0, delay_s, 0.0, 0.0, 0.0])):
        columns = common[:, [0, 2, 3, 4]]
        fitted = columns @ np.linalg.lstsq(columns, residual, rcond=1e-6)[0]
        total += float(np.abs(residual - fitted).sum())
    return total


def _normal(windows: _Windows, unknown: Array) -> tuple[Array, Array, float]:
    """Normal equations (W, 5, 5) and (W, 5) of the windows with Huber weights, and the residuals' 1 sigma."""
    steps = list(windows.steps(unknown))
    if not steps:
        return np.zeros((0, 5, 5)), np.zeros((0, 5)), 0.0
    sizes = np.abs(np.concatenate([residual for _, residual in steps]))
    noise = max(1.4826 * float(np.median(sizes)), 1e-3)
    H, h = [], []
    for common, residual in steps:
        weight = np.minimum(1.0, HUBER * noise / np.maximum(np.abs(residual), 1e-9))
        H.append(common.T @ (weight[:, None] * common))
        h.append(common.T @ (weight * residual))
    return np.array(H), np.array(h), noise
