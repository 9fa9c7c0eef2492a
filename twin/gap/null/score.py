"""Efficient scores: what a run says about every effect with theta projected out.

With V = I + J_theta Sigma J_theta' the score is b = P' V^-1 e and its information A = P' V^-1 P (Neyman 1959,
C(alpha) tests; here theta is random with variance Sigma, so it is projected out as far as it varies).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

EM_STEPS = 6
PRIOR_RUNS = 3.0  # weight of the assumed variance of theta, in runs (assumed)
LEAST_SIGMA = 0.03  # least 1 sigma of theta, as a share of its unit (assumed)
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


def learn_state_sigma(runs: Sequence[WhitenedRun], first: Array) -> Array:
    """1 sigma (T,) of theta about its mean over the runs, by expectation-maximisation (Dempster et al.
    1977)."""
    sigma = first.copy()
    if len(runs) < 2:
        return sigma
    T = runs[0].states
    for _ in range(EM_STEPS):
        means, spreads = [], []
        for run in runs:
            H = np.linalg.inv(run.state_information(sigma))
            means.append(H @ run.gram[:T, -1])
            spreads.append(np.diag(H))
        centred = np.array(means) - np.mean(means, axis=0)
        observed = (centred**2).sum(axis=0) + (len(runs) - 1) / len(runs) * np.sum(spreads, axis=0)
        variance = (PRIOR_RUNS * first**2 + observed) / (PRIOR_RUNS + len(runs) - 1)
        sigma = np.maximum(np.sqrt(variance), LEAST_SIGMA * first)
    return sigma
