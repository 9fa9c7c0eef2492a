"""Efficient scores: what a run says about every effect with theta projected out.

With V = I + J_theta Sigma J_theta' the score is b = P' V^-1 e and its information A = P' V^-1 P (Neyman 1959,
C(alpha) tests; here theta is random with variance Sigma, so it is projected out as far as it varies).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

REPLICATES = 20  # twin replicates that stand in for references


@dataclass(frozen=True, eq=False)
class Score:
    """Score b (P,) and information A (P, P) of one run."""

    b: Array
    A: Array


def without_states(gram: Array, sigma: Array) -> Array:
    """Inner products (M, M) of all columns but the states, those (T + M, T + M) of all given, with theta of
    1 sigma (T,) projected out."""
    T = len(sigma)
    solved = np.linalg.solve(gram[:T, :T] + np.diag(sigma**-2.0), gram[:T, T:])
    return np.asarray(gram[T:, T:] - gram[:T, T:].T @ solved)


def score(run: WhitenedRun, sigma: Array) -> Score:
    """The score of a run with theta of the given 1 sigma (T,)."""
    rest = without_states(run.gram, sigma)
    return Score(rest[:-1, -1].copy(), rest[:-1, :-1].copy())


def replicates(templates: Sequence[WhitenedRun], sigma: Array, offset: Array | float) -> list[Score]:
    """Expected scores of twin replicates of the templates, all of which have the parameters `offset` (P,).

    The scatter that is learned from them is the twin's own; a diagnosis that relies on it is uncalibrated.
    """
    information = [score(run, sigma).A for run in templates]
    every = itertools.islice(itertools.cycle(information), REPLICATES)
    return [Score((A * offset).sum(axis=1), A) for A in every]
