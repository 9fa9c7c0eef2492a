"""Model discrepancy: how an effect's sensitivity would differ if its law were not quite that of the
catalogue.

A law of another form acts at the same place and depends otherwise on the state: on speed, turn rate, time.
Each column's sensitivity is therefore also multiplied by such functions, whose coefficients are small against
the effect's own (after Kennedy and O'Hagan 2001, with a basis in place of a Gaussian process).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.rollout.nuisance import BASIS, command_basis
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

Array = NDArray[np.float64]

FUNCTIONS = ("speed", "abs_turn", "turn_rate", "acceleration", "time")
"""Factors of the sensitivities, each of mean zero and variance one over a run."""


def discrepancy_of(run: WhitenedRun, model: Model, sigma: Array, columns: int) -> Array:
    """Change of the scores (P,) by each function times each of the first `columns` columns: (P, columns,
    F)."""
    f = np.column_stack([command_basis(run.log, model, run.time_s), run.time_s])
    f = f[:, [*map(BASIS.index, FUNCTIONS[:-1]), -1]]
    f = (f - f.mean(axis=0)) / np.maximum(f.std(axis=0), 1e-9)
    T, rows = run.states, run.rows[:, :-1]
    out = np.empty((rows.shape[1] - T, columns, f.shape[1]))
    back = np.linalg.solve(run.state_information(sigma), run.gram[:T, T:-1])
    for j in range(f.shape[1]):
        inner = (rows.T @ (rows[:, T : T + columns] * f[:, j : j + 1].astype(np.float32))).astype(float)
        out[:, :, j] = inner[T:] - back.T @ inner[:T]
    return out
