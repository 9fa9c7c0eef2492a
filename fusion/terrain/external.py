"""The ground as a log's external source has it: a camera's class probabilities, or true labels."""

from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.terrain.classifier import UNKNOWN

TRUE_SOURCES = ("annotation", "simulation")
"""Sources that did not exist while driving: they are for scoring, not for the estimator."""


def true_grounds(recording: Recording) -> list[tuple[int, str]]:
    """Start (ns) and name of each ground that a recording is labelled with; none without true labels.

    From its terrain channel if annotated or simulated, else from its terrain name.
    """
    terrain = recording.terrain
    if terrain is not None and len(terrain) and terrain.source in TRUE_SOURCES:
        label = terrain.label.astype(str)
        first = np.flatnonzero(np.concatenate([[True], label[1:] != label[:-1]]))
        return list(zip(terrain.t_ns[first].tolist(), label[first].tolist(), strict=True))
    return [(recording.start_ns, recording.terrain_name)] if recording.terrain_name else []


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
