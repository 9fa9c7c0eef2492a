"""The integrator's accuracy, as docs/explanation/twin.md quotes it."""

from __future__ import annotations

import pytest

from tests.studies import engine_accuracy as numerics


def test_half_the_step_is_nearer_to_the_reference() -> None:
    scenario, terrain = "figure_eight", "mud"
    whole, half = (numerics.position_error_m(scenario, terrain, n) for n in (3, 6))
    assert half < whole < 1e-3


@pytest.mark.parametrize("terrain", ["medium_sand", "mud"])
def test_a_parked_robot_creeps_less_than_a_tenth_of_a_millimetre_a_second(terrain: str) -> None:
    assert 0.0 < numerics.creep_mps(terrain) < 1e-4


def test_the_best_of_several_times_is_told() -> None:
    calls: list[int] = []
    assert numerics.best_of(3, lambda: calls.append(1)) >= 0.0
    assert len(calls) == 3
