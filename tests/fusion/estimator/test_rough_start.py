"""A start whose fixes end before the heading is good: it begins with what is known, and says how well."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.replay import replay
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

SIGMA_M = 1.0
USUAL_YAW_SIGMA_RAD = 0.12
"""As good as the heading of a start otherwise is."""


def with_few_fixes(
    seconds: float,
    seed: int,
    drive: Scenario | str = "figure_eight",
    sigma_m: float = SIGMA_M,
    vehicle: str = "elevate",
) -> Recording:
    """A drive with fixes once a second, metres off and without velocity, that end after `seconds`."""
    run = simulate(drive, terrain="asphalt", seed=1, vehicle=vehicle)
    assert run.gnss is not None
    t_s = (run.gnss.t_ns - run.start_ns) * 1e-9
    gnss = run.gnss.select((np.arange(len(t_s)) % 5 == 0) & (t_s < seconds))
    off = sigma_m * np.random.default_rng(seed).normal(size=gnss.enu_m.shape)
    sigma = np.full(gnss.enu_m.shape, sigma_m)
    enu_m = gnss.enu_m + off
    plain = dataclasses.replace(gnss, enu_m=enu_m, sigma_enu_m=sigma, velocity_enu_mps=None, sigma_v_mps=None)
    return dataclasses.replace(run, gnss=plain)


def test_fixes_that_end_before_the_heading_is_good_still_give_a_start() -> None:
    found = replay(with_few_fixes(9.0, 0), mode="fixed")
    path, errors = found.estimate.trajectory, found.scores.errors
    assert path.covariance is not None
    assert errors is not None
    assert float(np.sqrt(path.covariance[0, 5, 5])) > USUAL_YAW_SIGMA_RAD
    assert float(np.nanmedian(2.0 * errors.nees())) < 5.991


def test_many_fixes_start_with_an_unknown_heading_where_they_show_none() -> None:
    """They tell where the robot is, and how far it can have driven since."""
    circles = (DriveSegment(40.0, v_mps=0.3, yaw_rate_radps=1.0),)
    circling = Scenario("circling", 40.0, drive=circles, route=(RouteLeg("asphalt"),))
    found = replay(with_few_fixes(30.0, 0, circling, 4.0, "husky"), mode="fixed")
    path, errors = found.estimate.trajectory, found.scores.errors
    assert path.covariance is not None
    assert errors is not None
    yaw_sigma = np.sqrt(path.covariance[:, 5, 5])
    assert yaw_sigma[0] > 1.5
    assert (np.diff(yaw_sigma) > -1e-6).all(), "wheels and IMU alone do not show a heading"
    assert float(np.nanmedian(2.0 * errors.nees())) < 5.991


def test_without_any_hint_of_the_heading_there_is_no_start() -> None:
    """Nor a local one, as long as fixes are waited for."""
    run = with_few_fixes(4.0, 0)
    assert run.imu is not None
    short = dataclasses.replace(run, imu=run.imu.between(run.start_ns, run.start_ns + 25 * 10**9))
    with pytest.raises(DataError, match="never moved far enough"):
        replay(short, mode="fixed")


def departing() -> Recording:
    """A robot that hardly moves for 20 s, then drives away on a curve; no fixes from 20 to 35 s."""
    drive = (DriveSegment(20.0, v_mps=0.02), DriveSegment(40.0, v_mps=0.8, yaw_rate_radps=0.05))
    away = Scenario("departing", 60.0, drive=drive, route=(RouteLeg("asphalt"),), heading_deg=50.0)
    run = simulate(away, seed=1, vehicle="husky")
    assert run.gnss is not None
    assert run.truth is not None
    t_s = (run.gnss.t_ns - run.start_ns) * 1e-9
    gnss = run.gnss.select((t_s < 20.0) | (t_s > 35.0))
    there = np.stack([np.interp(gnss.t_ns, run.truth.t_ns, x) for x in run.truth.position_m.T], axis=1)
    off = np.random.default_rng(2).normal(0.0, 0.3, there.shape) + np.array([0.8, -0.5, 0.0])
    sigma = np.full(there.shape, SIGMA_M)
    gnss = dataclasses.replace(
        gnss, enu_m=there + off, sigma_enu_m=sigma, velocity_enu_mps=None, sigma_v_mps=None
    )
    return dataclasses.replace(run, gnss=gnss)


@pytest.mark.parametrize("batch", [False, True], ids=["live", "batch"])
def test_fixes_that_come_back_show_a_heading_that_was_unknown(batch: bool) -> None:
    """Until then sigma spans where the robot may be; and its first fixes are not refused."""
    run = departing()
    found = replay(run, mode="fixed", batch=batch)
    path, errors = found.estimate.trajectory, found.scores.errors
    assert errors is not None
    assert path.covariance is not None
    assert any("it was open at first; later fixes showed it" in note for note in found.estimate.notes)
    assert float(np.nanmax(2.0 * errors.nees())) < 9.21
    unaided = (path.t_ns - run.start_ns) * 1e-9 < 34.0
    yaw_sigma = np.sqrt(path.covariance[unaided, 5, 5])
    assert (yaw_sigma < 0.2).all() if batch else (yaw_sigma > 0.6).all()
    assert errors.distance_m()[errors.t_ns > run.start_ns + 45_000_000_000].max() < 2.0
