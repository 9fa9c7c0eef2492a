"""Forks: moments of a measured drive from which a model has to tell the next five seconds.

A model gets the past second, the true forward speed and yaw rate at the fork, and the inputs of the
future: the measured wheel speeds, or the commands. It has to give forward speed, sideways speed and
yaw rate. Prediction and truth are compared as means over half a second: the truth is no faster.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.studies.joined_windows import DT_S
from tests.studies.twin_field.field_run import FieldRun

Array = NDArray[np.float64]

HORIZON_S, PAST_S, BIN_S = 5.0, 1.0, 0.5
SPACING_S = 5.0
"""Horizons do not overlap."""
MOVING_MPS = 0.1
"""Horizons in which the wheels turn less than this on average are left out."""
GROUP_S = 20.0
"""Forks of a stretch of this length of a long drive count as one when intervals are drawn."""
LEAST_TRUTH = 0.9
"""Share of a horizon that must have truth for its speed to be scored."""
N_PAST, N_FUTURE, N_BIN = round(PAST_S / DT_S), round(HORIZON_S / DT_S), round(BIN_S / DT_S)
BINS = N_FUTURE // N_BIN


@dataclass(frozen=True, eq=False)
class Forks:
    """F forks of one vehicle and one kind of input, sampled at `DT_S`.

    The T samples go from `PAST_S` before to `HORIZON_S` after the fork, which is sample `N_PAST`.

    Attributes:
        recording, group, ground: (F,) where they come from; `group` is what a bootstrap draws.
        time_s: (F,) of the fork in its stretch.
        inputs_radps: (F, T, 2) speeds of left and right wheels, measured or commanded.
        past_radps: (F, N_PAST + 1, 2) measured wheel speeds up to the fork.
        motion: (F, T, 3) true forward speed, sideways speed (m/s) and yaw rate (rad/s), NaN where unknown.
        noise_mps: (F,) rms of the truth's own noise in half-second means of the forward speed.
        given_turn: whether the yaw rate is an input, not a prediction (no left and right in the log).
    """

    recording: NDArray[np.str_]
    group: NDArray[np.str_]
    ground: NDArray[np.str_]
    time_s: Array
    inputs_radps: Array
    past_radps: Array
    motion: Array
    noise_mps: Array
    given_turn: bool

    def __len__(self) -> int:
        return len(self.recording)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Forks:
        """The forks of a mask or of indices."""
        changed: dict[str, Any] = {
            f.name: getattr(self, f.name)[rows]
            for f in dataclasses.fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return dataclasses.replace(self, **changed)

    def start(self) -> Array:
        """(F, 3) true motion at the fork, NaN where unknown."""
        return self.motion[:, N_PAST]

    def truth(self) -> Array:
        """(F, BINS, 3) half-second means of the true motion, NaN where unknown."""
        return half_second_means(self.motion[:, N_PAST:])


def joined(parts: Sequence[Forks]) -> Forks:
    """Forks of several kinds of ground as one."""
    first = parts[0]
    together: dict[str, Any] = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts])
        for f in dataclasses.fields(first)
        if isinstance(getattr(first, f.name), np.ndarray)
    }
    return dataclasses.replace(first, **together)


def half_second_means(motion: Array) -> Array:
    """(F, BINS, 3) means of (F, N_FUTURE + 1, 3) samples, the first of which is the fork itself."""
    future = 0.5 * (motion[:, 1:] + motion[:, :-1])
    return np.asarray(future.reshape(len(motion), BINS, N_BIN, 3).mean(axis=2))


def forks_of(runs: Sequence[FieldRun], inputs: str) -> Forks | None:
    """All forks of the runs, None where there is none.

    Args:
        runs: of one vehicle.
        inputs: "wheels" (measured speeds) or "commands".
    """
    parts: list[tuple[FieldRun, int]] = []
    for run in runs:
        given = run.sides_radps if inputs == "wheels" else run.commanded_radps
        first = N_PAST
        while first + N_FUTURE < len(run.t_s):
            span = slice(first - N_PAST, first + N_FUTURE + 1)
            moving = (
                np.abs(run.sides_radps[first : span.stop]).mean() * run.vehicle.wheel.radius_m > MOVING_MPS
            )
            if moving and np.isfinite(given[span]).all() and _is_known(run, first):
                parts.append((run, first))
                first += round(SPACING_S / DT_S)
            else:
                first += N_BIN
    return _stacked(parts, inputs) if parts else None


def _is_known(run: FieldRun, first: int) -> bool:
    """Whether the truth covers the fork and the horizon; a run without any truth is scored by its gyro."""
    known = np.isfinite(run.velocity_mps[first - N_PAST : first + N_FUTURE + 1, 0])
    if not np.isfinite(run.velocity_mps).any():
        return run.has_sides
    return bool(known[: N_PAST + 1].all() and known[N_PAST:].mean() >= LEAST_TRUTH)


def _stacked(parts: Sequence[tuple[FieldRun, int]], inputs: str) -> Forks:
    def cut(values: Array, first: int) -> Array:
        return values[first - N_PAST : first + N_FUTURE + 1]

    motion, given, noise = [], [], []
    for run, first in parts:
        velocity = _filled(cut(run.velocity_mps, first))
        motion.append(np.column_stack([velocity, cut(run.yaw_rate_radps, first)]))
        given.append(cut(run.sides_radps if inputs == "wheels" else run.commanded_radps, first))
        scatter = run.noise_mps[first : first + N_FUTURE].reshape(BINS, N_BIN).mean(axis=1)
        noise.append(float(np.sqrt(np.nanmean(scatter**2))) if np.isfinite(scatter).any() else np.nan)
    return Forks(
        recording=np.array([run.recording for run, _ in parts]),
        group=np.array([f"{run.name}@{int(run.t_s[first] // GROUP_S)}" for run, first in parts]),
        ground=np.array([run.ground for run, _ in parts]),
        time_s=np.array([run.t_s[first] for run, first in parts]),
        inputs_radps=np.stack(given),
        past_radps=np.stack([run.sides_radps[first - N_PAST : first + 1] for run, first in parts]),
        motion=np.stack(motion),
        noise_mps=np.array(noise),
        given_turn=not parts[0][0].has_sides,
    )


def _filled(velocity: Array) -> Array:
    """Short gaps of the truth bridged linearly; (T, 2) NaN where there is none at all."""
    known = np.isfinite(velocity[:, 0])
    if not known.any():
        return velocity
    at = np.arange(len(velocity))
    return np.stack([np.interp(at, at[known], velocity[known, k]) for k in range(2)], axis=1)
