"""Models of forks: each recovers what it made itself, and the truth is found under noisy poses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle
from tests.studies.body_velocity import Poses, body_velocity, heading
from tests.studies.joined_windows import DT_S
from tests.studies.twin_field import kinematic
from tests.studies.twin_field.field_run import speed_noise
from tests.studies.twin_field.fitting import residuals
from tests.studies.twin_field.forks import BINS, N_FUTURE, N_PAST, Forks, half_second_means
from tests.studies.twin_field.twin_model import ACTUATION, GROUND, TwinModel, calibrated, changed

SAMPLES = N_PAST + N_FUTURE + 1


def steps(count: int, seed: int) -> np.ndarray:
    """(F, T, 2) wheel speeds, rad/s, of random steps that a ramp joins."""
    rng = np.random.default_rng(seed)
    t = DT_S * np.arange(SAMPLES)
    before, after = rng.uniform(-6.0, 10.0, (2, count, 1, 2))
    at = rng.uniform(0.0, 4.0, (count, 1, 1))
    return before + (after - before) * np.clip((t[None, :, None] - at) / 0.5, 0.0, 1.0)


def forks(inputs: np.ndarray) -> Forks:
    """Forks with these inputs and no motion yet."""
    count = len(inputs)
    names = np.array([f"fork{k}" for k in range(count)])
    return Forks(
        names, names, names, np.zeros(count), inputs, inputs[:, : N_PAST + 1],
        np.zeros((count, SAMPLES, 3)), np.zeros(count), False,
    )  # fmt: skip


def moved(model, inputs: np.ndarray, noise: float = 0.0) -> Forks:
    """The forks on which the model's own prediction is the truth, with white noise on it."""
    empty = forks(inputs)
    start = empty.motion.copy()
    start[:, :, :] = model.predict(empty)[:, :1]  # steady up to the fork
    begun = dataclasses.replace(empty, motion=start)
    future = model.predict(begun)
    scatter = np.random.default_rng(7).normal(0.0, 1.0, future.shape) * noise
    motion = np.concatenate([start[:, :N_PAST], future + scatter], axis=1)
    return dataclasses.replace(empty, motion=motion)


@pytest.fixture(scope="module")
def warthog():
    return load_vehicle("warthog")


def test_plain_model_drives_straight_and_turns_on_the_spot(warthog):
    inputs = np.ones((2, SAMPLES, 2))
    inputs[1, :, 0] = -1.0
    told = kinematic.plain(warthog).predict(forks(inputs))
    radius, track = warthog.odometry.wheel_radius_m, warthog.odometry.track_m
    assert np.allclose(told[0], [radius, 0.0, 0.0])
    assert np.allclose(told[1], [0.0, 0.0, 2.0 * radius / track])


def test_radius_and_track_are_found(warthog):
    plain = kinematic.plain(warthog)
    made = dataclasses.replace(plain, left_gain=0.94, right_gain=0.94, left_m=0.93, right_m=-0.93)
    found = kinematic.radius_and_track(plain, moved(made, steps(12, 0)))
    assert found.left_gain == pytest.approx(0.94, abs=1e-4)
    assert found.left_m - found.right_m == pytest.approx(1.86, abs=1e-3)


def test_icr_model_is_recovered(warthog):
    plain = kinematic.plain(warthog)
    made = dataclasses.replace(plain, left_gain=0.9, right_gain=0.97, left_m=0.8, right_m=-1.1, x_m=0.12)
    found = kinematic.icr(plain, moved(made, steps(12, 1)))
    for name in ("left_gain", "right_gain", "left_m", "right_m", "x_m"):
        assert getattr(found, name) == pytest.approx(getattr(made, name), abs=2e-3), name


def test_lags_and_dead_time_are_recovered(warthog):
    plain = kinematic.plain(warthog)
    made = dataclasses.replace(plain, left_m=0.9, right_m=-0.9, dead_time_s=0.18, lag_s=0.5, turn_lag_s=1.1)
    found = kinematic.lagged(plain, moved(made, steps(20, 2)))
    assert found.dead_time_s == pytest.approx(0.18, abs=0.01)
    assert found.lag_s == pytest.approx(0.5, abs=0.02)
    assert found.turn_lag_s == pytest.approx(1.1, abs=0.05)


def test_lag_meets_the_exact_response_to_a_ramp(warthog):
    """x' = (t - x) / T from 0: x = t - T (1 - exp(-t/T))."""
    t = DT_S * np.arange(N_FUTURE + 1)
    inputs = np.zeros((1, SAMPLES, 2))
    inputs[0, N_PAST:] = t[:, None]
    model = dataclasses.replace(kinematic.plain(warthog), radius_m=1.0, lag_s=0.7)
    told = model.predict(forks(inputs))[0, :, 0]
    assert np.allclose(told, t - 0.7 * (1.0 - np.exp(-t / 0.7)), atol=1e-12)


def test_lag_without_a_known_start_begins_on_its_target(warthog):
    empty = forks(np.full((1, SAMPLES, 2), 4.0))
    model = dataclasses.replace(kinematic.plain(warthog), lag_s=0.7)
    told = model.predict(dataclasses.replace(empty, motion=np.full_like(empty.motion, np.nan)))
    assert np.allclose(told[0, :, 0], 4.0 * warthog.odometry.wheel_radius_m)


