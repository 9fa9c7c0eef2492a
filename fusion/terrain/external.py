"""Class probabilities that a log brings along from a source of its own, such as a camera."""

from __future__ import annotations

import numpy as np

from terrafusion.datasets.core.recording import Terrain
from terrafusion.fusion.terrain.classifier import UNKNOWN

TRUE_SOURCES = ("annotation", "simulation")
"""Sources that were not there when the robot drove: they are for scoring, not for the estimator."""


def external_probabilities(
    terrain: Terrain | None, known: tuple[str, ...]
) -> list[tuple[int, dict[str, float]]]:
    """Time and probabilities by class, for `Estimator.add_terrain`; empty where the log has none.

    What the source gives to classes the policy does not know counts as `unknown`.
    Rows that are not finite, negative or all zero are left out.
    """
    if terrain is None or terrain.probabilities is None or terrain.source in TRUE_SOURCES:
        return []
    rows = []
    for t_ns, p in zip(terrain.t_ns.tolist(), terrain.probabilities, strict=True):
        if not np.isfinite(p).all() or (p < 0.0).any() or not p.sum() > 0.0:
            continue
        named = dict.fromkeys(known, 0.0)
        for name, value in zip(terrain.classes, p.tolist(), strict=True):
            named[name if name in named else UNKNOWN] += value
        rows.append((int(t_ns), named))
    return rows
