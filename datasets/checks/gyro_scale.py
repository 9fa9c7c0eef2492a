"""Scale of the gyro about z, against the yaw of the truth, else against the shape of the measured path."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks.bootstrap_interval import RESAMPLES, SEED, BootstrapInterval, interval_of
from terrafusion.datasets.checks.finding import CheckContext, Finding, changed_field
from terrafusion.datasets.checks.motion import common_span, yaw_angles
from terrafusion.datasets.checks.path import path_by
from terrafusion.datasets.checks.path_model import path_model
from terrafusion.datasets.core.bootstrap import resampled_rows

WINDOW_S, LEAST_WINDOWS, LEAST_R = 4.0, 12, 0.95
"""Yaw rates are compared as means over windows so long that a delay hardly matters."""
PATH_WINDOWS = 8
LARGE, SURELY, WIDEST = 0.02, 0.01, 0.05
"""A scale error counts from the first on, with its interval beyond the second and narrower than the third."""
MOST_MISSING = 0.01
"""With more empty cells, as where a range was exceeded, turns are missing: no scale."""
MOST = 0.2
"""Beyond this it is no scale, but another unit or axis."""


def check_gyro_scale(context: CheckContext) -> Iterator[Finding]:
    """The gyro must turn as far as the robot does."""
    imu = context.recording.imu
    if imu is None or np.isnan(imu.gyro_radps[:, 2]).mean() > MOST_MISSING:
        return
    found = _by_truth(context) or _by_path(context)
    if found is None:
        return
    error, source = found
    if not LARGE < abs(error.value) < MOST or not error.is_beyond(SURELY) or error.high - error.low > WIDEST:
        return
    factor = 1.0 / (1.0 + error.value)
    yield Finding(
        "gyro-scale", "warning", "imu",
        f"gyro z reads {abs(error.value):.1%} too {'much' if error.value > 0.0 else 'little'}",
        f"{1.0 + error.value:.4f} times the turns by {source}, 95 % interval {1.0 + error.low:.4f} to "
        f"{1.0 + error.high:.4f}",
        f"multiply gyro z by {factor:.4f}",
        changed_field("imu", "gyro_radps", lambda rates: rates * (1.0, 1.0, factor)),
    )  # fmt: skip


def _by_truth(context: CheckContext) -> tuple[BootstrapInterval, str] | None:
    known = yaw_angles(context)
    if "gyro" not in known or "truth" not in known:
        return None
    gyro, truth = known["gyro"], known["truth"]
    start, end = common_span(gyro, truth)
    if not end - start >= (LEAST_WINDOWS + 1) * WINDOW_S:
        return None
    grid = np.arange(start, end, WINDOW_S)
    x, y = truth.rates(grid), gyro.rates(grid)
    if min(x.std(), y.std()) <= 0.0 or np.corrcoef(x, y)[0, 1] < LEAST_R:
        return None
    draws = np.concatenate([np.arange(len(x))[None], resampled_rows(len(x), RESAMPLES, SEED)])
    a, b = (values[draws] - values[draws].mean(axis=1, keepdims=True) for values in (x, y))
    slope = np.sqrt((b**2).sum(axis=1) / np.maximum((a**2).sum(axis=1), 1e-12)) - 1.0
    return interval_of(float(slope[0]), slope[1:], len(x)), "the truth's yaw"


def _by_path(context: CheckContext) -> tuple[BootstrapInterval, str] | None:
    for source, name in (("gnss", "the path of the fixes"), ("truth", "the path of the truth")):
        path = path_by(context.recording, source)
        model = path_model(context, path) if path is not None else None
        if model is not None and model.windows >= PATH_WINDOWS:
            return model.gyro_scale, name
    return None
