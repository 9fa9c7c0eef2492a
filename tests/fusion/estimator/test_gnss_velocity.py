"""Velocities of fixes: of unknown sigma, without an upward part, of the wrong shape."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import ASSUMED_VELOCITY_SIGMA_MPS
from terrafusion.fusion.api.replays import replay
from terrafusion.fusion.inputs.validation import checked_fix
from tests.fusion.estimator.test_gnss import winding


@pytest.fixture(scope="module")
def drive() -> Recording:
    return winding()


@pytest.mark.parametrize("sigma", [0.0, -1.0, float("nan"), float("inf")])
def test_a_velocity_of_unknown_sigma_has_an_assumed_one(sigma: float) -> None:
    taken = checked_fix(0, [1.0, 2.0, 3.0], [0.1, 0.1, 0.0], [1.0, 0.0, 0.0], sigma, None)
    assert taken is not None
    assert taken.velocity_mps is not None
    assert taken.sigma_v_mps == ASSUMED_VELOCITY_SIGMA_MPS
    assert np.isnan(taken.sigma_m[2]), "nor is a height"


@pytest.mark.parametrize("calibrate", [False, True])
def test_a_velocity_without_its_upward_part_tells_as_much_of_the_motion(
    drive: Recording, calibrate: bool
) -> None:
    """Receivers that report speed and course; the drive is level, but for its noise."""
    assert drive.gnss is not None
    assert drive.gnss.velocity_enu_mps is not None
    level = drive.gnss.velocity_enu_mps.copy()
    level[:, 2] = np.nan
    speeds, none = (
        dataclasses.replace(drive, gnss=dataclasses.replace(drive.gnss, velocity_enu_mps=v))
        for v in (level, None)
    )
    sigmas = [
        np.median(replay(run, mode="fixed", calibrate=calibrate).estimate.slip_sigma)
        for run in (drive, speeds, none)
    ]
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.05)
    assert sigmas[1] < sigmas[2]


def test_a_velocity_of_two_axes_and_an_endless_sigma_are_refused() -> None:
    with pytest.raises(DataError, match="velocity"):
        checked_fix(0, np.zeros(3), np.full(3, 0.1), np.zeros(2), 0.1, None)
    with pytest.raises(DataError, match="sigma"):
        checked_fix(0, np.zeros(3), np.array([np.inf, np.inf, 1.0]), None, np.nan, None)
