"""What an explanation leaves of a gap, channel by channel, in units of what the references leave.

A law of the twin is never quite that of the robot: what it leaves over grows with the effect itself, and by
how much differs from channel to channel. So the noise of each channel is taken as unknown beside its floor,
and explanations are compared by sums of logarithms: a channel that no candidate explains speaks for none,
and one of high precision does not speak for all. (Up to the count of independent errors this is the profile
likelihood of normal errors of unknown variance a channel.)

Each channel's errors fall in two parts: what lies in the space of the candidates' signatures there (few
directions, so that a weak effect shows), and all the rest. What the states of a run (ground, sensor offsets)
take up is not explained either: how far they must go, in units of how they scatter, counts as one more
channel.
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
from terrafusion.twin.gap.rollout.residuals import Evidence

Array = NDArray[np.float64]

RIDGE = 1.0
"""Directions of a channel in which typical effects make less than a sigma in all are not in its space."""
LEAST_STATE = 0.5
"""A state's square in the references counts as no less, in units of its variance."""
STEPS = 3
"""Rounds of the fit, after each of which channels are weighted anew."""
WIDE = 30.0
"""1 sigma of an effect's size in it, typical sizes: the data decide."""


@dataclass(frozen=True, eq=False)
class Products:
    """Inner products of an error, by channel: with the run's columns (C, N), and with itself (C,)."""

    gain: Array
    square: Array


@dataclass(frozen=True, eq=False)
class Columns:
    """A run's N columns, by which errors enter.

    Attributes:
        J: (n, N).
        common: (n,) what the references have in common.
        channels: rows of each channel.
    """

    J: Array
    common: Array
    channels: tuple[slice, ...]

    @classmethod
    def of(cls, run: Evidence, channels: int, columns: int, offset: Array) -> Columns:
        """Of a run; `offset` (P,) is what the references have in common, in all its columns and probes."""
        ends = np.searchsorted(run.channel, np.arange(channels + 1))  # rows are in the order of channels
        N, T = run.states + columns, run.states
        parts = tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(ends))
        return cls(run.rows[:, :N].astype(float), run.rows[:, T:-1].astype(float) @ offset, parts)

    def gram(self) -> Array:
        """Inner products (C, N, N) of the columns, by channel."""
        return np.stack([self.J[c].T @ self.J[c] for c in self.channels])

    def products(self, error: Array) -> Products:
        """Of a whitened error (n,), less what the references have in common."""
        left = error - self.common
        gain = np.stack([left[c] @ self.J[c] for c in self.channels])
        return Products(gain, np.array([float(left[c] @ left[c]) for c in self.channels]))


@dataclass(frozen=True, eq=False)
class Block:
    """One run: inner products of its N columns (states, then effects) by channel, and its own error.

    Attributes:
        gram, inverse: (C, N, N); the inverse with a ridge.
        error: less what the references have in common.
        states: how many columns are states.
        rows: (C,) errors of each channel.
    """

    gram: Array
    inverse: Array
    error: Products
    states: int
    rows: Array

    @classmethod
    def of(cls, run: Evidence, columns: Columns) -> Block:
        """Of a run with these columns."""
        gram = columns.gram()
        inverse: Array = np.asarray(np.linalg.inv(gram + RIDGE * np.eye(gram.shape[1])))
        rows = np.array([float(c.stop - c.start) for c in columns.channels])
        return cls(gram, inverse, columns.products(run.rows[:, -1].astype(float)), run.states, rows)

    def moved(self, error: Products, columns: Sequence[int], value: Array) -> Products:
        """The error once effects of such size are taken out of it, linearly."""
        at = [self.states + i for i in columns]
        gain = error.gain - self.gram[:, :, at] @ value
        square = error.square - (error.gain[:, at] + gain[:, at]) @ value
        return Products(gain, np.maximum(square, 0.0))

    def adapted(self, error: Products, sigma: Array, weight: Array) -> Array:
        """The states (T,) that suit an error, with their prior, channels weighted (C,)."""
        T = self.states
        H = np.einsum("c,cij->ij", weight, self.gram[:, :T, :T]) + np.diag(sigma**-2.0)
        return np.asarray(np.linalg.solve(H, weight @ error.gain[:, :T]))


@dataclass(frozen=True, eq=False)
class Left:
    """What is left over, as sums of logarithms over channels: `inside` the candidates' space, with the
    states, and `outside`; `weight` (C,) is that of each channel in the next fit."""

    inside: float
    outside: float
    weight: Array

    @property
    def total(self) -> float:
        """Both."""
        return self.inside + self.outside


