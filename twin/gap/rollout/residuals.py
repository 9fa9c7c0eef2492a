"""One-run evidence: prediction errors of every channel, whitened, and their derivatives.

A run's residual is e = J_phi phi + J_theta theta + Q pose + noise: phi the effects' parameters and the
probes, theta what legitimately varies from run to run (soil strength, turn-on offsets), pose the start of
each window. The poses are projected out at once; theta stays, its variance is learnt from the references.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.poses import settled_start
from terrafusion.twin.gap.data.samples import layout
from terrafusion.twin.gap.rollout import nuisance as probes
from terrafusion.twin.gap.rollout.sensitivities import (
    Ask,
    Drive,
    Signature,
    drive,
    placed,
    settled_predictions,
    signatures,
)
from terrafusion.twin.model.vehicle import VehicleParams

Array = NDArray[np.float64]

SOIL_STATE = {"soil_strength/shear": 0.5, "soil_strength/bearing": 0.5, "motion_resistance/rolling": 0.3}
"""Columns that vary from run to run as the ground does, and their first 1 sigma in scales (assumed)."""
OFFSETS = {"yaw_rate_radps": 0.001, "accel_x_mps2": 0.02, "accel_y_mps2": 0.02}
"""Channels of the IMU with a turn-on offset, and its first 1 sigma (assumed)."""
CURRENTS = ("current_left_a", "current_right_a")
"""Channels with an offset and a gain, drawn anew with every run, of the vehicle file's 1 sigma."""
LEAST_OFFSET_A, LEAST_GAIN = 0.05, 1e-3
"""Least 1 sigma of those (assumed)."""
SAME_YAW_RAD = 0.2
"""Runs that were told the same share a signature where they set out within such a sector of headings."""
MOST_SOIL = 4.0
"""A run's own ground is looked for within so many typical sizes."""
REACH = 3.0
"""It is also looked for within so many sigmas of how the references' grounds scatter: what goes beyond is
something to be found."""
GROUND_STEPS, ENOUGH, GOOD = 4, 0.97, 1.2
"""Steps of that search; it ends when one gains less than 3 %, or the errors are near the noise."""
WITHIN = 0.98
"""Share of its range in which a parameter is looked for."""
OUTLIER_SIGMAS, ROBUST_STEPS = 4.0, 8
"""Errors beyond so many sigmas of the channel's noise do not pull on a run's states (one in 16 000 normal
errors is); steps of that fit."""
NUISANCE = 0.3
"""1 sigma of the effects, in typical sizes, while a run's own ground is looked for."""


