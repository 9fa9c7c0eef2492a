"""The slip that the trials hold an estimate against."""

from __future__ import annotations

import numpy as np

from terrafusion.fusion.scores.slip_trials import MOVING_MPS, mean_slip, true_slip
from terrafusion.twin.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from terrafusion.twin.vehicle import load_vehicle


def test_slip_of_a_keyframe_is_the_mean_of_its_span_and_unknown_at_rest() -> None:
    params = load_vehicle("elevate")
    drive = (DriveSegment(2.0), DriveSegment(8.0, 1.0))
    start = Scenario("start", 10.0, route=(RouteLeg("loose_sand"),), drive=drive)
    exact = simulate(start, vehicle=params, noiseless=True)
    t_ns = exact.start_ns + (np.arange(1.0, 9.8, 0.1) * 1e9).astype(np.int64)
    slip = mean_slip(exact, params, t_ns, 0.1)
    _, rim, speed = true_slip(exact, params, t_ns)
    assert np.isnan(slip[speed < 0.5 * MOVING_MPS]).all()
    steady = t_ns > exact.start_ns + 6_000_000_000
    assert np.isfinite(slip[steady]).all()
    assert np.abs(slip - (1.0 - speed / np.maximum(rim, 0.1)))[steady].max() < 1e-3
    assert (slip[steady] > 0.0).all()  # driving wheels outrun the robot
