"""Effects that look alike, and one on top of another of the same kind, through the whole diagnosis."""

from __future__ import annotations

import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.reports.gap_text import answer as screen
from terrafusion.twin.gap.diagnose import diagnose
from tests.twin.gap.runs import runs
from tests.twin.gap.test_diagnose import VEHICLE, checked

pytestmark = pytest.mark.usefixtures("fitted_once")

DRAG = {"motion_resistance", "drivetrain_friction", "mud_adhesion"}


@pytest.fixture(scope="module")
def references() -> list[Recording]:
    return runs(100, 6)


@pytest.mark.parametrize(
    "effect",
    [
        {"motion_resistance/in_motion": 0.05},
        {"drivetrain_friction/coulomb": 0.6},
        {"mud_adhesion/suction": 2000.0},
    ],
)
def test_rolling_resistance_dry_friction_and_suction_are_one_set(
    references: list[Recording], effect: dict[str, float]
) -> None:
    """Their signatures correlate by 0.97 to 0.999; what remains is about as much as a law is wrong."""
    found = diagnose(runs(900, 2, effect), references, VEHICLE)
    answer = checked(found)
    assert answer["verdict"] == "ambiguous"
    assert len(answer["named"]) == 1
    first, *others = answer["sets"]
    assert DRAG <= set(first["effects"]) <= {*DRAG, "mass"}  # a load adds to the drag
    assert first["probability"] > 0.7
    assert all(len(s["effects"]) <= 4 for s in others)
    assert "which these drives cannot tell apart" in " ".join(" ".join(screen(found)).split())


@pytest.mark.parametrize(
    ("effect", "alike"),
    [
        ({"wheel_radius_asymmetry/right": -0.05}, "encoder_scale"),
        ({"torque_limit/weak_left": 0.3}, "cg_lateral"),
    ],
)
def test_a_change_of_one_side_is_one_cause_with_its_size(
    references: list[Recording], effect: dict[str, float], alike: str
) -> None:
    """Before there were laws of one side, it was a pair of effects, or a centre of gravity for certain."""
    found = diagnose(runs(900, 2, effect), references, VEHICLE)
    answer = checked(found)
    ((key, value),) = effect.items()
    name = key.split("/")[0]
    assert len(answer["named"]) == 1
    assert name in answer["sets"][0]["effects"]
    assert {*answer["sets"][0]["effects"]} <= {name, alike}
    (cause,) = (c for c in answer["causes"] if c["effect"] == name)
    number = cause["parameters"][key]
    assert abs(number["value"] - value) < 2.0 * number["sigma"] < 0.8 * abs(value)


def test_sigma_covers_a_delay_on_top_of_one_that_references_have() -> None:
    """Their own delay is removed to first order only, so the further one comes out 8 ms too long."""
    late = {"imu_time_offset/shift": 0.05}
    found = diagnose(runs(900, 2, {"imu_time_offset/shift": 0.11}), runs(100, 8, late), VEHICLE)
    answer = checked(found)
    assert answer["named"] == ["imu_time_offset"]
    number = answer["causes"][0]["parameters"]["imu_time_offset/shift"]
    assert abs(number["value"] - 0.06) < 2.0 * number["sigma"] < 0.04
