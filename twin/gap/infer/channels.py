"""What an explanation leaves unexplained of a gap, channel by channel, in units of the references.

A law of the twin is never quite that of the robot: the misfit grows with the effect and differs from channel
to channel. So the noise of each channel is taken as unknown above its floor, and explanations are compared by
sums of logarithms (up to the count of independent errors, the profile likelihood of normal errors of unknown
variance a channel): neither a channel that no candidate explains nor one of high precision dominates.

The errors of each channel are split into the part inside the space of the candidates' sensitivities (few
directions, so that a weak effect shows) and the part outside. How far the states of a run (soil, sensor
offsets) move, in units of their scatter, counts as one more channel.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.null.null import common_offset
from terrafusion.twin.gap.null.score import Score
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

Array = NDArray[np.float64]

RIDGE = 1.0
"""Directions of a channel in which typical effects make less than a sigma in all are outside its space."""
LEAST_STATE = 0.5  # least square of a state in the references, in units of its variance
STEPS = 3  # rounds of the linear fit, after each of which channels are weighted anew
WIDE = 30.0  # 1 sigma of an effect's size in it, typical sizes: the data decide


@dataclass(frozen=True, eq=False)
class ErrorProducts:
    """Inner products of an error, by channel: with the run's columns (C, N), and with itself (C,)."""

    gain: Array
    square: Array


@dataclass(frozen=True, eq=False)
class ChannelColumns:
    """A run's columns (states, then effects) by channel.

    Attributes:
        J: (n, N).
        common: (n,) error common to the references.
        channels: samples of each channel.
    """

    J: Array
    common: Array
    channels: tuple[slice, ...]

    @classmethod
    def of(cls, run: WhitenedRun, channels: int, columns: int, offset: Array) -> ChannelColumns:
        """Of a run with so many effect columns; `offset` (P,) is common to the references."""
        ends = np.searchsorted(run.channel, np.arange(channels + 1))  # samples are sorted by channel
        parts = tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(ends))
        N = run.states + columns
        return cls(run.rows[:, :N].astype(float), run.by_parameter @ offset, parts)

    def products(self, error: Array) -> ErrorProducts:
        """Of a whitened error (n,), less what is common to the references."""
        rest = error - self.common
        gain = np.stack([rest[c] @ self.J[c] for c in self.channels])
        return ErrorProducts(gain, np.array([float(rest[c] @ rest[c]) for c in self.channels]))


