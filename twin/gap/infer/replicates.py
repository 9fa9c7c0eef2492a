"""Twin replicates: runs that differ by nothing but noise and theta, where references are too few.

They are drawn in the whitened rows: e = J_theta theta + noise, poses projected out, which is what the twin
itself says of the scatter from run to run. What it does not know of, they do not show: an answer made with
them is uncalibrated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.infer.refit import scored
from terrafusion.twin.gap.null.score import Score, score
from terrafusion.twin.gap.rollout.residuals import Evidence

Array = NDArray[np.float64]

COUNT = 20
"""Replicates that stand in for references."""


def replicates(
    templates: Sequence[Evidence], sigma: Array, common: Array | None, count: int, seed: int
) -> list[Score]:
    """Scores of replicates, each driven as one of the templates was.

    Args:
        common: (P,) coefficients that all references share; None: nothing.
    """
    rng, out = np.random.default_rng(seed), []
    for i in range(count):
        run = templates[i % len(templates)]
        T = run.states
        error = run.rows[:, :T].astype(float) @ (sigma * rng.standard_normal(T))
        noise = rng.standard_normal(len(run.time_s))
        for k in np.unique(run.window):
            mine = run.window == k
            noise[mine] -= run.frame[mine] @ (run.frame[mine].T @ noise[mine])
        error += noise
        if common is not None:
            error += run.rows[:, T:-1].astype(float) @ common
        out.append(scored(run, sigma, error, score(run, sigma).A))
    return out
