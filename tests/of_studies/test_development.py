"""Development trials of the blind check and the weights trained on them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from terrafusion.twin.gap.answer.verdict import UNKNOWN
from terrafusion.twin.gap.blind import plan
from tests.studies.blind.development import (
    Trial,
    crossed,
    read,
    site,
    specs,
    train,
    utilities,
    write,
)


def made(rng: np.random.Generator, effect: str | None) -> Trial:
    """A trial in which the true effect leaves a third and others most of the gap."""
    before = float(rng.uniform(4.0, 12.0))
    left = {name: before * float(rng.uniform(0.85, 1.0)) for name in "abcdef"}
    if effect is not None:
        left[effect] = before * float(rng.uniform(0.1, 0.5))
    parts = {name: (x, 0.2 * x, 0.3 * x) for name, x in left.items()}
    gap, fits = (before, 0.2 * before, 0.3 * before), (float(rng.uniform(0.0, 0.9)), 1.0, 0.0)
    return Trial(f"{effect}/same", "gentle", "grass", 1.5, effect, parts, gap, fits, {})


def test_trained_weights_name_causes_they_were_not_trained_on() -> None:
    rng = np.random.default_rng(5)
    trained = train([made(rng, effect) for effect in [*"abc" * 6, *[None] * 8]])
    for effect in [*"def" * 5, *[None] * 10]:
        odds = utilities(made(rng, effect), trained)
        assert max(odds, key=lambda k: odds[k]) == effect


def test_sites_left_out_are_judged_by_the_others() -> None:
    rng = np.random.default_rng(7)
    sites = [[made(rng, effect) for effect in ["a", "b", "c", None, None]] for _ in range(4)]
    known, outside = crossed(sites)
    assert (len(known), len(outside)) == (12, 8)
    assert max(known) < UNKNOWN < min(outside)


def test_trials_and_weights_survive_a_file(tmp_path: Path) -> None:
    import json

    trial, path = made(np.random.default_rng(6), "a"), tmp_path / "site.json"
    path.write_text(json.dumps([dataclasses.asdict(trial)]), encoding="utf-8")
    assert read([path]) == [trial]
    found = train([trial])
    write(tmp_path / "cause_posterior.yaml", found, [trial], 1)
    text = (tmp_path / "cause_posterior.yaml").read_text(encoding="utf-8")
    assert "1 trials" in text
    assert f"slope: {found.slope:.4g}" in text


def test_development_trials_share_no_draw_with_a_blind_check() -> None:
    kind, soil, trials = site(3)
    assert (kind, soil) == ("gentle", "grass")
    assert site(3)[2] == trials
    here = {spec.seed for number in range(4) for spec in specs(number)}
    checked = plan.plan(0, plan.QUICK)
    there = {spec.seed for trial in checked for spec in plan.specs(trial)}
    assert not here & there
    robots = {spec.robot_seed for spec in specs(3)}
    assert len(robots) == 1
    assert robots.isdisjoint(spec.robot_seed for trial in checked for spec in plan.specs(trial))
