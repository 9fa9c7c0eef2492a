"""Bootstrap over whole groups: what belongs together is drawn together (Efron and Tibshirani 1993)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def resamples(group: NDArray[Any], count: int, seed: int) -> list[NDArray[np.int64]]:
    """Rows of `count` resamples of the groups (F,), with replacement, each of as many groups as there are."""
    rng = np.random.default_rng(seed)
    names, index = np.unique(group, return_inverse=True)
    members = [np.flatnonzero(index == k) for k in range(len(names))]
    return [
        np.concatenate([members[k] for k in rng.integers(len(names), size=len(names))]) for _ in range(count)
    ]
