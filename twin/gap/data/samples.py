"""Maps each observed sample of a log to the samples of the twin's run that it averages."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.calibrate.predict import averaging
from terrafusion.twin.effects.sensing import CLOCK_S, IMU
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.sensors.effects import CLOCK_DRIFT, DELAYS

Indices = NDArray[np.int64]

COARSE_STEP = 5  # derivatives are stored at every n-th sample of the run: they enter as weights only


@dataclass(frozen=True, eq=False)
class SampleMap:
    """What follows from the time stamps of a log; lists hold one entry a channel.

    Attributes:
        blocks: channel, window and sample indices of the part of each channel in each window, in the order of
            all samples.
        equally_spaced: parts of a channel with the same spacing in time: channel, indices (g, m) in the
            channel and among all samples.
        fine, coarse: samples (n, k) of the run, or of its `COARSE_STEP`-th ones, with their weights.
    """

    blocks: list[tuple[int, int, Indices]]
    equally_spaced: list[tuple[int, Indices, Indices]]
    fine: list[tuple[Indices, Array]]
    coarse: list[tuple[Indices, Array]]


_CACHE: WeakKeyDictionary[PreparedLog, SampleMap] = WeakKeyDictionary()


def sample_map(log: PreparedLog) -> SampleMap:
    """The sample map of a log, computed once."""
    known = _CACHE.get(log)
    if known is None:
        fine = [drop_zero_weights(*averaging(o, log)) for o in log.observed]
        blocks = _blocks(log)
        coarse = [_coarse(o, log) for o in log.observed]
        known = _CACHE[log] = SampleMap(blocks, _equally_spaced(log, blocks), fine, coarse)
    return known


def delayed_samples(log: PreparedLog, effects: Mapping[str, float]) -> list[tuple[Indices, Array]]:
    """`SampleMap.fine` of the log with the delays among the effects: an observed sample is made of the twin's
    run as it was a delay earlier.

    The catalogue's law of a delay is first order, y - e dy/dt: enough for a sensitivity, but wrong for a
    third of a second. IMU readings continue across windows; positions are reset at each window and are
    extrapolated before its start.
    """
    delays = {key: effects[key] for key in DELAYS if effects.get(key, 0.0) != 0.0}
    out = list(sample_map(log).fine)
    for i, observed in enumerate(log.observed):
        delay_s = _delay_s(observed, delays)
        if delay_s.any():
            before = dataclasses.replace(
                observed, begin_s=observed.begin_s - delay_s, end_s=observed.end_s - delay_s
            )
            window = window_of(before if observed.channel in IMU else observed, log.windows)
            out[i] = drop_zero_weights(*averaging(before, log, np.maximum(window, 0)))
    return out


def _delay_s(observed: Observed, delays: Mapping[str, float]) -> Array:
    """Delay (n,) of each sample of a channel, s."""
    middle = 0.5 * (observed.begin_s + observed.end_s)
    out = np.zeros(len(middle))
    for key, value in delays.items():
        if observed.channel in DELAYS[key]:
            out += value * (middle / CLOCK_S if key == CLOCK_DRIFT else 1.0)
    return out


def driven_by(log: PreparedLog, vehicle: VehicleParams) -> PreparedLog:
    """The log with the commands within the limits of a twin."""
    out = log.driven_by(vehicle)
    _CACHE[out] = sample_map(log)
    return out


def with_observed(log: PreparedLog, observed: Sequence[Observed]) -> PreparedLog:
    """The log with other sigmas of its samples."""
    out = dataclasses.replace(log, observed=tuple(observed))
    _CACHE[out] = sample_map(log)
    return out


def by_channel(log: PreparedLog, values: Array) -> list[Array]:
    """Values (n,) of all samples as one array a channel, zero outside the windows."""
    out, place = [np.zeros(len(o.value)) for o in log.observed], 0
    for i, _, rows in sample_map(log).blocks:
        out[i][rows] = values[place : place + len(rows)]
        place += len(rows)
    return out


def coarse_subset(log: PreparedLog) -> Indices:
    """Which of all samples of the windows are the coarse ones."""
    starts = log.first_samples()
    counts = np.diff(starts)
    return np.concatenate(
        [b + np.arange(0, n, COARSE_STEP) for b, n in zip(starts[:-1], counts, strict=True)]
    )


def coarse_counts(log: PreparedLog) -> Indices:
    """Number (W,) of coarse samples of each window."""
    return np.diff(log.windows, axis=1).ravel() // COARSE_STEP + 1


def weighted_means(samples: tuple[Indices, Array], values: Array) -> Array:
    """Weighted means (n, ...) of values (N, ...) at the samples."""
    at, weight = samples
    lead = (-1,) + (1,) * (values.ndim - 1)
    out = weight[:, 0].reshape(lead) * values[at[:, 0]]
    for k in range(1, at.shape[1]):
        out += weight[:, k].reshape(lead) * values[at[:, k]]
    return np.asarray(out)


def interpolated(at_s: Array, known_s: Array, values: Array) -> Array:
    """Values (n, ...) at times (n,) linearly interpolated to others (m,), constant beyond the ends."""
    place = np.interp(at_s, known_s, np.arange(float(len(known_s))))
    low = np.minimum(place.astype(np.int64), max(len(known_s) - 2, 0))
    share = (place - low).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - share) * values[low] + share * values[np.minimum(low + 1, len(known_s) - 1)])


def drop_zero_weights(at: Indices, weight: Array) -> tuple[Indices, Array]:
    """The same samples without columns that all have weight zero."""
    order = np.argsort(weight == 0.0, axis=1, kind="stable")
    order = order[:, : max(1, int((weight != 0.0).sum(axis=1).max(initial=1)))]
    return np.take_along_axis(at, order, axis=1), np.take_along_axis(weight, order, axis=1)


def _blocks(log: PreparedLog) -> list[tuple[int, int, Indices]]:
    out = []
    for i, observed in enumerate(log.observed):
        window = window_of(observed, log.windows)
        out += [(i, int(k), np.flatnonzero(window == k)) for k in np.unique(window)]
    return out


def _equally_spaced(
    log: PreparedLog, blocks: Sequence[tuple[int, int, Indices]]
) -> list[tuple[int, Indices, Indices]]:
    groups: dict[tuple[int, bytes], list[Indices]] = {}
    place = 0
    for i, _, rows in blocks:
        steps = np.diff(log.observed[i].slot[rows])
        groups.setdefault((i, steps.tobytes()), []).append(np.stack([rows, place + np.arange(len(rows))]))
        place += len(rows)
    return [(i, *np.stack(some, axis=1)) for (i, _), some in groups.items()]


def _coarse(observed: Observed, log: PreparedLog) -> tuple[Indices, Array]:
    """Coarse samples (n, 6) of each observed one and their weights: Simpson's rule over three linear
    interpolations."""
    step, counts = COARSE_STEP * DT_S, coarse_counts(log)
    offset = np.cumsum(counts) - counts
    k = np.clip(window_of(observed, log.windows), 0, len(log.windows) - 1)
    ats, weights = [], []
    for share, weight in ((0.0, 1.0 / 6.0), (0.5, 2.0 / 3.0), (1.0, 1.0 / 6.0)):
        t_s = observed.begin_s + share * (observed.end_s - observed.begin_s)
        place = np.clip((t_s - log.windows[k, 0] * DT_S) / step, 0.0, counts[k] - 1.0)
        low = np.minimum(place.astype(np.int64), np.maximum(counts[k] - 2, 0))
        ats += [offset[k] + low, offset[k] + np.minimum(low + 1, counts[k] - 1)]
        weights += [weight * (1.0 - (place - low)), weight * (place - low)]
    return np.stack(ats, axis=1), np.stack(weights, axis=1)
