"""Ground classifier of one robot: calibrated softmax regression over its surface features, in a YAML file.

Multinomial logistic regression, fitted by scikit-learn, evaluated here without it. Cross-validated by run it
is better than a forest on BorealTC (docs/explanation/terrain.md). Missing features count as the training
mean; training on copies of the windows without whole feature groups keeps it calibrated then.

A change of ground raises an alarm: the classes' log-odds of the last second differ from their mean over the
seconds before by more than they do along runs on one ground (Hotelling's T^2 per degree of freedom). Unlike
probabilities, log-odds do not saturate: a change shows although the new ground is taken for a wrong class.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError, TerrafusionError
from terrafusion.datasets.core.yaml_file import dump_yaml, read_yaml
from terrafusion.fusion.terrain.sequence import PatchFilter
from terrafusion.fusion.training.surface_features import (
    GROUPS,
    HOP_S,
    SURFACE_FEATURES,
    WINDOW_S,
    SurfaceWindows,
)

SCHEMA = "terrafusion.surface/2"
PATCH_LENGTH_M = 10.0
WINDOWS_ACROSS_A_CHANGE = round(WINDOW_S / HOP_S)
"""Windows after a change that contain some of the ground before: for them only the last second is used."""
STRENGTH = 0.1
"""Inverse of the L2 penalty on the weights of standardised features."""
ERROR_SHARE = 1e-3
"""Probability floor, so that no single window excludes a class."""
UNKNOWN_SHARE = 0.05
"""Share of windows of known ground that may be classified as unknown (split conformal, Vovk et al. 2005)."""
_NUMBERS = ("mean", "scale", "weights", "offsets", "centres", "precision", "alarm")
_PLAIN = ("schema", "made_by", "inputs", "features", "classes", "temperature", "odd_distance")
ALARM_MEMORY, ALARM_LEAST = 6, 3
"""Windows before, at most and at least, that the newest is compared with."""
ALARM_OVERLAP = 1
"""Windows just before the newest that share samples with it, and are left out."""
ALARM_LIMIT = 5.0
"""T^2 per degree of freedom of an alarm (chosen on routes spliced from BorealTC)."""
_ALARM_SHRINK = 1e-3


@dataclass(frozen=True, eq=False)
class SoftmaxModel:
    """Weights of standardised features, calibration and novelty threshold.

    Attributes:
        classes: k names.
        mean, scale: (d,) of the features in training.
        weights, offsets: (k, d), (k,).
        centres, precision: (k, d) class means and (d, d) inverse scatter within classes, standardised.
        odd_distance: novelty threshold: squared Mahalanobis distance per observed feature from the nearest
            class beyond which a window is unknown.
        alarm: (k, k) inverse scatter of log-odds along a drive on one ground, see `change_alarm`; zeros
            raise no alarm.
        temperature: divisor of the log-probabilities before the patch filter, as windows overlap.
        inputs: file name -> SHA-256 of the training logs.
    """

    classes: tuple[str, ...]
    mean: Array
    scale: Array
    weights: Array
    offsets: Array
    centres: Array
    precision: Array
    alarm: Array
    odd_distance: float = np.inf
    temperature: float = 1.0
    inputs: dict[str, str] = dataclasses.field(default_factory=dict)
    made_by: str = ""

    def standardised(self, x: Array) -> Array:
        """Standardised features (n, d), 0 where not observed."""
        return np.nan_to_num((np.atleast_2d(x) - self.mean) / self.scale)

    def log_odds(self, x: Array) -> Array:
        """Log-odds (n, k) of the classes against their geometric mean."""
        logits = self.standardised(x) @ self.weights.T + self.offsets
        return np.asarray(logits - logits.mean(axis=1, keepdims=True))

    def log_probabilities(self, x: Array) -> Array:
        """log P(class | window) (n, k), equal priors, each at least about log `ERROR_SHARE`."""
        logits = self.log_odds(x)
        p = np.exp(logits - logits.max(axis=1, keepdims=True))
        p /= p.sum(axis=1, keepdims=True)
        k = len(self.classes)
        return np.asarray(np.log(ERROR_SHARE + (1.0 - k * ERROR_SHARE) * p))

    def oddness(self, x: Array) -> Array:
        """Squared Mahalanobis distance (n,) from the nearest class, per observed feature."""
        z = self.standardised(x)
        away = z[:, None, :] - self.centres
        away[np.broadcast_to(~np.isfinite(np.atleast_2d(x))[:, None, :], away.shape)] = 0.0
        distance = np.einsum("nki,ij,nkj->nk", away, self.precision, away)
        observed = np.maximum(np.isfinite(np.atleast_2d(x)).sum(axis=1), 1)
        return np.asarray(distance.min(axis=1) / observed)

    def changes(self, windows: SurfaceWindows) -> NDArray[np.bool_]:
        """Which of the n windows of a drive raise the alarm of a change of ground."""
        odds, begin = self.log_odds(windows.recent), 0
        found = np.zeros(len(odds), dtype=bool)
        for i in range(len(odds)):
            found[i] = has_changed(odds[begin : i + 1], self.alarm)
            begin = i if found[i] else begin
        return found

    def filtered(self, windows: SurfaceWindows) -> Array:
        """Class probabilities (n, k) along the n windows of a drive.

        After an alarm the patch begins anew, and is classified by seconds of the new ground alone: few
        windows, which count in full.
        """
        log_p, recent = self.log_probabilities(windows.x), self.log_probabilities(windows.recent)
        patches = PatchFilter(len(self.classes), PATCH_LENGTH_M)
        p = np.empty_like(log_p)
        age = WINDOWS_ACROSS_A_CHANGE
        for i, (rolled, changed) in enumerate(zip(windows.rolled_m, self.changes(windows), strict=True)):
            patches.predict(float(rolled))
            if changed:
                patches.forget(1.0)
            age = 0 if changed else age + 1
            p[i] = patches.update(recent[i] if age < WINDOWS_ACROSS_A_CHANGE else log_p[i] / self.temperature)
        return p

    def write(self, path: Path) -> None:
        """Write as YAML, six significant digits."""
        content: dict[str, Any] = {
            "schema": SCHEMA, "made_by": self.made_by, "inputs": self.inputs,
            "features": list(SURFACE_FEATURES), "classes": list(self.classes),
            "temperature": _digits(self.temperature), "odd_distance": _digits(self.odd_distance),
        }  # fmt: skip
        content |= {name: _digits(getattr(self, name).tolist()) for name in _NUMBERS}
        dump_yaml(path, content, default_flow_style=None, width=110)


def read_softmax(path: Path) -> SoftmaxModel:
    """A model file.

    Raises:
        ConfigError: another schema, or inconsistent numbers.
    """
    content = read_yaml(path)
    again = "create it again with 'terrafusion terrain train'"
    if content.get("schema") != SCHEMA or set(content) != {*_PLAIN, *_NUMBERS}:
        raise ConfigError(f"no model of schema {SCHEMA}", file=path, remedy=again)
    if content["features"] != list(SURFACE_FEATURES):
        raise ConfigError("'features' differ from what this version computes", file=path, remedy=again)
    try:
        numbers = {name: np.array(content[name], dtype=float) for name in _NUMBERS}
        odd, temperature = float(content["odd_distance"]), float(content["temperature"])
    except (TypeError, ValueError):
        raise ConfigError("holds something that is no number", file=path, remedy=again) from None
    d, k = len(SURFACE_FEATURES), len(content["classes"])
    shapes = {
        "mean": (d,),
        "scale": (d,),
        "weights": (k, d),
        "offsets": (k,),
        "centres": (k, d),
        "precision": (d, d),
        "alarm": (k, k),
    }
    for name, shape in shapes.items():
        if numbers[name].shape != shape or not np.isfinite(numbers[name]).all():
            raise ConfigError(f"'{name}' needs {shape} finite numbers", file=path, remedy=again)
    if not (numbers["scale"] > 0.0).all() or not temperature > 0.0 or not odd > 0.0:
        raise ConfigError(
            "'scale', 'temperature' and 'odd_distance' must be positive", file=path, remedy=again
        )
    return SoftmaxModel(
        tuple(str(c) for c in content["classes"]), **numbers, odd_distance=odd, temperature=temperature,
        inputs=dict(content["inputs"]), made_by=str(content["made_by"]),
    )  # fmt: skip


def fit_softmax(x: Array, labels: Sequence[str], features: Sequence[str] = SURFACE_FEATURES) -> SoftmaxModel:
    """Fit to windows (n, d) with a label each, by `features` alone; not yet calibrated, and without alarm.

    Classes have equal weight.

    Raises:
        ConfigError: fewer than two classes.
        TerrafusionError: scikit-learn is not installed.
    """
    try:
        from sklearn.linear_model import LogisticRegression
    except ImportError:
        raise TerrafusionError(
            "the package scikit-learn is not installed", remedy="pip install 'terrafusion[learn]'"
        ) from None
    used = np.isin(SURFACE_FEATURES, list(features))
    x = np.where(used & np.isfinite(x), x, np.nan)
    classes, y = np.unique(np.asarray(labels, dtype=str), return_inverse=True)
    if len(classes) < 2:
        raise ConfigError("training needs at least two grounds", remedy="give logs of more grounds")
    observed = np.isfinite(x).any(axis=0)
    mean, scale = np.zeros(x.shape[1]), np.ones(x.shape[1])
    mean[observed] = np.nanmean(x[:, observed], axis=0)
    scale[observed] = np.maximum(np.nanstd(x[:, observed], axis=0), 1e-6)
    z = np.nan_to_num((x - mean) / scale)
    regression = LogisticRegression(C=STRENGTH, max_iter=2000, class_weight="balanced")
    regression.fit(*_with_gaps(z, y))
    two = len(classes) == 2  # scikit-learn then keeps one row, of the second class
    weights = np.vstack([-regression.coef_, regression.coef_]) / 2.0 if two else regression.coef_
    offsets = np.append(-regression.intercept_, regression.intercept_) / 2.0 if two else regression.intercept_
    weights = np.where(observed, weights, 0.0)
    centres = np.stack([z[y == c].mean(axis=0) for c in range(len(classes))])
    scatter = np.cov((z - centres[y]).T) + 0.1 * np.eye(z.shape[1])
    precision: Array = np.asarray(np.linalg.inv(scatter), dtype=np.float64)
    silent = np.zeros((len(classes), len(classes)))
    return SoftmaxModel(tuple(classes.tolist()), mean, scale, weights, offsets, centres, precision, silent)


def _with_gaps(z: Array, y: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
    """The windows (n, d), and for each of some feature groups every fourth of them again without it."""
    copies, labels = [z], [y]
    for i, group in enumerate(("motor current", "spectrum above 10 Hz", "gyro spectrum")):
        part = z[i::4].copy()
        part[:, np.isin(SURFACE_FEATURES, GROUPS[group])] = 0.0
        copies.append(part)
        labels.append(y[i::4])
    return np.vstack(copies), np.concatenate(labels)


def _digits(x: Any) -> Any:
    return [_digits(v) for v in x] if isinstance(x, list) else float(f"{x:.6g}")


def precision_of(drives: Sequence[Array]) -> Array:
    """Inverse scatter (k, k) of the differences along drives on one ground, each with log-odds (n, k)."""
    away = [
        odds[i] - _before(odds[: i + 1]).mean(axis=0)
        for odds in drives
        for i in range(ALARM_MEMORY + ALARM_OVERLAP + 1, len(odds), 2)
    ]
    k = drives[0].shape[1]
    if len(away) < 2 * k:
        return np.zeros((k, k))
    scatter = np.cov(np.array(away).T)
    return np.asarray(np.linalg.pinv(scatter + _ALARM_SHRINK * np.trace(scatter) / k * np.eye(k)))


def has_changed(odds: Array, precision: Array) -> bool:
    """Whether the ground of the last of the log-odds (n, k), all since the last alarm, is a new one."""
    before = _before(odds)
    if len(before) < ALARM_LEAST:
        return False
    away = odds[-1] - before.mean(axis=0)
    return float(away @ precision @ away) > ALARM_LIMIT * (odds.shape[1] - 1)


def _before(odds: Array) -> Array:
    return odds[max(len(odds) - 1 - ALARM_OVERLAP - ALARM_MEMORY, 0) : max(len(odds) - 1 - ALARM_OVERLAP, 0)]
