"""Calibration head: from log evidence to probabilities.

Four numbers that the model itself does not give: a temperature, since the errors of laws are correlated in
ways that the discrepancy does not have; the log odds of a cause outside the catalogue; and how wrong a size
is, as a share of it, because the robot's law is another. They are fitted to sets of the twin (`python -m
tests.studies.gap_sets`).
"""

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.infer.explain import Explanation, Sets

SEVERAL = (0.8, 0.17)  # prior of one and of two effects (assumed: the rest is for more)
LAPSE = 0.02  # probability that the evidence does not hold (assumed), spread evenly over all sets


@dataclass(frozen=True)
class Head:
    """The numbers.

    Attributes:
        temperature: divides the log evidence.
        unknown: log odds of an unknown cause before the runs.
        law_motion, law_sensor: 1 sigma of a size, as a share of it, of effects on the motion and of delays,
            and of others of the sensors.
    """

    temperature: float
    unknown: float
    law_motion: float
    law_sensor: float


@functools.cache
def calibration_head() -> Head:
    """The one that comes with the package.

    Raises:
        ConfigError: the file lacks a number.
    """
    from terrafusion.datasets.core.config import structure
    from terrafusion.datasets.core.yaml_file import read_yaml

    path = Path(__file__).with_name("head.yaml")
    return structure(Head, read_yaml(path), file=path, key="")


def _weighted(found: Explanation, effects: int, temperature: float) -> tuple[list[Sets], Array]:
    """Log of prior times evidence of each set."""
    names = list(found.evidence)
    prior = [math.log(SEVERAL[len(name) - 1] / math.comb(effects, len(name))) for name in names]
    return names, np.array([found.evidence[name] for name in names]) / temperature + prior


def log_odds(found: Explanation, effects: int) -> float:
    """Of any effect against none, at even prior odds; `effects` is the number of candidates."""
    return float(np.logaddexp.reduce(_weighted(found, effects, 1.0)[1]))


def probabilities(
    found: Explanation, effects: int, head: Head, p_value: float
) -> tuple[dict[Sets, float], float]:
    """Of the sets and of an unknown cause, given that there is a gap.

    The evidence for an unknown cause is that of a change along the nuisance basis, or the greatest that the
    p-value of the gap allows (Sellke, Bayarri and Berger 2001, eq. 3): a gap of any shape.
    """
    names, values = _weighted(found, effects, head.temperature)
    p = min(max(p_value, 1e-300), math.exp(-1.0))
    outside = float(np.logaddexp(found.outside / head.temperature, -math.log(-math.e * p * math.log(p))))
    values = np.append(values, outside + head.unknown)
    shares = np.exp(values - values.max())
    shares = (1.0 - LAPSE) * shares / shares.sum() + LAPSE / len(shares)
    return dict(zip(names, shares[:-1].tolist(), strict=True)), float(shares[-1])
