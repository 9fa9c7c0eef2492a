"""The opponent of the blind check: bounded least squares of all parameters at once."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.blind.drives import drive
from terrafusion.twin.gap.blind.opponent import first_forms, joint_least_squares
from terrafusion.twin.gap.blind.plan import Trial
from terrafusion.twin.gap.blind.plant.run import record
from terrafusion.twin.gap.blind.plant.spec import RunSpec
from terrafusion.twin.gap.blind.verdicts import judge
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle

LATE_S, REFERENCES = 0.08, 5


@pytest.fixture(scope="module")
def runs() -> list[Recording]:
    """References, one run more like them, and one with a delayed command."""
    vehicle, soil = load_vehicle("elevate"), load_soil("gravel")
    changes = [{}] * (REFERENCES + 1) + [{"late_s": LATE_S}]
    drives = [drive("exciting", np.random.default_rng(i), "length") for i in range(len(changes))]
    return record(
        [
            RunSpec(vehicle, soil, d, 0.1 * i, i, 7, c)
            for i, (d, c) in enumerate(zip(drives, changes, strict=True))
        ]
    )


def test_it_fits_one_form_an_effect() -> None:
    every = Candidates.of()
    some = first_forms(every)
    assert some.effects == every.effects
    assert len(some.hypotheses) == len(some.effects)
    for h in some.hypotheses:
        for i in h.columns:
            j = every.keys.index(some.keys[i])
            assert (some.scale[i], some.low[i], some.units[i]) == (
                every.scale[j],
                every.low[j],
                every.units[j],
            )
    assert "backlash/open_gear/gap" not in some.keys
    assert some.world_fixed <= set(some.moving) <= set(some.keys)


def test_it_names_a_delay_with_its_size_and_nothing_without_one(runs: list[Recording]) -> None:
    vehicle = load_vehicle("elevate")
    references = runs[:REFERENCES]
    quiet = joint_least_squares(runs[REFERENCES : REFERENCES + 1], references, vehicle).to_json()
    assert (quiet["verdict"], quiet["named"]) == ("no_gap", [])
    found = joint_least_squares(runs[-1:], references, vehicle).to_json()
    assert found["causes"][0]["effect"] == found["named"][0] == "dead_time"
    assert found["causes"][0]["parameters"]["dead_time/transport"]["value"] == pytest.approx(LATE_S, abs=0.01)
    trial = Trial(
        "t",
        "same",
        "same drives",
        "exciting",
        "exciting",
        25.0,
        "gravel",
        ("dead_time/same",),
        (LATE_S,),
        0,
        5,
    )
    judged = judge(trial, {"seconds": 1.0, "answer": found})
    assert (judged.crashed, judged.right(), judged.found) == (False, True, 1)
    assert judged.deviation is not None


def test_too_few_references_are_refused(runs: list[Recording]) -> None:
    with pytest.raises(DataError, match="2 references"):
        joint_least_squares(runs[-1:], runs[:2], load_vehicle("elevate"))
