"""A twin that turns otherwise than the robot has the robot's track where it goes the same way along it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.data.poses import aligned_start, moved, window_index
from terrafusion.twin.gap.data.samples import with_observed
from terrafusion.twin.gap.rollout.measured_turns import GYRO, as_measured
from terrafusion.twin.gap.rollout.sensitivities import (
    Rollout,
    channel_sensitivities,
    linearise,
    predictions,
    turned,
)
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import run

KEYS = ("gyro_scale/scale", "gyro_bias/constant", "track_width/scale", "wheel_radius/scale")
CANDIDATES = Candidates.of([key.split("/")[0] for key in KEYS])
SPEED_MPS = 1.2


@pytest.fixture(scope="module")
def log_and_model() -> tuple[PreparedLog, Model]:
    (log,), model, _ = prepared([run(970)], load_vehicle("elevate"), None)
    return log, model


def driven(log: PreparedLog, rates: tuple[float, ...]) -> list[Array]:
    """Channels of a robot that drives at a constant speed and turns at so many rates, one after the other, in
    each window."""
    out = []
    begin_s = log.windows[:, 0] * 0.01
    fine = np.linspace(0.0, 20.0, 20001)
    rate = np.array(rates)[np.minimum((fine / 2.0).astype(int), len(rates) - 1)]
    yaw = np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(fine))])
    velocity = SPEED_MPS * np.exp(1j * yaw)
    track = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(fine))])
    for i, o in enumerate(log.observed):
        since = begin_s[window_index(log, i)]
        at, a, b = o.end_s - since, o.begin_s - since, o.end_s - since
        if o.channel == GYRO:
            out.append((np.interp(b, fine, yaw) - np.interp(a, fine, yaw)) / (b - a))
        elif o.channel in ("gnss_east_m", "gnss_v_e_mps"):
            out.append(np.interp(at, fine, (track if o.channel.endswith("_m") else velocity).real))
        elif o.channel in ("gnss_north_m", "gnss_v_n_mps"):
            out.append(np.interp(at, fine, (track if o.channel.endswith("_m") else velocity).imag))
        else:
            out.append(np.zeros(len(o.value)))
    return out


def measured(log: PreparedLog, values: list[Array]) -> PreparedLog:
    pairs = zip(log.observed, values, strict=True)
    return with_observed(log, [dataclasses.replace(o, value=y) for o, y in pairs])


def off(log: PreparedLog, values: list[Array]) -> float:
    """Greatest distance of predicted fixes from those measured, m, the windows aligned."""
    laid = moved(log, values, log.start, aligned_start(log, values, log.start))
    errors = [o.value - y for o, y in zip(log.observed, laid, strict=True) if o.channel.startswith("gnss")]
    return max(float(np.abs(e).max()) for e in errors if len(e))


rates = st.tuples(*[st.floats(-0.4, 0.4)] * 5)


@given(robot=rates, twin=rates)
@settings(max_examples=25, deadline=None)
def test_the_track_is_the_robots_however_the_twin_turns(log_and_model, robot, twin) -> None:
    log, _ = log_and_model
    log = measured(log, driven(log, robot))
    values = driven(log, twin)
    assert off(log, as_measured(log, values, values)) < 0.02 + 0.02 * off(log, values)


def test_derivatives_are_those_of_the_turned_track(log_and_model) -> None:
    """To first order, about a twin that turns too little."""
    log, model = log_and_model
    start, step = {"track_width/scale": 0.15}, 0.3
    model = dataclasses.replace(model, effects=start)
    candidates = CANDIDATES.beside(start)
    plain = channel_sensitivities(log, linearise(log, model, candidates, log.start, KEYS))
    found = turned(log, plain)
    for key in KEYS:
        i = candidates.keys.index(key)
        change = {key: start.get(key, 0.0) + step * float(candidates.scale[i])}
        near, far = predictions([Rollout(log, {}), Rollout(log, change)], model, candidates)
        assert near is not None
        assert far is not None
        pairs = zip(as_measured(log, near, near), as_measured(log, far, far), strict=True)
        slopes = [(b - a) / step for a, b in pairs]
        for k, observed in enumerate(log.observed):
            if observed.channel.startswith("gnss"):
                size = float(np.abs(plain[k].columns[:, 3 + i]).max() + np.abs(slopes[k]).max())
                assert np.abs(found[k].columns[:, 3 + i] - slopes[k]).max() < 0.03 * size + 5e-4, key


def test_a_gyro_of_loud_noise_turns_nothing(log_and_model) -> None:
    log, model = log_and_model
    (values,) = predictions([Rollout(log, {})], model, CANDIDATES)
    assert values is not None
    noise = np.random.default_rng(3)
    pairs = zip(log.observed, values, strict=True)
    loud = [y + (o.channel == GYRO) * noise.normal(0.0, 2.0, len(y)) for o, y in pairs]
    turned_by_noise = as_measured(measured(log, loud), values, values)
    assert off(measured(log, values), turned_by_noise) < 0.05


def test_without_a_gyro_tracks_stay(log_and_model) -> None:
    log, model = log_and_model
    kept = [i for i, o in enumerate(log.observed) if o.channel != GYRO]
    blind = dataclasses.replace(log, observed=tuple(log.observed[i] for i in kept))
    (values,) = predictions([Rollout(blind, {})], model, CANDIDATES)
    assert values is not None
    assert all(np.array_equal(a, b) for a, b in zip(as_measured(blind, values, values), values, strict=True))