@dataclass(frozen=True, eq=False)
class RunProducts:
    """One run: inner products of its N columns by channel, and its own error.

    Attributes:
        gram, inverse: (C, N, N); the inverse with a ridge.
        error: less what is common to the references.
        states: how many columns are states.
        samples: (C,) of each channel.
    """

    gram: Array
    inverse: Array
    error: ErrorProducts
    states: int
    samples: Array

    @classmethod
    def of(cls, run: WhitenedRun, columns: ChannelColumns) -> RunProducts:
        """Of a run with these columns."""
        gram = np.stack([columns.J[c].T @ columns.J[c] for c in columns.channels])
        inverse: Array = np.asarray(np.linalg.inv(gram + RIDGE * np.eye(gram.shape[1])))
        samples = np.array([float(c.stop - c.start) for c in columns.channels])
        return cls(gram, inverse, columns.products(run.error), run.states, samples)

    def minus(self, error: ErrorProducts, columns: Sequence[int], value: Array) -> ErrorProducts:
        """The error with effects of such size subtracted, linearly."""
        at = [self.states + i for i in columns]
        gain = error.gain - self.gram[:, :, at] @ value
        square = error.square - (error.gain[:, at] + gain[:, at]) @ value
        return ErrorProducts(gain, np.maximum(square, 0.0))

    def fitted_states(self, error: ErrorProducts, sigma: Array, weight: Array) -> Array:
        """The states (T,) that fit an error, with their prior, channels weighted (C,)."""
        T = self.states
        H = np.einsum("c,cij->ij", weight, self.gram[:, :T, :T]) + np.diag(sigma**-2.0)
        return np.asarray(np.linalg.solve(H, weight @ error.gain[:, :T]))


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Sums of log energy ratios over channels, `inside` the candidates' space, with the states, and
    `outside`; `weight` (C,) is that of each channel in the next fit."""

    inside: float
    outside: float
    weight: Array

    @property
    def total(self) -> float:
        """Both."""
        return self.inside + self.outside


@dataclass(frozen=True, eq=False)
class ChannelTable:
    """The judged runs by channel.

    Attributes:
        columns, runs: of each judged run; `columns` is empty where there are only sums.
        sigma: (T,) 1 sigma of the states.
        inside, outside: (C,) energies of a reference run, on average.
        states: (T,) squares of its states, in units of their variance.
        references: (R, 2C) energies of every reference run inside, then outside.
    """

    columns: tuple[ChannelColumns, ...]
    runs: tuple[RunProducts, ...]
    sigma: Array
    inside: Array
    outside: Array
    states: Array
    references: Array

    @classmethod
    def of(
        cls,
        runs: Sequence[WhitenedRun],
        references: Sequence[WhitenedRun],
        scores: Sequence[Score],
        sigma: Array,
        columns: int,
        jobs: int = 1,
    ) -> ChannelTable:
        """Of judged runs; `scores` are those of the references, each of which is compared with the others.

        With fewer than two references the floor is that of white noise.
        """
        channels = len(runs[0].limit)
        offset = common_offset(scores)
        own = tuple(ChannelColumns.of(run, channels, columns, offset) for run in runs)
        judged = tuple(RunProducts.of(run, of) for run, of in zip(runs, own, strict=True))

        def against_others(i: int) -> RunProducts:
            others = [s for j, s in enumerate(scores) if j != i]
            of = ChannelColumns.of(references[i], channels, columns, common_offset(others))
            return RunProducts.of(references[i], of)

        with ThreadPoolExecutor(jobs) as threads:
            floors = list(threads.map(against_others, range(len(references) if len(scores) > 1 else 0)))
        each = [run_energy(floor, floor.error, sigma, np.ones(channels)) for floor in floors]
        floor = _reference_floor(floors, judged, sigma)
        return cls(own, judged, sigma, *floor, np.array(each).reshape(-1, 2 * channels))

    def before(self) -> Unexplained:
        """Of the gap with no effect in the twin, to first order."""
        return self.unexplained([run.error for run in self.runs])

    def products(self, errors: Sequence[Array]) -> list[ErrorProducts]:
        """Of other whitened errors of the runs."""
        return [of.products(error) for of, error in zip(self.columns, errors, strict=True)]

    def unexplained(self, errors: Sequence[ErrorProducts], steps: int = 2) -> Unexplained:
        """What remains of these errors, one a run, once each run's states are fitted."""
        weight = np.ones(len(self.inside))
        best: Unexplained | None = None
        for _ in range(steps):
            inside, outside, states = energies(self.runs, errors, self.sigma, weight)
            ratio, rest, far = (
                np.maximum(now / (len(self.runs) * floor), 1.0)
                for now, floor in ((inside, self.inside), (outside, self.outside), (states, self.states))
            )
            weight = 1.0 / ratio
            found = Unexplained(
                float(np.log(ratio).sum() + np.log(far.mean())), float(np.log(rest).sum()), weight
            )
            if best is None or found.total < best.total:
                best = found
        assert best is not None
        return best

    def linear_fit(
        self, columns: Sequence[int], low: Array, high: Array, errors: Sequence[ErrorProducts] | None = None
    ) -> tuple[Array, Unexplained]:
        """Best sizes (k,) of some columns within bounds, to first order, and what remains of `errors`."""
        first = [run.error for run in self.runs] if errors is None else errors
        start = self.unexplained(first)
        value, best = np.zeros(len(columns)), start
        weight = start.weight
        for _ in range(STEPS):
            tried = np.clip(self.least_squares(columns, first, weight), low, high)
            now = self.unexplained(
                [run.minus(e, columns, tried) for run, e in zip(self.runs, first, strict=True)]
            )
            weight = now.weight
            if now.total < best.total:
                value, best = tried, now
        return value, best

    def least_squares(self, columns: Sequence[int], errors: Sequence[ErrorProducts], weight: Array) -> Array:
        """Sizes (k,) of some columns by weighted least squares, the states of each run with their prior."""
        k, T = len(columns), self.runs[0].states
        A, b = np.eye(k) / WIDE**2, np.zeros(k)
        at = [*range(T), *(T + i for i in columns)]
        for run, error in zip(self.runs, errors, strict=True):
            G = np.einsum("c,cij->ij", weight, run.gram[:, at][:, :, at])
            g = weight @ error.gain[:, at]
            X = np.linalg.solve(G[:T, :T] + np.diag(self.sigma**-2.0), np.column_stack([G[:T, T:], g[:T]]))
            A += G[T:, T:] - G[T:, :T] @ X[:, :-1]
            b += g[T:] - G[T:, :T] @ X[:, -1]
        return np.asarray(np.linalg.solve(A, b))


def energies(
    runs: Sequence[RunProducts], errors: Sequence[ErrorProducts], sigma: Array, weight: Array
) -> tuple[Array, Array, Array]:
    """Squares (C,) inside and outside each channel's space once the states are fitted, and those (T,) of the
    states in units of their variance, summed over the runs."""
    inside, outside, states = np.zeros(len(weight)), np.zeros(len(weight)), np.zeros(len(sigma))
    for run, error in zip(runs, errors, strict=True):
        T, theta = run.states, run.fitted_states(error, sigma, weight)
        gain = error.gain - run.gram[:, :, :T] @ theta
        square = error.square - (error.gain[:, :T] + gain[:, :T]) @ theta
        within = ((gain[:, None] @ run.inverse)[:, 0] * gain).sum(axis=1)
        inside += within
        outside += np.maximum(square - within, 0.0)
        states += (theta / sigma) ** 2
    return inside, outside, states


def run_energy(run: RunProducts, error: ErrorProducts, sigma: Array, weight: Array) -> Array:
    """Energies (2C,) of one run's error inside, then outside each channel's space."""
    inside, outside, _ = energies([run], [error], sigma, weight)
    return np.maximum(np.concatenate([inside, outside]), 1e-9)


def _reference_floor(
    references: Sequence[RunProducts], runs: Sequence[RunProducts], sigma: Array
) -> tuple[Array, Array, Array]:
    """Energies of a reference inside and outside (C,), and squares of its states (T,), on average; without
    references, those of white noise and the states' own variance."""
    if references:
        weight, count = np.ones(len(references[0].gram)), len(references)
        inside, outside, states = energies(references, [f.error for f in references], sigma, weight)
        floor = np.maximum(states / count, LEAST_STATE)
        return np.maximum(inside / count, 1e-9), np.maximum(outside / count, 1e-9), floor
    directions = np.mean([np.einsum("cij,cji->c", run.inverse, run.gram) for run in runs], axis=0)
    samples = np.mean([run.samples for run in runs], axis=0)
    return np.maximum(directions, 1.0), np.maximum(samples - directions, 1.0), np.ones(len(sigma))
