"""Methods, and the ground labels that some of them are given."""

from __future__ import annotations

import dataclasses

import pytest

from terrafusion.fusion.benchmark.methods import (
    DATA_SHEET_NOISE,
    METHODS,
    known_labels,
    most_different_class,
    replay_options,
    shuffled,
    true_labels,
    wrong_labels,
)
from terrafusion.fusion.noise.labels import GroundLabels
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.twin.run_recording import START_NS
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate

POLICY = load_policy()
LABELS = GroundLabels((START_NS, START_NS + 10**10), ("asphalt", "lava"))


@pytest.fixture(scope="module")
def two_grounds():
    scenario = load_scenario("mixed_terrain")
    short = dataclasses.replace(scenario, duration_s=60.0)
    return simulate(short, seed=1)


def test_every_method_is_a_mode_with_its_own_name() -> None:
    assert len({method.name for method in METHODS}) == len(METHODS) == 8
    for method in METHODS:
        options = replay_options(method, LABELS, seed=3)
        assert options is not None
        assert options["mode"] == method.mode


def test_arms_that_need_labels_have_none_without_them() -> None:
    without = {method.name for method in METHODS if replay_options(method, None, seed=3) is None}
    assert without == {"oracle", "shuffled", "adversarial"}


def test_ground_that_the_policy_does_not_know_has_no_adversary() -> None:
    snow = GroundLabels((START_NS,), ("snow",))
    without = {method.name for method in METHODS if replay_options(method, snow, seed=3) is None}
    assert without == {"adversarial"}


def test_the_data_sheet_knows_no_slip_and_no_tuning() -> None:
    options = replay_options(METHODS[0], None, seed=0)
    assert options is not None
    row = options["policy"].fixed
    assert {name: getattr(row, name) for name in DATA_SHEET_NOISE} == DATA_SHEET_NOISE
    assert options["settings"]["tuning"].fixed.applied(row) == row


def test_true_labels_follow_the_simulation(two_grounds) -> None:
    labels = true_labels(two_grounds)
    assert labels is not None
    assert labels.names == ("asphalt", "loose_sand")
    terrain = two_grounds.terrain
    for t, label in zip(terrain.t_ns.tolist(), terrain.label.astype(str), strict=True):
        assert labels.at(t) == label


def test_a_detectors_word_is_no_truth(two_grounds) -> None:
    heard = dataclasses.replace(two_grounds.terrain, source="detector")
    assert true_labels(dataclasses.replace(two_grounds, terrain=heard, terrain_name="")) is None


def test_a_log_whose_words_the_policy_does_not_know_has_no_oracle(two_grounds) -> None:
    lava, mud = (
        true_labels(dataclasses.replace(two_grounds, terrain=None, terrain_name=word))
        for word in ("lava", "mud")
    )
    assert lava is not None
    assert known_labels(lava) is None
    assert known_labels(mud) == mud == GroundLabels((START_NS,), ("mud",))


def test_shuffled_labels_come_from_the_seed_and_from_all_classes() -> None:
    one, same, other = (shuffled(LABELS, POLICY, seed) for seed in (1, 1, 2))
    assert one == same != other
    assert set(one.names) == set(POLICY.names()) - {"unknown"}


def test_the_most_foreign_class_is_never_the_true_one() -> None:
    for name in POLICY.names():
        if name != "unknown":
            assert most_different_class(name, POLICY) not in (name, "unknown")
    assert most_different_class("loose_sand", POLICY) in ("asphalt", "medium_sand")
    assert most_different_class("lava", POLICY) == "unknown"
    assert wrong_labels(LABELS, POLICY).t_ns == LABELS.t_ns
