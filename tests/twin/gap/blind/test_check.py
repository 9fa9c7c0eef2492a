"""The blind check: plan, seal, answers, scores."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis.strategies import integers

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.twin.effects.catalogue import built_in
from terrafusion.twin.gap.blind import drives, seal
from terrafusion.twin.gap.blind.answers import answered, cases
from terrafusion.twin.gap.blind.check import run_blind_check
from terrafusion.twin.gap.blind.drives import DURATION_S, KINDS, SHORT_S, drive
from terrafusion.twin.gap.blind.plan import (
    D_PRIMES,
    FULL,
    HARDER,
    OTHER_DRIVES,
    PLAIN,
    QUICK,
    RUNS,
    CheckSize,
    from_text,
    plan,
    specs,
    to_text,
)
from terrafusion.twin.gap.blind.plant.parameters import CHANGES
from terrafusion.twin.gap.blind.rates import Rate, reliability
from terrafusion.twin.gap.blind.score import score
from terrafusion.twin.gap.blind.sensitivity import size_at
from terrafusion.twin.gap.blind.shapes import IN_CATALOGUE, OUT_OF_CATALOGUE, SAME, SHIFTED, shapes
from terrafusion.twin.gap.blind.verdicts import judge
from terrafusion.twin.model.vehicle import load_vehicle
from tests.studies.blind.sensitivity import Oracle, size_for
from tests.twin.gap.blind import blind_answers as fake

BUILT_IN = tuple(dict.fromkeys(form.effect for form in built_in().values() if form.candidate))
TINY = CheckSize(nulls=1, other_nulls=0, effects=1, other_effects=0, harder=0, outside=0, pairs=1)


def as_answers(trials: Any, answer: Any) -> dict[str, Any]:
    return {t.trial: {"diagnosis": {"seconds": 1.0, "error": None, "answer": answer(t)}} for t in trials}


def figures(trials: Any, answer: Any) -> dict[str, Any]:
    return dict(score(trials, as_answers(trials, answer))["figures"]["diagnosis"])


def one(setting: str, family: str = "null") -> Any:
    return next(t for t in plan(0, FULL) if (t.setting, t.family) == (setting, family))


# The plan


def test_the_full_check_is_as_large_as_it_has_to_be() -> None:
    """200 nulls on the references' drives and 200 on others; at least 20 trials a cell; effects in turn."""
    trials = plan(0, FULL)
    nulls = Counter(t.setting for t in trials if t.family == "null")
    assert nulls[PLAIN] == sum(nulls[setting] for setting in OTHER_DRIVES) == 200
    cells = Counter((t.family, t.setting in OTHER_DRIVES, t.d_prime) for t in trials)
    assert min(cells.values()) >= 20
    assert all(sum(t.setting == setting for t in trials) >= 40 for setting in HARDER)
    for family, d_prime in ((f, d) for f in (SAME, SHIFTED) for d in D_PRIMES):
        own = [t for t in trials if (t.family, t.setting, t.d_prime) == (family, PLAIN, d_prime)]
        assert min(Counter(t.drive for t in own).values()) >= 20
        possible = {
            s.effect for s in IN_CATALOGUE
            if s.kind == family and all(size_at(s.key, kind, d_prime) is not None for kind in KINDS)
        }  # fmt: skip
        assert len(possible & {t.effects()[0] for t in own}) >= 0.9 * len(possible)
    assert Counter(t.references for t in trials).keys() == {5, 12, 20}


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


def test_sizes_have_the_d_prime_of_the_stored_table() -> None:
    """They grow with d'; what the plant is not asked for is no trial."""
    for key in shapes():
        for kind in KINDS:
            sizes = [s for d in D_PRIMES if (s := size_at(key, kind, d)) is not None]
            assert sizes == sorted(sizes)
            assert all(0.0 < s < shapes()[key].most for s in sizes)
    for trial in plan(0, FULL):
        for key, value in zip(trial.shapes, trial.values, strict=True):
            assert value == size_at(key, trial.drive, trial.d_prime)
    between = size_at("gyro_bias/same", "exciting", 15.0)
    assert between is not None
    assert size_at("gyro_bias/same", "exciting", 10.0) < between < size_at("gyro_bias/same", "exciting", 25.0)


