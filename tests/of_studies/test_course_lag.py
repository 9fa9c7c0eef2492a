"""The fit of course lag and centre of rotation recovers what made a path."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.datasets.core.trajectory import Trajectory
from tests.studies.course_lag import fitted, motion


@pytest.mark.parametrize(("lag_s", "place_m"), [(0.25, 0.1), (0.0, -0.2)])
def test_lag_and_place_are_found(lag_s: float, place_m: float) -> None:
    t = np.arange(0.0, 120.0, 0.05)
    speed, rate = 1.0 + 0.5 * np.sin(0.31 * t), 0.6 * np.sin(0.23 * t)
    yaw = np.cumsum(rate) * 0.05
    lateral = -(place_m + lag_s * speed) * rate
    place = np.cumsum((speed + 1j * lateral) * np.exp(1j * (yaw - 0.025 * rate))) * 0.05
    zero = np.zeros_like(t)
    quaternion = np.column_stack([zero, zero, np.sin(0.5 * yaw), np.cos(0.5 * yaw)])
    truth = Trajectory(
        np.round(t * 1e9).astype(np.int64), np.column_stack([place.real, place.imag, zero]), quaternion
    )
    found = fitted(motion(truth))
    assert found.lag_s == pytest.approx(lag_s, abs=0.02)
    assert found.place_m == pytest.approx(place_m, abs=0.02)
