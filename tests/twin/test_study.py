"""The source study's post-processing, on cases whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.simulate import simulate
from terrafusion.twin.study.table import imu_speed, speed_errors


def test_exact_sensors_have_small_speed_errors_on_firm_ground() -> None:
    recording = simulate("paper_profile", terrain="asphalt", noiseless=True)
    errors = speed_errors(recording, 0.175)
    assert errors.odometry < 0.01
    assert errors.imu < 0.05
    assert errors.gnss_velocity < 1e-9


def test_odometry_error_follows_slip_on_loose_sand() -> None:
    recording = simulate("paper_profile", terrain="loose_sand", slope_deg=5.0)
    assert speed_errors(recording, 0.175).odometry == pytest.approx(0.27, abs=0.01)


def test_imu_speed_drifts_and_starts_at_rest() -> None:
    recording = simulate("paper_profile", terrain="medium_sand", slope_deg=5.0)
    t, speed = imu_speed(recording)
    assert np.abs(speed[t < 2.0]).max() < 0.01
    truth = np.interp(t, (recording.truth.t_ns - recording.start_ns) * 1e-9, recording.truth.twist_body[:, 0])
    drift = np.abs(speed - truth)
    assert drift[-1000:].mean() > drift[500:1500].mean()
