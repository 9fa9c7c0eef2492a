"""Likelihood of a window's features on each ground.

Every class is a small mixture of Gaussians over the features, because a ground looks different flat and on
a slope. Features that were not observed are marginalised (dropped from mean and covariance, which is exact
for Gaussians); the variance of the slip estimate is added to that of its class. `unknown` is one broad
Gaussian around all grounds: it wins where every class fits badly. Log-likelihoods are divided by a
temperature calibrated on runs held out from training (Guo et al. 2017), as neighbouring windows repeat one
another.
"""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.config import refuse, structure
from terrafusion.datasets.core.quantity import Quantity, Word
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.fusion.terrain.features import FEATURES, SLIP, Window, extract
from terrafusion.fusion.terrain.spectrum import SpectrumClassifier, SpectrumFile, log_probabilities

SCHEMA = "terrafusion.terrain/1"
UNKNOWN = "unknown"
FOREIGN_SLIP = 0.03
"""1 sigma of the relative error of the rolling radius of a robot not trained on, which looks like slip.

Assumed; tyre pressure and load change the rolling radius of a pneumatic wheel by a few per cent."""
FOREIGN_UNKNOWN = 0.96
"""Prior of `unknown` for a robot not trained on that has not been seen to slip."""
SLIP_TEMPERATURE = 20.0
"""Windows per independent observation where slip alone is used: its estimate is correlated over about 10 s
(`slip_time_s` of the policy's fixed noise, and receivers drift as slowly), windows come twice a second."""
CLAIM_TEMPERATURE = 4.0
"""The same where slip checks what another source claims: good fixes show a new slip after 2 s, and a claim
given up in error leaves the robot with its own detector (assumed)."""
_BROAD_SHARE = 0.1


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
        classes: class name -> density of its features, without `unknown`.
        unknown: the broad density; its weight is calibrated, so it need not be 1.
        temperature: divisor of log-likelihoods (>= 1).
        patch_length_m: expected distance between two changes of ground.
        vehicles: names of the vehicles whose vibration the model knows.
        slip_only: use the slip alone; see `for_vehicle`.
        doubt: share of the probabilities that is spread evenly: a ground that looks like another may do so
            for a whole run, which more windows do not average out.
        spectrum: of a model of one robot's own logs: tells its grounds apart by their vibration.
        claimed: densities by which the claims of another source are checked, where not `classes`.
        scores: held-out figures of the training.
        inputs: name -> SHA-256 of the files of logs that it was trained on.
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
    doubt: float = 0.0
    spectrum: SpectrumClassifier | None = None
    inputs: dict[str, str] = dataclasses.field(default_factory=dict)
    claimed: dict[str, Mixture] | None = None

    def for_vehicle(self, name: str | None) -> Self:
        """The model for a robot.

        Vibration and skidding in turns depend more on tyres, chassis and IMU mounting than on the ground.
        A robot the model was not trained on is therefore classified by its slip alone, among the grounds
        that are known to slip: the others look like any firm ground, which is `unknown` for such a robot.
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
            doubt=0.0,
            spectrum=None,
            claimed=widened,
        )

    def of_claims(self) -> Self:
        """The model by which the claims of another source are checked."""
        if self.claimed is None:
            return self
        return dataclasses.replace(self, classes=self.claimed, temperature=CLAIM_TEMPERATURE)

    def prior(self, classes: tuple[str, ...]) -> Array:
        """Prior probabilities (k,) of the named classes.

        Names without a density look like `unknown`; they share a third of its probability, so that they
        neither take its place nor add to it until a camera names one.
        """
        k = len(classes)
        if not self.slip_only or k == 1:
            strange = np.array([name not in self.classes and name != UNKNOWN for name in classes])
            count = int(strange.sum())
            if not count:
                return np.full(k, 1.0 / k)
            known = [2.0 / 3.0 if name == UNKNOWN else 1.0 for name in classes]
            return np.where(strange, 1.0 / 3.0 / count, known) / (k - count)
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

    A name the model has no density for (a ground only a camera knows) gets the broad density of `unknown`.
    """

    def __init__(self, model: TerrainModel, classes: tuple[str, ...]) -> None:
        mixtures = [model.classes.get(name, model.unknown) for name in classes]
        self._log_weight = np.concatenate([m.log_weight for m in mixtures])
        self._mean = np.concatenate([m.mean for m in mixtures])
        self._covariance = np.concatenate([m.covariance for m in mixtures])
        self._starts = np.cumsum([0] + [len(m.log_weight) for m in mixtures[:-1]])
        self._temperature = model.temperature
        self._judged = np.arange(len(FEATURES)) == SLIP if model.slip_only else np.ones(len(FEATURES), bool)
        self._by_vibration = not model.slip_only
        grounds = () if model.spectrum is None else model.spectrum.grounds
        self._grounds = np.array([classes.index(name) for name in grounds], dtype=int)

    def of_window(self, window: Window, log_odds: Array | None) -> Array:
        """Tempered log-likelihoods (k,) of a window, known up to a constant.

        Given `log_odds` of the spectrum, the densities of the vibration tell whether the ground is one of
        those with a density, the spectrum which of these: p(x | c) = P(c | spectrum) sum of p(x | known).
        """
        values, variances = extract(window, self._by_vibration)
        if log_odds is None:
            return self.evaluate(values, variances)
        is_slip = np.arange(len(FEATURES)) >= SLIP
        vibration = self._log_densities(np.where(is_slip, np.nan, values), variances)
        known = np.logaddexp.reduce(vibration[self._grounds])
        vibration[self._grounds] = known + log_probabilities(log_odds)
        slips = self._log_densities(np.where(is_slip, values, np.nan), variances)
        return np.asarray((vibration + slips) / self._temperature)

    def evaluate(self, values: Array, variances: Array) -> Array:
        """Tempered log-likelihoods (k,) of the features (d,); zeros when none was observed.

        `variances` (d,) are those of the measurements themselves, added to the classes' own.
        """
        return np.asarray(self._log_densities(values, variances) / self._temperature)

    def _log_densities(self, values: Array, variances: Array) -> Array:
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
        return np.asarray(top + np.log(sums))


