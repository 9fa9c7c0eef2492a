"""The classifier of a robot's grounds by the spectrum of their vibration, from labelled windows."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.terrain.change_alarm import LEAST, OVERLAP, last_difference
from terrafusion.fusion.terrain.features import Window
from terrafusion.fusion.terrain.spectrum import SpectrumClassifier

STRENGTH = 0.1
"""Inverse of the L2 penalty on the weights of standardised levels."""
FALSE_ALARMS = 1.0 / 120.0
"""Share of windows on one ground that may raise the alarm of a change: one a minute, of two a second."""
_LEAST_WINDOWS = 120
_SHRINK = 1e-3


def fit_spectrum(levels: Mapping[str, Array]) -> SpectrumClassifier | None:
    """The classifier, every ground as likely as another; None where the grounds have no level in common.

    `levels` are (n, 42) of `Window.bands` by ground; a level that not every ground shows is not used.
    """
    from sklearn.linear_model import LogisticRegression

    grounds = tuple(levels)
    common = np.all([np.isfinite(one).any(axis=0) for one in levels.values()], axis=0)
    if not common.any():
        return None
    x = np.where(common, np.vstack([levels[name] for name in grounds]), np.nan)
    labels = np.repeat(np.arange(len(grounds)), [len(levels[name]) for name in grounds])
    known = np.isfinite(x).any(axis=1)
    mean, scale = np.zeros(x.shape[1]), np.ones(x.shape[1])
    mean[common] = np.nanmean(x[:, common], axis=0)
    scale[common] = np.maximum(np.nanstd(x[:, common], axis=0), 1e-6)
    standardised = np.nan_to_num((x[known] - mean) / scale)
    fit = LogisticRegression(C=STRENGTH, class_weight="balanced", max_iter=1000)
    fit.fit(standardised, labels[known])
    weights, offsets = fit.coef_, fit.intercept_
    if len(grounds) == 2:  # scikit-learn then has the one of the second against the first
        weights, offsets = np.vstack([-weights, weights]) / 2.0, np.append(-offsets, offsets) / 2.0
    silent = np.zeros((len(grounds), len(grounds)))
    return SpectrumClassifier(grounds, mean, scale, weights, offsets, silent)


def alarm_precision(classifier: SpectrumClassifier, stretches: Iterable[Sequence[Window]]) -> Array:
    """Precision (k, k) of `ChangeAlarm`, from stretches on one ground that the classifier was not fitted to.

    Zeros, which raise no alarm, where the stretches are too short to know the share of false ones.
    """
    k = len(classifier.grounds)
    found = []
    for windows in stretches:
        odds = [one for one in map(classifier.log_odds, windows) if one is not None]
        found += [last_difference(np.array(odds[: i + 1])) for i in range(LEAST + OVERLAP, len(odds))]
    if len(found) < _LEAST_WINDOWS:
        return np.zeros((k, k))
    apart = np.array(found)
    scatter = np.cov(apart.T)
    precision = np.linalg.pinv(scatter + _SHRINK * np.trace(scatter) / k * np.eye(k))
    square = np.einsum("ni,ij,nj->n", apart, precision, apart)
    return np.asarray(precision / np.quantile(square, 1.0 - FALSE_ALARMS))
