"""Features of a window: what they must not depend on, and what they must."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from terrafusion.fusion.terrain.features import (
    FEATURES,
    MIN_SPEED_MPS,
    SLIP,
    YAW_SLIP,
    Window,
    extract,
    slip_without_prior,
)

Array = NDArray[np.float64]
Z_MID, Z_HIGH = FEATURES.index("z_mid"), FEATURES.index("z_high")


class Shaking:
    """A motion known at all times: 60 sinusoids a channel, evenly spread over a band."""

    def __init__(self, seed: int, low_hz: float, high_hz: float) -> None:
        rng = np.random.default_rng(seed)
        self.frequency = np.linspace(low_hz, high_hz, 60) + rng.uniform(0.0, 0.05, 60)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (60, 6))

    def at(self, t_s: Array) -> Array:
        wave = np.sin(
            2.0 * np.pi * self.frequency[:, None, None] * t_s[None, :, None] + self.phase[:, None, :]
        )
        return np.asarray(0.1 * wave.sum(axis=0))

    def mean_over(self, t_s: Array, step_s: float) -> Array:
        """What an integrating sensor reports: the mean over the interval that ends at each time."""
        return np.asarray(np.mean([self.at(t_s - step_s * (i + 0.5) / 20) for i in range(20)], axis=0))


def window(signal: Array, t_s: Array, **changes: float | None) -> Window:
    plain = Window(
        dt_s=0.5, imu_t_s=t_s, gyro_radps=0.2 * signal[:, 3:], accel_mps2=signal[:, :3] + [0.0, 0.0, 9.8],
        wheel_speed_mps=1.0, wheel_speed_rate_mps2=0.0, speed_mps=1.0, yaw_rate_wheels_radps=None,
        yaw_rate_gyro_radps=0.0,
    )  # fmt: skip
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


def levels(motion: Shaking, rate_hz: float, averaging: bool) -> Array:
    """Mean features of 40 windows of one second, sampled at `rate_hz`."""
    out = []
    for start in range(40):
        t = start + 1.0 + np.arange(round(rate_hz)) / rate_hz
        signal = motion.mean_over(t, 1.0 / rate_hz) if averaging else motion.at(t)
        out.append(extract(window(signal, t))[0])
    return np.asarray(np.mean(out, axis=0))


@pytest.mark.parametrize("rate_hz", [30.0, 50.0, 200.0, 400.0])
def test_levels_agree_between_sampling_rates(rate_hz: float) -> None:
    motion = Shaking(1, 2.0, 13.5)
    low, mid, xy, roll_pitch = 0, 1, 3, 4
    difference = levels(motion, rate_hz, averaging=False) - levels(motion, 100.0, averaging=False)
    assert np.abs(difference[[low, mid, xy, roll_pitch]]).max() < 0.03


def test_levels_agree_between_integrating_sensors_of_30_and_100_hz() -> None:
    # Rich vibration up to 45 Hz: what the slow sensor cannot resolve, it must not report.
    motion = Shaking(2, 2.0, 45.0)
    slow, fast = levels(motion, 30.0, averaging=True), levels(motion, 100.0, averaging=True)
    assert np.isnan(slow[Z_HIGH])
    assert np.isfinite(fast[Z_HIGH])
    shared = [0, 1, 3, 4]
    assert np.abs(slow - fast)[shared].max() < 0.12
    # The plain RMS of the samples, which is not used, differs far more.
    t30, t100 = np.arange(1200) / 30.0, np.arange(4000) / 100.0
    rms = [motion.mean_over(t, t[1] - t[0])[:, 2].std() for t in (t30, t100)]
    assert np.log10(rms[1] / rms[0]) > 0.2


@given(st.floats(0.2, 3.0), st.floats(0.5, 2.0))
def test_shaking_that_grows_with_the_root_of_speed_is_one_ground(speed: float, gain: float) -> None:
    t = np.arange(100) / 100.0
    signal = Shaking(3, 2.0, 40.0).at(t)
    at_one = extract(window(signal, t))[0]
    faster = window(gain * np.sqrt(speed) * signal, t, speed_mps=speed, wheel_speed_mps=speed)
    assert extract(faster)[0][:SLIP] == pytest.approx(at_one[:SLIP] + np.log10(gain), abs=0.01)


def test_levels_are_root_mean_squares_in_si() -> None:
    # A sinusoid of amplitude a has the RMS a / sqrt(2): 10 Hz lies in the middle band.
    t = np.arange(100) / 100.0
    signal = np.zeros((100, 6))
    signal[:, 2] = 0.5 * np.sin(2.0 * np.pi * 10.0 * t)
    assert 10 ** extract(window(signal, t))[0][Z_MID] == pytest.approx(0.5 / np.sqrt(2.0), rel=0.03)


def test_tilt_bias_and_steady_acceleration_are_not_vibration() -> None:
    t = np.arange(100) / 100.0
    signal = Shaking(4, 3.0, 40.0).at(t)
    drifting = signal + np.array([1.0, -2.0, 0.5, 0.1, 0.2, 0.3]) + t[:, None] * 0.8
    assert extract(window(drifting, t))[0][:SLIP] == pytest.approx(
        extract(window(signal, t))[0][:SLIP], abs=1e-6
    )


def test_standing_says_nothing() -> None:
    t = np.arange(100) / 100.0
    still = window(
        Shaking(5, 3.0, 40.0).at(t), t, speed_mps=0.0, wheel_speed_mps=0.5 * MIN_SPEED_MPS, slip=0.4
    )
    assert np.isnan(extract(still)[0]).all()


def test_a_gap_or_a_channel_of_zeros_is_not_a_quiet_ground() -> None:
    t = np.arange(100) / 100.0
    t[50:] += 0.2
    signal = Shaking(6, 3.0, 40.0).at(t)
    assert np.isnan(extract(window(signal, t))[0][:SLIP]).all()
    t = np.arange(100) / 100.0
    signal[:, 3:] = 0.0
    values = extract(window(signal, t))[0]
    assert np.isnan(values[FEATURES.index("roll_pitch")])
    assert np.isfinite(values[:4]).all()


def test_slip_counts_only_when_observed_and_less_when_wheels_change_speed() -> None:
    t = np.arange(100) / 100.0
    signal = Shaking(7, 3.0, 40.0).at(t)
    assert np.isnan(extract(window(signal, t))[0][SLIP])
    values, steady = extract(window(signal, t, slip=0.3, slip_sigma=0.04))
    assert values[SLIP] == 0.3
    assert steady[SLIP] == pytest.approx(0.04**2)
    _, surging = extract(window(signal, t, slip=0.3, slip_sigma=0.04, wheel_speed_rate_mps2=1.0))
    assert surging[SLIP] > 2.0 * steady[SLIP]


def test_yaw_slip_compares_gyro_with_wheels_when_turning() -> None:
    t = np.arange(100) / 100.0
    signal = Shaking(8, 3.0, 40.0).at(t)
    turning = window(signal, t, yaw_rate_wheels_radps=0.5, yaw_rate_gyro_radps=0.3)
    assert extract(turning)[0][YAW_SLIP] == pytest.approx(0.4)
    straight = window(signal, t, yaw_rate_wheels_radps=0.01, yaw_rate_gyro_radps=0.0)
    assert np.isnan(extract(straight)[0][YAW_SLIP])


@given(
    st.lists(st.sampled_from([0.0, 1.0, -1.0, 1e9, np.nan, np.inf]), min_size=7, max_size=7),
    st.integers(0, 8),
)
def test_odd_numbers_never_pass(numbers: list[float], n: int) -> None:
    wheel, rate, speed, yaw, gyro, slip, sigma = numbers
    t = np.arange(n) / 100.0
    odd = Window(
        0.5, t, np.full((n, 3), gyro), np.full((n, 3), rate), wheel, rate, speed, yaw, gyro, slip, abs(sigma)
    )  # fmt: skip
    with np.errstate(all="ignore"):
        values, variances = extract(odd)
    seen = np.isfinite(values)
    assert np.isfinite(variances[seen]).all()
    assert not np.isinf(values).any()


@given(st.floats(-0.5, 0.9), st.floats(0.01, 0.3), st.floats(-0.1, 0.2), st.floats(0.01, 0.3))
def test_the_prior_is_taken_out_of_the_slip(
    measured: float, sigma: float, prior: float, prior_sigma: float
) -> None:
    information = sigma**-2 + prior_sigma**-2
    estimate = (measured / sigma**2 + prior / prior_sigma**2) / information
    got = slip_without_prior(estimate, information**-0.5, prior, prior_sigma)
    if sigma > 1.01 * prior_sigma:
        assert got is None
    elif sigma < 0.99 * prior_sigma:
        assert got == pytest.approx((measured, sigma), rel=1e-6, abs=1e-9)


def test_an_estimate_that_is_its_prior_says_nothing() -> None:
    assert slip_without_prior(0.01, 0.05, 0.01, 0.05) is None
    assert slip_without_prior(0.2, 0.08, 0.01, 0.05) is None
