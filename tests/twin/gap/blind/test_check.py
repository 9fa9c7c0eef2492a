"""The blind check: plan, seal, answers, scores."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis.strategies import integers

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.twin.effects.catalogue import built_in
from terrafusion.twin.gap.blind import seal
from terrafusion.twin.gap.blind.answers import answered, cases
from terrafusion.twin.gap.blind.check import run_blind_check
from terrafusion.twin.gap.blind.drives import DURATION_S, KINDS, drive
from terrafusion.twin.gap.blind.plan import FULL, QUICK, CheckSize, from_text, plan, specs, to_text
from terrafusion.twin.gap.blind.plant.parameters import CHANGES
from terrafusion.twin.gap.blind.rates import Rate, reliability
from terrafusion.twin.gap.blind.score import score
from terrafusion.twin.gap.blind.severity import half_power
from terrafusion.twin.gap.blind.shapes import IN_CATALOGUE, OUT_OF_CATALOGUE, SAME, SHIFTED, shapes
from terrafusion.twin.gap.blind.verdicts import judge
from tests.studies.blind.power import half_power_multiple
from tests.studies.blind.severity import Observer, size_for
from tests.twin.gap.blind import blind_answers as fake

BUILT_IN = tuple(dict.fromkeys(form.effect for form in built_in().values() if form.candidate))
TINY = CheckSize(nulls=2, effects=1, outside=1, pairs=1, runs=1, references=1, severities=(4.0,))


def as_answers(trials: Any, answer: Any) -> dict[str, Any]:
    return {t.trial: {"trial": t.trial, "seconds": 1.0, "error": None, "answer": answer(t)} for t in trials}


# The plan


def test_the_full_check_is_as_large_as_it_has_to_be() -> None:
    """200 nulls, at least 20 trials a cell, every effect in every cell of the catalogue's families."""
    trials = plan(0, FULL)
    cells = Counter((t.family, t.drive, t.severity) for t in trials)
    assert sum(count for (family, _, _), count in cells.items() if family == "null") == 200
    assert min(cells.values()) >= 20
    for family in (SAME, SHIFTED):
        for kind in KINDS:
            own = {t.effects()[0] for t in trials if (t.family, t.drive, t.severity) == (family, kind, 1.5)}
            assert own == set(BUILT_IN)


def test_every_effect_has_two_shapes_of_its_own() -> None:
    """37 effects, each in two shapes that turn different changes; eight more that the catalogue does not
    hold."""
    names = BUILT_IN
    assert len(names) == 37
    for kind in (SAME, SHIFTED):
        assert [s.effect for s in IN_CATALOGUE if s.kind == kind] == list(names)
    assert not {s.effect for s in OUT_OF_CATALOGUE} & set(names)
    assert len(OUT_OF_CATALOGUE) >= 5
    turned = [change for shape in shapes().values() for change, _ in shape.changes]
    assert set(turned) <= set(CHANGES)
    for effect in names:
        same, shifted = (dict(shapes()[f"{effect}/{kind}"].changes) for kind in (SAME, SHIFTED))
        assert same != shifted


def test_severities_are_multiples_of_the_stored_points() -> None:
    """A multiple of the point of shape and drive, within what the plant is asked for."""
    assert all(half_power(shape.key, kind) > 0.0 for shape in shapes().values() for kind in KINDS)
    singles = [t for t in plan(0, FULL) if len(t.shapes) == 1]
    for trial in singles:
        key = trial.shapes[0]
        wanted = trial.severity * half_power(key, trial.drive)
        assert trial.values[0] == min(wanted, shapes()[key].most)
    capped = sum(t.values[0] == shapes()[t.shapes[0]].most for t in singles)
    assert capped < 0.25 * len(singles)


def test_a_plan_depends_on_its_seed_alone_and_its_order_tells_nothing() -> None:
    assert plan(3, QUICK) == plan(3, QUICK)
    assert plan(3, QUICK) != plan(4, QUICK)
    families = [t.family for t in plan(0, FULL)]
    assert {"null", "same", "outside", "pair"} <= set(families[:60])
    assert from_text(to_text(plan(3, QUICK))) == plan(3, QUICK)


@pytest.mark.parametrize("share", [0.01, 0.2, 1.0])
def test_a_share_has_every_family_drive_and_severity(share: float) -> None:
    trials, full = plan(3, FULL.part(share)), plan(3, FULL)
    cells = {(t.family, t.drive, t.severity) for t in trials}
    assert cells <= {(t.family, t.drive, t.severity) for t in full}
    assert {c for c in cells if c[0] != "null"} == {
        (t.family, t.drive, t.severity) for t in full if t.family != "null"
    }
    assert share * len(full) <= len(trials) <= share * len(full) + len(cells)
    assert {(t.runs, t.references) for t in trials} == {(FULL.runs, FULL.references)}


