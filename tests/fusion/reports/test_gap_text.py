"""A diagnosis in words."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from terrafusion.fusion.reports import gap_text
from terrafusion.fusion.reports.gap_text import LINES, _shrinks, answer, explanation, numbers, verdict_line
from terrafusion.twin.gap.answer.verdict import Cause, CredibleSet, GapVerdict
from terrafusion.twin.gap.data.candidates import Candidates


def test_a_set_of_most_effects_names_none() -> None:
    effects = Candidates.of().effects[:35]
    verdict = GapVerdict(
        "ambiguous", effects[:1], [], [CredibleSet(effects, 0.77, named=True)], 0.2, 0.0, None
    )
    answer: Any = SimpleNamespace(verdict=verdict, drives=None, uncalibrated=True)
    expected = "Gap whose cause these drives do not show: any of 35 effects fits (77 % certain"
    assert verdict_line(answer).startswith(expected)


def test_a_gap_beside_effects_of_about_no_size_is_undecided() -> None:
    detection, evidence = SimpleNamespace(p_value=0.017), SimpleNamespace(patchier=None)
    verdict = GapVerdict("no_gap", (), [], [], 0.2, 0.0, None)
    answer: Any = SimpleNamespace(
        verdict=verdict, drives=None, detection=detection, evidence=evidence, significance=0.05
    )
    assert verdict_line(answer).startswith("Undecided: the runs differ from the references, but no effect")


@pytest.mark.parametrize(
    ("effect", "value", "text"),
    [
        ("rate_dependent_shear", 1e3, "the end of its range"),
        ("mud_adhesion", 1.0, "+- 640 Pa"),
    ],
)
def test_sizes_say_where_their_range_ends_and_have_no_power_of_ten(
    effect: str, value: float, text: str
) -> None:
    candidates = Candidates.of([effect])
    at = candidates.hypotheses[0].columns
    size = np.minimum(value, candidates.bounds(at)[1])
    cause = Cause(effect, (effect,), 0.9, at, size, 640.0 / candidates.scale[list(at)], None)
    answer: Any = SimpleNamespace(evidence=SimpleNamespace(candidates=candidates))
    assert text in numbers(answer, cause)


def test_sizes_that_grow_with_the_robot_say_for_which_they_are() -> None:
    grows = [line for line in explanation("drivetrain_friction") if "in proportion" in line]
    assert [line.split(":")[0].strip() for line in grows] == [
        f"drivetrain_friction/{x}" for x in ("coulomb", "dry")
    ]


@pytest.mark.parametrize(
    ("share", "interval", "left", "doubted"),
    [
        (0.7, (0.4, 0.9), 0.1, False),
        (0.0, (0.0, 0.3), 0.1, True),
        (0.6, (0.0, 1.0), 0.1, True),
        (None, None, 0.9, True),
        (None, None, 0.1, False),
        (None, None, None, True),  # it was said to explain over 99 % of nothing
    ],
)
def test_a_cause_that_removes_no_error_for_sure_is_doubted(
    share: float | None, interval: tuple[float, float] | None, left: float | None, doubted: bool
) -> None:
    shrink = SimpleNamespace(floor=1.0, share=share, interval=interval, physical={}, channels={})
    verdict = SimpleNamespace(named=("mass",), left=left)
    answer: Any = SimpleNamespace(shrinkage=shrink, verdict=verdict, runs=("a", "b"))
    assert ("doubt the cause" in _shrinks(answer, 3)[0]) == doubted


@pytest.mark.parametrize("more", [0, 1, 7])
def test_a_screen_that_is_cut_says_so(more: int, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = [f"line {i}" for i in range(LINES + more)]
    monkeypatch.setattr(gap_text, "_screen", lambda *_: whole)
    diagnosis: Any = None
    screen = answer(diagnosis)
    assert len(screen) == LINES
    assert screen[:-1] == whole[: LINES - 1]
    assert screen[-1] == (f"... and {more + 1} lines more, in the report" if more else whole[-1])


@pytest.mark.parametrize(
    ("share", "interval", "said"),
    [(0.2, (0.14, 0.26), True), (0.2, None, True), (0.2, (0.1, 0.9), False), (0.9, None, False)],
)
def test_a_cause_that_leaves_most_of_the_gap_is_not_alone(
    share: float, interval: tuple[float, float] | None, said: bool
) -> None:
    """Of a lateral centre of gravity and a scale of encoders, the first was named, with 98 %."""
    shrink = SimpleNamespace(floor=1.0, share=share, interval=interval, physical={}, channels={})
    verdict = SimpleNamespace(named=("mass",), left=0.1)
    answer: Any = SimpleNamespace(shrinkage=shrink, verdict=verdict, runs=("a", "b"))
    assert ("another cause" in _shrinks(answer, 3)[0]) == said
