"""The discrepancy of a law: in proportion to its size, and in each channel by itself."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.infer.close_look import FUNCTIONS, CloseLook, by_sensor
from terrafusion.twin.gap.infer.predictive import Metric
from terrafusion.twin.gap.infer.single_effects import Laws
from tests.twin.gap.infer.test_single_effects import CANDIDATES, law, noise, problem

SCALE, BIAS = law("gyro_scale", "scale"), law("gyro_bias", "constant")
GIVEN = 20.0  # size at which the discrepancy is given


def close_look(columns: np.ndarray, discrepancy: np.ndarray, error: np.ndarray) -> CloseLook:
    """At one law, whose discrepancy by channel has these columns (n, D) at the size `GIVEN`; there is none by
    functions of the commands."""
    F = len(FUNCTIONS) + 1
    X = np.column_stack([columns, np.zeros((len(error), F)), discrepancy, error])
    m = Metric(np.pad(X.T @ X, (0, 1)), columns.shape[1])
    extra = columns.shape[1] + np.arange(F + discrepancy.shape[1])
    laws = Laws.of(CANDIDATES, {}, m.shared, m.none)
    return CloseLook(m, laws, (SCALE,), {SCALE: extra}, {SCALE: GIVEN}, lambda *_: False)


def setting() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns of the effects, the law's signature, and which half of the samples are of one channel."""
    columns = problem(5)[0]
    half = (np.arange(len(columns)) % 2).astype(float)
    return columns, columns[:, CANDIDATES.hypotheses[SCALE].columns[0]], half


def test_a_law_of_no_size_explains_nothing_by_its_discrepancy() -> None:
    columns, signature, half = setting()
    shape = GIVEN * signature * np.sign(np.sin(np.arange(len(half))))
    other = 0.1 * (shape - signature * (signature @ shape) / (signature @ signature))
    fit = close_look(columns, shape[:, None], other + noise(5)).fit((SCALE,))
    assert abs(fit.values[0][0]) < 0.5
    assert fit.gain < 0.05 * float(other @ other)


@pytest.mark.parametrize("size", [2.0, 10.0, 22.0])
def test_what_a_law_leaves_in_one_channel_is_in_proportion_to_its_size(size: float) -> None:
    columns, signature, half = setting()
    error = size * signature * (0.9 + 0.2 * half) + noise(6)
    fit = close_look(columns, GIVEN * (signature * half)[:, None], error).fit((SCALE,))
    whole = 0.5 * float(error @ error) - 0.5 * len(error)
    assert fit.gain > 0.99 * whole - 15.0
    assert fit.values[0][0] == pytest.approx(size, rel=0.2)


def test_a_size_is_that_of_the_channel_that_shows_most() -> None:
    columns, signature, half = setting()
    strength = np.where(half == 1.0, 1.0, 0.2)
    columns = columns * strength[:, None]
    error = signature * strength * np.where(half == 1.0, 10.0, 20.0) + 0.1 * noise(7)
    by_channel = GIVEN * (signature * strength)[:, None] * np.column_stack([half, 1.0 - half])
    fit = close_look(columns, by_channel, error).fit((SCALE,))
    assert fit.values[0][0] == pytest.approx(10.4, abs=0.3)


@pytest.mark.parametrize(
    ("odd", "old", "both"),
    [(0.0, (), True), (1.0, (), False), (0.0, (BIAS,), False), (0.0, (SCALE, BIAS), True)],
)
def test_a_second_law_explains_most_of_what_the_first_leaves(
    odd: float, old: tuple[int, ...], both: bool
) -> None:
    """Or what the first leaves has the shape of no law: here of ten columns beside a little of the second.
    One that references may hold counts as little, unless they may hold the other, too."""
    columns, signature, half = setting()
    others = np.random.default_rng(8).standard_normal((len(half), 10))
    bias = columns[:, CANDIDATES.hypotheses[BIAS].columns[0]]
    error = GIVEN * signature + bias + odd * others.sum(axis=1) + noise(8)
    nothing = np.zeros((len(half), len(FUNCTIONS) + 2))
    X = np.column_stack([columns, others, nothing, error])
    m = Metric(np.pad(X.T @ X, (0, 1)), columns.shape[1] + others.shape[1])
    extra = m.shared + np.arange(nothing.shape[1])
    look = CloseLook(
        m, Laws.of(CANDIDATES, {}, m.shared, m.none), (SCALE, BIAS),
        {SCALE: extra, BIAS: extra}, {SCALE: GIVEN, BIAS: 1.0}, lambda i, _: i in old,
    )  # fmt: skip
    found, pair = look.search(), (min(SCALE, BIAS), max(SCALE, BIAS))
    alone, together = look.fit((SCALE,)).evidence, look.fit(pair).evidence
    assert together > alone + 50.0
    assert (pair in found) == both
    assert found[SCALE,].evidence == (alone if both else together)


def test_wheels_of_both_sides_are_one_sensor() -> None:
    from types import SimpleNamespace as Stub

    names = ("wheel_left_radps", "wheel_right_radps", "yaw_rate_radps", "gnss_east_m", "gnss_north_m")
    run = Stub(log=Stub(observed=[Stub(channel=name) for name in names]), channel=np.arange(5))
    found = by_sensor(run)  # type: ignore[arg-type]
    assert found.T.tolist() == [[1, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 1]]