def test_only_the_runs_have_the_effect() -> None:
    """References are of the same robot and soil without it; every run has its own ground, noise and drive."""
    trial = next(t for t in plan(0, QUICK) if t.family == "pair")
    made = specs(trial)
    assert len(made) == trial.runs + trial.references
    assert all(len(s.changes) >= 2 for s in made[: trial.runs])
    assert all(not s.changes for s in made[trial.runs :])
    assert {s.robot_seed for s in made} == {made[0].robot_seed}
    assert len({s.seed for s in made}) == len(made) == len({s.heading_rad for s in made})
    assert all(s.duration_s() == pytest.approx(DURATION_S) for s in made)


@pytest.mark.parametrize("kind", KINDS)
def test_drives_begin_and_end_at_rest(kind: str) -> None:
    import numpy as np

    segments = drive(kind, np.random.default_rng(5))
    assert sum(s.duration_s for s in segments) == pytest.approx(DURATION_S)
    assert segments[0].v_mps == segments[-1].v_mps == 0.0
    assert segments[-1].duration_s >= 2.0


def test_a_case_tells_nothing_of_the_truth() -> None:
    """What a diagnosis is given: recordings with neutral names and no truth."""
    first = next(iter(cases(plan(0, TINY)[:1])))
    told = f"{first.trial} {first.runs[0].name} {first.runs[0].description} {first.runs[0].notes}"
    assert not any(name in told for name in (*BUILT_IN, *CHANGES, "null", "pair"))
    assert first.runs[0].truth is None


# The seal


def test_labels_come_back_after_the_answers(tmp_path: Path) -> None:
    seal.seal(tmp_path, b"the truth", {"seed": 1})
    assert b"truth" not in (tmp_path / seal.LABELS).read_bytes()
    with pytest.raises(DataError, match="not finished"):
        seal.unseal(tmp_path)
    (tmp_path / seal.ANSWERS).write_text("{}\n")
    seal.close(tmp_path)
    assert seal.unseal(tmp_path) == b"the truth"
    assert seal.unseal(tmp_path) == b"the truth"


def test_answers_that_came_at_the_wrong_time_are_refused(tmp_path: Path) -> None:
    """Changed after closing, closed anew after the opening, or given under another commitment."""
    for name in ("changed", "late", "older"):
        (tmp_path / name).mkdir()
        seal.seal(tmp_path / name, b"labels", {})
        (tmp_path / name / seal.ANSWERS).write_text("first\n")
        seal.close(tmp_path / name)
    (tmp_path / "changed" / seal.ANSWERS).write_text("second\n")
    with pytest.raises(DataError, match="changed after they were closed"):
        seal.unseal(tmp_path / "changed")

    seal.unseal(tmp_path / "late")
    (tmp_path / "late" / seal.ANSWERS).write_text("second\n")
    seal.close(tmp_path / "late")
    with pytest.raises(DataError, match="opened before"):
        seal.unseal(tmp_path / "late")

    seal.seal(tmp_path / "older", b"other labels", {})
    with pytest.raises(DataError, match="another commitment"):
        seal.unseal(tmp_path / "older")


@pytest.mark.parametrize("part", [seal.LABELS, seal.KEY])
def test_other_labels_are_noticed(tmp_path: Path, part: str) -> None:
    """Neither the sealed file nor the key can be swapped for those of other labels."""
    other = tmp_path / "other"
    other.mkdir()
    seal.seal(tmp_path, b"labels", {})
    seal.seal(other, b"labelz", {})
    (tmp_path / seal.ANSWERS).write_text("\n")
    seal.close(tmp_path)
    (tmp_path / part).write_bytes((other / part).read_bytes())
    with pytest.raises(DataError, match="changed"):
        seal.unseal(tmp_path)
    for name in (seal.LABELS, seal.KEY):
        (tmp_path / name).write_bytes((other / name).read_bytes())
    with pytest.raises(DataError, match="not those committed to"):
        seal.unseal(tmp_path)


def test_a_diagnosis_cannot_open_the_labels(tmp_path: Path) -> None:
    seal.seal(tmp_path, b"labels", {})
    seal.forbid(tmp_path)
    try:
        for name in (seal.LABELS, seal.KEY):
            with pytest.raises(PermissionError):
                (tmp_path / name).read_bytes()
        assert seal.commitment(tmp_path) is not None
    finally:
        seal.permit(tmp_path)
    assert (tmp_path / seal.LABELS).read_bytes()


