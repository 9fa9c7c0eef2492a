"""What `init` says of numbers that were not measured, and of rates of jittering topics."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.datasets.checks.summary import mean_rate_hz
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.fusion.init.draft import DraftLine
from terrafusion.fusion.init.geometry import STATED, unmeasured_lines


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