_FEATURE_VALUES = Quantity("", size=len(FEATURES))


@dataclass(frozen=True)
class ComponentFile:
    """One Gaussian of a density."""

    weight: Annotated[float, Quantity("", 1e-300, 1e300)]
    mean: Annotated[tuple[float, ...], _FEATURE_VALUES]
    covariance: tuple[Annotated[tuple[float, ...], _FEATURE_VALUES], ...]


@dataclass(frozen=True)
class TerrainModelFile:
    """Keys of a terrain model file."""

    schema: Annotated[str, Word((SCHEMA,))]
    made_by: str
    inputs_sha256: str
    vehicles: tuple[str, ...]
    features: tuple[str, ...]
    temperature: Annotated[float, Quantity("", 1.0, 1e3)]
    patch_length_m: Annotated[float, Quantity("m", 0.1, 1e5)]
    classes: dict[str, tuple[ComponentFile, ...]]
    unknown: tuple[ComponentFile, ...]
    scores: dict[str, Any]
    doubt: Annotated[float, Quantity("", 0.0, 0.99)] = 0.0
    spectrum: SpectrumFile | None = None
    inputs: dict[str, str] = dataclasses.field(default_factory=dict)


@functools.cache
def _shipped() -> TerrainModel:
    return load_terrain_model(Path(__file__).with_name("model.yaml"))


def load_terrain_model(path: Path | None = None) -> TerrainModel:
    """The model file `path`, or the one shipped with the library.

    Raises:
        ConfigError: unknown or missing key, wrong shape, a matrix that is no covariance.
    """
    if path is None:
        return _shipped()
    content = structure(TerrainModelFile, read_yaml(path), file=path)
    refuse(_problems(content), path)
    return TerrainModel(
        classes={name: _mixture(parts) for name, parts in content.classes.items()},
        unknown=_mixture(content.unknown),
        temperature=content.temperature,
        patch_length_m=content.patch_length_m,
        vehicles=content.vehicles,
        inputs_sha256=content.inputs_sha256,
        made_by=content.made_by,
        scores=content.scores,
        doubt=content.doubt,
        spectrum=None if content.spectrum is None else SpectrumClassifier.of_file(content.spectrum),
        inputs=content.inputs,
    )


def _problems(content: TerrainModelFile) -> Iterator[tuple[str, str]]:
    again = "make it again with 'terrafusion terrain train'"
    if content.features != FEATURES:
        yield (
            "'features' differ from what this version computes",
            f"{again}; it reads [{', '.join(FEATURES)}]",
        )
    if not content.classes or UNKNOWN in content.classes:
        yield "'classes' must map class names to mixtures, without 'unknown'", again
    if content.spectrum is not None:
        yield from ((what, again) for what in content.spectrum.problems(set(content.classes)))
    densities = {f"classes.{name}": parts for name, parts in content.classes.items()}
    for key, parts in (densities | {UNKNOWN: content.unknown}).items():
        if not parts:
            yield f"'{key}' is empty", f"give a list of weight, mean and covariance, or {again}"
        for i, part in enumerate(parts):
            matrix = np.array(part.covariance)
            square = len(part.covariance) == len(FEATURES) and np.allclose(matrix, matrix.T)
            if not square or not (np.linalg.eigvalsh(matrix) > 0.0).all():
                yield f"'{key}[{i}].covariance' is not symmetric and positive definite", again


def _mixture(parts: tuple[ComponentFile, ...]) -> Mixture:
    return Mixture(
        np.log([part.weight for part in parts]),
        np.array([part.mean for part in parts]),
        np.array([part.covariance for part in parts]),
    )
