"""The classifier of a robot's grounds by the spectrum of their vibration, from labelled windows."""

from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.terrain.spectrum import SpectrumClassifier

STRENGTH = 0.1
"""Inverse of the L2 penalty on the weights of standardised levels."""


def fit_spectrum(levels: Mapping[str, Array]) -> SpectrumClassifier | None:
    """The classifier, every ground as likely as another.

    Args:
        levels: ground -> (n, 42) of `band_levels`; a level that not every ground shows is not used.

    Returns:
        None where the grounds have no level in common.
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
    return SpectrumClassifier(grounds, mean, scale, weights, offsets)