def test_a_plan_depends_on_its_seed_alone_and_its_order_tells_nothing() -> None:
    assert plan(3, QUICK) == plan(3, QUICK)
    assert plan(3, QUICK) != plan(4, QUICK)
    families = [t.family for t in plan(0, FULL)]
    assert {"null", "same", "outside", "pair"} <= set(families[:60])
    assert from_text(to_text(plan(3, QUICK))) == plan(3, QUICK)


@pytest.mark.parametrize("share", [0.01, 0.2, 1.0])
def test_a_share_has_every_family_and_severity(share: float) -> None:
    trials, full = plan(3, FULL.part(share)), plan(3, FULL)
    assert {(t.family, t.d_prime) for t in trials} == {(t.family, t.d_prime) for t in full}
    assert share * len(full) <= len(trials) <= share * len(full) + 25
    assert {t.setting for t in trials} >= {PLAIN, *HARDER}


def test_only_the_runs_have_the_effect() -> None:
    """References are of the same robot and soil without it; every run has its own ground, noise and drive."""
    trial = one(PLAIN, "pair")
    made = specs(trial)
    assert len(made) == RUNS + trial.references
    assert all(len(s.changes) >= 2 for s in made[:RUNS])
    assert all(not s.changes for s in made[RUNS:])
    assert {s.robot_seed for s in made} == {made[0].robot_seed}
    assert len({s.seed for s in made}) == len(made) == len({s.heading_rad for s in made})
    assert all(s.duration_s() == pytest.approx(DURATION_S) for s in made)


def test_the_effects_of_a_pair_are_tried_alone_on_the_same_runs() -> None:
    trials = plan(0, FULL)
    pair = next(t for t in trials if t.family == "pair")
    alone = [t for t in trials if t.part_of == pair.trial]
    assert sorted(t.effects()[0] for t in alone) == sorted(pair.effects())
    together = specs(pair)
    for trial in alone:
        for a, b in zip(specs(trial), together, strict=True):
            assert dataclasses.replace(a, changes={}) == dataclasses.replace(b, changes={})
            assert dict(a.changes).items() <= dict(b.changes).items()


@pytest.mark.parametrize("setting", OTHER_DRIVES)
def test_other_drives_differ_from_the_references(setting: str) -> None:
    """In their profile, speed, length or site; the references stay what they are elsewhere."""
    trial = one(setting)
    made = specs(trial)
    judged, normal = made[0], made[RUNS]
    assert normal.duration_s() == DURATION_S
    assert (trial.drive != trial.reference_drive) == (setting in ("profile", "waypoints"))
    assert (judged.duration_s() == SHORT_S) == (setting == "length")
    assert (judged.ground != normal.ground) == (setting == "site")
    pace = [np.mean([abs(s.v_mps) for s in spec.drive]) for spec in (judged, normal)]
    if setting == "speed":
        assert abs(math.log(pace[0] / pace[1])) > 0.2


def test_harder_settings_leave_the_diagnosis_with_wrong_numbers() -> None:
    """The plant's robot or soil is not the one that file and label name."""
    off = specs(one("robot 10 % off"))[0].vehicle
    file = load_vehicle("elevate")
    assert off.body.mass_kg != file.body.mass_kg
    assert off.wheel.radius_m != file.wheel.radius_m
    assert off.odometry == file.odometry
    trial = one("wrong soil label")
    assert all(s.soil.name != trial.soil for s in specs(trial))
    assert len(specs(one("5 references"))) == RUNS + 5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("differs", ["", "speed", "length"])
def test_drives_begin_and_end_at_rest(kind: str, differs: str) -> None:
    segments = drive(kind, np.random.default_rng(5), differs)
    duration_s = SHORT_S if differs == "length" else DURATION_S
    assert sum(s.duration_s for s in segments) == pytest.approx(duration_s)
    assert segments[0].v_mps == segments[-1].v_mps == 0.0
    assert segments[-1].duration_s >= 2.0


