"""One-run evidence: prediction errors of every channel, whitened, and their derivatives.

A run's residual is e = J_phi phi + J_theta theta + Q pose + noise: phi the effects' parameters and the
probes, theta what legitimately varies from run to run (soil strength, turn-on offsets), pose the start of
each window. The poses are projected out at once; theta stays, its variance is learnt from the references.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap import probes
from terrafusion.twin.gap.candidates import Candidates
from terrafusion.twin.gap.poses import all_settled, settled_start
from terrafusion.twin.gap.signatures import Drive, drive, placed, predictions, signatures
from terrafusion.twin.identify.log import Log, window_of
from terrafusion.twin.identify.model import Model
from terrafusion.twin.identify.noise import Noise, autoregressive, clipped, gauss_markov

Array = NDArray[np.float64]

SOIL_STATE = {"soil_strength/shear": 0.5, "soil_strength/bearing": 0.5, "motion_resistance/rolling": 0.3}
"""Columns that vary from run to run as the ground does, and their first 1 sigma in scales (assumed)."""
OFFSETS = {
    "yaw_rate_radps": 0.001, "accel_x_mps2": 0.02, "accel_y_mps2": 0.02,
    "current_left_a": 0.05, "current_right_a": 0.05,
}  # fmt: skip
"""Channels with a turn-on offset, and its first 1 sigma (assumed)."""
SAME_YAW_RAD = 0.2
"""Runs that were told the same share a signature where they set out within such a sector of headings."""
LEAST_SCALE = 0.2
"""No channel is taken as better than this share of what its data sheet and scatter say (assumed)."""
MOST_SOIL = 4.0
"""A run's own ground is looked for within so many typical sizes."""
GROUND_STEPS, ENOUGH, GOOD = 4, 0.97, 1.2
"""Steps of that search; it ends when one gains less than 3 %, or the errors are near the noise."""
NUISANCE = 0.3
"""1 sigma of the effects, in typical sizes, while a run's own ground is looked for."""


@dataclass(frozen=True, eq=False)
class Raw:
    """One run before whitening; lists hold one entry a channel of `log.observed`.

    Attributes:
        error: (n,) measured less predicted, linearised about the run's own ground (see `at_own_ground`).
        state, change, probe, pose: (n, T), (n, K), (n, G) and (n, 3) derivatives.
    """

    log: Log
    error: list[Array]
    state: list[Array]
    change: list[Array]
    probe: list[Array]
    pose: list[Array]


@dataclass(frozen=True, eq=False)
class Evidence:
    """One run, whitened, poses projected out: all inner products of [state, change, probe, error].

    Attributes:
        name: of the recording.
        gram: (T + P + 1, T + P + 1) inner products.
        rows: (n, T + P + 1) the rows themselves, channel, time and window of each.
        frame: (n, 3) orthonormal columns a window, along which the poses move the rows.
        seconds: length.
        states: T.
        told: (n,) part of the error that the run's own states explain.
        limit: by channel, beyond which what they leave counts as this much (see `outliers`).
    """

    name: str
    log: Log
    gram: Array
    rows: NDArray[np.float32]
    frame: Array
    channel: NDArray[np.int64]
    time_s: Array
    window: NDArray[np.int64]
    seconds: float
    states: int
    told: Array
    limit: Array


@dataclass(eq=False)
class Drives:
    """Signatures by the twin and what it was told: runs that repeat a drive share one."""

    model: Model
    candidates: Candidates
    kept: dict[str, Drive] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)

    def name(self, log: Log) -> str:
        """What runs that share a signature have in common."""
        sector = np.round(log.start[:1, 2] / SAME_YAW_RAD) + 0.0  # no negative zero
        key = hashlib.sha256(sector.tobytes())
        for part in (log.sides, log.windows, log.borders):
            key.update(np.ascontiguousarray(part).tobytes())
        key.update(repr((log.labels, self.candidates.keys, sorted(self.model.effects.items()))).encode())
        return key.hexdigest()

    def of(self, log: Log) -> Drive:
        """The drive of a log, from the poses that the log itself suggests."""
        name = self.name(log)
        with self.lock:
            known = self.kept.get(name)
        if known is None:
            known = drive(log, self.model, self.candidates, log.start)
            with self.lock:
                self.kept[name] = known
        return placed(known, log, log.start)


