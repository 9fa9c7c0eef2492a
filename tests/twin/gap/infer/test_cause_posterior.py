"""The odds of causes by what each leaves."""

from __future__ import annotations

from pathlib import Path

import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.gap.infer import cause_posterior
from terrafusion.twin.gap.infer.cause_posterior import (
    CauseResidual,
    PosteriorWeights,
    posterior_weights,
    probabilities,
)
from terrafusion.twin.gap.infer.goodness_of_fit import GoodnessOfFit


def residual(left: float) -> CauseResidual:
    return CauseResidual(0.6 * left, 0.1 * left, 0.3 * left)


def chances(one: float, other: float, before: float) -> tuple[dict[str, float], float]:
    """Of two causes that leave so much of a gap, and of the unknown one."""
    by, gap = PosteriorWeights(6.0, 0.9, 2.0, 3.0, 4.0), residual(before)
    odds = {"one": by.log_odds(residual(one), gap), "other": by.log_odds(residual(other), gap)}
    return probabilities(odds, by.unknown_log_odds(gap))


def test_odds_follow_what_is_left_and_an_unknown_cause_what_is_unexplained() -> None:
    known, unknown = chances(3.0, 3.0, 10.0)
    assert known["one"] == pytest.approx(known["other"])
    assert sum(known.values()) + unknown == pytest.approx(1.0)
    known, _ = chances(3.0, 5.0, 10.0)
    assert known["one"] > 2.0 * known["other"] > 0.0
    shares = [chances(left, 9.8, 10.0)[1] for left in (1.0, 5.0, 8.0, 9.0, 9.8)]
    assert shares == sorted(shares)
    assert shares[0] < 0.05
    assert shares[-1] > 0.5


def test_the_less_the_best_fits_the_likelier_is_an_unknown_cause() -> None:
    by, gap = PosteriorWeights(6.0, 0.9, 2.0, 3.0, 4.0), residual(8.0)
    odds = {"one": by.log_odds(residual(5.0), gap), "other": by.log_odds(residual(6.0), gap)}
    worse = [(0.0, 1.0, 0.0), (0.5, 1.0, 0.0), (1.0, 1.0, 0.0)]
    quieter = [(0.5, 1.0, 0.0), (0.5, 1.0, 0.5), (0.5, 1.0, 1.0)]
    for ways in (worse, quieter):
        shares = [probabilities(odds, by.unknown_log_odds(gap, GoodnessOfFit(*way)))[1] for way in ways]
        assert shares[0] < shares[1] < shares[2]
    known, unknown = probabilities(odds, by.unknown_log_odds(gap, GoodnessOfFit(1.0, 1.0, 1.0)))
    assert unknown > 0.5
    assert sum(known.values()) == pytest.approx(1.0 - unknown)
    assert known["one"] > known["other"]


def test_a_larger_gap_makes_the_same_shares_surer() -> None:
    small, large = (chances(0.4 * gap, 0.6 * gap, gap)[0] for gap in (2.0, 20.0))
    assert large["one"] / large["other"] > 2.0 * small["one"] / small["other"]


def test_weights_of_the_package_are_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert posterior_weights().slope > 0.0
    assert 0.5 < posterior_weights().share < 1.5
    assert posterior_weights().misfit > 0.0
    assert posterior_weights().quieter > 0.0
    (tmp_path / "cause_posterior.yaml").write_text("weights: {slope: 1}\n", encoding="utf-8")
    monkeypatch.setattr(cause_posterior.resources, "files", lambda _: tmp_path)
    posterior_weights.cache_clear()
    with pytest.raises(ConfigError, match="weights"):
        posterior_weights()
    posterior_weights.cache_clear()
