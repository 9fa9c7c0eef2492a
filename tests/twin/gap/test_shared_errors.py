"""Errors that wheels and gyro share: found in what references show, subtracted, put back."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog, prepare
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.rollout.shared_errors import learn_gain, with_shared, without_shared
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate

TURN = 0.3


@pytest.fixture(scope="module")
def log() -> PreparedLog:
    model = Model(load_vehicle("elevate"), {"grass": load_soil("grass")}, {})
    return prepare(simulate("figure_eight", terrain="grass", seed=1), model, ground="grass")


def errors(log: PreparedLog, seed: int) -> list[Array]:
    rng = np.random.default_rng(seed)
    return [rng.normal(size=len(o.value)) for o in log.observed]


def columns(log: PreparedLog, seed: int) -> list[Array]:
    return [e[:, None] for e in errors(log, seed)]


def test_what_is_subtracted_can_be_put_back(log: PreparedLog) -> None:
    own = columns(log, 0)
    back = with_shared(log, TURN, without_shared(log, TURN, own))
    assert all(np.allclose(a, b, atol=1e-9) for a, b in zip(own, back, strict=True))


def test_the_map_is_linear(log: PreparedLog) -> None:
    one, other = columns(log, 0), columns(log, 1)
    both = without_shared(log, TURN, [2.0 * a - b for a, b in zip(one, other, strict=True)])
    alone = zip(without_shared(log, TURN, one), without_shared(log, TURN, other), strict=True)
    assert all(np.allclose(x, 2.0 * a - b) for x, (a, b) in zip(both, alone, strict=True))


def test_all_but_the_gyro_are_left_alone(log: PreparedLog) -> None:
    own = columns(log, 0)
    for o, before, after in zip(log.observed, own, without_shared(log, TURN, own), strict=True):
        assert np.array_equal(before, after) != (o.channel == "yaw_rate_radps")


def test_shared_errors_are_found_and_noise_alone_is_not(log: PreparedLog) -> None:
    noise = [0.01 * e for e in errors(log, 3)]
    drawn = zip(log.observed, errors(log, 2), noise, strict=True)
    wheels = [e if o.channel.startswith("wheel") else n for o, e, n in drawn]
    shared = with_shared(log, TURN, [e[:, None] for e in wheels])
    found = learn_gain([(log, [e[:, 0] for e in shared])])
    assert found == pytest.approx(TURN, abs=0.01)
    assert learn_gain([(log, errors(log, k)) for k in range(4)]) == 0.0


def test_without_wheels_of_both_sides_nothing_is_shared(log: PreparedLog) -> None:
    less = dataclasses.replace(log, observed=log.observed[1:])
    own = columns(less, 0)
    assert without_shared(less, TURN, own) == own
    assert learn_gain([(less, errors(less, 0))]) == 0.0
