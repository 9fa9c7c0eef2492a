"""Where outages are placed, and fixes simulated from truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.benchmark.outage_plan import (
    AID_HZ,
    AID_SIGMA_M,
    TAIL_S,
    aided_by_truth,
    plan_outages,
    until,
)

SECOND_NS = 1_000_000_000


@given(
    earliest=st.floats(0.0, 500.0),
    span=st.floats(0.0, 500.0),
    seconds=st.floats(5.0, 120.0),
    most=st.integers(0, 6),
)
def test_planned_outages_lie_inside_evenly_and_apart(
    earliest: float, span: float, seconds: float, most: int
) -> None:
    outages = plan_outages(earliest, earliest + span, seconds, most)
    starts = np.array([o.start_s for o in outages])
    assert len(outages) <= most
    assert (
        bool(outages) == (most > 0 and span - TAIL_S - seconds >= 0.0) or abs(span - TAIL_S - seconds) < 1e-6
    )
    assert (starts >= earliest - 1e-3).all()
    assert (starts + seconds <= earliest + span - TAIL_S + 1e-3).all()
    gaps = np.diff(starts)
    assert (gaps >= 0.5 * seconds - 2e-3).all()
    assert np.ptp(gaps) < 3e-3 if len(gaps) else True


def test_fixes_from_truth_have_the_noise_they_claim(drive: Callable[..., Any]) -> None:
    recording = drive(seconds=600.0).recording
    aided = aided_by_truth(recording, seed=3)
    gnss = aided.gnss
    assert gnss is not None
    error = gnss.enu_m - recording.truth.positions_at(gnss.t_ns)
    assert np.diff(gnss.t_ns).min() >= SECOND_NS / AID_HZ - 2e6
    assert error[:, :2].std() == pytest.approx(AID_SIGMA_M, rel=0.1)
    assert abs(error[:, :2].mean()) < 4.0 * AID_SIGMA_M / np.sqrt(error[:, :2].size)
    again = aided_by_truth(recording, seed=3).gnss
    assert again is not None
    assert np.array_equal(again.enu_m, gnss.enu_m)
    other = aided_by_truth(recording, seed=4).gnss
    assert other is not None
    assert not np.array_equal(other.enu_m, gnss.enu_m)
    assert aided.overrides.antenna_m == (0.0, 0.0, 0.0)
    with pytest.raises(DataError, match="no positions"):
        aided_by_truth(dataclasses.replace(recording, truth_channels=("yaw",)), seed=3)


def test_a_cut_recording_ends_where_it_is_cut(drive: Callable[..., Any]) -> None:
    recording = drive(seconds=120.0).recording
    part = until(recording, 50.0)
    assert part.duration_s() == pytest.approx(50.0, abs=0.05)
    assert part.start_ns == recording.start_ns
    assert part.wheels is not None
    assert np.array_equal(part.wheels.speed, recording.wheels.speed[: len(part.wheels)])