def raw(log: Log, drives: Drives, channels: Sequence[str]) -> Raw:
    """Errors and derivatives of a run.

    Args:
        channels: observed channels of all runs, for which there are probes.

    Raises:
        TerrafusionError: the twin diverges.
    """
    found = drives.of(log)
    start = settled_start(log, [s.value for s in signatures(log, found)], log.start)
    return raw_of(log, placed(found, log, start), drives.model, drives.candidates, channels)


def raw_of(log: Log, found: Drive, model: Model, candidates: Candidates, channels: Sequence[str]) -> Raw:
    """Errors and derivatives of a run, from its signature."""
    keys = candidates.keys
    soil = [keys.index(name) for name in SOIL_STATE if name in keys]
    error, state, change, probe, pose = [], [], [], [], []
    for observed, s in zip(log.observed, signatures(log, found), strict=True):
        offsets = np.zeros((len(s.value), len(OFFSETS)))
        if observed.channel in OFFSETS:
            offsets[:, list(OFFSETS).index(observed.channel)] = OFFSETS[observed.channel]
        error.append(observed.value - s.value)
        state.append(np.hstack([s.change[:, soil], offsets]))
        change.append(s.change)
        probe.append(probes.columns(log, model, observed, s, channels))
        pose.append(s.by_pose)
    return Raw(log, error, state, change, probe, pose)


def at_own_ground(run: Raw, drives: Drives, noise: Mapping[str, Noise]) -> Raw:
    """The run with errors linearised about its own ground, not about that of the references.

    Slip grows steeply with the ground's strength; to first order, a run on softer ground would show a gap.
    The twin is run on the ground that suits this run, as long as that lowers the errors, and the way there
    is carried back linearly.
    """
    names = [name for name in SOIL_STATE if name in drives.candidates.keys]
    own, best = np.zeros(len(names)), run
    evidence = whitened(without_probes(run), noise)
    rows, cost = evidence.rows[:, :-1].astype(float), float(evidence.gram[-1, -1])
    gain = evidence.gram[:-1, -1]
    for _ in range(GROUND_STEPS):
        step = _soil_step(evidence, gain, drives.candidates, len(names))
        tried = np.clip(own + step, -MOST_SOIL, MOST_SOIL)
        effects = _soil_at(tried, names, drives)
        told = predictions(run.log, drives.model, drives.candidates, [effects], run.log.start)
        found = all_settled(run.log, told)[0]
        if found is None:
            break
        error = [o.value - y for o, y in zip(run.log.observed, found, strict=True)]
        white = whitened_error(run, evidence, noise, error)
        now, before = float(white @ white), cost
        if now >= before:
            break
        own, best, cost, gain = tried, dataclasses.replace(run, error=error), now, rows.T @ white
        if now > ENOUGH * before or now < GOOD * len(evidence.time_s):
            break
    back = [e + s[:, : len(names)] @ own for e, s in zip(best.error, run.state, strict=True)]
    return dataclasses.replace(run, error=back)


def _soil_step(evidence: Evidence, gain: Array, candidates: Candidates, count: int) -> Array:
    """Step of the ground (T,), in typical sizes, by inner products (K,) of columns and error; effects take
    part as nuisances of lesser size."""
    sigma = state_sigmas(candidates)
    prior = np.concatenate([sigma**-2.0, np.full(len(candidates.keys), NUISANCE**-2.0)])
    prior[:count] = 1.0
    K = len(prior)
    return np.asarray(np.linalg.solve(evidence.gram[:K, :K] + np.diag(prior), gain)[:count])


def without_probes(run: Raw) -> Raw:
    """The run with no probes: they are half of all columns, and only the scores need them."""
    return dataclasses.replace(run, probe=[p[:, :0] for p in run.probe])


