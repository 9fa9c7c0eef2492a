"""The pose of a window follows the fixes, its track turns as the gyro measured."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.data.poses import EAST_NORTH, aligned_start, alignment_angles, moved
from terrafusion.twin.gap.rollout.sensitivities import Rollout, aligned_predictions
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import run

CANDIDATES = Candidates.of(["gyro_bias"])
BIAS_RADPS = 0.03


@pytest.fixture(scope="module")
def recording() -> Recording:
    return run(950)


def log_of(recording: Recording) -> tuple[PreparedLog, Model]:
    (log,), model, _ = prepared([recording], load_vehicle("elevate"), None)
    return log, model


def turned(log: PreparedLog, angle: float, shift: float) -> list[np.ndarray]:
    """What the log observed, its tracks turned and shifted as a whole."""
    at = {o.channel: i for i, o in enumerate(log.observed)}
    values = [o.value.copy() for o in log.observed]
    for pair in EAST_NORTH:
        east, north = (values[at[c]].copy() for c in pair)
        values[at[pair[0]]] = np.cos(angle) * east - np.sin(angle) * north + shift * (pair == EAST_NORTH[0])
        values[at[pair[1]]] = np.sin(angle) * east + np.cos(angle) * north
    return values


def test_a_turned_and_shifted_track_is_laid_back(recording: Recording) -> None:
    log, _ = log_of(recording)
    wrong = turned(log, 0.8, 3.0)
    assert alignment_angles(log, wrong) == pytest.approx(-0.8, abs=0.01)
    laid_back = moved(log, wrong, log.start, aligned_start(log, wrong, log.start))
    for now, then, observed in zip(laid_back, wrong, log.observed, strict=True):
        if observed.channel.startswith("gnss"):
            spread = float(np.std(observed.value))
            assert np.abs(now - observed.value).max() < 0.02 * spread + 0.02
        else:
            assert np.array_equal(now, then)


def test_the_start_turns_about_the_track(recording: Recording) -> None:
    """From the new start, the same motion gives the track observed."""
    log, _ = log_of(recording)
    start = np.zeros_like(log.start)
    found = aligned_start(log, turned(log, 0.3, -2.0), start)
    assert found[:, 2] == pytest.approx(-0.3, abs=0.01)
    # The start (0, 0) of the turned track lies at R(-.3) (0 + 2, 0) in the one observed.
    assert found[:, :2] == pytest.approx(
        np.tile([2 * np.cos(0.3), -2 * np.sin(0.3)], (len(start), 1)), abs=0.1
    )


def test_a_gyro_bias_in_the_twin_leaves_no_error_in_positions(recording: Recording) -> None:
    assert recording.imu is not None
    gyro = recording.imu.gyro_radps.copy()
    gyro[:, 2] += BIAS_RADPS
    biased = dataclasses.replace(recording, imu=dataclasses.replace(recording.imu, gyro_radps=gyro))
    errors = []
    for one, effects in ((recording, {}), (biased, {"gyro_bias/constant": BIAS_RADPS}), (biased, {})):
        log, model = log_of(one)
        (predicted,) = aligned_predictions([Rollout(log, effects)], model, CANDIDATES)
        assert predicted is not None
        errors.append({o.channel: o.value - y for o, y in zip(log.observed, predicted, strict=True)})
    sigma = {o.channel: o.sigma for o in log.observed}
    for channel in ("gnss_east_m", "gnss_north_m", "gnss_v_e_mps", "gnss_v_n_mps"):
        moved = np.abs(errors[1][channel] - errors[0][channel]) / sigma[channel]
        assert moved.max() < 0.2
    assert np.median(errors[2]["yaw_rate_radps"] - errors[0]["yaw_rate_radps"]) == pytest.approx(BIAS_RADPS)
