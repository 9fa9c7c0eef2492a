"""The twin that drives what `next_run` tries."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from terrafusion.twin.gap.answer import next_run
from terrafusion.twin.gap.answer.next_run import LIFTED, PAYLOAD, PAYLOAD_SHARE
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import VEHICLE_PARAMETERS
from tests.twin.gap.runs import run


def test_a_payload_has_a_moment_of_inertia() -> None:
    """It spreads as the robot does; on a stand the wheels carry neither."""
    (log,), model, _ = prepared([run(1)], load_vehicle("elevate"), None)
    evidence: Any = SimpleNamespace(
        runs=[SimpleNamespace(log=log)], model=model, candidates=Candidates.of(["mass"])
    )
    names = ("speed staircase", "speed staircase" + PAYLOAD, LIFTED)
    seen = [next_run.course_of(evidence, name, {"mass"}).model for name in names]
    of = [m.vehicle_vector() for m in seen]
    for name in ("mass_kg", "yaw_inertia_kgm2"):
        at = VEHICLE_PARAMETERS.index(name)
        assert of[1][at] == pytest.approx((1.0 + PAYLOAD_SHARE) * of[0][at])
    assert of[2][VEHICLE_PARAMETERS.index("mass_kg")] == next_run.STAND_MASS_KG


def test_a_proposed_drive_says_what_to_command_no_faster_than_the_robot_goes() -> None:
    """A name alone, such as "speed staircase", can be driven by no one."""
    drives = next_run.drives()
    steps = "5 s at 0.3 m/s; 5 s at 0.6 m/s; 5 s at 0.9 m/s; 5 s at 1 m/s; 5 s at 1 m/s"
    assert next_run.in_words(drives["speed staircase"], 1.0) == steps
    turns = "14 s at 0.8 m/s, 0.45 rad/s; 14 s at 0.8 m/s, -0.45 rad/s"
    assert next_run.in_words(drives["figure of eight"], 2.0) == turns
    chirp = next_run.in_words(drives["chirp, 0.2 to 3 Hz"], 2.0)
    assert chirp.startswith("13 s at 0.8 +- 0.3 m/s, 0.2 to 3 Hz; ")
