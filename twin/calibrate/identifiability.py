"""What the data identify: the information matrix in units of the prior, and its weak directions.

Parameters are scaled by their prior sigmas, so that the posterior sigma along a direction is 1 where the log
holds no information on it. Sensor errors and poses are marginalised beforehand.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array

IDENTIFIED_RATIO = 0.5
"""A parameter is identified when the log at least halves its prior sigma."""
MEMBER = 0.3
"""A parameter belongs to a direction when its weight in the unit vector is at least this."""

IDENTIFIED, COMBINED, NOT_IDENTIFIED = "identified", "only in combination", "not identified"
"""Values of `status` in calibration.json."""


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the data do not identify.

    Attributes:
        weights: by name, in prior sigmas, of the members.
        ratio: posterior over prior sigma along it.
        sentence: in words.
    """

    weights: dict[str, float]
    ratio: float
    sentence: str


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What the data say of P parameters.

    Attributes:
        ratio: (P,) posterior over prior sigma.
        alone: (P,) the same if all other parameters were known.
        status: (P,) `IDENTIFIED`, `COMBINED` or `NOT_IDENTIFIED`.
        eigenvalues: (P,) of the data's information in units of the prior's, falling.
        eigenvectors: (P, P) in columns.
        weak: the directions that are not identified.
    """

    ratio: Array
    alone: Array
    status: tuple[str, ...]
    eigenvalues: Array
    eigenvectors: Array
    weak: tuple[Direction, ...]


def examine(names: Sequence[str], covariance: Array) -> Identifiability:
    """Identifiability from the posterior covariance (P, P) in prior sigmas."""
    precision = np.linalg.inv(covariance)
    ratio, alone = np.sqrt(np.diag(covariance)), 1.0 / np.sqrt(np.diag(precision))
    known = [ratio <= IDENTIFIED_RATIO, alone <= IDENTIFIED_RATIO]
    status = tuple(np.select(known, [IDENTIFIED, COMBINED], NOT_IDENTIFIED).tolist())
    values, vectors = np.linalg.eigh(precision - np.eye(len(names)))
    values, vectors = values[::-1], vectors[:, ::-1]
    ratios = 1.0 / np.sqrt(np.maximum(1.0 + values, 1e-12))
    weak = [_direction(names, vectors[:, i], ratios[i]) for i in np.flatnonzero(ratios > IDENTIFIED_RATIO)]
    return Identifiability(ratio, alone, status, np.maximum(values, 0.0), vectors, tuple(weak))


def _direction(names: Sequence[str], vector: Array, ratio: float) -> Direction:
    order = np.argsort(-np.abs(vector))
    members = [int(i) for i in order if abs(vector[i]) >= MEMBER] or [int(order[0])]
    sign = 1.0 if vector[members[0]] >= 0.0 else -1.0
    weights = {names[i]: round(sign * float(vector[i]), 3) for i in members}
    left = f"the log leaves {100.0 * ratio:.0f} % of the prior sigma"
    if len(members) == 1:
        return Direction(weights, ratio, f"{names[members[0]]} is not identified by this data ({left})")
    moves = " and ".join(f"{name} {'up' if weight > 0.0 else 'down'}" for name, weight in weights.items())
    listed = ", ".join(list(weights)[:-1]) + f" and {list(weights)[-1]}"
    return Direction(
        weights, ratio, f"{listed} are identified only in combination: {moves} looks the same ({left})"
    )
