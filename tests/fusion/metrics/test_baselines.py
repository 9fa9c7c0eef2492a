"""Dead reckoning and the receiver alone: exact on exact sensors, scored like the estimate."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.metrics.baselines import Baselines, baselines, dead_reckoning
from terrafusion.fusion.metrics.scores import Outage, score
from terrafusion.twin.model.vehicle import load_vehicle

REST_S, SPEED_MPS, TURN_RADPS, BIAS_RADPS = 5.0, 0.8, 0.05, 0.02
TRACK_M = 0.5


def with_sensors(d, *, bias_radps: float = 0.0, gyro: bool = True, sides: bool = True) -> Recording:
    """The synthetic drive with exact wheels, and a gyro with a bias."""
    truth = d.recording.truth
    speed, rate = truth.twist_body[:, 0], truth.twist_body[:, 5]
    half = 0.5 * TRACK_M * rate
    wheels = (
        Wheels(truth.t_ns, np.stack([speed - half, speed + half], axis=1), ("left", "right"), "mps")
        if sides
        else Wheels(truth.t_ns, speed[:, None], ("speed",), "mps")
    )
    rates = np.full((len(truth), 3), np.nan)
    rates[:, 2] = rate + bias_radps
    imu = Imu(truth.t_ns, rates, np.full((len(truth), 3), np.nan)) if gyro else None
    return dataclasses.replace(d.recording, wheels=wheels, imu=imu)


def compared(recording, d, used=None, outages=(), held_out=None) -> Baselines:
    scores = score(d.estimate, recording, held_out=held_out, outages=outages)
    return baselines(recording, d.estimate, scores, used, outages, rig=rig_with_antenna(0.0))


def rig_with_antenna(forward_m: float) -> Rig:
    rig = load_vehicle("elevate").rig()
    gnss = dataclasses.replace(rig.sensors.gnss, antenna_m=(forward_m, 0.0, 0.0))
    sensors = dataclasses.replace(rig.sensors, gnss=gnss)
    return dataclasses.replace(rig, wheel_radius_m=0.2, track_m=TRACK_M, sensors=sensors)


def test_exact_sensors_give_the_exact_path(drive):
    d = drive(truth_hz=100)
    for recording in (with_sensors(d), with_sensors(d, gyro=False)):
        assert compared(recording, d).dead_reckoning_m < 0.02


def test_without_gyro_and_sides_there_is_no_heading(drive):
    d = drive()
    recording = with_sensors(d, gyro=False, sides=False)
    assert dead_reckoning(recording, 0.2, TRACK_M) is None
    assert compared(recording, d).dead_reckoning_m is None


def test_the_bias_at_rest_is_taken_out():
    t_ns = np.arange(0, 60_000_000_000, 20_000_000, dtype=np.int64)
    moving = t_ns >= REST_S * 1e9
    speed, rate = SPEED_MPS * moving, TURN_RADPS * moving
    gyro = np.stack([np.zeros_like(rate), np.zeros_like(rate), rate + BIAS_RADPS], axis=1)
    wheels = Wheels(t_ns, np.stack([speed, speed], axis=1), ("left", "right"), "mps")
    path = dead_reckoning(Recording("r", 0, wheels=wheels, imu=Imu(t_ns, gyro, gyro)), 0.2, TRACK_M)
    turned = TURN_RADPS * (t_ns[-1] * 1e-9 - REST_S)
    assert path.yaw_rad[-1] == pytest.approx(turned, abs=2e-3)
    radius = SPEED_MPS / TURN_RADPS
    end = radius * (np.sin(turned) + 1j * (1.0 - np.cos(turned)))
    assert abs(path.position_m[-1] - end) < 0.1


def test_wheels_that_read_too_much_drift_by_their_share(drive):
    d = drive()
    wrong = with_sensors(d)
    wrong = dataclasses.replace(
        wrong, wheels=dataclasses.replace(wrong.wheels, speed=1.1 * wrong.wheels.speed)
    )
    # Laid onto the first 10 m; 120 m at 10 % are 12 m at the end, 7 m in the mean square, less on curves.
    assert 3.0 < compared(wrong, d).dead_reckoning_m < 7.0


def test_the_receiver_is_scored_as_it_is(drive):
    d = drive()
    off = dataclasses.replace(d.fixes, enu_m=d.fixes.enu_m + np.array([3.0, 0.0, 0.0]))
    found = compared(with_sensors(d), d, used=off)
    assert found.gnss_m == pytest.approx(3.0, abs=0.05)


def test_in_an_outage_the_last_fix_is_held_and_dead_reckoning_starts_from_the_estimate(drive):
    d = drive(offset_m=(2.0, 0.0))
    recording, outage = with_sensors(d), Outage(40.0, 30.0)
    used = d.fixes.select(~outage.covers(d.fixes.t_ns, recording.start_ns))
    found = compared(recording, d, used=used, outages=[outage])
    truth = recording.truth.positions_at(recording.start_ns + np.array([39, 70]) * 10**9)[:, :2]
    moved = float(np.hypot(*(truth[1] - truth[0])))
    assert found.outages[0].gnss_m == pytest.approx(moved, abs=0.5)
    assert found.outages[0].dead_reckoning_m == pytest.approx(2.0, abs=0.05)


def test_an_antenna_is_brought_to_the_reference(drive):
    d = drive()
    recording = with_sensors(d)
    yaw = recording.truth.yaw_rad()[::50][: len(d.fixes)]
    arm = np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=1)
    ahead = dataclasses.replace(d.fixes, enu_m=d.fixes.enu_m + arm)
    scores = score(d.estimate, recording, antenna_m=(1.0, 0.0, 0.0))
    assert baselines(recording, d.estimate, scores, ahead, rig=rig_with_antenna(1.0)).gnss_m < 0.1
    assert baselines(recording, d.estimate, scores, ahead, rig=rig_with_antenna(0.0)).gnss_m > 0.9


def test_without_a_reference_nothing_is_scored(drive):
    d = drive()
    recording = dataclasses.replace(with_sensors(d), truth=None)
    found = compared(recording, d, used=d.fixes)
    assert dataclasses.asdict(found) == {"dead_reckoning_m": None, "gnss_m": None, "outages": ()}


def test_held_out_fixes_are_a_reference(drive):
    d = drive()
    recording = dataclasses.replace(with_sensors(d), truth=None)
    rows = np.arange(len(d.fixes)) % 5 == 4
    fixes = dataclasses.replace(d.fixes, sigma_enu_m=np.full((len(d.fixes), 3), 0.1))
    found = compared(recording, d, used=fixes.select(~rows), held_out=fixes.select(rows))
    assert found.dead_reckoning_m < 0.2
    assert found.gnss_m < 0.2  # a straight line across a second of a curve


def test_invalid_fixes_are_not_the_receiver(drive):
    d = drive()
    none = Gnss(d.fixes.t_ns, d.fixes.enu_m, d.fixes.sigma_enu_m, np.full(len(d.fixes), Fix.NONE, np.uint8))
    assert compared(with_sensors(d), d, used=none).gnss_m is None
