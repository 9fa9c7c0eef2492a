"""The distance of the axles by steering angles and gyro."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Imu, Steering, Wheels
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.init.wheelbase import measured_wheelbase


def driven(
    length_m: float,
    *,
    zero_rad: float = 0.0,
    bias_radps: float = 0.0,
    noise: float = 0.0,
    turn_rad: float = 0.3,
) -> Recording:
    """A car's minute: speed and steering come and go at their own rates."""
    rng, t_ns = np.random.default_rng(3), [np.arange(0, 60 * 10**9, 10**9 // hz) for hz in (20, 10, 50)]
    angle, speed, both = (np.array([1e-9 * t]).T for t in t_ns)
    speed_of = lambda t: 1.2 + 0.8 * np.sin(0.31 * t)  # noqa: E731
    angle_of = lambda t: turn_rad * np.sin(0.5 * t + 0.4)  # noqa: E731
    rate = (speed_of(both) * np.tan(angle_of(both)) / length_m)[:, 0]
    gyro = np.stack(
        [0.0 * rate, 0.0 * rate, rate + bias_radps + noise * rng.standard_normal(len(rate))], axis=1
    )
    return Recording(
        "car",
        0,
        steering=Steering(t_ns[0], angle_of(angle) + zero_rad, ("angle",)),
        wheels=Wheels(t_ns[1], np.hstack([speed_of(speed)] * 2), ("left", "right"), "mps"),
        imu=Imu(t_ns[2], gyro, np.full((len(rate), 3), np.nan)),
    )


@settings(max_examples=20, deadline=None)
@given(
    length_m=st.floats(0.3, 3.0), zero_rad=st.floats(-0.03, 0.03), bias_radps=st.floats(-0.02, 0.02),
)  # fmt: skip
def test_it_is_found_beside_a_wrong_zero_and_a_bias(
    length_m: float, zero_rad: float, bias_radps: float
) -> None:
    found = measured_wheelbase(driven(length_m, zero_rad=zero_rad, bias_radps=bias_radps, noise=0.01), 0.1)
    assert found is not None
    assert abs(found[0] - length_m) < 0.03 * length_m
    assert 0.15 * length_m < found[1] < 0.2 * length_m


def test_it_is_exact_without_noise() -> None:
    found = measured_wheelbase(driven(1.8), 0.1)
    assert found is not None
    assert found[0] == pytest.approx(1.8, rel=2e-3)


def test_what_does_not_show_it_gives_none() -> None:
    car = driven(1.8)
    assert car.steering is not None
    wheel = dataclasses.replace(car.steering, names=("steering_wheel",))
    late = dataclasses.replace(car.steering, t_ns=car.steering.t_ns + 2 * 10**9)
    for one in (
        dataclasses.replace(car, steering=None),
        dataclasses.replace(car, imu=None),
        dataclasses.replace(car, steering=wheel),
        dataclasses.replace(car, steering=late),
        driven(1.8, turn_rad=0.0),
        driven(-1.8),
    ):
        assert measured_wheelbase(one, 0.1) is None
