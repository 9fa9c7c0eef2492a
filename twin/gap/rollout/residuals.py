"""Residuals of one run: prediction errors of every channel, whitened, with their sensitivities.

The model of a run is e = J_phi phi + J_theta theta + Q pose + noise: phi the parameters of the effects and of
the nuisance basis, theta the states that legitimately vary from run to run (soil, turn-on offsets), pose the
start of each window. Poses are projected out; theta stays, and its variance is learnt from the references.
"""

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.poses import aligned_start
from terrafusion.twin.gap.data.samples import Indices, by_channel, sample_map, with_observed
from terrafusion.twin.gap.rollout.batch import SOIL_SIGMAS
from terrafusion.twin.gap.rollout.measured_turns import with_heading_errors
from terrafusion.twin.gap.rollout.nuisance import nuisance_columns
from terrafusion.twin.gap.rollout.sensitivities import (
    Linearisation,
    Sensitivity,
    channel_sensitivities,
    linearise,
    moved_to,
    turned,
)
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise, with_shared, without_shared
from terrafusion.twin.model.vectors import soil_vector
from terrafusion.twin.model.vehicle import VehicleParams

OFFSET_SIGMAS = {"yaw_rate_radps": 0.001, "accel_x_mps2": 0.02, "accel_y_mps2": 0.02}
"""IMU channels with a turn-on offset, and its first 1 sigma (assumed)."""
CURRENTS = ("current_left_a", "current_right_a")
"""Channels with an offset and a gain that are drawn with every run, of the vehicle file's 1 sigma."""
LEAST_OFFSET_A, LEAST_GAIN = 0.05, 1e-3  # least 1 sigma of those (assumed)
SAME_YAW_RAD = 0.2
"""Runs with equal commands share a linearisation if they start within such a sector of headings."""
CHUNK = 4096  # samples that are multiplied at once in 64 bits: a copy of all would not stay in the cache
OUTLIER_SIGMAS, ROBUST_STEPS = 4.0, 8
"""Errors beyond so many sigmas do not pull on a run's states (1 in 16 000 normal errors is); steps of that
fit."""


@dataclass(frozen=True, eq=False)
class RunResiduals:
    """One run before whitening; lists hold one entry a channel of `log.observed`.

    Attributes:
        soil: (S,) the run's soil, in typical sizes from the model's, in the order of `SOIL_SIGMAS`.
        error: (n,) measured less predicted, linearised about that soil.
        columns: (n, 3 + T + K + G) derivatives by pose, states, effects and nuisance basis.
        by_patch: (n, D) those by patches of ground in the window.
        states, effects: T, K.
    """

    log: PreparedLog
    soil: Array
    error: list[Array]
    columns: list[Array]
    by_patch: list[Array]
    states: int
    effects: int

    def without_nuisance(self) -> Self:
        """Without the nuisance basis: half of all columns, which only the scores need."""
        return dataclasses.replace(
            self, columns=[c[:, : 3 + self.states + self.effects] for c in self.columns]
        )

    def errors_alone(self) -> Self:
        """Without all columns but those of the poses."""
        return dataclasses.replace(self, columns=[c[:, :3] for c in self.columns], states=0, effects=0)

    def errors_of(self, predicted: Sequence[Array]) -> list[Array]:
        """What was measured less other predictions, one array a channel."""
        return [o.value - y for o, y in zip(self.log.observed, predicted, strict=True)]


