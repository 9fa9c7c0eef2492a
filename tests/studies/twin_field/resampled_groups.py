"""Bootstrap over whole groups of rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def resampled_groups(group: NDArray[Any], resamples: int, seed: int) -> list[NDArray[np.int64]]:
    """Row numbers of resamples of whole groups (F,): rows of one group are drawn together."""
    rng = np.random.default_rng(seed)
    names, index = np.unique(group, return_inverse=True)
    members = [np.flatnonzero(index == k) for k in range(len(names))]
    return [
        np.concatenate([members[k] for k in rng.integers(len(names), size=len(names))])
        for _ in range(resamples)
    ]
