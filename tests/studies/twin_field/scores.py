"""Scores of predictions, and their medians with intervals over independent stretches of driving."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.bootstrap import percentile_interval
from tests.studies.body_velocity import heading
from tests.studies.joined_windows import DT_S
from tests.studies.twin_field.forks import BIN_S, HORIZON_S, N_PAST, Forks, half_second_means
from tests.studies.twin_field.resampled_groups import resampled_groups

Array = NDArray[np.float64]

SPANS_S = (1.0, 2.0, HORIZON_S)
METRICS = (
    *(f"speed_rms_{span:g}s_mps" for span in SPANS_S),
    *(f"turn_rms_{span:g}s_radps" for span in SPANS_S),
    "position_m",
    "heading_rad",
)
"""RMS error of forward speed and yaw rate (half-second means) over spans from the fork, and where the robot
ends after five seconds, in the body frame of the fork."""
DRAWS, SEED = 500, 20240101


@dataclass(frozen=True)
class Interval:
    """A median and its 95 % interval."""

    median: float
    low: float
    high: float


def scores(prediction: Array, forks: Forks) -> Array:
    """(F, len(METRICS)) errors of predictions (F, N_FUTURE + 1, 3); NaN where there is no truth."""
    off = half_second_means(prediction) - forks.truth()
    if forks.given_turn:
        off[..., 2] = np.nan
    bins = [round(span / BIN_S) for span in SPANS_S]
    rms = [np.sqrt((off[:, :n, channel] ** 2).mean(axis=1)) for channel in (0, 2) for n in bins]
    told, true = _end(prediction), _end(forks.motion[:, N_PAST:])
    turned = np.abs(told[:, 2] - true[:, 2]) if not forks.given_turn else np.full(len(forks), np.nan)
    return np.column_stack([*rms, np.hypot(told[:, 0] - true[:, 0], told[:, 1] - true[:, 1]), turned])


def _end(motion: Array) -> Array:
    """(F, 3) place and heading after the horizon, from the motion (F, T, 3) by the trapezoid rule."""
    out = np.empty((len(motion), 3))
    t: Array = DT_S * np.arange(motion.shape[1], dtype=float)
    for k, (forward, aside, turn) in enumerate(np.moveaxis(motion, 2, 1)):
        psi = heading(t, turn)
        velocity = (forward + 1j * aside) * np.exp(1j * psi)
        place = DT_S * complex(velocity.sum() - 0.5 * (velocity[0] + velocity[-1]))
        out[k] = place.real, place.imag, psi[-1]
    return out


def medians(values: Array, group: NDArray[np.str_]) -> tuple[Array, Array]:
    """Medians (C,) of the columns of values (F, C) and of `DRAWS` resamples of whole groups (F,), (DRAWS, C).

    Unknown values (NaN) are left out, column by column.
    """
    draws = np.array([_medians(values[rows]) for rows in resampled_groups(group, DRAWS, SEED)])
    return _medians(values), draws


def interval(middle: float, draws: Array) -> Interval:
    """The value with its 95 % interval over the resamples (DRAWS,)."""
    known = draws[np.isfinite(draws)]
    if not known.size or not np.isfinite(middle):
        return Interval(np.nan, np.nan, np.nan)
    return Interval(float(middle), *percentile_interval(known))


def _medians(values: Array) -> Array:
    ordered = np.sort(values, axis=0)  # NaN come last
    known = np.isfinite(values).sum(axis=0)
    columns = np.arange(values.shape[1])
    low, high = np.maximum((known - 1) // 2, 0), np.minimum(known // 2, len(values) - 1)
    return np.where(known > 0, 0.5 * (ordered[low, columns] + ordered[high, columns]), np.nan)