@dataclass(frozen=True, eq=False)
class Table:
    """The judged runs by channel.

    Attributes:
        columns, blocks: of each judged run; `columns` is empty where there is no evidence but sums.
        sigma: (T,) 1 sigma of the states.
        inside, outside: (C,) what a reference run leaves, on average.
        states: (T,) squares of its states, in units of their variance.
        each: (R, 2C) what every reference run leaves inside, then outside.
    """

    columns: tuple[Columns, ...]
    blocks: tuple[Block, ...]
    sigma: Array
    inside: Array
    outside: Array
    states: Array
    each: Array

    @classmethod
    def of(
        cls,
        runs: Sequence[Evidence],
        references: Sequence[Evidence],
        scores: Sequence[Score],
        sigma: Array,
        columns: int,
        jobs: int = 1,
    ) -> Table:
        """Of judged runs; `scores` are those of the references, of which each is held against the others.

        Without two references the floor is what white noise would leave.
        """
        channels = len(runs[0].limit)
        offset = common_offset(scores)
        own = tuple(Columns.of(run, channels, columns, offset) for run in runs)
        blocks = tuple(Block.of(run, of) for run, of in zip(runs, own, strict=True))

        def against_others(i: int) -> Block:
            others = [s for j, s in enumerate(scores) if j != i]
            of = Columns.of(references[i], channels, columns, common_offset(others))
            return Block.of(references[i], of)

        with ThreadPoolExecutor(jobs) as pool:
            floors = list(pool.map(against_others, range(len(references) if len(scores) > 1 else 0)))
        each = [energy(floor, floor.error, sigma, np.ones(channels)) for floor in floors]
        left = floor_of(floors, blocks, sigma)
        return cls(own, blocks, sigma, *left, np.array(each).reshape(-1, 2 * channels))

    def before(self) -> Left:
        """Of the gap as it is."""
        return self.left([block.error for block in self.blocks])

    def products(self, errors: Sequence[Array]) -> list[Products]:
        """Of other whitened errors of the runs."""
        return [of.products(error) for of, error in zip(self.columns, errors, strict=True)]

    def left(self, errors: Sequence[Products], steps: int = 2) -> Left:
        """What these errors, one a run, leave once each run's states are adapted."""
        weight = np.ones(len(self.inside))
        best: Left | None = None
        for _ in range(steps):
            inside, outside, states = energies(self.blocks, errors, self.sigma, weight)
            ratio, rest, far = (
                np.maximum(now / (len(self.blocks) * floor), 1.0)
                for now, floor in ((inside, self.inside), (outside, self.outside), (states, self.states))
            )
            weight = 1.0 / ratio
            found = Left(float(np.log(ratio).sum() + np.log(far.mean())), float(np.log(rest).sum()), weight)
            if best is None or found.total < best.total:
                best = found
        assert best is not None
        return best

    def linear(
        self, columns: Sequence[int], low: Array, high: Array, errors: Sequence[Products] | None = None
    ) -> tuple[Array, Left]:
        """Best sizes (k,) of some columns within bounds, to first order, and what they leave of `errors`."""
        first = [block.error for block in self.blocks] if errors is None else errors
        start = self.left(first)
        value, best = np.zeros(len(columns)), start
        weight = start.weight
        for _ in range(STEPS):
            tried = np.clip(self.solved(columns, first, weight), low, high)
            now = self.left([b.moved(e, columns, tried) for b, e in zip(self.blocks, first, strict=True)])
            weight = now.weight
            if now.total < best.total:
                value, best = tried, now
        return value, best

    def solved(self, columns: Sequence[int], errors: Sequence[Products], weight: Array) -> Array:
        """Sizes (k,) of some columns by weighted least squares, the states of each run with their prior."""
        k, T = len(columns), self.blocks[0].states
        A, b = np.eye(k) / WIDE**2, np.zeros(k)
        at = [*range(T), *(T + i for i in columns)]
        for block, error in zip(self.blocks, errors, strict=True):
            G = np.einsum("c,cij->ij", weight, block.gram[:, at][:, :, at])
            g = weight @ error.gain[:, at]
            X = np.linalg.solve(G[:T, :T] + np.diag(self.sigma**-2.0), np.column_stack([G[:T, T:], g[:T]]))
            A += G[T:, T:] - G[T:, :T] @ X[:, :-1]
            b += g[T:] - G[T:, :T] @ X[:, -1]
        return np.asarray(np.linalg.solve(A, b))


def energies(
    blocks: Sequence[Block], errors: Sequence[Products], sigma: Array, weight: Array
) -> tuple[Array, Array, Array]:
    """Squares (C,) inside and outside each channel's space once the states are adapted, and those (T,) of the
    states in units of their variance, summed over the runs."""
    inside, outside, states = np.zeros(len(weight)), np.zeros(len(weight)), np.zeros(len(sigma))
    for block, error in zip(blocks, errors, strict=True):
        T, theta = block.states, block.adapted(error, sigma, weight)
        gain = error.gain - block.gram[:, :, :T] @ theta
        square = error.square - (error.gain[:, :T] + gain[:, :T]) @ theta
        within = ((gain[:, None] @ block.inverse)[:, 0] * gain).sum(axis=1)
        inside += within
        outside += np.maximum(square - within, 0.0)
        states += (theta / sigma) ** 2
    return inside, outside, states


def energy(block: Block, error: Products, sigma: Array, weight: Array) -> Array:
    """Energies (2C,) of one run's error inside, then outside each channel's space."""
    inside, outside, _ = energies([block], [error], sigma, weight)
    return np.maximum(np.concatenate([inside, outside]), 1e-9)


def floor_of(floors: Sequence[Block], blocks: Sequence[Block], sigma: Array) -> tuple[Array, Array, Array]:
    """What a reference leaves inside and outside (C,), and its states (T,), on average; without any, what
    white noise and the states' own variance would."""
    if floors:
        weight = np.ones(len(floors[0].gram))
        inside, outside, states = energies(floors, [f.error for f in floors], sigma, weight)
        count = len(floors)
        floor = np.maximum(states / count, LEAST_STATE)
        return np.maximum(inside / count, 1e-9), np.maximum(outside / count, 1e-9), floor
    directions = np.mean([np.einsum("cij,cji->c", b.inverse, b.gram) for b in blocks], axis=0)
    rows = np.mean([b.rows for b in blocks], axis=0)
    return np.maximum(directions, 1.0), np.maximum(rows - directions, 1.0), np.ones(len(sigma))
