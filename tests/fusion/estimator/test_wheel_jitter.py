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