OPENED = """
import sys
sys.path.insert(0, {tests!r})
order = []
def hook(event, arguments):
    if event == "open" and isinstance(arguments[0], str):
        name, writes = arguments[0].rsplit("/", 1)[-1], "r" not in str(arguments[1] or "r")
        order.append((name, writes))
sys.addaudithook(hook)
import blind_answers as fake
from terrafusion.twin.gap.blind.check import run_blind_check
from terrafusion.twin.gap.blind.plan import CheckSize
run_blind_check({out!r}, fake.guess, scale=CheckSize(2, 1, 1, 0, 1, 1, (4.0,)), seed=5)
sealed = ("labels.sealed", "labels.key")
reads = [i for i, (name, writes) in enumerate(order) if name in sealed and not writes]
closed = max(i for i, (name, _) in enumerate(order) if name.startswith("answers.closed.json"))
answers = max(i for i, (name, writes) in enumerate(order) if name.startswith("answers.jsonl") and writes)
assert reads, "the labels were never opened: the test would prove nothing"
assert answers < min(reads), "an answer was written after the labels were opened"
print("ok")
"""


def test_the_labels_stay_closed_until_all_answers_are_written(tmp_path: Path) -> None:
    """Every file the process opens is watched: labels and key are read after the last write of an answer."""
    code = OPENED.format(tests=str(Path(__file__).parent), out=str(tmp_path / "out"))
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "ok"


# The whole


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """For what happens around the diagnosis."""
    monkeypatch.setattr("terrafusion.twin.gap.blind.answers.cases", fake.short_cases)


@pytest.mark.usefixtures("quickly")
def test_the_oracle_is_asked_where_a_share_was_told(tmp_path: Path) -> None:
    """It is given the true effects; its shares stand beside those of the same trials."""
    asked = []

    def tells(runs: Any, references: Any, vehicle: Any, *, seed: int, effects: Any = None) -> fake.Fixed:
        answer = fake.diagnosis("effect", [("mass", 0.9)], ["mass"])
        if effects is not None:
            asked.append(effects)
        return fake.Fixed(answer | {"shrink": {"share": 0.5 if effects is None else 0.8}})

    scores = run_blind_check(tmp_path, tells, scale=TINY, seed=1, oracle=tells)
    single = [t.effects() for t in plan(1, TINY) if t.family in ("same", "shifted")]
    assert sorted(asked) == sorted(single)
    for family in ("same", "shifted"):
        found = scores["shrink"][family]
        assert (found["beside_oracle"], found["oracle"]) == pytest.approx((0.5, 0.8))
        assert found["over_oracle"] == pytest.approx(0.625)


@pytest.mark.usefixtures("quickly")
def test_a_diagnosis_that_breaks_is_wrong_everywhere(tmp_path: Path) -> None:
    scores = run_blind_check(tmp_path, fake.breaking, scale=TINY, seed=1)
    assert len(scores["crashes"]) == scores["trials"] == len(plan(1, TINY))
    assert scores["false_alarms"]["all"]["rate"] == 1.0
    assert all(cell["rate"] == 0.0 for cell in scores["power"])
    assert scores["pairs"]["both"]["rate"] == 0.0
    assert all("LinAlgError" in entry["error"] for entry in answered(tmp_path).values())
    assert json.loads((tmp_path / "blind.json").read_text()) == scores


@pytest.mark.usefixtures("quickly")
def test_a_check_resumes_where_it_was_stopped(tmp_path: Path) -> None:
    """Answers that are there are kept; a line that was cut off is asked for again; another seed is
    refused."""
    whole = run_blind_check(tmp_path / "whole", fake.guess, scale=TINY, seed=2)

    def stops(*arguments: Any, **more: Any) -> Any:
        stops.calls += 1  # type: ignore[attr-defined]
        if stops.calls > 3:  # type: ignore[attr-defined]
            raise KeyboardInterrupt
        return fake.guess(*arguments, **more)

    stops.calls = 0  # type: ignore[attr-defined]
    with pytest.raises(KeyboardInterrupt):
        run_blind_check(tmp_path / "cut", stops, scale=TINY, seed=2)
    path = tmp_path / "cut" / seal.ANSWERS
    path.write_text(path.read_text() + '{"trial": "trial-00')
    assert len(answered(tmp_path / "cut")) == 3
    with pytest.raises(ConfigError, match="another seed or size"):
        run_blind_check(tmp_path / "cut", fake.guess, scale=TINY, seed=3)
    resumed = run_blind_check(tmp_path / "cut", fake.guess, scale=TINY, seed=2)
    for scores in (whole, resumed):
        scores.pop("seconds")
        scores.pop("targets")
    assert resumed == whole


# The scores


def test_the_truth_scores_full_marks() -> None:
    trials = plan(0, FULL)
    scores = score(trials, as_answers(trials, fake.perfect))
    assert scores["crashes"] == []
    for entry in scores["targets"]:
        assert entry["met"] in (True, None), entry
    assert scores["false_alarms"]["all"]["hits"] == 0
    assert {cell["rate"] for cell in scores["power"]} == {1.0}
    assert scores["pairs"]["false_extras_a_case"] == 0.0
    for truth, said in scores["confusion"].items():
        outside = truth not in (*BUILT_IN, "no_gap")
        assert set(said) == {"unknown" if outside else truth}


