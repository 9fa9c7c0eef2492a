"""The slip that the trials hold an estimate against."""

from __future__ import annotations

import numpy as np

from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from tests.studies.slip_trials import (
    MOVING_MPS,
    Told,
    delays_text,
    mean_slip,
    poisson_interval,
    true_slip,
)


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


def test_delays_are_told_with_their_interval_and_with_what_was_never_told() -> None:
    assert delays_text([Told(10.0, 11.0), Told(20.0, 21.0)]) == (
        "1.00 s late [1.00, 1.00], at most 1.00 s; told in 2 of 2"
    )
    spread = delays_text([Told(0.0, 1.0), Told(0.0, 3.0), Told(0.0, None)])
    assert spread.startswith("2.00 s late [1.00, 3.00], at most 3.00 s; told in 2 of 3")
    assert delays_text([Told(0.0, None)]) == "never told in 1"


def test_a_rate_of_no_alarms_has_the_interval_of_three_and_a_half_over_the_time() -> None:
    low, high = poisson_interval(0, 3600.0)
    assert (low, round(high, 2)) == (0.0, 3.69)  # -ln 0.025
    low, high = poisson_interval(1, 4380.0)
    assert low < 3600.0 / 4380.0 < high