def test_a_case_tells_nothing_of_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a diagnosis is given: recordings with neutral names and no truth."""
    monkeypatch.setattr(drives, "DURATION_S", 5.0)
    monkeypatch.setattr(drives, "SHORT_S", 4.0)
    first = next(iter(cases([one("length")])))
    told = f"{first.trial} {first.runs[0].name} {first.runs[0].description} {first.runs[0].notes}"
    assert not any(name in told for name in (*BUILT_IN, *CHANGES, "null", "pair"))
    assert first.runs[0].truth is None
    assert [len(first.runs), len(first.references)] == [RUNS, 12]
    assert first.runs[0].duration_s() == pytest.approx(4.0, abs=0.1)
    assert first.references[0].duration_s() == pytest.approx(5.0, abs=0.1)


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
from terrafusion.twin.gap.blind import answers as module
from terrafusion.twin.gap.blind.plan import CheckSize
module.cases = fake.short_cases
run_blind_check({out!r}, fake.guess, scale=CheckSize(1, 0, 0, 0, 0, 1, 0), seed=5)
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
    found = scores["figures"]["diagnosis"]["shrink"]
    assert (found["mean"], found["oracle"]) == pytest.approx((0.5, 0.8))
    assert found["over_oracle"] == pytest.approx(0.625)


@pytest.mark.usefixtures("quickly")
def test_a_diagnosis_that_breaks_is_wrong_everywhere(tmp_path: Path) -> None:
    """And leaves the opponent, which answers the same trials, as it is."""
    scores = run_blind_check(tmp_path, fake.breaking, opponent=fake.guess, scale=TINY, seed=1)
    broken, other = scores["figures"]["diagnosis"], scores["figures"]["opponent"]
    assert len(broken["crashes"]) == scores["trials"] == len(plan(1, TINY))
    assert broken["false_alarms"][PLAIN]["rate"] == 1.0
    assert all(cell["rate"] == 0.0 for cell in broken["power_all"].values())
    assert broken["pairs"]["both_of_all"]["rate"] == 0.0
    assert all("LinAlgError" in entry["diagnosis"]["error"] for entry in answered(tmp_path).values())
    assert json.loads((tmp_path / "blind.json").read_text()) == scores
    assert other["crashes"] == []
    assert other["power_all"]["25"]["rate"] == 1.0


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
    assert fake.without_times(resumed) == fake.without_times(whole)


@pytest.mark.usefixtures("quickly")
def test_a_check_that_runs_out_of_time_scores_what_is_answered(tmp_path: Path) -> None:
    """A prefix of the random order; no trial that was not asked counts as a crash."""
    scores = run_blind_check(tmp_path, fake.guess, scale=TINY, seed=2, minutes=0.0)
    assert (scores["trials"], scores["planned"]) == (1, len(plan(2, TINY)))
    assert scores["figures"]["diagnosis"]["crashes"] == []
    assert list(answered(tmp_path)) == ["trial-0001"]
    again = run_blind_check(tmp_path, fake.guess, scale=TINY, seed=2)
    assert again == scores  # the labels are open: nothing is answered any more


# The scores


def test_the_truth_scores_full_marks() -> None:
    trials = plan(0, FULL)
    scores = score(trials, as_answers(trials, fake.perfect))
    own = scores["figures"]["diagnosis"]
    assert own["crashes"] == []
    for row in scores["headline"]:
        assert row["diagnosis"]["met"] in (True, None), row
    assert own["false_alarms"][PLAIN]["hits"] == own["false_alarms"]["other drives"]["hits"] == 0
    assert {rate["rate"] for rate in own["power_all"].values()} == {1.0}
    assert own["pairs"]["both"]["count"] == FULL.pairs
    for truth, said in own["confusion"].items():
        outside = truth not in (*BUILT_IN, "no_gap")
        assert set(said) == {"unknown" if outside else truth}


def test_guesses_score_at_chance_and_their_confidence_is_honest() -> None:
    """One of 37 first, three of 37 among the first three; stated 1/37, so no calibration error beyond
    chance."""
    found = figures(plan(0, FULL), fake.guessed)
    for family in ("same", "shifted"):
        for places, name in ((1, "top1"), (3, "top3")):
            given_, p = found[name][family], places / 37.0
            assert abs(given_["rate"] - p) < 4.0 * math.sqrt(p * (1.0 - p) / given_["count"])
        assert found["confidence"][family]["ece"] < 0.06
    assert found["false_alarms"][PLAIN]["rate"] == 1.0
    assert found["unknown"]["recall"]["rate"] == 0.0


def test_a_pair_counts_where_both_effects_are_seen_alone() -> None:
    """An effect that is not even seen alone is no fault of the search for two."""
    trials = plan(0, FULL)
    pairs = [t for t in trials if t.family == "pair"]
    blind_to = next(t.trial for t in trials if t.part_of == pairs[0].trial)

    def overlooks(t: Any) -> Any:
        return fake.diagnosis("no_gap") if t.trial in (blind_to, pairs[0].trial) else fake.perfect(t)

    found = figures(trials, overlooks)["pairs"]
    assert (found["both"]["hits"], found["both"]["count"]) == (len(pairs) - 1, len(pairs) - 1)
    assert found["both_of_all"]["count"] == len(pairs)


def test_sizes_are_compared_with_the_truth_in_their_sigma() -> None:
    """By the catalogue's own law; a size by another law has another meaning and is left out."""
    trial = next(t for t in plan(0, FULL) if t.shapes == ("gyro_scale/same",))
    for law, wanted in (("gyro_scale/scale", 1.5), ("gyro_scale/asymmetry", None)):
        answer = fake.diagnosis("effect", [("gyro_scale", 0.9)], ["gyro_scale"])
        answer["causes"][0]["parameters"] = {
            law: {"value": -1.3 * trial.values[0], "sigma": 0.2 * trial.values[0]}
        }
        found = judge(trial, {"seconds": 1.0, "answer": answer}).deviation
        assert found == (None if wanted is None else pytest.approx(wanted))