def test_twin_keeps_symmetry_and_mirrors_a_turn(warthog):
    model = TwinModel.nominal(warthog, load_soil("asphalt"), commanded=False)
    inputs = steps(1, 3)
    both = np.concatenate([inputs, inputs[..., ::-1]])
    told = model.predict(forks(both))
    assert np.allclose(told[0] * [1.0, -1.0, -1.0], told[1], atol=1e-9)
    straight = model.predict(forks(np.full((1, SAMPLES, 2), 3.0)))
    assert np.abs(straight[..., 1:]).max() < 1e-12


def test_twin_goes_at_the_wheels_speed_on_firm_ground(warthog):
    model = TwinModel.nominal(warthog, load_soil("asphalt"), commanded=False)
    told = model.predict(forks(np.full((1, SAMPLES, 2), 5.0)))
    assert told[0, -1, 0] == pytest.approx(5.0 * warthog.wheel.radius_m, rel=0.01)


def test_calibrated_twin_predicts_its_own_kind_at_noise_level(warthog):
    """Numbers of slippery ground and a wheel that is 5 % small, from noisy motion, told on other forks."""
    nominal = TwinModel.nominal(warthog, load_soil("asphalt"), commanded=False)
    hidden = changed(nominal, GROUND[:3], np.log([0.95, 0.3, 2.0]))
    noise = 0.05
    found = calibrated(nominal, GROUND[:3], moved(hidden, steps(6, 4), noise), rounds=8)
    fresh = moved(hidden, steps(4, 5))
    before = np.sqrt(np.mean(residuals(nominal.predict(fresh), fresh) ** 2))
    after = np.sqrt(np.mean(residuals(found.predict(fresh), fresh) ** 2))
    assert before > 1.0
    assert after < 0.25  # in units of 0.2 m/s and 0.1 rad/s: below the noise of one sample


def test_commanded_twin_lags_behind_the_command_and_arrives(warthog):
    model = TwinModel.nominal(warthog, load_soil("asphalt"), commanded=True)
    inputs = np.full((1, SAMPLES, 2), 2.0)
    inputs[0, N_PAST:] = 6.0
    started = dataclasses.replace(forks(inputs), past_radps=np.full((1, N_PAST + 1, 2), 2.0))
    motion = np.zeros((1, SAMPLES, 3))
    motion[..., 0] = 2.0 * warthog.wheel.radius_m
    told = model.predict(dataclasses.replace(started, motion=motion))[0, :, 0]
    goal = 6.0 * warthog.wheel.radius_m
    assert told[0] == pytest.approx(2.0 * warthog.wheel.radius_m)
    assert told[2] < 0.9 * goal
    assert told[-1] == pytest.approx(goal, rel=0.02)


def test_unknown_freedom_changes_nothing_and_known_ones_do(warthog):
    nominal = TwinModel.nominal(warthog, load_soil("asphalt"), commanded=True)
    same = changed(nominal, ACTUATION, np.zeros(len(ACTUATION)))
    assert np.array_equal(same.vehicle, nominal.vehicle)
    assert np.array_equal(same.soil, nominal.soil)
    other = changed(nominal, ACTUATION, np.full(len(ACTUATION), 0.1))
    assert (other.vehicle != nominal.vehicle).sum() == 6
    assert (other.soil != nominal.soil).sum() == 1


def test_body_velocity_is_found_under_noise_jumps_and_chunks_of_their_own():
    rng = np.random.default_rng(11)
    t = np.arange(0.0, 30.0, DT_S)
    rate = 0.6 * np.sin(0.5 * t)
    u, v = 1.5 + np.sin(0.4 * t), 0.1 * np.cos(0.3 * t)
    psi = heading(t, rate)
    track = np.cumsum((u + 1j * v) * np.exp(1j * psi)) * DT_S
    at = np.sort(rng.uniform(0.2, 29.8, 260))
    place = np.interp(at, t, track.real) + 1j * np.interp(at, t, track.imag)
    yaw = np.interp(at, t, psi)
    chunk = np.floor(at / 2.0).astype(np.int64)
    turn, shift = rng.uniform(-3.0, 3.0, (2, chunk.max() + 1))
    place = place * np.exp(1j * turn[chunk]) + shift[chunk]
    place += rng.normal(0.0, 0.02, len(at)) + 1j * rng.normal(0.0, 0.02, len(at))
    place[::29] += 1.5
    poses = Poses(at, np.stack([place.real, place.imag], 1), yaw + turn[chunk], chunk)
    found = body_velocity(t, rate, poses, u)
    inner = slice(20, -20)
    assert np.sqrt(np.mean((found[inner, 0] - u[inner]) ** 2)) < 0.06
    assert np.sqrt(np.mean((found[inner, 1] - v[inner]) ** 2)) < 0.06
    noise = speed_noise(t, rate, poses, u)[inner]
    assert 0.01 < np.sqrt(np.mean(noise**2)) < 0.12


def test_half_second_means_have_the_trapezoid_rule():
    ramp = np.repeat((DT_S * np.arange(N_FUTURE + 1))[None, :, None], 3, axis=2)
    means = half_second_means(ramp)
    assert means.shape == (1, BINS, 3)
    assert np.allclose(means[0, :, 0], 0.25 + 0.5 * np.arange(BINS))
