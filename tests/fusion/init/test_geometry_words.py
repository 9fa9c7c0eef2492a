"""What `init` says of numbers that were not measured, what it leaves out, and rates of jittering topics."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.checks.summary import mean_rate_hz
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.fusion.init.draft import DraftLine
from terrafusion.fusion.init.geometry import STATED, unmeasured_lines
from terrafusion.fusion.init.vehicle import _learned_lines


def test_a_number_of_the_log_is_not_called_assumed() -> None:
    draft = {
        "track_m": DraftLine(KnownNumber(1.5, "assumed"), f"m; {STATED}"),
        "mass_kg": DraftLine(KnownNumber(40.0, "assumed"), "kg; assumed, as of 'generic'"),
        "wheel_radius_m": DraftLine(KnownNumber(0.2, "measured"), "m; given"),
    }
    assert [word for word, _ in unmeasured_lines(draft)] == ["from log", "assumed"]


def test_the_rate_of_stamps_that_vary_is_that_of_the_messages() -> None:
    rng = np.random.default_rng(2)
    sent = np.arange(2000) * 10_000_000
    received = np.sort(sent + rng.uniform(10e6, 30e6, 2000).astype(np.int64))
    received[1000:] += 3_000_000_000
    assert mean_rate_hz(received) == pytest.approx(100.0, rel=0.005)
    assert mean_rate_hz(received[:1]) is None


def test_wheels_that_are_the_only_sensor_of_motion_are_late_against_none() -> None:
    late = KnownNumber(0.03, "calibrated", 0.01, ("monday",))
    calibration: Any = SimpleNamespace(known=lambda: SimpleNamespace(gnss_delay_s=late, wheel_delay_s=late))
    assert list(_learned_lines(calibration, {}, has_imu=True)) == ["gnss_delay_s", "wheel_delay_s"]
    assert list(_learned_lines(calibration, {}, has_imu=False)) == ["gnss_delay_s"]
