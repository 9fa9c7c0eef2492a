"""The drift of a receiver that reports more than its data sheet."""

from __future__ import annotations

import dataclasses

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.metrics.scores import score
from terrafusion.fusion.replay import replay
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

REPORTED_M, OFFSET_M = 5.0, np.array([3.0, -2.0, 0.0])


def coarse() -> Recording:
    """A drive with fixes of 5 m whose error hardly changes within the drive."""
    drive = (DriveSegment(40.0, v_mps=1.0, yaw_rate_amplitude_radps=0.3, period_s=9.0),)
    run = simulate(Scenario("winding", 40.0, drive=drive, route=(RouteLeg("asphalt"),)), seed=2)
    assert run.gnss is not None
    noise = np.random.default_rng(1).normal(0.0, 0.3, run.gnss.enu_m.shape)
    sigma = np.full(run.gnss.enu_m.shape, REPORTED_M)
    gnss = dataclasses.replace(run.gnss, enu_m=run.gnss.enu_m + OFFSET_M + noise, sigma_enu_m=sigma)
    return dataclasses.replace(run, gnss=gnss)


def test_an_error_that_stays_is_inside_the_ellipses_of_a_receiver_that_reports_it() -> None:
    """Averaged as white noise a hundred fixes would claim half a metre."""
    recording = coarse()
    found = replay(recording, mode="fixed")
    nees = score(found.estimate, recording).errors.nees()  # type: ignore[union-attr]
    assert np.nanmedian(nees) < 1.0
    sigma_m = np.sqrt(found.estimate.trajectory.covariance[-1, 0, 0])  # type: ignore[index]
    assert 0.5 * REPORTED_M < sigma_m < 1.1 * REPORTED_M