def test_look_alikes_count_once_and_extras_are_told() -> None:
    pair = one(PLAIN, "pair")
    first, second = pair.effects()
    extra = next(e for e in BUILT_IN if e not in (first, second))
    alike = next(e for e in BUILT_IN if e not in (first, second, extra))
    answer = fake.diagnosis("effect", [(first, 0.4), (extra, 0.3), (alike, 0.2)], [alike, first, extra])
    for cause in answer["causes"]:
        if cause["effect"] in (first, alike):
            cause["class"] = [first, alike]
    judged = judge(pair, {"seconds": 1.0, "error": None, "answer": answer})
    assert (judged.found, judged.extras, judged.rank) == (1, 1, 1)
    assert judged.confidence == pytest.approx(0.6)


@pytest.mark.parametrize("lost", ["causes", "gap", "verdict", "named", "shrink"])
def test_an_answer_that_breaks_the_contract_is_a_crash(lost: str) -> None:
    trial = one(PLAIN, "same")
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


def test_the_oracle_finds_the_detectability_of_a_known_shift() -> None:
    """White noise and one strong common direction: d' is that of the whitened shift, in proportion."""
    rng = np.random.default_rng(0)
    common = np.sin(np.arange(30.0))
    null = rng.normal(size=(400, 30)) + 5.0 * rng.normal(size=(400, 1)) * common
    shift = np.zeros(30)
    shift[7] = 4.0
    covariance = np.eye(30) + np.eye(30) + 25.0 * np.outer(common, common)  # of the runs, and the floors
    oracle = Oracle(null, np.ones(30))
    wanted = math.sqrt(shift @ np.linalg.solve(covariance, shift))
    assert oracle.d_prime(shift) == pytest.approx(wanted, rel=0.1)
    assert oracle.d_prime(2.0 * shift) == pytest.approx(2.0 * oracle.d_prime(shift))
    assert oracle.d_prime(np.zeros(30)) == 0.0
    assert oracle.d_prime(common) < 0.5  # what null runs do by themselves is no sign of an effect


def test_sizes_follow_a_power_law_up_to_the_largest() -> None:
    assert size_for([(2.0, 12.0), (1.0, 3.0)], 27.0, 99.0) == pytest.approx(3.0, rel=1e-3)
    assert size_for([(1.0, 3.0), (2.0, 12.0)], 6.0, 99.0) == pytest.approx(math.sqrt(2.0), rel=1e-3)
    assert size_for([(1.0, 1.0), (2.0, 2.0)], 50.0, 9.0) == 9.0
    bent = [(1.0, 5.0), (2.0, 4.0), (4.0, 30.0)]
    assert sorted(size_for(bent, d, 9.0) for d in D_PRIMES) == [size_for(bent, d, 9.0) for d in D_PRIMES]


def test_a_right_cause_called_unknown_is_not_right() -> None:
    """Ranked first is not enough for the headline; only the verdict differs between the two checks."""
    trials = [t for t in plan(0, FULL) if t.family in ("same", "shifted")]
    for verdict, rate in (("effect", 1.0), ("unknown", 0.0)):
        found = figures(trials, lambda t, v=verdict: fake.diagnosis(v, [(t.effects()[0], 0.9)]))
        assert {found["right"][family]["rate"] for family in ("same", "shifted")} == {rate}
        assert {found["top1"][family]["rate"] for family in ("same", "shifted")} == {1.0}
