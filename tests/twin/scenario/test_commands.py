"""Commands within the limit of acceleration: the fast way equals the plain rule to the bit."""

from __future__ import annotations

import dataclasses

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from terrafusion.twin.calibrate.inputs import DT_S, twin_input
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.commands import delayed_inputs, follow
from terrafusion.twin.simulate import simulate

SPEEDS = st.floats(-3.0, 3.0).map(lambda v: round(v, 2))


def plainly(goal: np.ndarray, step: float, start: float) -> np.ndarray:
    """One sample after the other."""
    now, out = start, []
    for target in goal.tolist():
        missing = target - now
        now = target if abs(missing) <= step else now + (step if missing > 0.0 else -step)
        out.append(now)
    return np.array(out)


@given(arrays(float, st.integers(0, 40), elements=SPEEDS), st.floats(0.001, 4.0), SPEEDS)
def test_following_a_goal(goal: np.ndarray, step: float, start: float) -> None:
    found = follow(goal, step, start)
    np.testing.assert_array_equal(found, plainly(goal, step, start))
    assert (np.abs(np.diff(found, prepend=start)) <= step * (1.0 + 1e-12) + 1e-15).all()


def test_a_step_is_a_ramp_that_ends_on_the_goal() -> None:
    np.testing.assert_allclose(follow(np.full(6, 1.0), 0.3, 0.0), [0.3, 0.6, 0.9, 1.0, 1.0, 1.0], atol=1e-15)


def test_a_command_that_is_not_late_is_the_limit_of_one_that_is_hardly_late() -> None:
    sides = np.random.default_rng(1).normal(size=(50, 2))
    prompt = delayed_inputs(sides, 0.01)
    np.testing.assert_array_equal(prompt[:, :2], sides)
    hardly = delayed_inputs(sides, 0.01, 1e-12)
    np.testing.assert_allclose(hardly[1:], prompt[1:], atol=1e-6)
    np.testing.assert_array_equal(prompt[0, 2:], 0.0)


@pytest.mark.parametrize("robot", ["elevate", "husky", "warthog"])
@pytest.mark.parametrize("drive", ["staircase", "demo"])
def test_a_log_drives_the_twin_as_the_robot_was_driven(robot: str, drive: str) -> None:
    """Whatever the limits of vehicle and scenario: up to the corners of ramps between samples."""
    vehicle = load_vehicle(robot)
    setup = set_up(drive, vehicle=vehicle, soils=None)
    given = twin_input(simulate(drive, vehicle=vehicle), vehicle, "command")
    late = setup.t_s - vehicle.drive.dead_time_s
    own = np.stack(
        [np.interp(late, DT_S * np.arange(len(given.sides)), side) for side in given.sides.T], axis=1
    )
    driven = setup.drive("auto").inputs[:, :2]
    assert np.sqrt(np.mean((own - driven) ** 2)) < 0.02  # rad/s


@pytest.mark.parametrize(("every", "noted"), [(1, False), (50, True)])
def test_commands_that_a_log_holds_seldom_are_noted(every: int, noted: bool) -> None:
    """Thinned, they drove the twin in steps that the robot was never commanded, without a word."""
    vehicle = load_vehicle("elevate")
    log = simulate("demo", vehicle=vehicle)
    assert log.command is not None
    some = {f.name: getattr(log.command, f.name)[::every] for f in dataclasses.fields(log.command)}
    found = twin_input(dataclasses.replace(log, command=type(log.command)(**some)), vehicle, "command")
    assert any("hold until the next" in note for note in found.notes) == noted
