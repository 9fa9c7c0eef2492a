"""Whether an estimate can be of its run at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Wheels
from terrafusion.fusion.metrics.health import examine_estimate, rolled_m

SECOND_NS = 1_000_000_000


def test_a_sound_estimate_passes_and_each_way_to_diverge_is_named(drive: Callable[..., Any]) -> None:
    made = drive(seconds=60.0)
    wheels, estimate = made.recording.wheels, made.estimate
    sound = examine_estimate(estimate, wheels, 0.3)
    assert sound.why == ""
    assert sound.rolled_m == pytest.approx(66.0, rel=0.01)
    assert sound.path_ratio() == pytest.approx(1.0 / 1.1, rel=0.02)
    path = estimate.trajectory

    def why(**changes: Any) -> str:
        moved = dataclasses.replace(path, **changes.pop("trajectory", {}))
        return examine_estimate(dataclasses.replace(estimate, trajectory=moved, **changes), wheels, 0.3).why

    assert "not finite" in why(trajectory={"position_m": path.position_m * np.nan})
    assert "covariance" in why(trajectory={"covariance": -path.covariance})
    assert "m/s with wheels" in why(velocity_mps=estimate.velocity_mps * 4.0)
    assert "path of" in why(trajectory={"position_m": path.position_m * 3.0})
    assert "path of" in why(trajectory={"position_m": path.position_m * 0.01})


@pytest.mark.parametrize(("sigma_m", "named"), [(1.0, False), (0.2, True)])
def test_a_path_lengthened_by_noise_within_its_sigma_is_sound(
    drive: Callable[..., Any], sigma_m: float, named: bool
) -> None:
    made = drive(seconds=60.0)
    path = made.estimate.trajectory
    noise = np.random.default_rng(1).normal(0.0, 0.6, path.position_m.shape)
    covariance = np.broadcast_to(sigma_m**2 * np.eye(6), (len(path), 6, 6))
    noisy = dataclasses.replace(path, position_m=path.position_m + noise, covariance=covariance)
    estimate = dataclasses.replace(made.estimate, trajectory=noisy)
    assert noisy.path_length_m() > 2.0 * path.path_length_m()
    assert ("path of" in examine_estimate(estimate, made.recording.wheels, 0.3).why) == named


def test_rolled_path_counts_both_ways_and_units() -> None:
    t_ns = np.arange(0, 11, dtype=np.int64) * SECOND_NS
    ahead = np.full((11, 2), 2.0)
    assert rolled_m(Wheels(t_ns, ahead, ("left", "right"), "mps"), 0.3) == pytest.approx(20.0)
    assert rolled_m(Wheels(t_ns, -ahead, ("left", "right"), "radps"), 0.3) == pytest.approx(6.0)
    assert rolled_m(Wheels(t_ns, ahead * [1, -1], ("left", "right"), "mps"), 0.3) == 0.0
    assert rolled_m(Wheels(t_ns[:0], ahead[:0], ("left", "right"), "mps"), 0.3) == 0.0


def test_a_gap_of_the_wheels_does_not_make_the_path_too_short(drive: Callable[..., Any]) -> None:
    """A clock that leaps an hour ahead while the robot drives."""
    made = drive(seconds=60.0)
    leap = np.where(np.arange(len(made.recording.wheels)) > 100, 3600 * SECOND_NS, 0)
    path = made.estimate.trajectory
    jump = np.where(path.t_ns > made.recording.wheels.t_ns[100], 3600 * SECOND_NS, 0)
    wheels = dataclasses.replace(made.recording.wheels, t_ns=made.recording.wheels.t_ns + leap)
    estimate = dataclasses.replace(made.estimate, trajectory=dataclasses.replace(path, t_ns=path.t_ns + jump))
    assert examine_estimate(estimate, wheels, 0.3).why == ""


def test_wheels_that_end_before_the_log_do_not_make_the_path_too_long(drive: Callable[..., Any]) -> None:
    made = drive(seconds=60.0)
    wheels = made.recording.wheels.select(np.arange(len(made.recording.wheels)) < 600)
    assert examine_estimate(made.estimate, wheels, 0.3).why == ""
