"""Efficient scores: what a run says of every effect once theta is projected out.

With V = I + J_theta Sigma J_theta' the score is b = P' V^-1 e and its information A = P' V^-1 P (Neyman 1959,
C(alpha) tests; here theta is random with variance Sigma, so it is projected out as far as it varies).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.rollout.residuals import Evidence

Array = NDArray[np.float64]

EM_STEPS = 6
PRIOR_RUNS = 3.0
"""The assumed variance of theta counts as much as that of so many runs."""
LEAST_SIGMA = 0.03
"""Theta is never taken as known better than this share of its unit."""


@dataclass(frozen=True, eq=False)
class Score:
    """Score b (P,), information A (P, P) of one run, and the sum of squares that theta leaves.

    `other` (P, K, F): how the score changes by laws of another form (see `discrepancy`); None where they are
    not asked for.
    """

    b: Array
    A: Array
    square: float
    rows: int
    other: Array | None = None

    @functools.cached_property
    def root(self) -> Array:
        """(P,) factors that bring b to unit variance, and do not where it says nothing."""
        return np.asarray(1.0 / np.sqrt(np.diag(self.A) + 1.0))

    @functools.cached_property
    def fisher(self) -> Array:
        """(P, P) covariance of `root` times b, were the twin right."""
        return self.root[:, None] * self.A * self.root


def score(run: Evidence, sigma: Array) -> Score:
    """The score of a run with theta of the given 1 sigma (T,)."""
    T, G = run.states, run.gram
    solved = np.linalg.solve(G[:T, :T] + np.diag(sigma**-2.0), G[:T, T:])
    left = G[T:, T:] - G[:T, T:].T @ solved
    return Score(left[:-1, -1].copy(), left[:-1, :-1].copy(), float(left[-1, -1]), len(run.time_s))


def learnt_sigma(runs: Sequence[Evidence], first: Array) -> Array:
    """1 sigma (T,) of theta about its mean over the runs, by expectation-maximisation (Dempster et al.
    1977)."""
    sigma = first.copy()
    if len(runs) < 2:
        return sigma
    T = runs[0].states
    for _ in range(EM_STEPS):
        means, spreads = [], []
        for run in runs:
            H = np.linalg.inv(run.gram[:T, :T] + np.diag(sigma**-2.0))
            means.append(H @ run.gram[:T, -1])
            spreads.append(np.diag(H))
        centred = np.array(means) - np.mean(means, axis=0)
        shown = (centred**2).sum(axis=0) + (len(runs) - 1) / len(runs) * np.sum(spreads, axis=0)
        variance = (PRIOR_RUNS * first**2 + shown) / (PRIOR_RUNS + len(runs) - 1)
        sigma = np.maximum(np.sqrt(variance), LEAST_SIGMA * first)
    return sigma
