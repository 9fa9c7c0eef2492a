"""Laws of another form: what an effect's signature could be, were its law not quite that of the catalogue.

A law of another form enters at the same place and depends otherwise on the state: on speed, on turn rate,
on time. Each column's signature is therefore also taken times such functions; their coefficients are small
against the effect's own. (A model discrepancy after Kennedy and O'Hagan 2001, by a basis in place of a
Gaussian process.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.rollout.nuisance import BASIS, basis
from terrafusion.twin.gap.rollout.residuals import Evidence

Array = NDArray[np.float64]

FUNCTIONS = ("speed", "abs_turn", "turn_rate", "acceleration", "time")
"""What signatures are multiplied with, each of mean zero and variance one over a run."""


def modulated(run: Evidence, model: Model, sigma: Array, columns: int) -> Array:
    """How scores (P,) change by each function times each of the first `columns` columns: (P, columns, F)."""
    f = np.column_stack([basis(run.log, model, run.time_s), run.time_s])
    f = f[:, [*map(BASIS.index, FUNCTIONS[:-1]), -1]]
    f = (f - f.mean(axis=0)) / np.maximum(f.std(axis=0), 1e-9)
    T, rows = run.states, run.rows[:, :-1]
    P = rows.shape[1] - T
    out = np.empty((P, columns, f.shape[1]))
    H = run.gram[:T, :T] + np.diag(sigma**-2.0)
    back = np.linalg.solve(H, run.gram[:T, T:-1])
    for j in range(f.shape[1]):
        inner = (rows.T @ (rows[:, T : T + columns] * f[:, j : j + 1].astype(np.float32))).astype(float)
        out[:, :, j] = inner[T:] - back.T @ inner[:T]
    return out