def _soil_at(own: Array, names: Sequence[str], drives: Drives) -> dict[str, float]:
    """Soil parameters that lie `own` (T,) typical sizes from the model's; `own` is kept within their
    ranges."""
    c, effects = drives.candidates, {}
    for i, name in enumerate(names):
        at, base = c.keys.index(name), drives.model.effects.get(name, 0.0)
        effects[name] = float(np.clip(base + own[i] * c.scale[at], 0.95 * c.low[at], 0.95 * c.high[at]))
        own[i] = (effects[name] - base) / c.scale[at]
    return effects


def state_sigmas(candidates: Candidates) -> Array:
    """First 1 sigma (T,) of the states, in units of their columns."""
    soil = [sigma for name, sigma in SOIL_STATE.items() if name in candidates.keys]
    return np.array([*soil, *np.ones(len(OFFSETS))])


def whitened(run: Raw, noise: Mapping[str, Noise]) -> Evidence:
    """The run in units and axes in which its noise is white."""
    parts, channels, times, windows = [], [], [], []
    states = run.state[0].shape[1]
    for i, observed in enumerate(run.log.observed):
        of = window_of(observed, run.log.windows)
        columns = np.column_stack([run.state[i], run.change[i], run.probe[i], run.error[i], run.pose[i]])
        for k in np.unique(of):
            rows = np.flatnonzero(of == k)
            parts.append(
                noise[observed.channel].whiten(observed.slot[rows], observed.sigma[rows], columns[rows])
            )
            channels.append(np.full(len(rows), i))
            times.append(0.5 * (observed.begin_s + observed.end_s)[rows])
            windows.append(np.full(len(rows), k))
    M, window = np.concatenate(parts), np.concatenate(windows)
    rows_, frame = M[:, :-3], M[:, -3:].copy()
    for k in np.unique(window):
        mine = window == k
        frame[mine] = _orthonormal(frame[mine])
        rows_[mine] -= frame[mine] @ (frame[mine].T @ rows_[mine])
    return Evidence(
        run.log.name, run.log, rows_.T @ rows_, rows_.astype(np.float32), frame, np.concatenate(channels),
        np.concatenate(times), window, run.log.seconds(), states,
        np.zeros(len(window)), np.full(len(run.log.observed), np.inf),
    )  # fmt: skip


def _orthonormal(columns: Array) -> Array:
    """Orthonormal columns (n, 3) that span those given; zero for those that say nothing."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    out = np.zeros_like(columns)
    out[:, : left.shape[1]] = left * (sizes > 1e-6 * max(float(sizes[0]), 1e-12))
    return out


def whitened_error(run: Raw, evidence: Evidence, noise: Mapping[str, Noise], error: Sequence[Array]) -> Array:
    """Another error (n,) of the run in the evidence's rows, poses projected out, within its limits."""
    parts = []
    for observed, e in zip(run.log.observed, error, strict=True):
        of = window_of(observed, run.log.windows)
        for k in np.unique(of):
            rows = np.flatnonzero(of == k)
            white = noise[observed.channel].whiten(observed.slot[rows], observed.sigma[rows], e[rows, None])
            parts.append(white[:, 0])
    out = np.concatenate(parts)
    for k in np.unique(evidence.window):
        mine = evidence.window == k
        out[mine] -= evidence.frame[mine] @ (evidence.frame[mine].T @ out[mine])
    most = evidence.limit[evidence.channel]
    return np.asarray(evidence.told + np.clip(out - evidence.told, -most, most))


def first_noise(runs: Sequence[Raw]) -> dict[str, Noise]:
    """White noise of the data sheets' sigma, with the correlation they tell, by channel."""
    out: dict[str, Noise] = {}
    for run in runs:
        for observed in run.log.observed:
            out.setdefault(observed.channel, Noise(1.0, _sheet_rho([run], observed.channel) or (1.0,)))
    return out


def _lags(runs: Sequence[Raw], channel: str) -> int:
    spans = [0]
    for run in runs:
        for observed in run.log.observed:
            if observed.channel == channel:
                of = window_of(observed, run.log.windows)
                spans += [int(np.ptp(observed.slot[of == k])) for k in np.unique(of)]
    return max(spans) + 1


