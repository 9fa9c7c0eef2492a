"""Wheels noisier than their data sheet: what they show of it, and that it is not taken for slip."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Wheels
from terrafusion.fusion.estimator.wheel_jitter import WheelJitter
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.replay import replay
from terrafusion.twin.simulate import simulate


def increment(distance_m: float) -> WheelIncrement:
    return WheelIncrement(
        np.array([distance_m, 0.0, 0.0]), np.array([1e-3, 1e-2, 1e-2, 0.1]), distance_m, 0.0
    )


@pytest.mark.parametrize("position_sigma_m", [0.004, 0.02])
def test_noise_of_the_counter_is_found(position_sigma_m: float) -> None:
    rng, jitter = np.random.default_rng(1), WheelJitter()
    shown = [
        jitter.applied(increment(float(d))).sigma[0]
        for d in np.diff(0.1 * np.arange(2000) + position_sigma_m * rng.normal(size=2000))
    ]
    assert np.median(shown[200:]) == pytest.approx(np.sqrt(2.0) * position_sigma_m, rel=0.2)


@pytest.mark.parametrize("pace", [0.3, 1.15, 2.6])
def test_pulses_of_a_coarse_encoder_are_found(pace: float) -> None:
    """Speeds of a whole number of counts, taken by the trapezoid rule: each count is in two increments."""
    count_m, jitter = 0.08, WheelJitter()
    rng = np.random.default_rng(0)
    travel = pace * count_m * np.cumsum(1.0 + 0.02 * rng.normal(size=2000))
    counted = np.diff(np.floor(travel / count_m)) * count_m
    moved, true = 0.5 * (counted[1:] + counted[:-1]), np.diff(travel)[1:]
    shown = [jitter.applied(increment(float(d)), count_m).sigma[0] for d in moved]
    assert 0.9 * np.std(moved - true) < np.median(shown[200:]) < 2.0 * np.std(moved - true)
    fine = WheelJitter()
    assert np.median([fine.applied(increment(float(d))).sigma[0] for d in moved]) < np.median(shown)


def test_quiet_wheels_keep_their_sigma() -> None:
    jitter = WheelJitter()
    speeds = 1.0 + 0.5 * np.sin(0.05 * np.arange(300))
    assert all(jitter.applied(increment(0.1 * float(v))).sigma[0] == 1e-3 for v in speeds)


def test_jitter_of_the_stamps_is_not_taken_for_slip() -> None:
    run = simulate("figure_eight", terrain="asphalt", seed=2)
    assert run.wheels is not None
    rng = np.random.default_rng(0)
    keep = np.arange(0, len(run.wheels), 10)
    wheels = run.wheels.select(np.isin(np.arange(len(run.wheels)), keep))
    late_ns = rng.integers(-15_000_000, 15_000_000, len(wheels))
    shaken = Wheels(
        np.sort(wheels.t_ns + late_ns), wheels.speed, wheels.names, wheels.unit, angle_rad=wheels.angle_rad
    )
    replayed = replay(dataclasses.replace(run, wheels=shaken), mode="fixed")
    slip = replayed.estimate.to_pandas()["slip"].to_numpy()
    assert abs(np.median(slip[len(slip) // 2 :])) < 0.03
