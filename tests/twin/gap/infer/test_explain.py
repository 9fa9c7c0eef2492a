"""Gaps explained through the twin: large effects, whose sensitivity misleads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.explain import Explanation, explain
from terrafusion.twin.gap.infer.other_drives import learn_offsets
from terrafusion.twin.gap.infer.run_states import learn_state_sigma
from terrafusion.twin.gap.null.evidence import gather_evidence
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.residuals import initial_state_sigma
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs


def explained(
    effects: Sequence[str], truth: Mapping[str, float], close: bool = True
) -> tuple[Explanation, Candidates]:
    candidates = Candidates.of(effects)
    given = runs(980, 2, truth), runs(985, 4)
    evidence = gather_evidence(*given, load_vehicle("elevate"), None, candidates, jobs=2)
    sigma = learn_state_sigma(evidence.references, initial_state_sigma(candidates))
    robot = learn_offsets([score(r, sigma) for r in evidence.references], candidates.count)
    return explain(evidence, sigma, robot, close=close), candidates


@pytest.mark.parametrize(
    ("key", "others", "truth", "within"),
    [
        ("soil_strength/shear", ("motion_resistance", "wheel_radius"), 0.9, 0.1),
        ("imu_time_offset/shift", ("gyro_bias", "gyro_scale"), 0.3, 0.015),
    ],
)
def test_a_large_effect_is_found_at_its_size(
    key: str, others: tuple[str, ...], truth: float, within: float
) -> None:
    """4.5 typical sizes of the ground's strength, and an IMU 15 of them late."""
    name = key.split("/")[0]
    found, candidates = explained([name, *others], {key: truth})
    singles = {effects: value for effects, value in found.evidence.items() if len(effects) == 1}
    assert max(singles, key=lambda effects: singles[effects]) == (name,)
    fit = found.fits[name,]
    column = candidates.keys.index(key)
    assert column in fit.laws[0].columns
    assert float(fit.values[0][0]) * candidates.scale[column] == pytest.approx(truth, abs=within)


def test_what_references_have_too_is_no_cause() -> None:
    """An IMU that is late in all runs: its linear part is known from the references, the rest is not, and
    gains as much on them as on the judged runs."""
    name = "imu_time_offset"
    candidates, late = Candidates.of([name, "gyro_scale"]), {"imu_time_offset/shift": 0.2}
    given = runs(980, 2, late), runs(985, 6, late)
    evidence = gather_evidence(*given, load_vehicle("elevate"), None, candidates, jobs=2)
    sigma = learn_state_sigma(evidence.references, initial_state_sigma(candidates))
    robot = learn_offsets([score(r, sigma) for r in evidence.references], candidates.count)
    found = explain(evidence, sigma, robot, close=True)
    assert found.evidence[name,] < 0.0
