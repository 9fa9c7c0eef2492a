"""Sensors of one sample a second: no gap, and hardly worse than at full rate."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.inputs.streams import longest_gap_s, usual_interval_s
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import replay
from terrafusion.twin.simulate import simulate


def at_rate(run: Recording, rate_hz: float) -> Recording:
    """The run with wheels thinned to a rate, and a yaw rate alone, the mean over its interval."""
    assert run.imu is not None
    assert run.wheels is not None
    t = run.imu.t_ns
    ends = np.arange(int(t[0]), int(t[-1]), round(1e9 / rate_hz))
    turned = np.concatenate([[0.0], np.cumsum(run.imu.gyro_radps[1:, 2] * np.diff(t) * 1e-9)])
    rate = np.diff(np.interp(ends, t, turned)) * rate_hz
    gyro = np.full((len(rate), 3), np.nan)
    gyro[:, 2] = rate
    imu = Imu(ends[1:], gyro, np.full((len(rate), 3), np.nan))
    near = np.unique(np.searchsorted(run.wheels.t_ns, ends).clip(0, len(run.wheels) - 1))
    wheels = run.wheels.select(np.isin(np.arange(len(run.wheels)), near))
    return dataclasses.replace(run, imu=imu, wheels=wheels)


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_an_outage_with_slow_sensors_is_as_good_as_the_sensors(rate_hz: float) -> None:
    run = simulate("figure_eight", terrain="asphalt", seed=4)
    outage = Outage(0.5 * run.duration_s(), 20.0)
    scored = replay(at_rate(run, rate_hz), mode="fixed", outages=[outage]).scores.outages[0]
    assert scored.percent is not None
    assert scored.percent < 6.0


@pytest.mark.parametrize(("rate_hz", "planar"), [(5, True), (10, True), (17, True), (20, False)])
def test_accelerations_of_a_slow_imu_do_not_carry_the_robot_away(rate_hz: int, planar: bool) -> None:
    """Every so many samples of 100 Hz, as a throttled topic has them: each with its vibration in full."""
    run = until(simulate("figure_eight", terrain="asphalt", seed=1), 76.0)
    assert run.imu is not None
    slow = dataclasses.replace(run, imu=run.imu.select(slice(0, None, round(100 / rate_hz))))
    result = replay(slow, outages=[Outage(40.0, 30.0)])
    assert result.scores.ate_m is not None
    assert result.scores.ate_m < 0.25
    assert any("too few to integrate: a planar graph" in note for note in result.estimate.notes) is planar


def test_limits_follow_the_interval_of_a_stream() -> None:
    at_1_hz, at_100_hz = (list(range(0, 40 * step, step)) for step in (10**9, 10**7))
    assert usual_interval_s(at_1_hz) == 1.0
    assert longest_gap_s(at_1_hz) == 2.5
    assert longest_gap_s(at_100_hz) == 0.5
    assert longest_gap_s([0, 10**10, 2 * 10**10]) == 5.0
