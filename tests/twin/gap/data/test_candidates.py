"""Typical sizes and ranges of candidates."""

from __future__ import annotations

import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.effects.catalogue import checked
from terrafusion.twin.effects.form import NOMINAL_KG, NOMINAL_RADIUS_M
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.model.vehicle import load_vehicle

DRY = "drivetrain_friction/dry"
GROWING = {DRY, "drivetrain_friction/coulomb"}


def most(vehicle: str) -> float:
    """Greatest dry friction that is sought on a vehicle, N m."""
    found = Candidates.of().sized_for(load_vehicle(vehicle))
    return float(found.high[found.keys.index(DRY)])


def test_the_nominal_robot_is_that_of_the_catalogue() -> None:
    elevate = load_vehicle("elevate")
    assert (elevate.body.mass_kg, elevate.wheel.radius_m) == (NOMINAL_KG, NOMINAL_RADIUS_M)


@pytest.mark.parametrize("vehicle", ["elevate", "husky", "warthog"])
def test_dry_friction_is_sought_up_to_half_the_load_of_a_wheel_at_its_radius(vehicle: str) -> None:
    robot = load_vehicle(vehicle)
    load_nm = 0.25 * robot.body.mass_kg * 9.81 * robot.wheel.radius_m
    assert most(vehicle) == pytest.approx(0.5 * load_nm, rel=0.03)
    assert checked({DRY: most(vehicle)})  # such a run can be made


def test_only_what_grows_with_the_robot_is_resized() -> None:
    plain, sized = Candidates.of(), Candidates.of().sized_for(load_vehicle("warthog"))
    other = [i for i, key in enumerate(plain.keys) if key not in GROWING]
    for name in ("scale", "low", "high"):
        assert (getattr(plain, name)[other] == getattr(sized, name)[other]).all()
    assert plain.scale[plain.keys.index(DRY)] < sized.scale[plain.keys.index(DRY)]


def test_a_friction_that_no_robot_has_is_refused() -> None:
    with pytest.raises(ConfigError, match="give 0 to 280 N m"):
        checked({DRY: 1000.0})
