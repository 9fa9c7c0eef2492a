"""The p-value on drives that no reference made: uniform without a gap, small with one."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from terrafusion.twin.gap.blind.rates import Rate
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.detection import (
    EXPECTED_WEIGHT,
    GRID,
    JITTER,
    UNKNOWN_SIZES,
    WIDE,
    Deviations,
    _matching_errors,
    detect,
)
from terrafusion.twin.gap.infer.other_drives import (
    CANDIDATE_SCATTER,
    CERTAIN,
    MISFIT_SCATTER,
    NUISANCE_SCATTER,
    PRIOR_COLUMNS,
    SCATTER_SCALES,
    RobotOffsets,
    _log_likelihood,
    _posterior,
    learn_misfit,
    learn_offsets,
)
from terrafusion.twin.gap.null.score import Score
from terrafusion.twin.gap.rollout.nuisance import BASIS

CANDIDATES = Candidates.of(["gyro_bias", "gyro_scale", "encoder_scale", "wheel_radius_asymmetry", "slope"])
P = CANDIDATES.count + 4
ROWS, COLUMN, TRIALS = 200, 2, 200
SCATTER = np.where(np.arange(P) < CANDIDATES.count, CANDIDATE_SCATTER, NUISANCE_SCATTER)
"""As the prior has it: what references hardly excite, they cannot say."""
DRIVES = {
    name: np.random.default_rng(i).standard_normal((ROWS, P)) * np.geomspace(*range_, P)
    for i, (name, range_) in enumerate({"reference": (1.0, 0.1), "other": (0.1, 1.0)}.items())
}
"""Sensitivities of a drive: the other one shows best what the references hardly excite."""


def scores(rng: np.random.Generator, count: int, drive: str, robot: np.ndarray) -> list[Score]:
    """Runs of a robot with its offsets (P,), scatter from run to run, and noise."""
    J, out = DRIVES[drive], []
    for _ in range(count):
        error = rng.standard_normal(ROWS) + J @ (robot + SCATTER * rng.standard_normal(P))
        out.append(Score(J.T @ error, J.T @ J))
    return out


def trial(seed: int, drive: str, effect: float = 0.0, judged: int = 1) -> tuple[list[Score], list[Score]]:
    """References, and judged runs of the same robot with an effect."""
    rng = np.random.default_rng(seed)
    robot = rng.standard_normal(P)
    changed = robot + effect * (np.arange(P) == COLUMN)
    return scores(rng, 12, "reference", robot), scores(rng, judged, drive, changed)


@functools.cache
def offsets_of(seed: int) -> RobotOffsets:
    """What the references of a trial teach, whatever is judged."""
    references, _ = trial(seed, "reference")
    return learn_offsets(references, CANDIDATES.count)


def p_value(seed: int, drive: str, effect: float = 0.0, judged: int = 1) -> float:
    _, runs = trial(seed, drive, effect, judged)
    return detect(runs, offsets_of(seed), CANDIDATES, seed).p_value


@pytest.mark.parametrize("judged", [1, 3])
@pytest.mark.parametrize("drive", ["reference", "other"])
def test_without_a_gap_p_values_are_uniform(drive: str, judged: int) -> None:
    from scipy.stats import kstest

    found = np.array([p_value(i, drive, judged=judged) for i in range(TRIALS)])
    alarms = Rate(int((found <= 0.05).sum()), TRIALS)
    assert alarms.interval()[0] <= 0.05
    assert kstest(found, "uniform", alternative="greater").pvalue > 0.001, "smaller than uniform: alarms"


@pytest.mark.parametrize("changed", [1, 3])
def test_a_gap_shows_without_any_one_of_three_runs(changed: int) -> None:
    """One that is odd by itself is none."""
    found = []
    for seed in range(20):
        _, runs = trial(seed, "reference", judged=3)
        _, odd = trial(seed, "reference", effect=3.0, judged=3)
        mixed = [*odd[:changed], *runs[changed:]]
        found.append(detect(mixed, offsets_of(seed), CANDIDATES, seed).p_value <= 0.05)
    assert np.mean(found) <= 0.1 if changed == 1 else np.mean(found) >= 0.9


@pytest.mark.parametrize("drive", ["reference", "other"])
def test_an_effect_is_seen_on_either_drive(drive: str) -> None:
    found = [p_value(i, drive, effect=3.0) for i in range(20)]
    assert sum(p <= 0.05 for p in found) >= 17


def test_the_prior_of_an_offset_is_learned_of_effects_together_and_of_each_channel() -> None:
    effects, channels = CANDIDATES.count, 2
    sizes = np.repeat([6.0, 4.0, 0.1], [effects, len(BASIS), len(BASIS)])
    rng = np.random.default_rng(3)
    J = rng.standard_normal((ROWS, len(sizes)))
    references = []
    for _ in range(6):
        error = rng.standard_normal(ROWS) + J @ sizes
        references.append(Score(J.T @ error, J.T @ J))
    offsets = learn_offsets(references, effects, of_twin=True)
    own, begin = offsets.mean**2 + np.diag(offsets.covariance), 0
    for size in (effects, *[len(BASIS)] * channels):
        mine = slice(begin, begin + size)
        learned = (PRIOR_COLUMNS + own[mine].sum()) / (PRIOR_COLUMNS + size)
        np.testing.assert_allclose(offsets.prior[mine], max(learned, 1.0), rtol=1e-9)
        begin += size
    assert offsets.prior[0] > offsets.prior[effects] > offsets.prior[-1] == 1.0


def test_what_references_do_not_show_counts_as_unknown() -> None:
    """An offset that only the other drive can show is no gap, as large as its prior allows."""
    hidden = P - 1
    rng = np.random.default_rng(5)
    robot = np.zeros(P)
    J = DRIVES["reference"].copy()
    J[:, hidden] = 0.0
    references = []
    for _ in range(12):
        error = rng.standard_normal(ROWS) + J @ (SCATTER * rng.standard_normal(P))
        references.append(Score(J.T @ error, J.T @ J))
    offsets = learn_offsets(references, CANDIDATES.count)
    assert offsets.covariance[hidden, hidden] == pytest.approx(1.0)
    robot[hidden] = 1.0
    assert detect(scores(rng, 1, "other", robot), offsets, CANDIDATES, 0).p_value > 0.05


def _of_misfit(variance: float) -> np.ndarray:
    """That of two columns of misfit behind the others, which do not change."""
    return np.append(np.zeros(P), [variance] * 2)


def _where_laws_differ(seed: int) -> tuple[float, float]:
    """p-values on the other drive, where two modulated laws act on it otherwise than on the references':
    where that is known, and where it is not."""
    rng, sigma = np.random.default_rng(seed), 3.0
    modulated = {k: J[:, :2] * np.linspace(-1.0, 1.0, ROWS)[:, None] for k, J in DRIVES.items()}
    robot, own = rng.standard_normal(P), sigma * rng.standard_normal(2)
    there = {"reference": own, "other": own + sigma * rng.standard_normal(2)}

    def some(count: int, drive: str) -> list[Score]:
        J, out = np.column_stack([DRIVES[drive], modulated[drive]]), []
        for _ in range(count):
            run = robot + SCATTER * rng.standard_normal(P)
            error = rng.standard_normal(ROWS) + J @ np.append(run, there[drive])
            out.append(Score(J.T @ error, J.T @ J))
        return out

    def plain(runs: list[Score]) -> list[Score]:
        return [Score(r.b[:P], r.A[:P, :P]) for r in runs]

    references, runs = some(12, "reference"), some(1, "other")
    offsets = learn_offsets(plain(references), CANDIDATES.count)
    misfit = learn_misfit(references, offsets, sigma, _of_misfit(sigma**2))
    known = detect(runs, misfit, CANDIDATES, seed).p_value
    return known, detect(plain(runs), offsets, CANDIDATES, seed).p_value


def test_laws_that_act_otherwise_on_another_drive_are_no_gap() -> None:
    known, unknown = np.array([_where_laws_differ(i) for i in range(60)]).T
    assert (known <= 0.05).mean() <= 0.12
    assert (unknown <= 0.05).mean() > 0.3


def test_the_same_seed_gives_the_same_bits() -> None:
    first = p_value(3, "other")
    offsets_of.cache_clear()
    assert p_value(3, "other") == first


def test_references_that_show_nothing_teach_no_scatter_of_the_misfit() -> None:
    offsets = learn_offsets(trial(1, "reference")[0], CANDIDATES.count)
    blind = [Score(np.zeros(P + 2), np.zeros((P + 2, P + 2)))] * 5
    found = learn_misfit(blind, offsets, 0.5, _of_misfit(0.25))
    np.testing.assert_allclose(found.scatter, np.append(offsets.scatter, [MISFIT_SCATTER**2] * 2))
    own = np.diag(found.covariance)
    np.testing.assert_allclose(own, np.append(offsets.prior, [0.5**2 + 0.25] * 2))


def _parts(A: np.ndarray, changed: np.ndarray | float = 0.0) -> list[np.ndarray]:
    """Covariance of scores: noise and offsets, change, scatter."""
    return [A @ A + A, (A * (changed + np.zeros(len(A)))) @ A, (A * SCATTER**2) @ A]


def test_deviations_are_likelihood_ratios() -> None:
    """Of scores x ~ N(U c, S): by the best sizes c ~ N(0, WIDE^2) of a form, and by the likelihood of an
    unknown cause of a size, but for a constant."""
    from scipy.stats import multivariate_normal as normal

    J = 0.1 * DRIVES["other"][:40]
    A = J.T @ J
    spread = sum(_parts(A))
    scores = np.random.default_rng(3).standard_normal((2, P)) * np.sqrt(np.diag(A) + 1.0)
    found = Deviations.of(A, _parts(A), 12.0, CANDIDATES).squares(scores)
    root = 1.0 / np.sqrt(np.diag(A) + 1.0)
    S, U = root[:, None] * spread * root + JITTER * np.eye(P), root[:, None] * A
    inverse = np.linalg.inv(S)
    forms = [list(h.columns) for h in CANDIDATES.hypotheses if not CANDIDATES.is_composite(h)]
    unknown = []
    for y, row in zip(scores * root, found, strict=True):
        wanted = list(y**2)
        for c in forms:
            H = U[:, c].T @ inverse @ U[:, c] + np.eye(len(c)) / WIDE**2
            best = np.linalg.solve(H, U[:, c].T @ inverse @ y)
            left = y - U[:, c] @ best
            wanted.append(y @ inverse @ y - left @ inverse @ left - best @ best / WIDE**2)
        np.testing.assert_allclose(row[: len(wanted)], wanted, rtol=1e-6, atol=1e-9)
        n = U[:, CANDIDATES.count :]
        zero = np.zeros(P)
        ratios = [normal(zero, S + s**2 * n @ n.T).pdf(y) / normal(zero, S).pdf(y) for s in UNKNOWN_SIZES]
        unknown.append(2.0 * np.log(ratios) - row[len(wanted) :])
    np.testing.assert_allclose(unknown[0], unknown[1], atol=1e-6)


def test_tails_of_deviations_are_those_of_drawn_scores() -> None:
    """Where columns change on the judged drive and scatter is known from a few references."""
    rng, count, A = np.random.default_rng(1), 40_000, DRIVES["other"].T @ DRIVES["other"]
    parts = _parts(A, 0.5)
    deviations = Deviations.of(A, parts, 6.0, CANDIDATES)
    factors = np.ones(count), 4.0 / rng.chisquare(4, count), 6.0 / rng.chisquare(6, count)
    scores = sum(
        np.sqrt(f)[:, None] * rng.standard_normal((count, P)) @ np.linalg.cholesky(part).T
        for f, part in zip(factors, parts, strict=True)
    )
    squares = deviations.squares(scores)
    np.testing.assert_allclose(squares.mean(axis=0), deviations.mean, rtol=0.1)
    for k in (0, P - 1, P + 1, squares.shape[1] - 1):
        for share in (0.1, 0.01):
            level = np.quantile(squares[:, k], 1.0 - share) / deviations.mean[k]
            found = np.exp(np.interp(np.log(level), np.log(GRID), deviations.log_tails[k]))
            assert found == pytest.approx(share, rel=0.25)


def test_a_column_that_changes_on_other_drives_does_not_hide_one_that_does_not() -> None:
    """The other columns are as uncertain as ever, whatever the tail of this one is."""
    changed = np.where(np.arange(P) == P - 1, 100.0, 0.0)
    found = []
    for seed in range(10):
        _, runs = trial(seed, "other", effect=4.0)
        offsets = offsets_of(seed)
        wide = dataclasses.replace(
            offsets, covariance=offsets.covariance + np.diag(changed), changed=changed
        )  # fmt: skip
        found.append([detect(runs, robot, CANDIDATES, seed).p_value for robot in (offsets, wide)])
    plain, beside = np.median(found, axis=0)
    assert beside < max(3.0 * plain, 0.003)


@pytest.mark.parametrize("scale", SCATTER_SCALES)
def test_references_show_how_alike_runs_are(scale: float) -> None:
    rng, robot, J = np.random.default_rng(7), np.zeros(P), 3.0 * DRIVES["reference"]
    references = []
    for _ in range(12):
        error = rng.standard_normal(ROWS) + J @ (robot + scale * SCATTER * rng.standard_normal(P))
        references.append(Score(J.T @ error, J.T @ J))
    found = np.sqrt(learn_offsets(references, CANDIDATES.count).scatter) / SCATTER
    assert np.median(found) == pytest.approx(scale, rel=0.25)


@pytest.mark.parametrize("scatter", [0.03, CANDIDATE_SCATTER])
def test_scores_of_columns_that_act_alike_vary_as_references_show(scatter: float) -> None:
    """The prior scatter of ten such columns adds up to more than that of the score of any one."""
    before, after = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        J = rng.standard_normal((ROWS, P))
        J[:, :10] = J[:, :1] + 0.3 * J[:, :10]
        size, robot, references = np.where(np.arange(P) < 10, scatter, SCATTER), rng.standard_normal(P), []
        for _ in range(12):
            error = rng.standard_normal(ROWS) + J @ (robot + size * rng.standard_normal(P))
            references.append(Score(J.T @ error, J.T @ J))
        for found, of_twin in ((before, True), (after, False)):
            offsets = learn_offsets(references, CANDIDATES.count, of_twin=of_twin)
            found.append(_over_expected(references, offsets)[:10].mean())
    assert np.median(after) == pytest.approx(1.0, abs=0.15)
    assert abs(np.median(after) - 1.0) <= abs(np.median(before) - 1.0)


def test_replicates_repeat_how_uncertain_a_matched_scatter_is() -> None:
    """A mean square of n references varies by 2 / n of itself, and an unusual score is less so."""
    references, runs = trial(3, "reference", effect=2.0)
    offsets = learn_offsets(references, CANDIDATES.count)
    A, n = runs[0].A, len(references)
    parts = [A @ offsets.known() @ A + A, np.zeros_like(A), (A * offsets.scatter) @ A]
    deviations = Deviations.of(A, parts, n, CANDIDATES)
    factors = _matching_errors(runs, deviations, offsets, np.random.default_rng(0))
    assert factors[:, :P].mean(axis=0) == pytest.approx(1.0, abs=0.05)
    assert factors[:, :P].var(axis=0) == pytest.approx(2.0 * n / (EXPECTED_WEIGHT + n) ** 2, rel=0.25)
    sure = dataclasses.replace(offsets, matched=False)
    assert detect(runs, offsets, CANDIDATES, 0).p_value > 1.5 * detect(runs, sure, CANDIDATES, 0).p_value


def _over_expected(references: list[Score], offsets: RobotOffsets) -> np.ndarray:
    """Root mean square (P,) of scores of references over that which the others predict."""
    square = np.zeros(len(offsets.mean))
    for r, mean in zip(references, offsets.left_out(references), strict=True):
        S = r.A @ (offsets.covariance + np.diag(offsets.scatter)) @ r.A + r.A
        square += (r.b - r.A @ mean) ** 2 / np.diag(S)
    return np.sqrt(square / len(references))


def test_the_likelihood_of_references_is_that_of_their_scores() -> None:
    """But for a constant: between two scatters."""
    from scipy.stats import multivariate_normal as normal

    references, prior = trial(2, "reference")[0][:3], np.full(P, 0.7)
    scatters = SCATTER**2, 0.1 * SCATTER**2 + 0.01
    A = np.kron(np.eye(3), references[0].A)
    b = np.concatenate([r.b for r in references])
    wanted = []
    for scatter in scatters:
        spread = np.kron(np.ones((3, 3)), np.diag(prior)) + np.kron(np.eye(3), np.diag(scatter))
        wanted.append(normal(np.zeros(3 * P), A @ spread @ A + A).logpdf(b))
    found = [_log_likelihood(references, scatter, prior) for scatter in scatters]
    assert found[1] - found[0] == pytest.approx(wanted[1] - wanted[0], rel=1e-6)


def test_offsets_are_certain_beyond_their_noise() -> None:
    mean, variance = np.array([1.0, -1.0, 0.5]), np.array([0.1, 0.1, 0.5])
    robot = RobotOffsets(mean, np.diag(variance + 0.2), variance, variance, 5, changed=np.full(3, 0.2))
    certain = np.sqrt(1.0 - 0.1 * CERTAIN)
    np.testing.assert_allclose(robot.certain(), [certain, -certain, 0.0])


def test_columns_that_a_log_has_no_channel_for_are_no_gap() -> None:
    """A form of one column and one of two."""
    candidates = Candidates.of(["gyro_bias", "gyro_scale", "accel_bias"])
    silent = [i for i, key in enumerate(candidates.keys) if not key.startswith("gyro_bias")]
    J = np.random.default_rng(4).standard_normal((ROWS, candidates.count + 4))
    J[:, silent] = 0.0
    rng, found = np.random.default_rng(5), list[float]()
    for _ in range(20):
        made = [Score(J.T @ rng.standard_normal(ROWS), J.T @ J) for _ in range(7)]
        detection = detect(made[:1], learn_offsets(made[1:], candidates.count), candidates, 0)
        assert np.isfinite(detection.statistic)
        found.append(detection.p_value)
    assert max(found) > 0.5
    assert sum(p <= 0.05 for p in found) <= 3


def test_beyond_all_replicates_the_p_value_goes_on_falling() -> None:
    large, larger = (p_value(3, "reference", effect=size) for size in (30.0, 300.0))
    assert larger < large < 1.0 / 1001.0


def test_columns_that_act_alike_share_modestly_what_they_explain() -> None:
    """With a wide prior two columns that all but cancel are large; what they explain together stays."""
    pair = np.array([[1.0, -0.9999], [-0.9999, 1.0]]) * 400.0
    references = [Score(pair @ np.array([12.0, 10.0]), pair)] * 6
    scatter, prior = np.full(2, 0.01), np.full(2, 400.0)
    mean, covariance, _ = _posterior(references, scatter, prior)
    wide = RobotOffsets(mean, covariance, scatter, prior, 6)
    modest = wide.modest(references)
    assert np.abs(modest.mean).max() < 0.5 * np.abs(wide.mean).max()
    assert pair @ modest.mean == pytest.approx(pair @ wide.mean, rel=0.1)
