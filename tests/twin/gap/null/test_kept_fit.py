"""The fit to references is made once, and as often as something of it changes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.null import reference_twin
from terrafusion.twin.gap.null.reference_twin import set_as_before
from terrafusion.twin.gap.rollout.residuals import LinearisationCache
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

CANDIDATES = Candidates.of(["soil_strength", "mass"])


NUMBER = "effects.soil_strength/shear"


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The fits that are made, here of one number."""
    out: list[float] = []

    def fit(logs: list[PreparedLog], cache: LinearisationCache, *_: object) -> Model:
        out.append(0.1 * (1 + len(out)) / 3.0)
        return cache.model.replaced({NUMBER: out[-1]})

    monkeypatch.setattr(reference_twin, "set_to_references", fit)
    monkeypatch.setattr(reference_twin, "cache_folder", lambda: tmp_path)
    return out


def test_the_same_references_are_fitted_once(made: list[float], tmp_path: Path) -> None:
    def twin(logs: list[PreparedLog], model: Model, candidates: Candidates = CANDIDATES) -> float:
        channels = tuple(o.channel for o in logs[0].observed)
        return set_as_before(logs, LinearisationCache(model, candidates), channels, 1).value(NUMBER)

    logs, model, _ = prepared(runs(40, 2), load_vehicle("elevate"), None)
    again, same, _ = prepared(runs(40, 2), load_vehicle("elevate"), None)
    assert twin(logs, model) == twin(again, same) == made[0]
    assert len(made) == 1
    other = dataclasses.replace(logs[0], observed=logs[0].observed[::-1])
    assert twin([other, logs[1]], model) == made[1]
    assert twin(logs, model.replaced({"vehicle.body.mass_kg": 100.0})) == made[2]
    assert twin(logs, model, Candidates.of(["soil_strength"])) == made[3]
    for file in tmp_path.iterdir():
        file.write_text("{damaged")
    assert twin(logs, model) == twin(logs, model) == made[4]
