"""What an explanation leaves in each channel, on synthetic columns."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.infer.channels import RIDGE, ChannelTable, ErrorProducts, RunProducts

CHANNELS, ROWS, STATES, EFFECTS = 3, 400, 1, 4
NO_REFERENCES = np.zeros((0, 2 * CHANNELS))
LOW, HIGH = np.full(1, -20.0), np.full(1, 20.0)


def columns(rng: np.random.Generator) -> np.ndarray:
    return 0.3 * rng.standard_normal((CHANNELS, ROWS, STATES + EFFECTS))


def block(J: np.ndarray, error: np.ndarray) -> RunProducts:
    gram = np.einsum("cni,cnj->cij", J, J)
    made = ErrorProducts(np.einsum("cni,cn->ci", J, error), (error**2).sum(axis=1))
    inverse = np.linalg.inv(gram + RIDGE * np.eye(J.shape[2]))
    return RunProducts(gram, inverse, made, STATES, np.full(CHANNELS, float(ROWS)))


def table(blocks: list[RunProducts]) -> ChannelTable:
    """A reference leaves unit variance: so many directions inside, the rest outside."""
    N = STATES + EFFECTS
    inside, outside = np.full(CHANNELS, float(N)), np.full(CHANNELS, float(ROWS - N))
    return ChannelTable((), tuple(blocks), np.ones(STATES), inside, outside, np.ones(STATES), NO_REFERENCES)


def test_taking_an_effect_out_is_what_it_is_in_full() -> None:
    rng = np.random.default_rng(1)
    J, e = columns(rng), rng.standard_normal((CHANNELS, ROWS))
    size = np.array([1.5, -0.7])
    moved = block(J, e).minus(block(J, e).error, [0, 2], size)
    again = block(J, e - J[:, :, [STATES, STATES + 2]] @ size).error
    np.testing.assert_allclose(moved.gain, again.gain, atol=1e-9)
    np.testing.assert_allclose(moved.square, again.square)


def test_the_true_effect_leaves_least_and_its_size_is_found() -> None:
    rng = np.random.default_rng(2)
    blocks = []
    for _ in range(3):
        J = columns(rng)
        blocks.append(block(J, rng.standard_normal((CHANNELS, ROWS)) + J[:, :, STATES + 1] * 4.0))
    found = {i: table(blocks).linear_fit([i], LOW, HIGH) for i in range(EFFECTS)}
    assert min(found, key=lambda i: found[i][1].total) == 1
    assert found[1][0][0] == pytest.approx(4.0, abs=0.3)
    assert found[1][1].total < 0.1 * table(blocks).before().total
    assert table(blocks).linear_fit([1], LOW, np.array([2.0]))[0][0] == 2.0


def test_a_channel_that_nothing_explains_speaks_for_none() -> None:
    """An error of another kind in one channel, a hundred times the noise: the other channels still decide."""
    rng = np.random.default_rng(3)
    blocks = []
    for _ in range(3):
        J = columns(rng)
        e = rng.standard_normal((CHANNELS, ROWS)) + J[:, :, STATES + 1] * 4.0
        e[0] += 100.0 * rng.standard_normal(ROWS)
        blocks.append(block(J, e))
    value, left = table(blocks).linear_fit([1], LOW, HIGH)
    assert value[0] == pytest.approx(4.0, abs=0.4)
    others = [table(blocks).linear_fit([i], LOW, HIGH)[1].total for i in (0, 2, 3)]
    assert min(others) > left.total + 1.0


def test_what_the_states_take_up_is_not_explained() -> None:
    """An effect whose signature is that of a state: it leaves less, as the state need not go so far."""
    rng = np.random.default_rng(4)
    blocks = []
    for _ in range(3):
        J = columns(rng)
        J[:, :, STATES + 1] = J[:, :, 0]
        blocks.append(block(J, rng.standard_normal((CHANNELS, ROWS)) + J[:, :, 0] * 6.0))
    before = table(blocks).before()
    value, left = table(blocks).linear_fit([1], LOW, HIGH)
    assert before.total > 2.0
    assert left.total < 0.5 * before.total
    assert value[0] == pytest.approx(6.0, abs=1.0)
