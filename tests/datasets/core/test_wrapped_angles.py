"""Encoder angles that start again after each turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.wrapped_angles import (
    TURN_RAD,
    TurnCounter,
    unwrapped,
    unwrapped_alone,
    unwrapped_beside_speeds,
)

STEPS = hnp.arrays(float, 200, elements=st.floats(-0.3 * TURN_RAD, 0.3 * TURN_RAD))


@given(STEPS, st.sampled_from([0.0, -np.pi, 1.3]))
def test_whole_turns_are_counted(steps: np.ndarray, start: float) -> None:
    """Whatever the wheel does, where steps are below a third of a turn; [0, 2 pi), +-pi or another turn."""
    true = start + np.concatenate([[0.5], 0.5 + np.cumsum(steps)])
    wrapped = (true - start) % TURN_RAD + start
    angle, note = unwrapped(wrapped[:, None], ("left",))
    assert angle is not None
    np.testing.assert_allclose(angle[:, 0] - angle[0, 0], true - true[0], atol=1e-9)
    assert bool(note) == bool((np.abs(np.diff(wrapped)) > np.pi).any())


@given(hnp.arrays(float, 50, elements=st.floats(-1e3, 1e3)))
def test_angles_beyond_one_turn_are_returned_as_they_are(angle: np.ndarray) -> None:
    both = np.stack([angle, np.linspace(0.0, 3.0, 50)], axis=1)
    if np.ptp(angle) > 1.001 * TURN_RAD:
        assert unwrapped(both, ("left", "right"))[0] is both


@pytest.mark.parametrize("range_rad", [7.3, 20.1, 411.8])
def test_a_counter_that_rolls_over_goes_on(range_rad: float) -> None:
    """16 bits of ticks are no whole number of turns; what is lost at the step is taken from beside it."""
    t = np.arange(0.0, 300.0, 0.05)
    true = np.cumsum(0.3 + 0.2 * np.sin(t / 5.0))
    counts = np.stack([true % range_rad, -true % range_rad, true], axis=1)
    angle, note = unwrapped(counts, ("left", "right", "third"))
    assert angle is not None
    rolled = (np.abs(np.diff(counts[:, 0])) > range_rad / 2.0).sum()
    for column, sense in ((0, 1.0), (1, -1.0)):
        moved = sense * (angle[:, column] - angle[0, column])
        np.testing.assert_allclose(moved, true - true[0], atol=2e-3 * rolled)
    assert angle[:, 2].tobytes() == true.tobytes()
    assert note.startswith("the counters of left, right roll over, or were reset")


@pytest.mark.parametrize("angle", [
    np.r_[np.linspace(0.0, 50.0, 99), 0.0, np.linspace(50.5, 99.0, 99)],
    np.r_[np.linspace(0.0, 20.0, 99), np.linspace(95.0, 99.0, 99)],
    np.r_[np.full(50, 0.0), 9.0, np.full(50, 0.0)],
    np.array([0.0, 2.0, 8.98846567e307]),
], ids=["an outlier", "a gap", "one jolt", "the largest numbers"])  # fmt: skip
def test_other_steps_are_no_counter_that_rolls_over(angle: np.ndarray) -> None:
    assert unwrapped(angle[:, None], ("left",))[1] == ""


def test_a_slow_log_of_less_than_a_turn_keeps_its_bits() -> None:
    angle = np.array([[0.0], [0.0], [2.5], [2.5], [5.0], [5.1]])
    assert unwrapped(angle, ("left",)) == (angle, "")


@given(STEPS)
def test_angles_that_arrive_one_by_one_are_counted_as_in_a_log(steps: np.ndarray) -> None:
    true = np.concatenate([[0.0], np.cumsum(steps)])
    wrapped = np.stack([true % TURN_RAD, true], axis=1)
    whole, _ = unwrapped(wrapped, ("left", "right"))
    assert whole is not None
    counter = TurnCounter()
    arrived = np.array([counter.counted(row, i * 10**9) for i, row in enumerate(wrapped)])
    np.testing.assert_array_equal(arrived[:, 0], whole[:, 0])
    if np.ptp(true) > 1.001 * TURN_RAD:
        np.testing.assert_array_equal(arrived[:, 1], true)


@pytest.mark.parametrize("least", [0.0, -4 * TURN_RAD])
def test_counters_that_arrive_one_by_one_roll_over_as_in_a_log(least: float) -> None:
    true = 3.0 + np.concatenate([np.linspace(0.0, 120.0, 600), np.linspace(120.0, -60.0, 900)])
    rolled = (true - least) % (8 * TURN_RAD) + least
    counter = TurnCounter()
    arrived = np.array([counter.counted(np.array([a]), i * 10**7)[0] for i, a in enumerate(rolled)])
    # Each roll takes the step before it for its own.
    np.testing.assert_allclose(np.diff(arrived), np.diff(true), atol=0.3)
    np.testing.assert_allclose(arrived - arrived[0], true - true[0], atol=1.0)


def test_missing_cells_stay_missing_and_the_other_wheel_keeps_its_bits() -> None:
    true = np.linspace(0.0, 40.0, 200)
    wrapped = np.stack([true % TURN_RAD, true], axis=1)
    wrapped[50:53, 0] = np.nan
    angle, note = unwrapped(wrapped, ("left", "right"))
    assert angle is not None
    assert note == "the angles of left start again after each turn; whole turns are counted"
    np.testing.assert_allclose(angle[:, 0], np.where(np.isnan(wrapped[:, 0]), np.nan, true))
    assert angle[:, 1].tobytes() == true.tobytes()


@pytest.mark.parametrize("turns", [0.35, 0.45, 0.6, 1.4])
def test_steps_above_a_third_of_a_turn_leave_the_way_open(turns: float) -> None:
    fast = np.arange(100)[:, None] * turns * TURN_RAD % TURN_RAD
    angle, note = unwrapped_beside_speeds(fast, ("left",))
    assert angle is None
    assert "more than a third of a turn" in note
    assert note.endswith("only the speeds are used")
    with pytest.raises(DataError, match="leave open how far it turned; log wheel speeds"):
        unwrapped_alone(fast, ("left",), "/joint_states")
