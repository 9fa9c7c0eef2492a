"""Ground memory in a drive: learned, carried to the next one, live, dumped; fixed mode does not use it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import terrafusion as tf
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.methods import true_labels
from terrafusion.fusion.benchmark.outage_plan import aided_by_truth, until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.grounds.file import save_grounds
from terrafusion.fusion.grounds.ground import FRICTION_MODELS, Tally
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.outputs.replay_files import metrics_of
from terrafusion.fusion.replay import replay
from terrafusion.fusion.reports.replay_text import summary_of_one
from terrafusion.twin.model.vehicle import as_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run


@pytest.fixture(scope="module")
def drive() -> Recording:
    """A drive of a robot that the terrain model does not know."""
    run = tf.simulate("figure_eight", vehicle="husky", terrain="asphalt", seed=3)
    return until(run, 30.0)


def test_a_drive_adds_to_the_memory_and_the_next_one_goes_on(drive: Recording, tmp_path: Path) -> None:
    path = tmp_path / "grounds.yaml"
    first = tf.replay(drive, grounds=path).grounds
    assert first is not None
    assert len(first) == 1
    save_grounds(first, path)
    run = tf.simulate("figure_eight", vehicle="husky", terrain="asphalt", seed=4)
    second = tf.replay(until(run, 30.0), grounds=path).grounds
    assert second is not None
    assert len(second) == 1
    assert second.grounds[0].windows > 1.5 * first.grounds[0].windows
    save_grounds(second, path)
    again = tf.replay(drive, mode="fixed", outages=[(20.0, 5.0)], grounds=path)
    assert again.grounds is not None
    assert again.grounds.grounds[0].windows == pytest.approx(second.grounds[0].windows, rel=1e-4)
    assert any("learned from this drive before" in note for note in again.estimate.notes)


def test_the_terrain_of_a_drive_is_told_by_the_grounds_that_the_robot_found(drive: Recording) -> None:
    result = replay(drive)
    metrics = metrics_of(result)
    shares = metrics["terrain"]
    assert shares["ground 1"] > 0.7
    assert sum(shares.values()) == pytest.approx(1.0)
    assert f"ground 1 ({100 * shares['ground 1']:.0f} %)" in " ".join(summary_of_one(metrics))


def test_a_ground_by_its_label_has_the_slip_that_the_robot_shows_on_it(drive: Recording) -> None:
    """Wheels 6 % smaller than the file says, on asphalt, where the policy's robot slips by 0.1 %."""
    radius_m = 1.06 * as_vehicle("husky").rig().wheel_radius_m
    worn = dataclasses.replace(drive, overrides=dataclasses.replace(drive.overrides, wheel_radius_m=radius_m))
    told = replay(worn, settings={"labels": true_labels(drive)}).estimate
    assert told.slip[-50:].mean() == pytest.approx(0.055, abs=0.02)
    assert told.weights["slip_mean"][-1] > 0.02


def test_what_is_remembered_changes_no_bit_of_fixed_weights(drive: Recording) -> None:
    """Even where the remembered ground is said to be ice."""
    memory = tf.replay(drive).grounds
    assert memory is not None
    ice = dataclasses.replace(memory.grounds[0], friction=np.eye(FRICTION_MODELS)[0], friction_windows=1000.0)
    plain, remembered = (tf.replay(drive, mode="fixed", grounds=g) for g in (None, GroundMemory([ice])))
    np.testing.assert_array_equal(
        plain.estimate.trajectory.position_m, remembered.estimate.trajectory.position_m
    )
    assert plain.grounds is None


def test_a_poisoned_memory_makes_the_estimate_no_worse(drive: Recording) -> None:
    """A ground of the memory is said to slip by a half: fixes contradict it."""
    memory = tf.replay(drive).grounds
    assert memory is not None
    motion = Tally(np.full(2, 100.0), np.array([0.5, 0.0]), np.full(2, 1e-4))
    poison = GroundMemory([dataclasses.replace(g, motion=motion) for g in memory.grounds])
    outage = [(20.0, 8.0)]
    plain, poisoned = (tf.replay(drive, grounds=g, outages=outage) for g in (None, poison))
    errors = [result.scores.outages[0].end_error_m for result in (plain, poisoned)]
    assert errors[0] is not None
    assert errors[1] is not None
    assert errors[1] < errors[0] + 0.1
    assert poisoned.grounds is not None
    assert abs(poisoned.grounds.grounds[0].motion.mean[0]) < 0.1


def test_a_dump_goes_on_with_the_same_memory(drive: Recording) -> None:
    config = EstimatorConfig(as_vehicle("husky").rig(), "husky", grounds=GroundMemory())
    whole, part = Estimator(config), Estimator(config)
    messages = list(drive.messages())
    for message in messages:
        whole.add(message)
    half = len(messages) // 2
    for message in messages[:half]:
        part.add(message)
    rest = Estimator.restore(config, part.dump())
    for message in messages[half:]:
        rest.add(message)
    own, other = whole.weights.learned_grounds(), rest.weights.learned_grounds()
    assert own is not None
    assert other is not None
    assert [g.windows for g in own.grounds] == [g.windows for g in other.grounds]
    np.testing.assert_array_equal(own.grounds[0].signature.mean, other.grounds[0].signature.mean)


def test_a_ground_met_again_in_an_outage_slips_as_it_did_before() -> None:
    """A robot that no model knows goes from asphalt to sand three times, the last time without fixes."""
    legs = (RouteLeg("asphalt", 35.0), RouteLeg("loose_sand", 35.0)) * 3
    weave = DriveSegment(175.0, 1.0, yaw_rate_amplitude_radps=0.2, period_s=10.0)
    scenario = Scenario(
        name="legs", description="asphalt and sand in turn", duration_s=180.0,
        drive=(DriveSegment(5.0), weave), route=legs,
    )  # fmt: skip
    log = aided_by_truth(simulate_run(scenario, vehicle="husky", seed=1).recording, 1)
    labels, slips = true_labels(log), dict[str, list[float]]()
    assert labels is not None

    def watch(estimator: Estimator) -> None:
        state = estimator.latest()
        assert state is not None
        if state.status == "outage":
            slips.setdefault(labels.at(state.t_ns), []).append(estimator.weights.noise.slip_mean)

    result = replay(log, outages=[Outage(125.0, 50.0)], watch=watch)
    end_m = result.scores.outages[0].end_error_m
    assert end_m is not None
    assert end_m < 1.0  # 2 % of the path; the slip of the whole drive alone would be off by 7 %
    assert np.median(slips["loose_sand"]) == pytest.approx(0.14, abs=0.04)
    assert np.median(slips["asphalt"]) == pytest.approx(0.0, abs=0.02)
    assert any(note.startswith("grounds found while driving") for note in result.estimate.notes)
    reasons = {change.reason.partition(": ")[2] for change in result.estimate.changes}
    assert any(reason.endswith("(found while driving)") for reason in reasons)
    assert f"{len(result.grounds or ())} grounds" in repr(result.grounds)
