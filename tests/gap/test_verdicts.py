"""Each verdict occurs on the right data, through the whole diagnosis and without any truth channel."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from terrafusion.datasets.errors import ConfigError, DataError
from terrafusion.datasets.recording import Recording
from terrafusion.twin.effects.catalogue import effect_names
from terrafusion.twin.gap import Diagnosis, diagnose
from terrafusion.twin.gap.corrected import values_of, write_corrected
from terrafusion.twin.vehicle import load_vehicle

from .drives import runs

SCHEMA = json.loads((Path(__file__).parents[2] / "docs/schemas/diagnosis.schema.json").read_text("utf-8"))
VEHICLE = load_vehicle("elevate")


@pytest.fixture(scope="module")
def references() -> list[Recording]:
    return runs(100, 10)


@pytest.fixture(scope="module")
def wide(references: list[Recording]) -> Diagnosis:
    """Wheels 3 % larger than the twin's."""
    return diagnose(runs(300, 2, {"wheel_radius/scale": 0.03}), references, VEHICLE)


def checked(d: Diagnosis) -> dict:
    answer = d.to_json()
    jsonschema.validate(answer, SCHEMA)
    probabilities = [c["probability"] for c in answer["causes"]]
    assert probabilities == sorted(probabilities, reverse=True)
    assert sum(probabilities) + answer["p_unknown"] + answer["p_null"] == pytest.approx(1.0, abs=1e-6)
    return answer


def test_runs_like_the_references_show_no_gap(references: list[Recording]) -> None:
    answer = checked(diagnose(runs(200, 2), references, VEHICLE))
    assert answer["verdict"] == "no_gap"
    assert answer["named"] == []
    assert not answer["gap"]["detected"]


def test_larger_wheels_are_an_effect_with_its_size(wide: Diagnosis) -> None:
    answer = checked(wide)
    assert answer["verdict"] in ("effect", "ambiguous")
    assert answer["named"] == ["wheel_radius"]
    assert not answer["gap"]["uncalibrated"]
    number = answer["causes"][0]["parameters"]["wheel_radius/scale"]
    assert number["value"] == pytest.approx(0.03, abs=0.004)
    assert {c["effect"] for c in answer["causes"]} == set(effect_names())


def test_the_gap_shrinks_on_runs_left_out(wide: Diagnosis) -> None:
    s = wide.to_json()["shrink"]
    assert s["after"] < s["before"]
    assert s["after"] < 1.2 * s["floor"]
    assert s["recalibration_only"] > s["after"]
    assert set(s["per_channel"]) >= {"gnss_position", "yaw_rate", "wheel_left"}


def test_the_map_names_a_cell_of_the_gap(wide: Diagnosis) -> None:
    cells = wide.to_json()["where"]
    assert cells[0]["p_value"] <= 0.05
    assert sum(c["share"] for c in cells) == pytest.approx(1.0, abs=1e-6)


def test_softer_bearing_is_a_parameter(references: list[Recording]) -> None:
    answer = checked(diagnose(runs(400, 2, {"soil_strength/bearing": 0.9}), references, VEHICLE))
    assert answer["verdict"] == "parameters"
    assert answer["named"] == ["soil_strength"]


def test_encoder_scale_and_lost_counts_cannot_be_told_apart(references: list[Recording]) -> None:
    answer = checked(diagnose(runs(500, 2, {"encoder_dropout/share": 0.04}), references, VEHICLE))
    assert answer["verdict"] == "ambiguous"
    assert {"encoder_scale", "encoder_dropout"} <= set(answer["causes"][0]["class"])


def test_an_effect_outside_the_candidates_is_unknown(references: list[Recording]) -> None:
    known = [name for name in effect_names() if name not in ("backlash", "encoder_scale", "encoder_dropout")]
    odd = runs(600, 2, {"backlash/lost_motion": 0.05})
    answer = checked(diagnose(odd, references, VEHICLE, effects=known))
    assert answer["verdict"] == "unknown"
    assert answer["named"] == []
    assert answer["p_unknown"] > 0.4


def test_two_effects_are_both_named(references: list[Recording]) -> None:
    both = {"gyro_scale/scale": 0.06, "wheel_radius/scale": 0.04}
    answer = checked(diagnose(runs(700, 2, both), references, VEHICLE))
    assert set(answer["named"]) == {"gyro_scale", "wheel_radius"}


def test_a_commissioning_error_in_all_runs_is_no_gap() -> None:
    wrong = {"track_width/scale": 0.1, "gyro_scale/scale": 0.02}
    answer = checked(diagnose(runs(800, 2, wrong), runs(810, 10, wrong), VEHICLE))
    assert answer["verdict"] == "no_gap"


def test_without_references_it_answers_and_says_that_it_is_uncalibrated() -> None:
    answer = checked(diagnose(runs(300, 2, {"wheel_radius/scale": 0.03}), [], VEHICLE))
    assert answer["gap"]["uncalibrated"]
    assert answer["gap"]["detected"]
    assert answer["reference_runs"] == []
    assert "wheel_radius" in answer["causes"][0]["class"]


def test_the_same_input_gives_the_same_bits(references: list[Recording], wide: Diagnosis) -> None:
    again = diagnose(runs(300, 2, {"wheel_radius/scale": 0.03}), references, VEHICLE)
    assert json.dumps(again.to_json()) == json.dumps(wide.to_json())


def test_the_corrected_vehicle_has_the_larger_wheels(wide: Diagnosis, tmp_path: Path) -> None:
    target = tmp_path / "corrected.yaml"
    said = write_corrected(wide, "elevate", target)
    corrected = load_vehicle(target)
    shift = values_of(wide)["wheel_radius/scale"]
    assert corrected.wheel.radius_m == pytest.approx(VEHICLE.wheel.radius_m * (1.0 + shift))
    assert any("radius_m" in line for line in said)


def test_nonsense_is_refused(references: list[Recording]) -> None:
    with pytest.raises(DataError, match="no run"):
        diagnose([], references, VEHICLE)
    with pytest.raises(ConfigError, match="unknown effect"):
        diagnose(references[:1], references[1:], VEHICLE, effects=["wheels_fell_off"])
    with pytest.raises(ConfigError, match="significance"):
        diagnose(references[:1], references[1:], VEHICLE, significance=np.nan)
