"""What is trained on and what is scored: by recording where there are several, else by halves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.studies.twin_field.forks import N_PAST, Forks

MASK = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Fold:
    """Masks (F,) of the forks to train on and to score; every fork is scored in exactly one fold."""

    train: MASK
    test: MASK


def folds(forks: Forks) -> tuple[list[Fold], str]:
    """Two folds of forks of one ground, and the rule they were made by.

    Recordings are taken in alternation where at least two know the forward speed; a single one, or ones
    that know different things, are cut in halves by time. Nothing is drawn at random.
    """
    known = np.isfinite(forks.motion[:, N_PAST, 0])
    if len(np.unique(forks.recording[known])) > 1:
        names = np.unique(forks.recording)
        one = np.isin(forks.recording, names[::2])
        return [Fold(one, ~one), Fold(~one, one)], "alternate recordings"
    one = np.zeros(len(forks), dtype=bool)
    for name in np.unique(forks.recording):
        groups = list(dict.fromkeys(forks.group[forks.recording == name].tolist()))
        one |= np.isin(forks.group, groups[: (len(groups) + 1) // 2])
    return [Fold(one, ~one), Fold(~one, one)], "halves of each recording"


def evenly(mask: MASK, most: int) -> MASK:
    """At most `most` of the forks of a mask, evenly spaced in their order."""
    rows = np.flatnonzero(mask)
    out = np.zeros(len(mask), dtype=bool)
    if len(rows):
        out[rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))]] = True
    return out
