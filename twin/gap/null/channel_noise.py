"""Noise of each channel, learnt from the reference runs."""

from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.noise import ResidualNoise, autoregressive, clipped, sheet_correlation
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.samples import Indices, by_channel, sample_map
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.rollout.residuals import (
    RunResiduals,
    initial_state_sigma,
    noise_sigma,
    physical_error,
    whitened,
)
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise, learn_gain, without_shared

Series = list[tuple[Indices, Array]]  # slots and residuals of a channel in each window

ANY_SIZE = 30.0  # 1 sigma of effects of any size, and of functions of the commands, in their units (assumed)
LEAST_SCALE = 0.2  # least scale of a channel's noise, in that of its data sheet (assumed)


def data_sheet_noise(runs: Sequence[RunResiduals]) -> ChannelNoise:
    """Noise of the data sheets' sigma and correlation, by channel."""
    out, lags = ChannelNoise({}), _lags(runs)
    for channel in dict.fromkeys(o.channel for run in runs for o in run.log.observed):
        rho = _sheet_correlation(runs, channel, lags[channel]) or (1.0,)
        out[channel] = ResidualNoise(1.0, rho)
    return out


def learn_noise(
    references: Sequence[RunResiduals],
    judged: Sequence[RunResiduals],
    candidates: Candidates,
    jobs: int = 1,
    before: ChannelNoise | None = None,
) -> ChannelNoise:
    """Scale and correlation in time of the noise, by channel, and of the errors that channels share.

    Theta, effects and poses are fitted to each reference run (ridge, one typical size) and the residuals are
    noise. Without references the judged runs are used, with effects of any size: or a large one would pass
    for noise.

    Args:
        before: noise learnt from nearly the same residuals; None: two rounds from that of the data sheets.
    """
    runs, size = (references, 1.0) if references else (judged, ANY_SIZE)
    every = [*judged, *references]
    noise = before or data_sheet_noise(every)
    sigma, lags = initial_state_sigma(candidates), _lags(every)
    for _ in range(1 if before else 2):
        now, series = noise, dict[str, Series]()
        rests = in_threads(jobs, lambda run, now=now: _fit_residuals(run, now, sigma, size), runs)
        turn = learn_gain((run.log, rest) for run, rest in zip(runs, rests, strict=True))
        for run, rest in zip(runs, rests, strict=True):
            for channel, pairs in _series(run, now, turn, rest).items():
                series.setdefault(channel, []).extend(pairs)
        found = {c: _channel_noise(c, series.get(c, []), every, now[c], lags[c]) for c in now}
        noise = ChannelNoise(found, turn)
    return noise


def _lags(runs: Sequence[RunResiduals]) -> dict[str, int]:
    """Number of lags of the longest window, by channel."""
    out: dict[str, int] = {}
    for run in runs:
        for i, _, rows in sample_map(run.log).blocks:
            observed = run.log.observed[i]
            out[observed.channel] = max(out.get(observed.channel, 1), int(np.ptp(observed.slot[rows])) + 1)
    return out


def _sheet_correlation(runs: Sequence[RunResiduals], channel: str, lags: int) -> tuple[float, ...] | None:
    """That of the first run whose channel has one."""
    mine = (o for run in runs for o in run.log.observed if o.channel == channel)
    return next((rho for o in mine if (rho := sheet_correlation(o, lags)) is not None), None)


def _channel_noise(
    channel: str, series: Series, every: Sequence[RunResiduals], before: ResidualNoise, lags: int
) -> ResidualNoise:
    values = np.concatenate([v for _, v in series]) if series else np.zeros(0)
    if len(values) < 4:
        return before
    rho = _sheet_correlation(every, channel, lags)
    if rho is None:
        rho = autoregressive([(s, clipped(v)) for s, v in series], lags)
    plain = ResidualNoise(1.0, rho)
    white = np.concatenate([plain.whiten(s, np.ones(len(s)), v[:, None])[:, 0] for s, v in series])
    robust = 1.4826 * float(np.median(np.abs(white)))
    return ResidualNoise(
        max(float(np.sqrt(np.mean(np.minimum(white**2, (4.0 * robust) ** 2)))), LEAST_SCALE), rho
    )


def _fit_residuals(run: RunResiduals, noise: ChannelNoise, sigma: Array, size: float) -> list[Array]:
    """Residuals of one run after a fit of its states, effects (1 sigma `size`) and poses, one array (n,) a
    channel, zero outside the windows."""
    white = whitened(run.without_nuisance(), noise)
    prior = np.append(sigma**-2.0, np.full(run.effects, size**-2.0))
    rows, K = white.rows.astype(float), len(prior)
    fit = np.linalg.solve(white.gram[:K, :K] + np.diag(prior), white.gram[:K, -1])
    return by_channel(run.log, physical_error(white, noise, rows[:, -1] - rows[:, :-1] @ fit))


def _series(run: RunResiduals, noise: ChannelNoise, turn: float, rest: Sequence[Array]) -> dict[str, Series]:
    """Residuals without shared errors, in sigmas of the data sheets, by channel and window."""
    own = without_shared(run.log, turn, [r[:, None] for r in rest])
    out = dict[str, Series]()
    for i, _, mine in sample_map(run.log).blocks:
        observed = run.log.observed[i]
        values = own[i][mine, 0] / noise_sigma(observed, noise[observed.channel])[mine]
        out.setdefault(observed.channel, []).append((observed.slot[mine], values))
    return out
