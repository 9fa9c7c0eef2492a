"""The vehicle of a recording: by name, file, object, by the log, or generic with the log's geometry."""

from __future__ import annotations

import dataclasses

import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.twin.model.choose import choose_vehicle
from terrafusion.twin.model.vehicle import load_vehicle

NAMELESS = Recording("run", 0)


def test_a_name_and_the_vehicle_itself_are_the_same() -> None:
    husky = load_vehicle("husky")
    assert choose_vehicle(NAMELESS, "husky") == choose_vehicle(NAMELESS, husky) == (husky, ())


def test_the_log_names_the_vehicle_unless_another_is_asked_for() -> None:
    named = dataclasses.replace(NAMELESS, vehicle="husky")
    assert choose_vehicle(named)[0].name == "husky"
    assert choose_vehicle(named, "warthog")[0].name == "warthog"


def test_without_a_name_the_geometry_of_the_log_is_needed() -> None:
    with pytest.raises(DataError, match="names no vehicle"):
        choose_vehicle(NAMELESS)
    known = dataclasses.replace(NAMELESS, overrides=Overrides(wheel_radius_m=0.2, track_m=0.6))
    vehicle, notes = choose_vehicle(known)
    assert vehicle.rig().track_m == 0.6
    assert "a generic one is used" in notes[-1]
