"""Version of the plant: pinned, stored with every check, and never mixed with another."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.reports.blind import summary
from terrafusion.twin.gap.blind import pin, seal
from terrafusion.twin.gap.blind.check import run_blind_check
from terrafusion.twin.gap.blind.plan import CheckSize
from terrafusion.twin.model.soil import load_soil
from tests.twin.gap.blind import blind_answers as fake

TINY = CheckSize(nulls=1, other_nulls=0, effects=0, other_effects=0, harder=0, outside=0, pairs=0)


def test_the_plant_is_the_pinned_one() -> None:
    """The plant does not change together with the method. If meant: new pin, new study."""
    assert pin.plant_sha256() == pin.PINNED


def test_a_number_of_a_soil_changes_the_version(monkeypatch: pytest.MonkeyPatch) -> None:
    def firmer(name: str) -> Any:
        soil = load_soil(name)
        shear = dataclasses.replace(soil.shear, shear_modulus_m=1.001 * soil.shear.shear_modulus_m)
        return dataclasses.replace(soil, shear=shear)

    monkeypatch.setattr(pin, "load_soil", firmer)
    assert pin.plant_sha256.__wrapped__() != pin.PINNED


def test_a_source_file_changes_the_version(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plant, shapes, and beside them drives and severities."""
    monkeypatch.setattr(pin, "PLANT", (*pin.PLANT, "rates.py"))
    assert pin.plant_sha256.__wrapped__() != pin.PINNED
    before = pin.trials_sha256()  # which remembers its answer
    monkeypatch.setattr(pin, "TRIALS", pin.TRIALS[1:])
    assert pin.trials_sha256.__wrapped__() != before


def test_a_check_names_its_plant_and_is_not_continued_on_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("terrafusion.twin.gap.blind.answers.cases", fake.short_cases)
    scores = run_blind_check(tmp_path, fake.guess, scale=TINY)
    before = seal.commitment(tmp_path)
    assert before is not None
    assert scores["plant_sha256"] == before["plant_sha256"] == pin.PINNED
    assert pin.PINNED[:12] in summary(scores)[0]
    monkeypatch.setattr("terrafusion.twin.gap.blind.check.plant_sha256", lambda: "0" * 64)
    with pytest.raises(ConfigError, match="another version of the plant"):
        run_blind_check(tmp_path, fake.guess, scale=TINY)
