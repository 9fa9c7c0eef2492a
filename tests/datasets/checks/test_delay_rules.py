"""What is made of a measured delay between sensors: thresholds, words, repairs, and look-alikes."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from terrafusion.datasets.checks import delays, path_model, run_checks, scale
from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.known_delays import lag_with_sigma, on_one_clock
from terrafusion.datasets.checks.motion import Pair, Signal
from terrafusion.datasets.checks.path_model import model_by_fixes
from terrafusion.datasets.core.bootstrap import BootstrapInterval
from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.lag import Lag
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate
from tests.datasets.conftest import make_drive

IMU: Pair = ("imu", "wheels")
TRUTH: Pair = ("truth", "imu")
GNSS: Pair = ("gnss", "wheels")


@pytest.fixture(scope="module")
def drive() -> Recording:
    return make_drive()


def wave(period_s: float = 0.02, late_s: float = 0.0, seconds: float = 60.0) -> Signal:
    """A lively signal; `late_s` behind the others."""
    t_s = np.arange(0.0, seconds, period_s)
    at = t_s - late_s
    values = np.sin(1.1 * at) + np.sin(0.37 * at) + 0.5 * np.sin(2.9 * at)
    return np.rint(t_s * 1e9).astype(np.int64), values


def turning(rate: float, step_s: float) -> Recording:
    """200 s of turns; the IMU begins 1.5 s after the wheels, on a clock that is fast by `rate`, or with a
    step of it in the middle."""
    noise = np.random.default_rng(0).normal(0.0, 0.01, 20_000)
    t_ns, gyro = wave(0.01, seconds=200.0)
    late_ns = np.rint(t_ns * rate + (t_ns > 10**11) * step_s * 1e9).astype(np.int64)
    gyro = np.stack([0.0 * gyro, 0.0 * gyro, 0.2 * gyro + noise], axis=1)
    imu = Imu(t_ns + late_ns, gyro, np.full_like(gyro, np.nan)).select(t_ns > 1_500_000_000)
    t_ns, turn = wave(0.05, seconds=200.0)
    sides = 1.0 + 0.1 * np.outer(turn, [-1.0, 1.0])
    wheels = Wheels(t_ns, sides, ("left", "right"), "mps")
    return Recording("turning", 0, imu=imu, wheels=wheels)


@pytest.mark.parametrize(
    ("rate", "step_s"), [(0.002, 0.0), (-0.001, 0.0), (0.0002, 0.0), (0.0, 0.0), (0.0, 0.25)]
)
def test_a_small_drift_is_named_by_the_lags_of_channels_of_other_lengths(rate: float, step_s: float) -> None:
    log = turning(rate, step_s)
    findings = [finding for finding in delays.check_clocks(CheckContext(log, None)) if finding.repair]
    assert [(f.code, f.channel) for f in findings if f.code == "clock-drift"] == (
        [("clock-drift", "imu")] if abs(rate) >= 0.001 else []
    )
    for finding in findings if rate else ():
        assert finding.repair is not None
        imu = finding.repair(log).imu
        assert imu is not None
        np.testing.assert_allclose(np.diff(imu.t_ns), 1e7, rtol=2e-4)


def test_an_interval_that_holds_zero_is_no_distance_from_it() -> None:
    assert delays._distance_to_zero_s(Lag(0.3, 0.1, 0.5, 1.0)) == 0.1
    assert delays._distance_to_zero_s(Lag(-0.3, -0.5, -0.1, 1.0)) == 0.1
    assert delays._distance_to_zero_s(Lag(0.3, -0.1, 0.5, 1.0)) == 0.0
    assert delays._distance_to_zero_s(Lag(0.3, 0.0, 0.5, 1.0)) == 0.0


@pytest.mark.parametrize(
    ("pair", "seconds", "low_s", "high_s", "period_s", "matters"),
    [
        (IMU, 0.1, 0.06, 0.14, 0.01, True), (IMU, 0.099, 0.06, 0.14, 0.01, False),
        (IMU, 0.1, 0.05, 0.15, 0.01, False), (IMU, -0.15, -0.19, -0.101, 0.01, True),
        (IMU, -0.15, -0.19, -0.099, 0.01, False), (TRUTH, -0.15, -0.19, -0.06, 0.01, True),
        (GNSS, 0.2, 0.11, 0.3, 0.2, True), (GNSS, 0.19, 0.15, 0.2, 0.2, False),
        (GNSS, 0.6, 0.49, 0.7, 1.0, False), (GNSS, 0.6, 0.51, 0.7, 1.0, True),
    ],
)  # fmt: skip
def test_which_lags_matter(
    pair: Pair, seconds: float, low_s: float, high_s: float, period_s: float, matters: bool
) -> None:
    """Half a sample, or half of the least lag, are no lag; behind wheels a whole one."""
    lag = Lag(seconds, low_s, high_s, 0.9)
    assert delays._matters(pair, lag, wave(period_s), wave(0.01)) == matters
    assert delays._matters(pair, lag, wave(0.01), wave(period_s)) == matters


@pytest.mark.parametrize(
    ("off", "channel", "severity", "words"),
    [
        ({IMU: Lag(0.4, 0.3, 0.49, 0.9)}, "wheels", "warning", "0.400 s late against imu"),
        ({IMU: Lag(0.6, 0.51, 0.7, 0.9)}, "wheels", "error", "0.600 s late against imu"),
        ({IMU: Lag(0.6, 0.5, 0.7, 0.9)}, "wheels", "warning", "0.600 s late against imu"),
        ({IMU: Lag(-1.9, -2.0, -1.8, 0.9)}, "wheels", "warning", "1.900 s early against imu"),
        ({IMU: Lag(-2.2, -2.3, -2.01, 0.9)}, "wheels", "error", "2.200 s early against imu"),
        ({GNSS: Lag(0.4, 0.3, 0.5, 0.9)}, "gnss", "warning", "0.400 s early against wheels"),
        ({GNSS: Lag(-2.9, -3.2, -2.8, 0.9)}, "gnss", "warning", "2.900 s late against wheels"),
        ({GNSS: Lag(3.2, 3.01, 3.3, 0.9)}, "gnss", "error", "3.200 s early against wheels"),
    ],
)
def test_words_and_repair_of_an_offset(
    drive: Recording, off: dict[Pair, Lag], channel: str, severity: str, words: str
) -> None:
    finding = delays.offset_finding(drive, off, set(off))
    assert (finding.code, finding.severity, finding.channel) == ("clock-offset", severity, channel)
    assert finding.what == f"its times are {words}"
    late_s = float(words.split()[0]) * (1.0 if "late" in words else -1.0)
    assert finding.fix.startswith(f"move the times of {channel} by {-late_s:+.3f} s")
    (lag,) = off.values()
    first, last = (lag.low_s, lag.high_s) if channel == "wheels" else (-lag.high_s, -lag.low_s)
    assert f"interval {first:.3f} to {last:.3f} s, correlation 0.90" in finding.evidence
    assert finding.repair is not None
    moved, before = getattr(finding.repair(drive), channel), getattr(drive, channel)
    np.testing.assert_array_equal(moved.t_ns, before.t_ns - round(late_s * 1e9))


def test_of_several_the_sharpest_lag_is_told(drive: Recording) -> None:
    off = {IMU: Lag(0.4, 0.3, 0.5, 0.9), ("truth", "wheels"): Lag(0.42, 0.4, 0.44, 0.8)}
    finding = delays.offset_finding(drive, off, {*off, TRUTH})
    assert finding.what == "its times are 0.420 s late against truth"
    assert "disagrees with imu and truth" in finding.fix


def test_an_early_clock_that_fixes_alone_accuse_may_be_a_late_one(drive: Recording) -> None:
    """Wheels and fixes that are both late agree with each other; truth would clear the wheels."""
    off = {IMU: Lag(0.12, 0.11, 0.13, 0.9)}
    finding = delays.offset_finding(drive, off, {IMU, GNSS})
    assert finding.channel == "wheels"
    assert finding.what == "its times are 0.120 s late against imu"
    assert "wheels agrees with gnss, so either both are late or imu is early" in finding.fix
    cleared = delays.offset_finding(drive, off, {IMU, GNSS, ("truth", "wheels")})
    assert (cleared.channel, cleared.what) == ("imu", "its times are 0.120 s early against wheels")
    alone = delays.offset_finding(drive, {IMU: Lag(-0.4, -0.5, -0.3, 0.9)}, {IMU})
    assert "it may be that which is late" in alone.fix


def test_a_delay_of_the_vehicle_file_brings_its_sigma() -> None:
    lag = lag_with_sigma(Lag(0.318, 0.305, 0.332, 0.9), 0.186)
    assert (lag.low_s, lag.high_s) == pytest.approx((0.318 - 0.3648, 0.318 + 0.3648), abs=1e-3)
    assert lag_with_sigma(lag, 0.0) == lag


@pytest.mark.parametrize(
    ("value", "low", "high", "words"),
    [
        (0.5, 0.21, 0.8, "0.50 s late"), (0.5, 0.19, 0.8, ""), (0.29, 0.25, 0.3, ""),
        (0.31, 0.25, 0.4, "0.31 s late"), (-0.5, -0.8, -0.3, "0.50 s early"), (-0.5, -0.8, -0.1, ""),
    ],
)  # fmt: skip
def test_late_fixes(
    drive: Recording, monkeypatch: pytest.MonkeyPatch, value: float, low: float, high: float, words: str
) -> None:
    model = SimpleNamespace(delay_s=BootstrapInterval(value, low, high), windows=17, rest=0.9)
    monkeypatch.setattr(delays, "model_by_fixes", lambda _: model)
    found = list(delays._late_fixes(CheckContext(drive, None)))
    assert [finding.what for finding in found] == (
        [f"its times are {words} against wheels and imu"] if words else []
    )
    if words:
        assert found[0].evidence.endswith(f"{low:.2f} to {high:.2f} s, by the path in 17 stretches")
        assert found[0].fix == f"move the times of gnss by {-value:+.2f} s"
        assert found[0].repair is not None
        moved = found[0].repair(drive).gnss
        assert moved is not None
        model.rest = 0.98
        assert not list(delays._late_fixes(CheckContext(drive, None))), "no delay fits as well"
        assert drive.gnss is not None
        np.testing.assert_array_equal(moved.t_ns, drive.gnss.t_ns - round(value * 1e9))
    monkeypatch.setattr(delays, "model_by_fixes", model_by_fixes)
    assert not list(delays._late_fixes(CheckContext(dataclasses.replace(drive, gnss=None), None)))


def test_the_path_of_the_fixes_is_fitted_once_for_all_checks(
    drive: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted: list[object] = []
    monkeypatch.setattr(path_model, "_path_model", lambda _, measured: fitted.append(measured))
    context = CheckContext(dataclasses.replace(drive, truth=None), None)
    for check in (delays._late_fixes, scale.check_gyro_scale):
        assert not list(check(context))
    assert len([measured for measured in fitted if measured is not None]) == 1


def test_delays_that_the_vehicle_file_has_are_taken_out_first(
    drive: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = CheckContext(drive, None)
    assert on_one_clock(context) is context
    known = {"gnss_delay_s": 0.2, "wheel_delay_s": -0.1}
    monkeypatch.setattr(CheckContext, "known", lambda self, name: known[name])
    corrected = on_one_clock(context).recording
    for name, late_ns in (("gnss", 200_000_000), ("wheels", -100_000_000), ("imu", 0)):
        np.testing.assert_array_equal(getattr(corrected, name).t_ns, getattr(drive, name).t_ns - late_ns)


def test_a_mean_of_the_last_samples_is_no_clock() -> None:
    """Over 0.6 s: 0.29 s late. A plain delay stays what it is."""
    t_ns, values = wave()
    mean = np.convolve(values, np.full(30, 1.0 / 30.0))[: len(values)]
    lag = Lag(0.29, 0.28, 0.3, 0.98)
    found = delays._without_smoothing(lag, wave(), (t_ns, mean))
    assert found.seconds == pytest.approx(0.0, abs=0.041)  # lengths are tried in steps of 0.08 s
    assert found.high_s - found.low_s == pytest.approx(0.02)
    assert found.high_s == pytest.approx(found.seconds + 0.01)
    late = Lag(0.3, 0.29, 0.31, 1.0)
    assert delays._without_smoothing(late, wave(), wave(late_s=0.3)) == late


def test_a_body_that_is_dragged_follows_and_a_late_clock_does_not() -> None:
    from scipy.signal import lfilter

    t_ns, values = wave()
    decay = float(np.exp(-0.02 / 0.5))
    dragged = (t_ns, lfilter([1.0 - decay], [1.0, -decay], values))
    lag = Lag(-0.4, -0.42, -0.38, 0.95)
    assert delays._follows(lag, dragged, wave())
    assert not delays._follows(lag, wave(late_s=0.4), wave())


def test_a_wrong_sign_is_no_clock() -> None:
    t_ns, values = wave()
    lag = Lag(0.4, 0.38, 0.42, 0.9)
    assert delays.opposed(lag, wave(), (t_ns, -values))
    assert not delays.opposed(lag, wave(), wave(late_s=0.4))
    short = wave(seconds=0.02)
    assert not delays.opposed(lag, short, short)


def test_speeds_that_fade_alike_are_no_clock() -> None:
    """A robot that bogs down in mud: without its start, the path fades later as the wheels do now."""
    log = simulate("waypoints", vehicle="warthog", terrain="mud", cross_slope_deg=-8.0, seed=27)
    log = dataclasses.replace(log, terrain=None, terrain_name="")
    assert "clock-offset" not in {finding.code for finding in run_checks(log, load_vehicle("warthog").rig())}
    late = Lag(3.0, 2.9, 3.1, 0.99)
    assert not delays._as_well_without(late, wave(), wave(late_s=3.0))


def test_between_gaps_a_signal_is_not_known() -> None:
    t_ns, values = wave()
    keep = (t_ns < 10 * 10**9) | (t_ns >= 12 * 10**9)
    values = values.copy()
    values[100] = np.nan
    grid = np.arange(0.0, 20.0, 0.02)
    found, known = delays._resampled(grid, (t_ns[keep], values[keep]), t_ns[0])
    assert not known[(grid > 10.0) & (grid < 11.9)].any()
    assert known[grid < 9.9].all(), "one empty cell is bridged"
    assert found[known] == pytest.approx(wave()[1][: len(grid)][known], abs=0.01)
    (one, _), (other, _) = delays._on_grid((t_ns, values), (t_ns[50:500], values[50:500]), 0.0)
    assert one.tolist() == pytest.approx(wave()[1][50:499].tolist(), abs=0.01)
    assert len(other) == len(one) == 449


def test_correlations_of_nothing_are_none() -> None:
    one = wave()[1]
    assert delays._correlation(one, 2.0 * one + 1.0) == pytest.approx(1.0)
    assert delays._correlation(one, -one) == pytest.approx(-1.0)
    assert delays._correlation(one[:0], one[:0]) == 0.0
    assert delays._correlation(one, np.zeros(len(one))) == 0.0
    assert delays._correlation(np.ones(len(one)), one) == 0.0


def test_a_context_without_known_delays_keeps_its_recording(drive: Recording) -> None:
    other = dataclasses.replace(drive, gnss=None)
    assert on_one_clock(CheckContext(other, None)).recording is other
