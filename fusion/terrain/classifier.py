"""How probable the features of a window are on each ground.

Every class is a small mixture of Gaussians over the features, because a ground
looks different flat and on a slope. Features that were not observed are
marginalised (dropped from mean and covariance, which is exact for Gaussians);
the variance of the slip estimate is added to that of its class. `unknown` is
one broad Gaussian around all grounds: it wins where every class fits badly.
The logarithms are divided by a temperature calibrated on drives held out from
training (Guo et al. 2017), as neighbouring windows repeat one another.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.config import Quantity, checked_number, read_yaml
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.terrain.features import FEATURES, SLIP

Array = NDArray[np.float64]

SCHEMA = "terrafusion.terrain/1"
UNKNOWN = "unknown"
FOREIGN_SLIP = 0.03
"""1 sigma of the relative error of the rolling radius of a robot not trained on: it looks like slip.

Assumed; tyre pressure and load move the rolling radius of a pneumatic wheel by a few per cent.
"""
FOREIGN_UNKNOWN = 0.96
"""Share of `unknown` where a robot not trained on has not been seen to slip."""
SLIP_TEMPERATURE = 20.0
"""Windows that are one observation where slip alone is judged: its estimate stays as it is for about 10 s
(`slip_time_s` of the policy's fixed row, and receivers wander as slowly), windows come twice a second."""
_BROAD_SHARE = 0.1

_KEYS = (
    "schema", "made_by", "inputs_sha256", "vehicles", "features", "temperature", "patch_length_m", "classes",
    "unknown", "scores",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Mixture:
    """Gaussians over the features: `log_weight` (m,), `mean` (m, d), `covariance` (m, d, d)."""

    log_weight: Array
    mean: Array
    covariance: Array

    def mean_of(self, feature: int) -> float:
        """Mean of one feature over the whole mixture."""
        weight = np.exp(self.log_weight)
        return float(weight @ self.mean[:, feature] / weight.sum())


@dataclass(frozen=True, eq=False)
class TerrainModel:
    """Class densities and what the sequence filter needs.

    Attributes:
        classes: class name -> density of its features, `unknown` not among them.
        unknown: the broad density; its weight is calibrated, so it need not be 1.
        temperature: what log-likelihoods are divided by (>= 1).
        patch_length_m: expected distance between two changes of ground.
        vehicles: names of the vehicles whose vibration the model knows.
        slip_only: judge by the slip alone; see `for_vehicle`.
        scores: held-out figures of the training.
    """

    classes: dict[str, Mixture]
    unknown: Mixture
    temperature: float
    patch_length_m: float
    vehicles: tuple[str, ...]
    inputs_sha256: str = ""
    made_by: str = ""
    scores: dict[str, Any] = dataclasses.field(default_factory=dict)
    slip_only: bool = False

    def for_vehicle(self, name: str | None) -> TerrainModel:
        """The model as it holds for a robot.

        How much a robot trembles, and how it skids in a turn, says more of its
        tyres, its chassis and where its IMU sits than of the ground. A robot
        the model was not trained on is therefore judged by its slip alone, and
        only grounds it is known to slip on can be named: the others look like
        any firm ground, which for such a robot is `unknown`.
        """
        if name in self.vehicles:
            return self
        doubt = np.zeros((len(FEATURES), len(FEATURES)))
        doubt[SLIP, SLIP] = FOREIGN_SLIP**2
        widened = {
            n: dataclasses.replace(m, covariance=m.covariance + doubt) for n, m in self.classes.items()
        }
        firm = [n for n, m in widened.items() if abs(m.mean_of(SLIP)) < FOREIGN_SLIP]
        unknown = self.unknown
        if firm:
            known = _pooled([widened[n] for n in firm], [(1.0 - _BROAD_SHARE) / len(firm)] * len(firm))
            broad = dataclasses.replace(self.unknown, log_weight=np.zeros(1))
            unknown = _pooled([known, broad], [1.0, _BROAD_SHARE])
        slippery = {n: m for n, m in widened.items() if n not in firm}
        return dataclasses.replace(
            self,
            classes=slippery,
            unknown=unknown,
            temperature=max(self.temperature, SLIP_TEMPERATURE),
            slip_only=True,
        )

    def prior(self, classes: tuple[str, ...]) -> Array:
        """Probabilities (k,) of the named classes before anything was observed."""
        k = len(classes)
        if not self.slip_only or k == 1:
            return np.full(k, 1.0 / k)
        others = (1.0 - FOREIGN_UNKNOWN) / (k - 1)
        return np.array([FOREIGN_UNKNOWN if name == UNKNOWN else others for name in classes])


def _pooled(mixtures: list[Mixture], weights: list[float]) -> Mixture:
    """One mixture out of several, `weights` on their own."""
    return Mixture(
        np.concatenate([m.log_weight + np.log(w) for m, w in zip(mixtures, weights, strict=True)]),
        np.concatenate([m.mean for m in mixtures]),
        np.concatenate([m.covariance for m in mixtures]),
    )


class LikelihoodTable:
    """The densities of the named classes in one stack, evaluated together.

    A name the model has no density for (a ground only a camera knows) gets the
    broad density of `unknown`.
    """

    def __init__(self, model: TerrainModel, classes: tuple[str, ...]) -> None:
        mixtures = [model.classes.get(name, model.unknown) for name in classes]
        self._log_weight = np.concatenate([m.log_weight for m in mixtures])
        self._mean = np.concatenate([m.mean for m in mixtures])
        self._covariance = np.concatenate([m.covariance for m in mixtures])
        self._starts = np.cumsum([0] + [len(m.log_weight) for m in mixtures[:-1]])
        self._temperature = model.temperature
        self._judged = np.arange(len(FEATURES)) == SLIP if model.slip_only else np.ones(len(FEATURES), bool)

    def evaluate(self, values: Array, variances: Array) -> Array:
        """Tempered log-likelihoods (k,) of the features (d,); zeros when none was observed.

        `variances` (d,) are those of the measurements themselves, added to the classes' own.
        """
        seen = np.flatnonzero(np.isfinite(values) & self._judged)
        if not seen.size:
            return np.zeros(len(self._starts))
        covariance = self._covariance[:, seen[:, None], seen] + np.diag(variances[seen])
        root = np.linalg.cholesky(covariance)
        whitened = np.linalg.solve(root, (values[seen] - self._mean[:, seen])[:, :, None])[:, :, 0]
        log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        log_p = self._log_weight - log_det - 0.5 * (whitened * whitened).sum(axis=1)
        top = np.maximum.reduceat(log_p, self._starts)
        sizes = np.diff(np.append(self._starts, len(log_p)))
        sums = np.add.reduceat(np.exp(log_p - np.repeat(top, sizes)), self._starts)
        return np.asarray((top + np.log(sums)) / self._temperature)


def load_terrain_model(path: Path | None = None) -> TerrainModel:
    """The model file `path`, or the one shipped with the library.

    Raises:
        ConfigError: unknown or missing key, wrong shape, a covariance that is none.
    """
    if path is None:
        with resources.as_file(resources.files("terrafusion.fusion.terrain") / "model.yaml") as shipped:
            return _parse(read_yaml(shipped), shipped)
    return _parse(read_yaml(path), path)


def _parse(content: dict[str, Any], file: Path) -> TerrainModel:
    again = "make it again with 'terrafusion terrain train'"
    if content.get("schema") != SCHEMA:
        raise ConfigError(
            f"schema is '{content.get('schema')}'", file=file, remedy=f"this version reads {SCHEMA}"
        )
    for key in content:
        if key not in _KEYS:
            raise ConfigError(f"unknown key '{key}'", file=file, remedy=f"known: {', '.join(_KEYS)}")
    for key in _KEYS:
        if key not in content:
            raise ConfigError(f"'{key}' is missing", file=file, remedy=again)
    if content["features"] != list(FEATURES):
        raise ConfigError(
            "'features' differ from what this version computes",
            file=file,
            remedy=f"{again}; it must read [{', '.join(FEATURES)}]",
        )
    classes = content["classes"]
    if not isinstance(classes, dict) or not classes or UNKNOWN in classes:
        raise ConfigError("'classes' must map class names to mixtures, without 'unknown'", file=file)
    vehicles = content["vehicles"]
    if not isinstance(vehicles, list) or not isinstance(content["scores"], dict):
        raise ConfigError("'vehicles' must be a list and 'scores' a mapping", file=file, remedy=again)
    return TerrainModel(
        classes={name: _mixture(raw, file, f"classes.{name}") for name, raw in classes.items()},
        unknown=_mixture(content["unknown"], file, UNKNOWN),
        temperature=_number(content["temperature"], Quantity("", 1.0, 1e3), file, "temperature"),
        patch_length_m=_number(content["patch_length_m"], Quantity("m", 0.1, 1e5), file, "patch_length_m"),
        vehicles=tuple(str(name) for name in vehicles),
        inputs_sha256=str(content["inputs_sha256"]),
        made_by=str(content["made_by"]),
        scores=content["scores"],
    )


def _number(raw: Any, quantity: Quantity, file: Path, key: str) -> float:
    value = checked_number(raw, quantity, file=file, key=key)
    assert isinstance(value, float)
    return value


def _mixture(raw: Any, file: Path, key: str) -> Mixture:
    """Densities from a list of {weight, mean, covariance}."""
    d = len(FEATURES)
    if not isinstance(raw, list) or not raw:
        raise ConfigError(f"'{key}' must be a list of weight, mean and covariance", file=file)
    for part in raw:
        if not isinstance(part, dict) or set(part) != {"weight", "mean", "covariance"}:
            raise ConfigError(f"'{key}' must have exactly the keys weight, mean, covariance", file=file)
    try:
        weight = np.array([part["weight"] for part in raw], dtype=float)
        mean = np.array([part["mean"] for part in raw], dtype=float)
        covariance = np.array([part["covariance"] for part in raw], dtype=float)
    except (TypeError, ValueError):
        raise ConfigError(f"'{key}' holds something that is no number", file=file) from None
    if mean.shape != (len(raw), d) or covariance.shape != (len(raw), d, d):
        raise ConfigError(f"'{key}' needs {d} means and a {d} x {d} covariance", file=file)
    definite = np.isfinite(covariance).all() and (np.linalg.eigvalsh(covariance) > 0.0).all()
    if not definite or not np.allclose(covariance, np.swapaxes(covariance, 1, 2)):
        raise ConfigError(f"'{key}.covariance' is not symmetric and positive definite", file=file)
    if not np.isfinite(mean).all() or not (weight > 0.0).all() or not np.isfinite(weight).all():
        raise ConfigError(f"'{key}' needs finite means and positive weights", file=file)
    return Mixture(np.log(weight), mean, covariance)