@dataclass(frozen=True, eq=False)
class WhitenedRun:
    """One run, whitened, poses projected out.

    Attributes:
        residuals: the run before whitening.
        gram: (T + P + 1, T + P + 1) inner products of [state, effect and nuisance, error].
        rows: (n, T + P + 1) those columns; `channel`, `time_s` and `window` (n,) of each sample.
        pose_basis: (n, 3) orthonormal columns in each window, spanned by the poses.
        patch_basis: (n, D) columns U in each window: 1 - U U' whitens patches of ground (see `patchiness`).
        states: T.
        state_gain: (T, n) states by an error, as ridge regression has them; no rows where nothing is clipped.
        limit: by channel, where errors that the states do not explain are clipped (see `outliers`).
    """

    residuals: RunResiduals
    gram: Array
    rows: NDArray[np.float32]
    pose_basis: Array
    patch_basis: Array
    channel: Indices
    time_s: Array
    window: Indices
    states: int
    state_gain: Array
    limit: Array

    @property
    def name(self) -> str:
        """Of the recording."""
        return self.log.name

    @property
    def log(self) -> PreparedLog:
        """Of the run."""
        return self.residuals.log

    @property
    def error(self) -> Array:
        """(n,) whitened error."""
        return self.rows[:, -1].astype(float)

    @property
    def by_state(self) -> Array:
        """(n, T)."""
        return self.rows[:, : self.states].astype(float)

    @property
    def by_parameter(self) -> Array:
        """(n, P) columns of the effects and the nuisance basis."""
        return self.rows[:, self.states : -1].astype(float)

    def with_columns(self, columns: Array) -> Self:
        """With further whitened columns (n, D) behind those of effects and nuisance."""
        rows = np.column_stack([self.rows[:, :-1], columns.astype(np.float32), self.rows[:, -1]])
        return dataclasses.replace(self, rows=rows, gram=self.gram_with(columns))

    def gram_with(self, columns: Array) -> Array:
        """`gram` with further whitened columns (n, D) behind those of effects and nuisance."""
        size, D = len(self.gram), columns.shape[1]
        new, inner = np.arange(size - 1, size - 1 + D), inner_products(self.rows, columns)
        old = np.append(np.arange(size - 1), size - 1 + D)
        gram = np.empty((size + D, size + D))
        gram[np.ix_(old, old)], gram[np.ix_(old, new)], gram[np.ix_(new, old)] = self.gram, inner, inner.T
        gram[np.ix_(new, new)] = columns.T @ columns
        return gram

    def weighted(self, weight: Array) -> Self:
        """With columns and error of each channel times the root of its weight (C,)."""
        if (weight == 1.0).all():
            return self
        rows = self.rows * np.sqrt(weight)[self.channel].astype(np.float32)[:, None]
        return dataclasses.replace(self, rows=rows, gram=inner_products(rows, rows))

    def state_information(self, sigma: Array) -> Array:
        """(T, T) information of the states with their prior of 1 sigma (T,)."""
        return self.gram[: self.states, : self.states] + np.diag(sigma**-2.0)

    def without_states(self, sigma: Array, error: Array) -> Array:
        """An error (n,) or several (n, k) with the best states of that prior subtracted."""
        J = self.by_state
        return np.asarray(error - J @ np.linalg.solve(self.state_information(sigma), J.T @ error))

    def without_poses(self, error: Array) -> Array:
        """A whitened error (n,) with the poses projected out."""
        return _less(error, self.pose_basis, self.window)

    def without_patches(self, columns: Array) -> Array:
        """Columns (n, k) or an error (n,) without poses, white given the patches of ground."""
        return _less(columns, self.patch_basis, self.window)

    def with_patches(self, error: Array) -> Array:
        """The error (n,) that `without_patches` made this one of."""
        out = error.copy()
        for k in np.unique(self.window) if self.patch_basis.shape[1] else ():
            mine = self.window == k
            U = self.patch_basis[mine]
            out[mine] += U @ ((U.T @ out[mine]) / (1.0 - np.square(U).sum(axis=0)))
        return out


def inner_products(rows: NDArray[np.float32], columns: NDArray[np.float32] | Array) -> Array:
    """Of rows (n, M) and columns (n, D), in 64 bits."""
    out = np.zeros((rows.shape[1], columns.shape[1]))
    for i in range(0, len(rows), CHUNK):
        out += rows[i : i + CHUNK].astype(float).T @ columns[i : i + CHUNK].astype(float)
    return out


def _less(columns: Array, basis: Array, window: Indices) -> Array:
    out = columns.copy()
    for k in np.unique(window) if basis.shape[1] else ():
        mine = window == k
        out[mine] -= basis[mine] @ (basis[mine].T @ out[mine])
    return out


@dataclass(eq=False)
class LinearisationCache:
    """Linearisations by commands: runs that repeat a drive share one."""

    model: Model
    candidates: Candidates
    known: dict[str, Linearisation] = field(default_factory=dict)

    def key(self, log: PreparedLog) -> str:
        """Hash of what logs that share a linearisation have in common."""
        sector = np.round(log.start[:1, 2] / SAME_YAW_RAD) + 0.0  # no negative zero
        key = hashlib.sha256(sector.tobytes())
        model = self.model
        numbers = [model.vehicle_vector(), *(soil_vector(soil) for soil in model.soils.values())]
        for part in (log.sides, log.windows, log.borders, *numbers):
            key.update(np.ascontiguousarray(part).tobytes())
        key.update(repr((log.labels, self.candidates.keys, sorted(model.effects.items()))).encode())
        return key.hexdigest()

    def of(self, log: PreparedLog) -> Linearisation:
        """The linearisation of a log, from the poses of the first log with its commands."""
        key = self.key(log)
        if key not in self.known:
            self.known[key] = linearise(log, self.model, self.candidates, log.start)
        return self.known[key]


