"""The noise of each channel, as the reference runs show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.noise import ResidualNoise, autoregressive, clipped, gauss_markov
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.samples import layout
from terrafusion.twin.gap.rollout.residuals import (
    Raw,
    projected,
    stacked,
    state_sigmas,
    whitened_columns,
    without_probes,
)

Array = NDArray[np.float64]
Series = list[tuple[NDArray[np.int64], Array]]
"""Slots and residuals of a channel in each window."""

ANY_SIZE = 30.0
"""1 sigma of effects, in typical sizes, in a run that is judged by itself (assumed)."""
LEAST_SCALE = 0.2
"""No channel is taken as better than this share of what its data sheet and scatter say (assumed)."""


def first_noise(runs: Sequence[Raw]) -> dict[str, ResidualNoise]:
    """White noise of the data sheets' sigma, with the correlation they tell, by channel."""
    out: dict[str, ResidualNoise] = {}
    for run in runs:
        lags = _lags([run])
        for observed in run.log.observed:
            if observed.channel not in out:
                rho = _sheet_rho([run], observed.channel, lags[observed.channel]) or (1.0,)
                out[observed.channel] = ResidualNoise(1.0, rho)
    return out


def learnt_noise(
    references: Sequence[Raw],
    judged: Sequence[Raw],
    candidates: Candidates,
    jobs: int = 1,
    before: dict[str, ResidualNoise] | None = None,
) -> dict[str, ResidualNoise]:
    """Noise by channel, from residuals of reference runs that are fitted with all that could differ.

    What theta, a common set of effects and the poses explain is taken out (ridge, one typical size); what
    is left is noise, its scale and its correlation in time. Without references the judged runs must tell it:
    then effects of any size are taken out, or a large one would pass for noise.

    Args:
        before: noise learnt from nearly the same residuals; None: from that of the data sheets in two rounds.
    """
    runs, size = (references, 1.0) if references else (judged, ANY_SIZE)
    every = [*judged, *references]
    noise, sigma, lags = before or first_noise(every), state_sigmas(candidates), _lags(every)
    with ThreadPoolExecutor(jobs) as pool:
        for _ in range(1 if before else 2):
            now, series = noise, dict[str, Series]()
            for found in pool.map(lambda run, now=now: _left_over(run, now, sigma, size), runs):
                for channel, pairs in found.items():
                    series.setdefault(channel, []).extend(pairs)
            noise = {c: _noise(c, series.get(c, []), every, now[c], lags[c]) for c in now}
    return noise


def _lags(runs: Sequence[Raw]) -> dict[str, int]:
    """Number of lags of the longest window, by channel."""
    out: dict[str, int] = {}
    for run in runs:
        for i, _, rows in layout(run.log).blocks:
            observed = run.log.observed[i]
            out[observed.channel] = max(out.get(observed.channel, 1), int(np.ptp(observed.slot[rows])) + 1)
    return out


def _sheet_rho(runs: Sequence[Raw], channel: str, lags: int) -> tuple[float, ...] | None:
    for run in runs:
        for observed in run.log.observed:
            if observed.channel == channel and observed.correlation is not None:
                share, time_s = observed.correlation
                return gauss_markov(share, time_s, observed.slot_s, lags)
    return None


def _noise(
    channel: str, series: Series, every: Sequence[Raw], before: ResidualNoise, lags: int
) -> ResidualNoise:
    values = np.concatenate([v for _, v in series]) if series else np.zeros(0)
    if len(values) < 4:
        return before
    rho = _sheet_rho(every, channel, lags)
    if rho is None:
        rho = autoregressive([(s, clipped(v)) for s, v in series], lags)
    white = _whitened_series(ResidualNoise(1.0, rho), series)
    robust = 1.4826 * float(np.median(np.abs(white)))
    return ResidualNoise(
        max(float(np.sqrt(np.mean(np.minimum(white**2, (4.0 * robust) ** 2)))), LEAST_SCALE), rho
    )


def _whitened_series(noise: ResidualNoise, series: Series) -> Array:
    """All residuals, white; windows whose rows are as far apart are whitened together."""
    alike: dict[bytes, Series] = {}
    for slots, values in series:
        alike.setdefault(np.diff(slots).tobytes(), []).append((slots, values))
    parts = [
        noise.whiten(some[0][0], np.ones(len(some[0][0])), np.column_stack([v for _, v in some])).ravel()
        for some in alike.values()
    ]
    return np.concatenate(parts)


def _left_over(run: Raw, noise: Mapping[str, ResidualNoise], sigma: Array, size: float) -> dict[str, Series]:
    """Residuals of one run after its own fit, in first-guess sigmas, by channel and window; `size` is 1 sigma
    of the effects."""
    plain = without_probes(run)
    white = whitened_columns(run.log, noise, stacked(plain))
    evidence = projected(plain, white)
    prior = np.concatenate([1.0 / sigma**2, np.full(run.change[0].shape[1], size**-2.0)])
    K = len(prior)
    fit = np.linalg.solve(evidence.gram[:K, :K] + np.diag(prior), evidence.gram[:K, -1])
    pose = _best_poses(evidence.window, white[:, -3:], white[:, K] - white[:, :K] @ fit)
    out: dict[str, Series] = {}
    for i, k, rows in layout(run.log).blocks:
        observed = run.log.observed[i]
        left = run.error[i][rows] - run.state[i][rows] @ fit[: len(sigma)]
        left -= run.change[i][rows] @ fit[len(sigma) :] + run.pose[i][rows] @ pose[k]
        out.setdefault(observed.channel, []).append((observed.slot[rows], left / observed.sigma[rows]))
    return out


def _best_poses(window: NDArray[np.int64], columns: Array, left: Array) -> dict[int, Array]:
    """The pose (3,) of each window that explains most of what is left (n,)."""
    out = {}
    for k in np.unique(window):
        mine = columns[window == k]
        out[int(k)] = np.linalg.solve(1e-6 * np.eye(3) + mine.T @ mine, mine.T @ left[window == k])
    return out
