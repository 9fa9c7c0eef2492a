"""A delay is the run as it was so long before, whatever its size."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.effects.sensing import IMU
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.data.samples import delayed_samples, sample_map
from terrafusion.twin.gap.rollout.sensitivities import (
    Rollout,
    channel_sensitivities,
    linearise,
    predictions,
)
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.sensors.effects import CLOCK_DRIFT, DELAYS, without_delays
from tests.twin.gap.runs import run

CANDIDATES = Candidates.of(["imu_time_offset", "gnss_latency", "gyro_bias"])


@pytest.fixture(scope="module")
def log_and_model() -> tuple[PreparedLog, Model]:
    (log,), model, _ = prepared([run(1)], load_vehicle("elevate"), None)
    return log, model


@pytest.mark.parametrize(
    ("key", "late_s"),
    [("imu_time_offset/shift", 0.3), ("gnss_latency/both", 0.4), ("gnss_latency/velocity", 0.4)],
)
def test_a_late_row_is_an_earlier_one(log_and_model, key: str, late_s: float) -> None:
    """By whole slots: an IMU's rows over the borders of windows, too, fixes within each."""
    log, model = log_and_model
    effects = {key: late_s, "gyro_bias/constant": 0.05}
    plain, late = predictions(
        [Rollout(log, {"gyro_bias/constant": 0.05}), Rollout(log, effects)], model, CANDIDATES
    )
    assert plain is not None
    assert late is not None
    for observed, now, then in zip(log.observed, plain, late, strict=True):
        if observed.channel not in DELAYS[key]:
            assert np.array_equal(now, then)
            continue
        slots = round(late_s / observed.slot_s)
        assert slots >= 2
        assert np.array_equal(np.diff(observed.slot), np.ones(len(observed.slot) - 1))
        inside = np.ones(len(now) - slots, dtype=bool)
        if observed.channel not in IMU:
            of = window_of(observed, log.windows)
            inside = of[slots:] == of[:-slots]
        moved = np.abs(now[slots:] - now[:-slots])[inside].max()
        np.testing.assert_allclose(then[slots:][inside], now[:-slots][inside], atol=2e-3 * moved)


def test_a_fix_before_its_window_goes_straight_on(log_and_model) -> None:
    log, model = log_and_model
    plain, late = predictions([Rollout(log, {}), Rollout(log, {"gnss_latency/both": 0.2})], model, CANDIDATES)
    assert plain is not None
    assert late is not None
    at = {o.channel: i for i, o in enumerate(log.observed)}
    for axis, speed in (("gnss_east_m", "gnss_v_e_mps"), ("gnss_north_m", "gnss_v_n_mps")):
        of = window_of(log.observed[at[axis]], log.windows)
        first = [int(np.flatnonzero(of == k)[0]) for k in range(1, len(log.windows))]
        assert first
        for row in first:
            begin = plain[at[axis]][row] - late[at[axis]][row]
            assert begin == pytest.approx(0.2 * plain[at[speed]][row], abs=0.05)


def test_an_offset_that_grows_is_that_of_its_row(log_and_model) -> None:
    """As in a simulated drive, it is the value given after a minute of the log."""
    log, _ = log_and_model
    rate = [o.channel for o in log.observed].index("yaw_rate_radps")
    grown = delayed_samples(log, {CLOCK_DRIFT: 0.6})[rate]
    constant = delayed_samples(log, {"imu_time_offset/shift": 0.2})[rate]
    middle = 0.5 * (log.observed[rate].begin_s + log.observed[rate].end_s)
    row = int(np.argmin(np.abs(middle - 20.0)))  # 0.6 s after 60 s, a fifth of a second after 20

    def time_of(rows, i: int) -> float:
        return float(rows[0][i] @ rows[1][i])

    assert time_of(grown, row) == pytest.approx(time_of(constant, row), abs=0.6)  # samples of 10 ms
    assert delayed_samples(log, {"gyro_bias/constant": 0.1}) == sample_map(log).fine
    assert without_delays({CLOCK_DRIFT: 0.6, "gyro_bias/constant": 0.1}) == {"gyro_bias/constant": 0.1}


@pytest.mark.parametrize("key", ["dead_time/transport", "actuator_lag/command"])
def test_the_derivative_by_a_delay_of_commands_is_seen_between_them(key: str) -> None:
    """Commands came every 50 ms, and derivatives are kept as often: of 15 ms they showed a part."""
    recording, candidates = run(1), Candidates.of(["dead_time", "actuator_lag"])
    assert recording.command is not None
    at = np.arange(recording.start_ns, recording.command.t_ns[-1], 50_000_000)
    rows = np.searchsorted(recording.command.t_ns, at, side="right") - 1
    seldom = dataclasses.replace(
        recording.command, t_ns=at, v_mps=recording.command.v_mps[rows],
        yaw_rate_radps=recording.command.yaw_rate_radps[rows],
    )  # fmt: skip
    known = load_vehicle("elevate")
    stiff = dataclasses.replace(
        known.drive, speed_loop_p_nms=10.0 * known.drive.speed_loop_p_nms,
        max_accel_mps2=20.0, max_yaw_accel_radps2=40.0,
    )  # fmt: skip
    given = [dataclasses.replace(recording, command=seldom)], dataclasses.replace(known, drive=stiff)
    (log,), model, _ = prepared(*given, None)
    assert log.input_step_s == pytest.approx(0.05)
    column = 3 + candidates.keys.index(key)
    slope = channel_sensitivities(log, linearise(log, model, candidates, log.start, (key,)))[0].columns
    plain, late = predictions([Rollout(log, {}), Rollout(log, {key: 0.1})], model, candidates)
    assert plain is not None
    assert late is not None
    correlation = np.corrcoef(late[0] - plain[0], slope[:, column])[0, 1]
    print(correlation)
    assert correlation > 0.95
