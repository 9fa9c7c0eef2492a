"""The share of the gap that disappears lies between nothing and all of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.answer import shrinkage
from terrafusion.twin.gap.answer.shrinkage import Shrinkage, _share
from terrafusion.twin.gap.infer.refit import RunWithEffects


@pytest.mark.parametrize(("after", "share"), [(0.5, 1.0), (1.0, 1.0), (2.0, 0.5), (4.0, 0.0)])
def test_share_is_between_zero_and_one(after: float, share: float) -> None:
    spread = np.array([-0.1, 0.0, 0.1])
    found, interval = _share(3.0 + spread, after + spread[::-1], 1.0, 0.1)
    assert found == pytest.approx(share)
    assert interval is not None
    assert 0.0 <= interval[0] <= interval[1] <= 1.0


@pytest.mark.parametrize(
    ("share", "interval", "nothing"),
    [
        (0.0, (0.0, 0.02), True), (0.0, (0.0, 0.97), False), (0.2, (0.14, 0.26), False), (0.0, None, True),
        (0.6, None, False), (None, None, False),
    ],
)  # fmt: skip
def test_an_effect_removes_nothing_where_its_interval_holds_hardly_more(
    share: float | None, interval: tuple[float, float] | None, nothing: bool
) -> None:
    found = Shrinkage(135.0, 141.0, 0.9, share, interval, 100.0, {}, {}, [], [])
    assert found.nothing_removed() == nothing


def test_an_effect_is_tried_on_the_references_soil_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The soil that fits a run without the effect holds a part of it: heavier robots seem to drive softer
    ground. With the effect on that soil a right cause shrank the gap by nothing."""

    def errors(_: object, tried: list[RunWithEffects]) -> list[Array | None]:
        known = {(0, True): 3.0, (0, False): 1.0, (1, True): 1.0, (1, False): 2.0}
        return [
            None if (size := known.get((t.run, t.soil is None))) is None else np.full(4, size) for t in tried
        ]

    run = SimpleNamespace(by_parameter=np.zeros((4, 1)), without_states=lambda sigma, e: e)
    changed: Any = SimpleNamespace(changed=lambda columns, x: {"mass/at_cg": float(x[0])})
    evidence: Any = SimpleNamespace(runs=[run] * 3, candidates=changed, soil_limit=np.ones(2))
    robot, fit = SimpleNamespace(mean=np.zeros(1)), SimpleNamespace(columns=(0,))
    monkeypatch.setattr(shrinkage, "whitened_errors", errors)
    values, was = [(np.ones(1),)] * 3, [np.full(4, 5.0)] * 3
    found = shrinkage._errors_left_out(evidence, np.ones(1), robot, fit, values, was)  # type: ignore[arg-type]
    assert [e[0] for e in found] == [1.0, 1.0, 5.0]  # on the last the twin diverges