def run_residuals(log: PreparedLog, cache: LinearisationCache, channels: Sequence[str]) -> RunResiduals:
    """Errors and derivatives of a run.

    Args:
        channels: observed channels of all runs, for the nuisance basis.

    Raises:
        TerrafusionError: the twin diverges.
    """
    shared = cache.of(log)
    found = moved_to(log, turned(log, channel_sensitivities(log, shared)), shared.start, log.start)
    start, before = aligned_start(log, [s.value for s in found], log.start), log.start
    if cache.candidates.any_world_fixed(cache.model.effects):  # the run does not turn as a whole
        found = turned(log, channel_sensitivities(log, linearise(log, cache.model, cache.candidates, start)))
        start, before = aligned_start(log, [s.value for s in found], start), start
    return residuals_from(log, moved_to(log, found, before, start), cache.model, cache.candidates, channels)


def residuals_from(
    log: PreparedLog,
    found: Sequence[Sensitivity],
    model: Model,
    candidates: Candidates,
    channels: Sequence[str],
) -> RunResiduals:
    """Errors and derivatives of a run, from its sensitivities, turned as measured."""
    soil, log = soil_columns(candidates), with_timing(log, [s.value for s in found])
    error, columns, by_patch, K = [], [], [], candidates.count
    values = [s.value for s in found]
    pairs = zip(log.observed, values, strict=True)
    states = with_heading_errors(log, values, [_sensor_states(o.channel, y, model.vehicle) for o, y in pairs])
    for observed, s, sensors in zip(log.observed, found, states, strict=True):
        by_pose, by_effect, patches = np.split(s.columns, [3, 3 + K], axis=1)
        nuisance = nuisance_columns(log, model, observed, s.heading, channels)
        error.append(observed.value - s.value)
        columns.append(np.hstack([by_pose, by_effect[:, soil], sensors, by_effect, nuisance]))
        by_patch.append(patches)
    return RunResiduals(
        log, np.zeros(len(soil)), error, columns, by_patch, len(soil) + sensors.shape[1], K
    )  # fmt: skip


def _sensor_states(channel: str, predicted: Array, vehicle: VehicleParams) -> Array:
    """Columns (n, 7) of a channel by the sensor states that are drawn in every run: offsets, then gains."""
    columns = np.zeros((len(predicted), len(OFFSET_SIGMAS) + 2 * len(CURRENTS)))
    if channel in OFFSET_SIGMAS:
        columns[:, list(OFFSET_SIGMAS).index(channel)] = OFFSET_SIGMAS[channel]
    if channel in CURRENTS:
        at, current = len(OFFSET_SIGMAS) + CURRENTS.index(channel), vehicle.realism.current
        columns[:, at] = max(current.offset_sigma_a, LEAST_OFFSET_A)
        columns[:, at + len(CURRENTS)] = max(current.gain_sigma, LEAST_GAIN) * predicted
    return columns


def soil_columns(candidates: Candidates) -> list[int]:
    """Columns of the soil parameters that vary from run to run."""
    return [candidates.keys.index(name) for name in SOIL_SIGMAS if name in candidates.keys]


def initial_state_sigma(candidates: Candidates, imu: ImuSpec | None = None) -> Array:
    """First 1 sigma (T,) of the states, in units of their columns; with an IMU, its offsets are at least as
    large as its file says."""
    soil = [sigma for name, sigma in SOIL_SIGMAS.items() if name in candidates.keys]
    offsets = np.ones(len(OFFSET_SIGMAS))
    if imu is not None:
        sheet = imu.gyro_bias_sigma_radps, imu.accel_bias_sigma_mps2, imu.accel_bias_sigma_mps2
        offsets = np.maximum(np.array(sheet) / [*OFFSET_SIGMAS.values()], offsets)
    return np.array([*soil, *offsets, *np.ones(2 * len(CURRENTS))])


def with_timing(log: PreparedLog, predicted: Sequence[Array]) -> PreparedLog:
    """The log with `Observed.timing`: a command changed at some time since the one before, which moves every
    channel by its rate of change, here that of the prediction."""
    if log.input_step_s == 0.0:
        return log
    late_s = log.input_step_s / math.sqrt(3.0)  # of a uniform distribution
    pairs = zip(log.observed, predicted, strict=True)
    return with_observed(
        log, [dataclasses.replace(o, timing=_timing_sigma(o, log, y, late_s)) for o, y in pairs]
    )


def _timing_sigma(observed: Observed, log: PreparedLog, predicted: Array, late_s: float) -> Array:
    """1 sigma (n,) of a channel whose input is late by so much, of 1 sigma: its slope times that; and a jump
    of a current, which is sampled, not averaged, falls on the other side of a sample as often as that over
    its slot."""
    apart = np.maximum(np.diff(observed.slot), 1) * observed.slot_s
    slope = np.diff(predicted) / apart
    slope[np.diff(window_of(observed, log.windows)) != 0] = 0.0  # the pose is reset
    before, after = np.append(0.0, slope), np.append(slope, 0.0)
    rate = np.maximum(np.abs(before), np.abs(after))
    if observed.channel not in CURRENTS:
        return np.asarray(late_s * rate)
    bend = np.abs(after - before) * observed.slot_s
    jump = np.maximum(bend, np.maximum(np.append(0.0, bend[:-1]), np.append(bend[1:], 0.0)))
    return np.hypot(late_s * rate, jump * math.sqrt(min(late_s / observed.slot_s, 1.0)))


