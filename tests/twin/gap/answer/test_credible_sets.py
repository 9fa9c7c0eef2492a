"""Sets of a verdict."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.answer.credible_sets import credible_sets
from terrafusion.twin.gap.answer.verdict import Cause, GapVerdict


def cause(effect: str, probability: float, *others: str) -> Cause:
    return Cause(effect, (effect, *others), probability, (0,), np.ones(1), np.ones(1), None)


def verdict(kind: str, named: tuple[str, ...], causes: list[Cause]) -> GapVerdict:
    return GapVerdict(kind, named, causes, 0.0, 0.0, None)


def test_two_certain_causes_are_not_half_certain_each() -> None:
    found = credible_sets(
        verdict("effect", ("mass", "gyro_bias"), [cause("mass", 0.49), cause("gyro_bias", 0.49)])
    )
    assert [s.effects for s in found] == [("mass",), ("gyro_bias",)]
    assert all(s.probability == pytest.approx(0.98) and s.named for s in found)


def test_look_alikes_share_one_set() -> None:
    causes = [cause("slope", 0.6, "accel_bias"), cause("accel_bias", 0.3, "slope"), cause("mass", 0.06)]
    found = credible_sets(verdict("ambiguous", ("slope",), causes))
    assert found[0].effects == ("slope", "accel_bias")
    assert found[0].probability == pytest.approx(0.9)
    assert (found[1].effects, found[1].named) == (("mass",), False)


def test_no_gap_has_no_set() -> None:
    assert credible_sets(verdict("no_gap", (), [cause("mass", 0.5)])) == []
