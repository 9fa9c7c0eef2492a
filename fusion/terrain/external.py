"""Class probabilities of a log's external source, such as a camera."""

from collections.abc import Mapping

import numpy as np

from terrafusion.fusion.terrain.classifier import UNKNOWN

TRUE_SOURCES = ("annotation", "simulation")
"""Sources that did not exist while driving: they are for scoring, not for the estimator."""


def known_probabilities(
    probabilities: Mapping[str, float], known: tuple[str, ...]
) -> dict[str, float] | None:
    """Probabilities of the classes `known`, all others as `unknown`; None where they are no probabilities."""
    if not isinstance(probabilities, Mapping):
        return None
    try:
        p = np.fromiter(probabilities.values(), dtype=float)
    except (TypeError, ValueError, OverflowError):
        return None
    if not np.isfinite(p).all() or (p < 0.0).any() or not p.sum() > 0.0:
        return None
    named = dict.fromkeys(known, 0.0)
    for name, value in zip(probabilities, p.tolist(), strict=True):
        named[name if name in named else UNKNOWN] += value
    return named
