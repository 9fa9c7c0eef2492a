"""The drift of a receiver that reports more than its data sheet."""

from __future__ import annotations

import dataclasses

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.metrics.scores import score
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

REPORTED_M, OFFSET_M = 5.0, np.array([3.0, -2.0, 0.0])


def drifted(offset_m: np.ndarray, white_m: float, reported_m: float, vehicle: str = "elevate") -> Recording:
    """A drive with fixes whose error hardly changes within the drive, but for white noise."""
    drive = (DriveSegment(40.0, v_mps=1.0, yaw_rate_amplitude_radps=0.3, period_s=9.0),)
    run = simulate(
        Scenario("winding", 40.0, drive=drive, route=(RouteLeg("asphalt"),)), vehicle=vehicle, seed=2
    )
    assert run.gnss is not None
    truth, at_m = run.truth, load_vehicle(vehicle).rig().sensors.gnss.antenna_m
    assert truth is not None
    noise = np.random.default_rng(1).normal(0.0, white_m, run.gnss.enu_m.shape)
    sigma = np.full(run.gnss.enu_m.shape, reported_m)
    enu_m = truth.points_at(run.gnss.t_ns, at_m) + offset_m + noise
    gnss = dataclasses.replace(run.gnss, enu_m=enu_m, sigma_enu_m=sigma)
    return dataclasses.replace(run, gnss=gnss)


def test_an_error_that_stays_is_inside_the_ellipses_of_a_receiver_that_reports_it() -> None:
    """Averaged as white noise a hundred fixes would claim half a metre."""
    recording = drifted(OFFSET_M, 0.3, REPORTED_M)
    found = replay(recording, mode="fixed")
    nees = score(found.estimate, recording).errors.nees()  # type: ignore[union-attr]
    assert np.nanmedian(nees) < 1.0
    sigma_m = np.sqrt(found.estimate.trajectory.covariance[-1, 0, 0])  # type: ignore[index]
    assert 0.5 * REPORTED_M < sigma_m < 1.1 * REPORTED_M


def test_white_noise_as_large_as_the_report_does_not_show_that_there_is_no_drift() -> None:
    """Of two receivers with the same drift the noisier one must not be believed more."""
    sigmas_m = []
    for white_m in (0.05, 0.25):
        recording = drifted(0.18 * OFFSET_M, white_m, 0.25, "generic")
        found = replay(recording, mode="fixed", settings={"self_calibrate": False})
        nees = score(found.estimate, recording).errors.nees()  # type: ignore[union-attr]
        assert np.nanmedian(nees) < 1.0
        sigmas_m.append(np.sqrt(found.estimate.trajectory.covariance[-1, 0, 0]))  # type: ignore[index]
    assert sigmas_m[1] > 0.9 * sigmas_m[0]