def test_guesses_score_at_chance_and_their_confidence_is_honest() -> None:
    """One of 37 first, three of 37 among the first three; stated 1/37, so no calibration error beyond
    chance."""
    trials = plan(0, FULL)
    scores = score(trials, as_answers(trials, fake.guessed))
    for family in ("same", "shifted"):
        for places, name in ((1, "top1"), (3, "top3")):
            found, p = scores[name][family], places / 37.0
            assert abs(found["rate"] - p) < 4.0 * math.sqrt(p * (1.0 - p) / found["count"])
        assert scores["confidence"][family]["ece"] < 0.04
    assert scores["false_alarms"]["all"]["rate"] == 1.0
    assert scores["unknown"]["recall"]["rate"] == 0.0


def test_look_alikes_count_once_and_extras_are_told() -> None:
    pair = next(t for t in plan(0, FULL) if t.family == "pair")
    first, second = pair.effects()
    extra = next(e for e in BUILT_IN if e not in (first, second))
    alike = next(e for e in BUILT_IN if e not in (first, second, extra))
    answer = fake.diagnosis("effect", [(first, 0.4), (extra, 0.3), (alike, 0.2)], [alike, first, extra])
    for cause in answer["causes"]:
        if cause["effect"] in (first, alike):
            cause["class"] = [first, alike]
    judged = judge(pair, {"seconds": 1.0, "error": None, "answer": answer})
    assert (judged.found, judged.extras) == (1, 1)
    assert judged.ranks == (1, 0)
    assert judged.confidence == pytest.approx(0.6)


@pytest.mark.parametrize("lost", ["causes", "gap", "verdict", "named", "shrink"])
def test_an_answer_that_breaks_the_contract_is_a_crash(lost: str) -> None:
    trial = next(t for t in plan(0, QUICK) if t.family == "same")
    answer = fake.perfect(trial)
    answer.pop(lost)
    assert judge(trial, {"seconds": 1.0, "error": None, "answer": answer}).crashed
    assert judge(trial, None).crashed


@given(integers(0, 300), integers(1, 300))
def test_intervals_hold_their_rate(hits: int, more: int) -> None:
    found = Rate(hits, hits + more)
    low, high = found.interval()
    assert 0.0 <= low <= found.hits / found.count <= high <= 1.0


def test_intervals_and_calibration_by_known_figures() -> None:
    """Wilson (1927) at 0 of 10 and 5 of 10; confidence .8 with 3 of 4 right."""
    assert Rate(0, 10).interval()[1] == pytest.approx(0.2775, abs=1e-4)
    assert Rate(5, 10).interval() == pytest.approx((0.2366, 0.7634), abs=1e-4)
    found = reliability([0.8] * 4, [True, True, True, False])
    assert found.ece == pytest.approx(0.05)
    assert found.brier == pytest.approx((3 * 0.04 + 0.64) / 4)


def test_the_observer_measures_as_mahalanobis_does() -> None:
    """Factors and remainder together give the distance of the full covariance; sizes follow a power law."""
    import numpy as np

    rng = np.random.default_rng(0)
    null = rng.normal(size=(20, 6)) @ rng.normal(size=(6, 6))
    observer = Observer.of(null, np.full(6, 0.3))
    full = observer.factors.T @ observer.factors + np.diag(observer.variances)
    step = rng.normal(size=6)
    assert observer.distance(step) == pytest.approx(math.sqrt(step @ np.linalg.solve(full, step)))
    assert size_for([(1.0, 3.0), (2.0, 12.0)], 27.0, 99.0) == pytest.approx(3.0)
    assert half_power_multiple((1.0, 4.0, 16.0) * 2, (False, False, True) * 2) == pytest.approx(8.0, rel=0.2)
    assert size_for([(1.0, 1.0), (2.0, 2.0)], 50.0, 9.0) == 9.0


def test_a_right_cause_called_unknown_is_not_right() -> None:
    """Ranked first is not enough for the headline; only the verdict differs between the two checks."""
    trials = [t for t in plan(0, FULL) if t.family in ("same", "shifted")]
    for verdict, rate in (("effect", 1.0), ("unknown", 0.0)):
        answers = {
            t.trial: {"seconds": 1.0, "answer": fake.diagnosis(verdict, [(t.effects()[0], 0.9)])}
            for t in trials
        }
        scores = score(trials, answers)
        assert {scores["right"][family]["rate"] for family in ("same", "shifted")} == {rate}
        assert {scores["top1"][family]["rate"] for family in ("same", "shifted")} == {1.0}