def noise_sigma(observed: Observed, noise: ResidualNoise) -> Array:
    """1 sigma (n,) of a channel's samples, in units of the noise's scale."""
    if observed.timing is None:
        return observed.sigma
    return np.hypot(observed.sigma, observed.timing / noise.scale)


def whitened_columns(log: PreparedLog, noise: ChannelNoise, columns: Sequence[Array]) -> Array:
    """Columns (n, k) of all channels, given one array each, in units and axes of white noise."""
    columns = without_shared(log, noise.turn, columns)
    out = np.empty((sum(map(len, columns)), columns[0].shape[1]))
    sigma = [noise_sigma(o, noise[o.channel]) for o in log.observed]
    for i, rows, places in sample_map(log).equally_spaced:
        observed = log.observed[i]
        out[places] = noise[observed.channel].whiten_alike(
            observed.slot[rows[0]], sigma[i][rows], columns[i][rows]
        )
    return out


def physical_error(run: WhitenedRun, noise: ChannelNoise, error: Array) -> Array:
    """A whitened error (n,) in the units of the channels."""
    error, out = run.with_patches(error), np.empty(len(error))
    sigma = [noise_sigma(o, noise[o.channel]) for o in run.log.observed]
    for i, rows, places in sample_map(run.log).equally_spaced:
        observed = run.log.observed[i]
        out[places] = noise[observed.channel].unwhiten_alike(
            observed.slot[rows[0]], sigma[i][rows], error[places]
        )
    whole = with_shared(run.log, noise.turn, [c[:, None] for c in by_channel(run.log, out)])
    return np.concatenate([whole[i][rows, 0] for i, _, rows in sample_map(run.log).blocks])


def whitened(run: RunResiduals, noise: ChannelNoise) -> WhitenedRun:
    """The run in units and axes in which its noise is white, with the poses projected out."""
    both = [np.column_stack(parts) for parts in zip(run.columns, run.error, strict=True)]
    white = whitened_columns(run.log, noise, both)
    blocks = sample_map(run.log).blocks
    channel = np.concatenate([np.full(len(rows), i) for i, _, rows in blocks])
    window = np.concatenate([np.full(len(rows), k) for _, k, rows in blocks])
    middle = [0.5 * (o.begin_s + o.end_s) for o in run.log.observed]
    columns, pose_basis = white[:, 3:], white[:, :3].copy()
    out = np.empty_like(columns)
    for k in np.unique(window):
        mine = window == k
        pose_basis[mine] = Q = _orthonormal(pose_basis[mine])
        own = columns[mine]
        out[mine] = own - Q @ (Q.T @ own)
    return WhitenedRun(
        run, out.T @ out, out.astype(np.float32), pose_basis, pose_basis[:, :0], channel,
        np.concatenate([middle[i][rows] for i, _, rows in blocks]), window,
        run.states, np.zeros((0, len(window))), np.full(len(run.log.observed), np.inf),
    )  # fmt: skip


def _orthonormal(columns: Array) -> Array:
    """Orthonormal columns (n, 3) with the span of those given; zero for those without information."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    out = np.zeros_like(columns)
    out[:, : left.shape[1]] = left * (sizes > 1e-6 * max(float(sizes[0]), 1e-12))
    return out


def whitened_error(run: WhitenedRun, noise: ChannelNoise, error: Sequence[Array], clip: bool = True) -> Array:
    """Another error of the run, one array a channel, whitened (n,), poses projected out, outliers clipped."""
    out = run.without_poses(whitened_columns(run.log, noise, [e[:, None] for e in error])[:, 0])
    out = run.without_patches(out)
    return clip_outliers(run, out) if clip else out


def explained_by_states(J: Array, gain: Array, error: Array) -> Array:
    """Part (n,) of an error that a run's states explain, by their columns J (n, T) and `gain` (T, n); what is
    an outlier does not pull on them (Huber 1964)."""
    out = np.zeros(len(error))
    for _ in range(ROBUST_STEPS):
        out = J @ (gain @ (out + np.clip(error - out, -OUTLIER_SIGMAS, OUTLIER_SIGMAS)))
    return out


def clip_outliers(run: WhitenedRun, error: Array) -> Array:
    """A whitened error (n,), clipped where the run's states do not explain it."""
    if not len(run.state_gain):
        return error
    explained = explained_by_states(run.by_state, run.state_gain, error)
    limit = run.limit[run.channel]
    return np.asarray(explained + np.clip(error - explained, -limit, limit))