@dataclass(frozen=True, eq=False)
class Raw:
    """One run before whitening; lists hold one entry a channel of `log.observed`.

    Attributes:
        own: (S,) the run's own ground, in typical sizes from the model's, in the order of `SOIL_STATE`.
        error: (n,) measured less predicted, linearised about that ground (see `at_own_ground`).
        state, change, probe, pose: (n, T), (n, K), (n, G) and (n, 3) derivatives.
    """

    log: PreparedLog
    own: Array
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
        gain: (T, n) states by an error, as ridge regression has them; no rows where nothing is bounded.
        limit: by channel, beyond which what the states leave of an error counts as so much (see `outliers`).
    """

    name: str
    log: PreparedLog
    gram: Array
    rows: NDArray[np.float32]
    frame: Array
    channel: NDArray[np.int64]
    time_s: Array
    window: NDArray[np.int64]
    seconds: float
    states: int
    gain: Array
    limit: Array


@dataclass(eq=False)
class Drives:
    """Signatures by the twin and what it was told: runs that repeat a drive share one."""

    model: Model
    candidates: Candidates
    kept: dict[str, Drive] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)

    def name(self, log: PreparedLog) -> str:
        """What runs that share a signature have in common."""
        sector = np.round(log.start[:1, 2] / SAME_YAW_RAD) + 0.0  # no negative zero
        key = hashlib.sha256(sector.tobytes())
        for part in (log.sides, log.windows, log.borders):
            key.update(np.ascontiguousarray(part).tobytes())
        key.update(repr((log.labels, self.candidates.keys, sorted(self.model.effects.items()))).encode())
        return key.hexdigest()

    def of(self, log: PreparedLog) -> Drive:
        """The drive of a log, from the poses of the first run that was told the same."""
        name = self.name(log)
        with self.lock:
            known = self.kept.get(name)
        if known is None:
            known = drive(log, self.model, self.candidates, log.start)
            with self.lock:
                self.kept[name] = known
        return known


def raw(log: PreparedLog, drives: Drives, channels: Sequence[str]) -> Raw:
    """Errors and derivatives of a run.

    Args:
        channels: observed channels of all runs, for which there are probes.

    Raises:
        TerrafusionError: the twin diverges.
    """
    found = drives.of(log)
    own = placed(log, signatures(log, found), found.start, log.start)
    start, before = settled_start(log, [s.value for s in own], log.start), log.start
    if drives.candidates.any_world_fixed(drives.model.effects):  # it does not turn as a whole
        own = signatures(log, drive(log, drives.model, drives.candidates, start))
        start, before = settled_start(log, [s.value for s in own], start), start
    return raw_of(log, placed(log, own, before, start), drives.model, drives.candidates, channels)


def raw_of(
    log: PreparedLog,
    found: Sequence[Signature],
    model: Model,
    candidates: Candidates,
    channels: Sequence[str],
) -> Raw:
    """Errors and derivatives of a run, from its signatures."""
    keys = candidates.keys
    soil = [keys.index(name) for name in SOIL_STATE if name in keys]
    error, state, change, probe, pose = [], [], [], [], []
    for observed, s in zip(log.observed, found, strict=True):
        error.append(observed.value - s.value)
        state.append(np.hstack([s.change[:, soil], _sensor_states(observed.channel, s.value, model.vehicle)]))
        change.append(s.change)
        probe.append(probes.columns(log, model, observed, s, channels))
        pose.append(s.by_pose)
    return Raw(log, np.zeros(len(soil)), error, state, change, probe, pose)


def _sensor_states(channel: str, predicted: Array, vehicle: VehicleParams) -> Array:
    """Columns (n, 7) of a channel by what its sensor does anew in every run: offsets, then gains."""
    columns = np.zeros((len(predicted), len(OFFSETS) + 2 * len(CURRENTS)))
    if channel in OFFSETS:
        columns[:, list(OFFSETS).index(channel)] = OFFSETS[channel]
    if channel in CURRENTS:
        at, current = len(OFFSETS) + CURRENTS.index(channel), vehicle.realism.current
        columns[:, at] = max(current.offset_sigma_a, LEAST_OFFSET_A)
        columns[:, at + len(CURRENTS)] = max(current.gain_sigma, LEAST_GAIN) * predicted
    return columns


@dataclass(eq=False)
class _Search:
    """A run on its way to its own ground: where it is, errors there and what they cost."""

    run: Raw
    evidence: Evidence
    own: Array
    errors: list[Array]
    cost: float
    gain: Array
    going: bool = True

    def take(self, tried: Array, found: Sequence[Array] | None, noise: Mapping[str, ResidualNoise]) -> None:
        """A step is taken as long as it lowers the errors."""
        self.going = False
        if found is None:
            return
        error = [o.value - y for o, y in zip(self.run.log.observed, found, strict=True)]
        white = whitened_error(self.run, self.evidence, noise, error)
        now, before = float(white @ white), self.cost
        if now < before:
            self.gain = self.evidence.rows[:, :-1].astype(float).T @ white
            self.own, self.errors, self.cost = tried, error, now
            self.going = ENOUGH * before >= now >= GOOD * len(self.evidence.time_s)


def at_own_ground(
    runs: Sequence[Raw],
    drives: Drives,
    noise: Mapping[str, ResidualNoise],
    most: Array | float = MOST_SOIL,
    jobs: int = 1,
) -> list[Raw]:
    """Runs with errors linearised about their own grounds, not about that of the references.

    Slip grows steeply with the ground's strength; to first order, a run on softer ground would show a gap.
    The twin is run on the ground that suits each run, as long as that lowers the errors, and the way there
    is carried back linearly.

    Args:
        most: the ground is looked for within so many typical sizes (S,).
    """

    def begun(run: Raw) -> _Search:
        evidence = whitened(without_probes(run), noise)
        cost, gain = float(evidence.gram[-1, -1]), evidence.gram[:-1, -1]
        return _Search(run, evidence, run.own, run.error, cost, gain)

    def tried(search: _Search) -> tuple[dict[str, float], Array]:
        step = _soil_step(search.evidence, search.gain, drives.candidates, len(search.own))
        return on_own_ground(np.clip(search.own + step, -most, most), drives, {})

    with ThreadPoolExecutor(jobs) as threads:
        searches = list(threads.map(begun, runs))
        for _ in range(GROUND_STEPS):
            going = [search for search in searches if search.going]
            there = list(threads.map(tried, going))
            asks = [Ask(s.run.log, effects) for s, (effects, _) in zip(going, there, strict=True)]
            found = settled_predictions(asks, drives.model, drives.candidates, jobs)
            for _ in threads.map(_Search.take, going, [own for _, own in there], found, [noise] * len(found)):
                pass
    return [
        dataclasses.replace(s.run, own=s.own, error=carried_back(s.run, s.own, s.errors)) for s in searches
    ]


def carried_back(run: Raw, own: Array, errors: Sequence[Array]) -> list[Array]:
    """Errors on the run's own ground (S,) as they would be on the model's, to first order."""
    return [e + s[:, : len(own)] @ own for e, s in zip(errors, run.state, strict=True)]


def on_own_ground(own: Array, drives: Drives, effects: Mapping[str, float]) -> tuple[dict[str, float], Array]:
    """Effects with the ground as far (S,) from the model's, or from theirs, as the run's own is, within its
    range; and how far it so is: what is not driven must not be carried back."""
    c, out, driven = drives.candidates, dict(effects), own.copy()
    for k, name in enumerate(name for name in SOIL_STATE if name in c.keys):
        i = c.keys.index(name)
        base = effects.get(name, drives.model.effects.get(name, 0.0))
        low, high = min(WITHIN * c.low[i], base), max(WITHIN * c.high[i], base)
        out[name] = float(np.clip(base + own[k] * c.scale[i], low, high))
        driven[k] = (out[name] - base) / c.scale[i]
    return out, driven


def reach(runs: Sequence[Raw], candidates: Candidates) -> Array:
    """How far (S,) the ground of a run may lie from the model's, by those of the references; the first guess
    counts as one of them."""
    first = np.array([sigma for name, sigma in SOIL_STATE.items() if name in candidates.keys])
    squares = sum((run.own**2 for run in runs), first**2)
    return np.minimum(REACH * np.sqrt(squares / (1 + len(runs))), MOST_SOIL)


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


def state_sigmas(candidates: Candidates) -> Array:
    """First 1 sigma (T,) of the states, in units of their columns."""
    soil = [sigma for name, sigma in SOIL_STATE.items() if name in candidates.keys]
    return np.array([*soil, *np.ones(len(OFFSETS) + 2 * len(CURRENTS))])


def whitened_columns(log: PreparedLog, noise: Mapping[str, ResidualNoise], columns: Sequence[Array]) -> Array:
    """Columns (n, k) of all channels, one array a channel, in units and axes in which its noise is white."""
    out = np.empty((sum(map(len, columns)), columns[0].shape[1]))
    for i, rows, places in layout(log).alike:
        observed = log.observed[i]
        out[places] = noise[observed.channel].whiten_alike(
            observed.slot[rows[0]], observed.sigma[rows], columns[i][rows]
        )
    return out


def whitened(run: Raw, noise: Mapping[str, ResidualNoise]) -> Evidence:
    """The run in units and axes in which its noise is white."""
    return projected(run, whitened_columns(run.log, noise, stacked(run)))


def stacked(run: Raw) -> list[Array]:
    """State, change, probe, error and pose columns of each channel, side by side."""
    by_channel = zip(run.state, run.change, run.probe, run.error, run.pose, strict=True)
    return [np.column_stack(parts) for parts in by_channel]


def projected(run: Raw, white: Array) -> Evidence:
    """The evidence of whitened columns (n, T + P + 4), as `stacked` has them: the poses are projected out."""
    parts = layout(run.log).blocks
    channel = np.concatenate([np.full(len(rows), i) for i, _, rows in parts])
    window = np.concatenate([np.full(len(rows), k) for _, k, rows in parts])
    middle = [0.5 * (o.begin_s + o.end_s) for o in run.log.observed]
    rows_, frame = white[:, :-3], white[:, -3:].copy()
    out = np.empty_like(rows_)
    for k in np.unique(window):
        mine = window == k
        frame[mine] = Q = _orthonormal(frame[mine])
        own = rows_[mine]
        out[mine] = own - Q @ (Q.T @ own)
    return Evidence(
        run.log.name, run.log, out.T @ out, out.astype(np.float32), frame, channel,
        np.concatenate([middle[i][rows] for i, _, rows in parts]), window, run.log.seconds(),
        run.state[0].shape[1], np.zeros((0, len(window))), np.full(len(run.log.observed), np.inf),
    )  # fmt: skip


def _orthonormal(columns: Array) -> Array:
    """Orthonormal columns (n, 3) that span those given; zero for those that say nothing."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    out = np.zeros_like(columns)
    out[:, : left.shape[1]] = left * (sizes > 1e-6 * max(float(sizes[0]), 1e-12))
    return out


