"""Judged runs and references are clipped alike, however wrong the twin is on both."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.null.channel_noise import data_sheet_noise
from terrafusion.twin.gap.rollout.outliers import limit_outliers
from terrafusion.twin.gap.rollout.residuals import (
    OUTLIER_SIGMAS,
    LinearisationCache,
    WhitenedRun,
    initial_state_sigma,
    run_residuals,
    whitened,
)
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

CANDIDATES = Candidates.of(["wheel_radius"])
WRONG = 4.0
"""Errors of a wrong twin, in sigma of the noise."""


SIGMA = initial_state_sigma(CANDIDATES)


def with_error(run: WhitenedRun, error: Array) -> WhitenedRun:
    rows = run.rows.astype(float)
    rows[:, -1] = error
    return dataclasses.replace(run, rows=rows.astype(np.float32), gram=rows.T @ rows)


@pytest.fixture(scope="module")
def white() -> list[WhitenedRun]:
    """Four runs with heavy-tailed errors of a wrong twin (Student's t of two degrees of freedom)."""
    logs, model, _ = prepared(runs(0, 4), load_vehicle("elevate"), None)
    cache, channels = LinearisationCache(model, CANDIDATES), tuple(o.channel for o in logs[0].observed)
    residuals = [run_residuals(log, cache, channels) for log in logs]
    noise, rng = data_sheet_noise(residuals), np.random.default_rng(0)
    found = [whitened(run, noise) for run in residuals]
    return [with_error(run, WRONG * rng.standard_t(2.0, len(run.error))) for run in found]


def test_a_judged_run_is_limited_as_the_references(white: list[WhitenedRun]) -> None:
    """All err by four sigma, and none has changed."""
    (judged,), references = limit_outliers(white[:1], white[1:], SIGMA)
    assert np.isfinite(judged.limit).any()
    assert (judged.limit == references[0].limit).all()
    assert (judged.limit > 0.7 * WRONG * OUTLIER_SIGMAS).all()
    assert 0.0 < np.mean(judged.error != white[0].error) < 0.1


def test_a_run_that_has_changed_is_limited_by_its_own_errors(white: list[WhitenedRun]) -> None:
    changed = with_error(white[0], 3.0 * white[0].error)
    (judged,), references = limit_outliers([changed], white[1:], SIGMA)
    finite = np.isfinite(judged.limit)
    assert finite.any()
    assert (judged.limit > 2.0 * references[0].limit)[finite].all()
