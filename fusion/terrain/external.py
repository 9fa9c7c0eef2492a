"""Class probabilities that a log brings along from a source of its own, such as a camera."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.core.channels import Terrain
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
    for t_ns, p in zip(terrain.t_ns.tolist(), terrain.probabilities.tolist(), strict=True):
        named = known_probabilities(dict(zip(terrain.classes, p, strict=True)), known)
        if named is not None:
            rows.append((int(t_ns), named))
    return rows


def known_probabilities(
    probabilities: Mapping[str, float], known: tuple[str, ...]
) -> dict[str, float] | None:
    """Probabilities of the classes `known`, all others as `unknown`; None where they are no probabilities."""
    p = np.fromiter(probabilities.values(), dtype=float)
    if not np.isfinite(p).all() or (p < 0.0).any() or not p.sum() > 0.0:
        return None
    named = dict.fromkeys(known, 0.0)
    for name, value in probabilities.items():
        named[name if name in named else UNKNOWN] += value
    return named
