"""Factors as numbers, and back: for files that must not be able to do harm.

GTSAM writes a factor as text: structure (classes, keys, counts) and numbers. Reading such a text from an
untrusted file would let the file determine what is built and how large. Here a file holds the numbers
alone; the structure is that of a factor of the same kind which this process has made and written itself.
"""

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError


@dataclass(frozen=True, eq=False)
class FactorNumbers:
    """One factor: GTSAM class `kind`, keys, noise model, its size, and all numbers."""

    kind: str
    keys: list[int]
    noise: str
    dim: int
    numbers: Array


def numbers_of(factor: Any) -> FactorNumbers:
    """What `factor_from` needs to make the same factor, to the last bit.

    Raises:
        TypeError: a kind of factor that `_KINDS` does not list.
    """
    kind, noise = type(factor).__name__, type(factor.noiseModel()).__name__
    if kind not in _KINDS or noise not in _NOISES:
        raise TypeError(f"a {kind} with {noise} noise cannot be written: list it in factor_numbers")
    numbers = [float(text) for text in _NUMBER.findall(factor.serialize())]
    return FactorNumbers(kind, list(factor.keys()), noise, factor.noiseModel().dim(), np.array(numbers))


def factor_from(record: FactorNumbers) -> Any:
    """The factor of a record.

    Raises:
        ConfigError: no factor has such numbers.
    """
    make = _KINDS.get(record.kind)
    noise = _NOISES.get(record.noise)
    if make is None or noise is None or not 1 <= record.dim <= 15:
        raise ConfigError(f"unknown factor {record.kind} with {record.noise} noise of {record.dim}")
    try:
        factor = make(record.keys, noise(record.dim))
    except (TypeError, ValueError, RuntimeError):
        raise ConfigError(f"a {record.kind} cannot have the keys and the noise given") from None
    own = factor.serialize()
    count = len(_NUMBER.findall(own))
    if record.numbers.shape != (count,) or not np.isfinite(record.numbers).all():
        raise ConfigError(f"a {record.kind} with {record.noise} noise has {count} finite numbers")
    numbers = iter(record.numbers.tolist())
    factor.deserialize(_NUMBER.sub(lambda _: f"{next(numbers):.17e}", own))
    return factor


_NUMBER = re.compile(r"-?\d\.\d+e[+-]\d+")
"""GTSAM writes every real number with a point and an exponent, and nothing else so."""


@functools.cache
def _no_motion() -> gtsam.PreintegratedCombinedMeasurements:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(1.0)
    params.setBodyPSensor(gtsam.Pose3())
    measured = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias())
    measured.integrateMeasurement(np.array([0.0, 0.0, 1.0]), np.zeros(3), 1.0)
    return measured


_GTSAM: Any = gtsam  # its stubs know no call with a list of keys

_KINDS: dict[str, Callable[[list[int], Any], Any]] = {
    "CombinedImuFactor": lambda keys, _: _GTSAM.CombinedImuFactor(*keys, _no_motion()),
    "BetweenFactorPose3": lambda keys, noise: _GTSAM.BetweenFactorPose3(*keys, gtsam.Pose3(), noise),
    "BetweenFactorVector": lambda keys, noise: _GTSAM.BetweenFactorVector(
        *keys, np.zeros(noise.dim()), noise
    ),
    "BetweenFactorConstantBias": lambda keys, noise: _GTSAM.BetweenFactorConstantBias(
        *keys, gtsam.imuBias.ConstantBias(), noise
    ),
    "PriorFactorVector": lambda keys, noise: _GTSAM.PriorFactorVector(*keys, np.zeros(noise.dim()), noise),
    "GPSFactorArm": lambda keys, noise: _GTSAM.GPSFactorArm(*keys, np.zeros(3), np.zeros(3), noise),
    "AttitudeFactorPose3": lambda keys, noise: _GTSAM.AttitudeFactorPose3(
        *keys, gtsam.Unit3(0.0, 0.0, 1.0), noise, gtsam.Unit3(0.0, 0.0, 1.0)
    ),
}

_NOISES: dict[str, Callable[[int], Any]] = {
    "Isotropic": lambda dim: gtsam.noiseModel.Isotropic.Sigma(dim, 0.5),
    "Diagonal": lambda dim: gtsam.noiseModel.Diagonal.Sigmas(0.25 + np.arange(dim)),
    "Unit": lambda dim: gtsam.noiseModel.Unit.Create(dim),
    "Gaussian": lambda dim: gtsam.noiseModel.Unit.Create(dim),
}
