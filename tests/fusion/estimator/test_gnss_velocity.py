"""Velocities of fixes: of unknown sigma, without an upward part, of the wrong shape, in another frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import ASSUMED_VELOCITY_SIGMA_MPS
from terrafusion.fusion.api.replays import replay
from terrafusion.fusion.estimator.dead_reckoning import FixPair
from terrafusion.fusion.estimator.velocity_test import VelocityTest
from terrafusion.fusion.inputs.validation import GnssFix, checked_fix
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


FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "swapped": lambda v: v[:, [1, 0, 2]],
    "reversed": lambda v: -v,
    "zero": lambda v: 0.0 * v,
    "knots": lambda v: 1.944 * v,
}


@pytest.mark.parametrize(("fault", "batch"), [*((name, False) for name in FAULTS), ("reversed", True)])
def test_velocities_that_are_not_the_rate_of_the_positions_are_left_out(
    drive: Recording, fault: str, batch: bool
) -> None:
    gnss, truth = drive.gnss, drive.truth
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    assert truth is not None
    wrong = dataclasses.replace(gnss, velocity_enu_mps=FAULTS[fault](gnss.velocity_enu_mps))
    run = dataclasses.replace(drive, gnss=wrong)
    estimate = replay(run, mode="fixed", outages=[(20.0, 10.0)], batch=batch).estimate
    assert any("GNSS velocities left out: not the rate" in note for note in estimate.notes)
    off_m = estimate.trajectory.position_m[-1, :2] - truth.position_m[-1, :2]
    assert np.hypot(*off_m) < 1.0, "10 s after the last fix"


def believed_after(
    test: VelocityTest, times_s: range, sigma_m: float, speed: float = 1.0, multipath_m: float = 0.0
) -> bool:
    """Whether velocities are believed after fixes on a loop at 1 m/s, each second.

    Velocities are `speed` times the right ones; `multipath_m` is by how much positions wander.
    """
    rng = np.random.default_rng(1)
    for t_s in times_s:
        course = np.exp(0.05j * t_s)
        place = course / 0.05j
        fix_m = place + multipath_m * np.sin(t_s / 3.0) + sigma_m * complex(*rng.normal(size=2))
        v = speed * course
        fix = GnssFix(
            t_s * 10**9,
            np.array([fix_m.real, fix_m.imag, 0.0]),
            np.full(3, sigma_m),
            np.array([v.real, v.imag, np.nan]),
            0.05,
        )
        test.add(FixPair(fix.t_ns, 1j * place, fix_m, sigma_m), fix, 1.0)
    return test.refuted_along is None


@pytest.mark.parametrize("sigma_m", [0.02, 2.0])
def test_right_velocities_stay_and_wrong_ones_come_back_once_they_agree(sigma_m: float) -> None:
    test = VelocityTest()
    assert believed_after(test, range(600), sigma_m)
    assert not believed_after(test, range(600, 1000), sigma_m, speed=-1.0)
    assert believed_after(test, range(1000, 1600), sigma_m)


def test_positions_that_wheels_contradict_refute_no_velocities() -> None:
    assert believed_after(VelocityTest(), range(600), 0.02, multipath_m=3.0)