def whitened_error(
    run: Raw, evidence: Evidence, noise: Mapping[str, ResidualNoise], error: Sequence[Array]
) -> Array:
    """Another error (n,) of the run in the evidence's rows, poses projected out, within its limits."""
    out = whitened_columns(run.log, noise, [e[:, None] for e in error])[:, 0]
    for k in np.unique(evidence.window):
        mine = evidence.window == k
        out[mine] -= evidence.frame[mine] @ (evidence.frame[mine].T @ out[mine])
    return within_limits(evidence, out)


def explained(J: Array, gain: Array, error: Array, limit: float, steps: int) -> Array:
    """Part (n,) of an error that a run's states explain, by their columns J (n, T) and `gain` (T, n); what
    is beyond the limit does not pull on them (Huber 1964)."""
    told = np.zeros(len(error))
    for _ in range(steps):
        told = J @ (gain @ (told + np.clip(error - told, -limit, limit)))
    return told


def within_limits(evidence: Evidence, error: Array) -> Array:
    """A whitened error (n,) of which what the run's states leave is kept within the limits."""
    if not len(evidence.gain):
        return error
    J = evidence.rows[:, : evidence.states].astype(float)
    told = explained(J, evidence.gain, error, OUTLIER_SIGMAS, ROBUST_STEPS)
    most = evidence.limit[evidence.channel]
    return np.asarray(told + np.clip(error - told, -most, most))
