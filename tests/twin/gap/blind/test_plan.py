"""The trials of a blind check: effects, sizes, drives and settings."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest

from terrafusion.twin.effects.catalogue import built_in
from terrafusion.twin.gap.blind import drives
from terrafusion.twin.gap.blind.answers import cases
from terrafusion.twin.gap.blind.drives import DURATION_S, KINDS, SHORT_S, drive
from terrafusion.twin.gap.blind.plan import (
    D_PRIMES,
    FULL,
    HARDER,
    OTHER_DRIVES,
    PLAIN,
    QUICK,
    RUNS,
    plan,
    specs,
)
from terrafusion.twin.gap.blind.plant.parameters import CHANGES
from terrafusion.twin.gap.blind.sensitivity import size_at
from terrafusion.twin.gap.blind.shapes import IN_CATALOGUE, OUT_OF_CATALOGUE, SAME, SHIFTED, shapes
from terrafusion.twin.model.vehicle import load_vehicle

BUILT_IN = tuple(dict.fromkeys(form.effect for form in built_in().values() if form.candidate))


def one(setting: str, family: str = "null") -> Any:
    return next(t for t in plan(0, FULL) if (t.setting, t.family) == (setting, family))


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
