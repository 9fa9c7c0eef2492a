"""Gauss-Markov steps of the linear states; see `datasets.core.gauss_markov`."""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.gauss_markov import markov_decay, markov_spread

_decay = functools.lru_cache(maxsize=256)(markov_decay)
"""Steps and correlation times hardly change from one keyframe to the next."""


@dataclass(frozen=True, eq=False)
class MarkovStep:
    """From one keyframe to the next: x_j = mean + decay (x_i - mean) + noise of `sigma`, each (n,)."""

    decay: Array
    mean: Array
    sigma: Array

    def residual(self, before: Array, now: Array) -> Array:
        """Noise (n,) that leads from `before` to `now`, unwhitened."""
        return np.asarray(now - self.mean - self.decay * (before - self.mean))

    def restarted(self, states: slice) -> "MarkovStep":
        """The step with `states` restarted: from their mean, with their stationary spread."""
        decay, sigma = self.decay.copy(), self.sigma.copy()
        sigma[states] /= np.sqrt(1.0 - decay[states] ** 2)
        decay[states] = 0.0
        return MarkovStep(decay, self.mean, sigma)

    def inflated(self, other: "MarkovStep", states: Array) -> "MarkovStep":
        """The step with `states` (indices) as in `other` where that forgets more of them."""
        taken = states[other.decay[states] < self.decay[states]]
        decay, mean, sigma = self.decay.copy(), self.mean.copy(), self.sigma.copy()
        decay[taken], mean[taken], sigma[taken] = other.decay[taken], other.mean[taken], other.sigma[taken]
        return MarkovStep(decay, mean, sigma)


def markov_step(
    dt_s: float, mean: ArrayLike, sigma: ArrayLike, time_s: float | tuple[float, ...], forget: ArrayLike = 0.0
) -> MarkovStep:
    """Exact step over `dt_s` of processes with the given moments and correlation times (n,).

    `forget` in [0, 1] is the probability that the process has just restarted, as slip does where the
    ground changes.
    """
    means, sigmas = np.asarray(mean, dtype=float), np.asarray(sigma, dtype=float)
    kept = 1.0 - np.minimum(np.maximum(np.asarray(forget, dtype=float), 0.0), 1.0)
    decay = kept * _decay(dt_s, time_s)
    return MarkovStep(decay, means, sigmas * markov_spread(decay))
