"""Vehicle files with the effects that a diagnosis named."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.calibrate.files import write_yaml
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.answer.corrected import write_corrected
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.model.vehicle_file import read_vehicle


def diagnosis(vehicle: str | Path, key: str, value: float) -> Any:
    cause = {"effect": key.split("/")[0], "parameters": {key: {"value": value}}}
    answer = {"named": [cause["effect"]], "causes": [cause]}
    model = Model(load_vehicle(vehicle), {}, {})
    return SimpleNamespace(to_json=lambda: answer, evidence=SimpleNamespace(model=model))


@pytest.mark.parametrize(("change", "kept"), [(0.05, True), (0.3, False)])
def test_a_number_outside_the_range_of_the_file_has_no_range(
    change: float, kept: bool, tmp_path: Path
) -> None:
    """Or the file would say that its own number is not valid."""
    before, after = tmp_path / "before.yaml", tmp_path / "after.yaml"
    raw, _ = read_vehicle("elevate")
    mass_kg = raw["body"]["mass_kg"]["value"]
    raw["body"]["mass_kg"]["valid"] = [0.9 * mass_kg, 1.1 * mass_kg]
    write_yaml(before, raw)
    write_corrected(diagnosis(before, "mass/at_cg", change), before, after)
    entry = read_vehicle(after)[0]["body"]["mass_kg"]
    assert ("valid" in entry) == kept
    assert ("outside the validity range" in entry["source"]) != kept
    assert load_vehicle(after).body.mass_kg == pytest.approx((1.0 + change) * mass_kg)


def test_an_effect_is_written_as_it_was_found(tmp_path: Path) -> None:
    """A Warthog's friction is beyond the range of a robot of 32 kg."""
    key, after = "drivetrain_friction/coulomb", tmp_path / "after.yaml"
    write_corrected(diagnosis("warthog", key, 20.0), "warthog", after)
    assert load_vehicle(after).effects[key] == 20.0


def test_an_effect_by_its_name_alone_is_added_to(tmp_path: Path) -> None:
    before, after = tmp_path / "before.yaml", tmp_path / "after.yaml"
    raw, _ = read_vehicle("elevate")
    write_yaml(before, {**raw, "effects": {"gyro_bias": {"value": 0.003, "source": "told"}}})
    write_corrected(diagnosis(before, "gyro_bias/constant", 0.002), before, after)
    assert load_vehicle(after).effects == {"gyro_bias/constant": pytest.approx(0.005)}


def test_an_effect_by_two_names_is_refused(tmp_path: Path) -> None:
    path, number = tmp_path / "vehicle.yaml", {"value": 0.003, "source": "told"}
    raw, _ = read_vehicle("elevate")
    write_yaml(path, {**raw, "effects": {"gyro_bias": number, "gyro_bias/constant": number}})
    with pytest.raises(ConfigError, match="given twice") as refused:
        load_vehicle(path)
    assert str(path) in str(refused.value)