def _sheet_rho(runs: Sequence[Raw], channel: str) -> tuple[float, ...] | None:
    for run in runs:
        for observed in run.log.observed:
            if observed.channel == channel and observed.correlation is not None:
                share, time_s = observed.correlation
                return gauss_markov(share, time_s, observed.slot_s, _lags(runs, channel))
    return None


def learnt_noise(runs: Sequence[Raw], every: Sequence[Raw], candidates: Candidates) -> dict[str, Noise]:
    """Noise by channel, from residuals of reference runs that are fitted with all that could differ.

    What theta, a common set of effects and the poses explain is taken out (ridge, one typical size); what
    is left is noise, its scale and its correlation in time.

    Args:
        runs: the references.
        every: all runs, for the longest window.
    """
    noise = first_noise(every)
    for _ in range(2):
        series: dict[str, list[tuple[NDArray[np.int64], Array]]] = {}
        for run in runs:
            for channel, pairs in _left_over(run, noise, state_sigmas(candidates)).items():
                series.setdefault(channel, []).extend(pairs)
        noise = {c: _noise(c, series.get(c, []), every, noise[c]) for c in noise}
    return noise


def _noise(
    channel: str, series: list[tuple[NDArray[np.int64], Array]], every: Sequence[Raw], before: Noise
) -> Noise:
    values = np.concatenate([v for _, v in series]) if series else np.zeros(0)
    if len(values) < 4:
        return before
    rho = _sheet_rho(every, channel)
    if rho is None:
        rho = autoregressive([(s, clipped(v)) for s, v in series], _lags(every, channel))
    white = np.concatenate([Noise(1.0, rho).whiten(s, np.ones(len(v)), v[:, None])[:, 0] for s, v in series])
    robust = 1.4826 * float(np.median(np.abs(white)))
    return Noise(max(float(np.sqrt(np.mean(np.minimum(white**2, (4.0 * robust) ** 2)))), LEAST_SCALE), rho)


def _left_over(
    run: Raw, noise: Mapping[str, Noise], sigma: Array
) -> dict[str, list[tuple[NDArray[np.int64], Array]]]:
    """Residuals of one run after its own fit, in first-guess sigmas, by channel and window."""
    evidence = whitened(without_probes(run), noise)
    G, T = evidence.gram, evidence.states
    prior = np.concatenate([1.0 / sigma**2, np.ones(run.change[0].shape[1])])
    K = len(prior)
    fit = np.linalg.solve(G[:K, :K] + np.diag(prior), G[:K, -1])
    out: dict[str, list[tuple[NDArray[np.int64], Array]]] = {}
    lefts = [e - np.hstack([s, c]) @ fit for e, s, c in zip(run.error, run.state, run.change, strict=True)]
    _project_pose(run, lefts, noise)
    for observed, left in zip(run.log.observed, lefts, strict=True):
        of = window_of(observed, run.log.windows)
        scaled = left / observed.sigma
        out[observed.channel] = [(observed.slot[of == k], scaled[of == k]) for k in np.unique(of)]
    assert len(sigma) == T
    return out


def _project_pose(run: Raw, lefts: list[Array], noise: Mapping[str, Noise]) -> None:
    """Take the best pose of each window out of the residuals, in place."""
    of = [window_of(o, run.log.windows) for o in run.log.observed]
    for k in range(len(run.log.windows)):
        H, g = 1e-6 * np.eye(3), np.zeros(3)
        for observed, left, pose, w in zip(run.log.observed, lefts, run.pose, of, strict=True):
            rows = w == k
            if rows.any():
                both = np.column_stack([pose[rows], left[rows]])
                white = noise[observed.channel].whiten(observed.slot[rows], observed.sigma[rows], both)
                H, g = H + white[:, :3].T @ white[:, :3], g + white[:, :3].T @ white[:, 3]
        d = np.linalg.solve(H, g)
        for left, pose, w in zip(lefts, run.pose, of, strict=True):
            left[w == k] -= pose[w == k] @ d
