"""A change of the ground over a part of the path, against the twin driven over such ground."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.data.samples import coarse_counts
from terrafusion.twin.gap.rollout.ground_patches import LENGTH_M, PATCH_SIGMAS, STEP_M
from terrafusion.twin.gap.rollout.sensitivities import Linearisation, linearise
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import OUTPUTS
from tests.twin.gap.runs import run

CANDIDATES = Candidates.of()
DRIFT, DRIFT_M = "soil_drift/over_travel", 50.0
"""Strength that changes with the distance s from the start as s / sqrt(s^2 + (50 m)^2)."""
SHEAR = "soil_strength/shear"


@pytest.fixture(scope="module")
def drive() -> tuple[PreparedLog, Linearisation]:
    (log,), model, _ = prepared([run(1)], load_vehicle("elevate"), None)
    return log, linearise(log, model, CANDIDATES, log.start, {*PATCH_SIGMAS, DRIFT})


def column(shared: Linearisation, key: str) -> np.ndarray:
    return shared.columns[:, :, 3 + CANDIDATES.keys.index(key)] / CANDIDATES.scale[CANDIDATES.keys.index(key)]


def patches(shared: Linearisation, key: str) -> np.ndarray:
    """(n, Y, H) of one parameter, in its unit, by its value at each point of the path."""
    at = list(PATCH_SIGMAS).index(key)
    own = np.split(shared.columns[:, :, 3 + CANDIDATES.count :], len(PATCH_SIGMAS), axis=2)[at]
    place = STEP_M * np.arange(own.shape[2])
    root = np.linalg.cholesky(np.exp(-np.abs(place[:, None] - place) / LENGTH_M))
    return own @ np.linalg.inv(root) / (PATCH_SIGMAS[key] * CANDIDATES.scale[CANDIDATES.keys.index(key)])


def test_all_patches_together_are_the_whole_run(drive) -> None:
    _, shared = drive
    for key in PATCH_SIGMAS:
        whole, together = column(shared, key), patches(shared, key).sum(axis=2)
        for i, channel in enumerate(OUTPUTS):
            within = 2e-3 if channel in ("gnss_east_m", "gnss_north_m") else 1e-9  # positions are integrated
            error = np.linalg.norm(together[:, i] - whole[:, i])
            assert error <= within * np.linalg.norm(whole[:, i]), (key, channel)


def test_ground_that_weakens_on_the_way_is_a_sum_of_patches(drive) -> None:
    """Also in heading and position, which patches behind the robot have changed; a whole-run sensitivity
    times the local change would not do there."""
    log, shared = drive
    pieces, truth = patches(shared, SHEAR), column(shared, DRIFT)
    speed = np.abs(shared.fine[:, OUTPUTS.index("speed_mps")])
    begin, travel, first = 0, 0.0, 0
    for count, (start, stop) in zip(coarse_counts(log), log.windows, strict=True):
        fine = slice(first, first + stop - start + 1)
        first = fine.stop
        middles = travel + STEP_M * np.arange(pieces.shape[2])  # spins aside, which count as path
        change = middles / np.hypot(middles, DRIFT_M)
        own = slice(begin, begin + count)
        for channel in ("yaw_rate_radps", "gnss_v_e_mps", "gnss_v_n_mps", "gnss_east_m", "current_left_a"):
            i = OUTPUTS.index(channel)
            made, true = pieces[own, i] @ change, truth[own, i]
            assert np.linalg.norm(made - true) < 0.18 * np.linalg.norm(true), channel
        begin, travel = own.stop, travel + DT_S * float(speed[fine].sum())
    assert begin == len(pieces)
