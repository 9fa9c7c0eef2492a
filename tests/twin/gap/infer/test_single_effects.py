"""Laws alone and together: sizes, evidence, and pairs that no single effect shows."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.infer.predictive import Metric
from terrafusion.twin.gap.infer.single_effects import RIDGE, Laws

CANDIDATES = Candidates.of(["gyro_bias", "gyro_scale", "encoder_scale", "encoder_dropout"])
ROWS, SIZE = 300, 4.0
LADDERS = {
    law: (np.array([0.0, 1.0, 3.0]), (-1, 0, 1))
    for law in CANDIDATES.hypotheses
    if (law.effect, law.form) == ("encoder_scale", "in_loop")
}


def law(effect: str, form: str) -> int:
    return next(i for i, h in enumerate(CANDIDATES.hypotheses) if (h.effect, h.form) == (effect, form))


def problem(seed: int, ladder: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Columns (n, K) of the effects, and signatures (n, 2) of the law with a ladder."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((ROWS, CANDIDATES.count))
    return columns, rng.standard_normal((ROWS, 2)) if ladder is None else ladder


def metric_of(columns: np.ndarray, signatures: np.ndarray, error: np.ndarray) -> tuple[Metric, Laws]:
    X = np.column_stack([columns, signatures, error])
    m = Metric(np.pad(X.T @ X, (0, 1)), columns.shape[1])
    return m, Laws.of(CANDIDATES, LADDERS, m.shared, m.none)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng([9, seed]).standard_normal(ROWS)


def test_sizes_are_unbiased_and_their_sigma_is_the_scatter() -> None:
    i, at = law("gyro_scale", "scale"), CANDIDATES.keys.index("gyro_scale/scale")
    z = []
    for seed in range(100):
        columns, signatures = problem(seed)
        m, laws = metric_of(columns, signatures, 0.5 * columns[:, at] + noise(seed))
        fit = laws.fit(m, (i,))
        z.append((fit.values[0][0] - 0.5) / np.sqrt(fit.covariance[0][0, 0]))
    assert abs(np.mean(z)) < 0.3
    assert 0.8 < np.std(z) < 1.25


def test_a_size_that_runs_hardly_show_is_small() -> None:
    """As much information in the runs as before them: half of the size."""
    i, at = law("gyro_scale", "scale"), CANDIDATES.keys.index("gyro_scale/scale")
    columns, signatures = problem(4)
    columns[:, at] *= np.sqrt(RIDGE) / np.linalg.norm(columns[:, at])
    m, laws = metric_of(columns, signatures, 0.5 * columns[:, at])
    assert laws.fit(m, (i,)).values[0][0] == pytest.approx(0.25)


@pytest.mark.parametrize("size", [0.5, 1.0, 1.5, 2.0, 3.0])
def test_a_size_between_two_simulated_ones_is_interpolated(size: float) -> None:
    columns, (one, three) = problem(1)[0], problem(1)[1].T
    between = size * one if size <= 1.0 else one + 0.5 * (size - 1.0) * (three - one)
    m, laws = metric_of(columns, np.column_stack([one, three]), between)
    fit = laws.fit(m, (law("encoder_scale", "in_loop"),))
    assert fit.values[0][0] == pytest.approx(size, abs=1e-3)
    assert fit.gain == pytest.approx(0.5 * between @ between, rel=1e-6)
    if size != 1.0:  # a corner, where each side has a slope of its own
        slope = one if size < 1.0 else 0.5 * (three - one)
        assert fit.covariance[0][0, 0] == pytest.approx(1.0 / (slope @ slope), rel=1e-3)


def test_an_effect_of_one_side_is_not_believed_on_the_other() -> None:
    i, (columns, _) = law("encoder_dropout", "share"), problem(2)
    mine = CANDIDATES.keys.index("encoder_dropout/share")
    assert CANDIDATES.low[mine] == 0.0
    for sign, believed in ((1.0, True), (-1.0, False)):
        ladder = (np.array([0.0, 1.0, 3.0]), (-1, 0, 1))
        own = columns[:, mine]
        X = np.column_stack([columns, own, 3.0 * own, sign * own + noise(3)])
        m = Metric(np.pad(X.T @ X, (0, 1)), columns.shape[1])
        laws = Laws.of(CANDIDATES, {CANDIDATES.hypotheses[i]: ladder}, m.shared, m.none)
        assert (laws.fit(m, (i,)).evidence > 20.0) == believed


def test_a_pair_is_found_where_each_alone_is_second_to_a_third() -> None:
    """A greedy search would start with the effect that lies between the two."""
    a, b = law("gyro_bias", "constant"), law("gyro_scale", "scale")
    c = law("encoder_scale", "reading")
    columns, signatures = problem(5)
    one, two, three = (CANDIDATES.hypotheses[i].columns[0] for i in (a, b, c))
    columns[:, three] = 0.7 * (columns[:, one] + columns[:, two]) + 0.1 * columns[:, three]
    m, laws = metric_of(columns, signatures, 0.8 * columns[:, one] + 0.8 * columns[:, two] + noise(6))
    alone = {i: laws.fit(m, (i,)).evidence for i in (a, b, c)}
    assert max(alone, key=lambda i: alone[i]) == c
    pairs = {pair: laws.fit(m, pair).evidence for pair in ((a, b), (a, c), (b, c))}
    together = laws.fit(m, (a, b))
    assert max(pairs, key=lambda pair: pairs[pair]) == (a, b) or pairs[a, b] > alone[c]
    np.testing.assert_allclose(np.concatenate(together.values), 0.8, atol=0.3)


def test_noise_is_no_evidence() -> None:
    found = []
    for seed in range(30):
        columns, signatures = problem(seed)
        m, laws = metric_of(columns, signatures, noise(seed))
        found += [laws.fit(m, (i,)).evidence for i in range(len(laws.names))]
    assert np.mean(found) < 0.0
    assert np.mean(np.array(found) > 3.0) < 0.02


def test_a_law_that_must_be_simulated_and_is_not_explains_nothing() -> None:
    columns, signatures = problem(7)
    m, laws = metric_of(columns, signatures, noise(7))
    dropout = law("encoder_dropout", "share")
    fit = laws.fit(m, (dropout,))
    assert fit.evidence == -np.inf or fit.gain == 0.0
    assert isinstance(fit.laws[0], Hypothesis)


def test_a_size_beyond_the_simulated_ones_is_the_last_of_them() -> None:
    columns, signatures = problem(1)
    m, laws = metric_of(columns, signatures, 5.0 / 3.0 * signatures[:, 1])
    assert laws.fit(m, (law("encoder_scale", "in_loop"),)).values[0][0] == pytest.approx(3.0)


def expected_share(information: np.ndarray, k: int, sides: float, size: float, largest: float) -> float:
    """Log of the prior's density at a size, which is uniform in the logarithm above .1, times the posterior's
    volume: over both sides of one size, over the circle of two."""
    volume = 0.5 * k * np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(information + RIDGE * np.eye(k))[1]
    area = sides * size if k == 1 else 2.0 * np.pi * size**2
    return float(volume - np.log(area * np.log(largest / 0.1)))


@pytest.mark.parametrize(
    ("effect", "form", "sides", "true"),
    [
        ("gyro_scale", "scale", 2.0, [0.5]),
        ("gyro_scale", "scale", 2.0, [0.02]),  # as small as sizes are thought to be: .1
        ("accel_bias", "constant", 1.0, [0.6, 0.8]),
    ],
)
def test_evidence_is_the_likelihood_times_the_share_of_the_prior(
    effect: str, form: str, sides: float, true: list[float]
) -> None:
    candidates = Candidates.of([effect])
    i = next(i for i, h in enumerate(candidates.hypotheses) if h.form == form)
    at = list(candidates.hypotheses[i].columns)
    columns = np.random.default_rng(8).standard_normal((ROWS, candidates.count))
    error = columns[:, at] @ true
    X = np.column_stack([columns, error])
    m = Metric(np.pad(X.T @ X, (0, 1)), columns.shape[1])
    fit = Laws.of(candidates, {}, m.shared, m.none).fit(m, (i,))
    np.testing.assert_allclose(fit.values[0], true, rtol=1e-4)
    H = columns[:, at].T @ columns[:, at]
    largest = max(1.0, *np.abs(candidates.bounds(tuple(at))).ravel())
    share = expected_share(H, len(at), sides, max(float(np.linalg.norm(true)), 0.1), largest)
    assert fit.evidence - fit.gain == pytest.approx(share, abs=1e-3)
    np.testing.assert_allclose(fit.covariance[0], np.linalg.inv(H + RIDGE * np.eye(len(at))), rtol=1e-6)


def test_each_law_of_a_pair_has_its_own_part_of_the_covariance() -> None:
    candidates = Candidates.of(["accel_bias", "gyro_scale"])
    pair = [
        next(i for i, h in enumerate(candidates.hypotheses) if h.form == form)
        for form in ("constant", "scale")
    ]
    columns = np.random.default_rng(8).standard_normal((ROWS, candidates.count))
    at = [c for i in pair for c in candidates.hypotheses[i].columns]
    X = np.column_stack([columns, columns[:, at] @ (0.6, 0.8, 0.5)])
    m = Metric(np.pad(X.T @ X, (0, 1)), columns.shape[1])
    fit = Laws.of(candidates, {}, m.shared, m.none).fit(m, pair)
    P = np.linalg.inv(columns[:, at].T @ columns[:, at] + RIDGE * np.eye(3))
    np.testing.assert_allclose(fit.covariance[0], P[:2, :2])
    np.testing.assert_allclose(fit.covariance[1], P[2:, 2:])


def test_a_simulated_law_of_two_columns_has_one_size() -> None:
    candidates = Candidates.of(["accel_bias"])
    both = candidates.hypotheses[0]
    columns, signatures = np.random.default_rng(2).standard_normal((2, ROWS, candidates.count))
    X = np.column_stack([columns, signatures[:, :2], 2.0 * signatures[:, 0]])
    m = Metric(np.pad(X.T @ X, (0, 1)), columns.shape[1])
    ladders = {both: (np.array([0.0, 1.0, 3.0]), (-1, 0, 1))}
    laws = Laws.of(candidates, ladders, m.shared, m.none)
    fit = laws.fit(m, (0,))
    assert fit.values[0].shape == (2,)
    assert len(set(fit.values[0])) == len(set(fit.covariance[0].ravel())) == 1
    assert fit.covariance[0].shape == (2, 2)
