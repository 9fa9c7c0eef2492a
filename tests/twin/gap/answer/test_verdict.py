"""Verdicts from the evidence of sets of effects."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.answer.verdict import GapVerdict, judge
from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.diagnose import withheld
from terrafusion.twin.gap.infer.calibration import Head
from terrafusion.twin.gap.infer.detection import Detection
from terrafusion.twin.gap.infer.explain import Explanation
from terrafusion.twin.gap.infer.single_effects import Fitted
from terrafusion.twin.gap.null.drives import DriveCoverage

NAMES = ("soil_strength", "mass", "gyro_bias", "gyro_scale", "track_width")
CANDIDATES = Candidates.of(NAMES)
HEAD = Head(1.0, -4.0, 0.1, 0.03)
FOUND = Detection(9.0, 1e-6)


def fitted(*effects: str, sigma: float = 0.1) -> Fitted:
    laws = tuple(next(h for h in CANDIDATES.hypotheses if h.effect == e) for e in effects)
    columns: tuple[Hypothesis, ...] = laws
    values = tuple(np.full(len(h.columns), 2.0) for h in columns)
    return Fitted(laws, values, np.zeros(1), 10.0, 10.0, tuple(sigma**2 * np.eye(len(v)) for v in values))


def verdict(
    evidence: dict[tuple[str, ...], float], outside: float = -50.0,
    detection: Detection = FOUND, alike: dict[str, set[str]] | None = None, other_drives: bool = False,
    left: dict[tuple[str, ...], float] | None = None, sigma: float = 0.1,
) -> GapVerdict:  # fmt: skip
    every = {(name,): -50.0 for name in NAMES} | evidence
    fits = {effects: fitted(*effects, sigma=sigma) for effects in every}
    found = Explanation(every, fits, outside, alike or {}, lambda fit: [fit.values] * 3, left or {})
    return judge(detection, 0.05, found, CANDIDATES, HEAD, other_drives)


def test_two_certain_effects_are_each_certain() -> None:
    both = verdict({("gyro_bias", "mass"): 80.0, ("mass",): 40.0, ("gyro_bias",): 30.0})
    assert both.kind == "effect"
    assert {*both.named} == {"gyro_bias", "mass"}
    named = [s for s in both.sets if s.named]
    assert [s.effects for s in named] in ([("gyro_bias",), ("mass",)], [("mass",), ("gyro_bias",)])
    assert all(s.probability > 0.95 for s in named)
    certain = 1.0 - both.p_null - both.p_unknown
    assert [c.probability for c in both.causes[:2]] == pytest.approx([certain] * 2, rel=0.03)
    assert sum(c.probability for c in both.causes) <= 2.0 * certain
    assert both.fit is not None
    assert {law.effect for law in both.fit.laws} == {"gyro_bias", "mass"}


def test_effects_that_are_as_likely_share_a_set_of_their_sum() -> None:
    alike = verdict({("mass",): 60.0, ("track_width",): 59.5, ("gyro_bias",): 50.0})
    assert alike.kind == "ambiguous"
    assert alike.named == ("mass",)
    assert set(alike.sets[0].effects) == {"mass", "track_width"}
    assert alike.sets[0].probability > 0.95 > alike.causes[0].probability
    assert alike.causes[0].members == ("mass", "track_width")
    assert alike.causes[1].members == ("track_width", "mass")
    total = sum(c.probability for c in alike.causes) + alike.p_null + alike.p_unknown
    assert total == pytest.approx(1.0)  # no set of two is considered


def test_a_look_alike_of_one_of_two_is_in_its_set_alone() -> None:
    pairs = {("gyro_bias", "mass"): 80.0, ("gyro_bias", "track_width"): 79.5, ("mass",): 40.0}
    found = {frozenset(s.effects) for s in verdict(pairs).sets if s.named}
    assert found == {frozenset({"mass", "track_width"}), frozenset({"gyro_bias"})}


def test_effects_of_the_same_signature_are_one_set_whatever_the_evidence() -> None:
    found = verdict({("mass",): 60.0, ("track_width",): 30.0}, alike={"mass": {"track_width"}})
    assert found.kind == "ambiguous"
    assert found.sets[0].effects == ("mass", "track_width")


def test_look_alikes_as_improbable_as_each_other_are_in_order_of_their_names() -> None:
    others = {*NAMES} - {"mass"}
    found = verdict({("mass",): 2000.0}, alike={"mass": others})  # the others' probabilities are all zero
    assert found.sets[0].effects == ("mass", *sorted(others))


def test_a_gap_that_no_effect_explains_is_of_unknown_cause() -> None:
    sure = Detection(9.0, 1e-12)
    weak = verdict({("mass",): 2.0}, detection=sure)
    assert weak.kind == "unknown"
    assert weak.named == ()
    assert weak.p_unknown > 0.5
    assert verdict({("mass",): 60.0}, detection=sure).kind == "effect"
    assert verdict({("mass",): 10.0}, outside=60.0).kind == "unknown"
    far = verdict({("gyro_scale",): 40.0, ("mass",): 30.0}, outside=400.0)  # all are as improbable
    assert [c.effect for c in far.causes[:2]] == ["gyro_scale", "mass"]  # not in the catalogue's order
    assert [s.effects for s in far.sets] == [("gyro_scale",)]  # not nearly the whole catalogue
    none = verdict({("mass",): 60.0}, detection=Detection(1.0, 0.6))
    assert none.kind == "no_gap"
    assert none.p_unknown == 0.0
    assert none.sets == []


def test_on_unseen_drives_an_effect_that_explains_less_than_half_of_the_gap_is_not_named() -> None:
    for left, kind in ((0.3, "effect"), (0.7, "no_gap")):
        found = verdict({("mass",): 600.0}, left={("mass",): left})
        assert found.named == ("mass",)
        after = found.withheld_on_unseen_drives()
        assert after.kind == kind
        assert after.sets[0].named == (kind == "effect")


def test_on_unseen_drives_an_unknown_cause_stands_where_the_gap_is_sure() -> None:
    unknown = verdict({("mass",): 2.0}, detection=Detection(9.0, 1e-12))
    effect = verdict({("mass",): 600.0}, left={("mass",): 0.7})
    assert unknown.withheld_on_unseen_drives().kind == "no_gap"
    assert unknown.withheld_on_unseen_drives(sure=True).kind == "unknown"
    assert effect.withheld_on_unseen_drives().kind == "no_gap"


def test_on_unseen_drives_a_sure_gap_that_its_effect_hardly_explains_is_of_unknown_cause() -> None:
    """Stronger ground in another simulator was no gap at p = 2e-6: a mass that left 69 % of it."""
    effect = verdict({("mass",): 600.0}, left={("mass",): 0.7})
    after = effect.withheld_on_unseen_drives(sure=True)
    assert (after.kind, after.named, after.fit) == ("unknown", (), None)
    none = verdict({("mass",): 3.0}, detection=Detection(4.0, 0.017), sigma=3.0)
    assert none.kind == none.withheld_on_unseen_drives(sure=True).kind == "no_gap"  # of about no size


@pytest.mark.parametrize(
    ("covered", "p_value", "patchier", "kind"),
    [
        (0.9, 1e-3, False, "unknown"), (0.6, 1e-5, False, "unknown"), (0.6, 1e-3, False, "no_gap"),
        (0.4, 1e-5, False, "no_gap"), (0.6, 1e-5, True, "no_gap"), (0.9, 1e-5, True, "no_gap"),
    ],
)  # fmt: skip
def test_an_unknown_cause_needs_drives_that_are_covered_and_alike_ground(
    covered: float, p_value: float, patchier: bool, kind: str
) -> None:
    unknown = verdict({("mass",): 2.0}, detection=Detection(9.0, 1e-12))
    assert withheld(unknown, p_value, 0.05, DriveCoverage(covered, ()), patchier).kind == kind


def test_an_extrapolated_p_value_is_little_evidence_of_an_unknown_cause_on_other_drives() -> None:
    kinds = [
        verdict({("mass",): 3.0}, detection=Detection(9.0, p), other_drives=other).kind
        for p, other in ((1e-12, False), (1e-4, False), (1e-12, True), (1e-3, True))
    ]
    assert kinds == ["unknown", "unknown", "effect", "effect"]


def test_a_stronger_ground_is_a_parameter() -> None:
    assert verdict({("soil_strength",): 60.0}).kind == "parameters"


def test_a_ground_that_a_missing_effect_resembles_is_ambiguous() -> None:
    alike = verdict({("soil_strength",): 60.0, ("mass",): 59.8})
    assert alike.kind == "ambiguous"
    assert alike.sets[0].effects == ("soil_strength", "mass")
    unlikely = verdict({("soil_strength",): 60.0, ("mass",): 50.0}, alike={"soil_strength": {"mass"}})
    assert unlikely.kind == "parameters"
    assert unlikely.sets[0].effects == ("soil_strength", "mass")


def test_sigma_holds_how_wrong_a_law_is() -> None:
    causes = {c.effect: c for c in verdict({("mass",): 60.0}).causes}
    assert causes["mass"].sigma[0] == pytest.approx(np.hypot(0.1, 0.1 * 2.0))
    assert causes["gyro_scale"].sigma[0] == pytest.approx(np.hypot(0.1, 0.03 * 2.0))


@pytest.mark.parametrize(
    ("sigma", "evidence", "kind"), [(3.0, 3.0, "no_gap"), (0.5, 3.0, "effect"), (3.0, 60.0, "effect")]
)
def test_an_effect_of_about_no_size_is_named_only_where_the_runs_surely_show_one(
    sigma: float, evidence: float, kind: str
) -> None:
    """Segments of a clean field log, with p = .017, were `rate_dependent_shear` of .5 +- .9."""
    found = verdict({("mass",): evidence}, detection=Detection(4.0, 0.017), sigma=sigma)
    assert found.kind == kind
    assert found.named == (() if kind == "no_gap" else ("mass",))
    assert any(s.named for s in found.sets) == (kind == "effect")


def test_an_effect_that_removes_nothing_of_the_gap_is_no_cause() -> None:
    """A motor of another simulator that died was a torque limit of 98 %."""
    named = verdict({("mass",): 60.0})
    after = named.refuted()
    assert after.kind == "unknown"
    assert after.named == ()
    assert after.fit is None
    assert after.p_unknown > 0.9
    assert not any(s.named for s in after.sets)
    total = sum(c.probability for c in after.causes) + after.p_null + after.p_unknown
    assert total == pytest.approx(1.0)
