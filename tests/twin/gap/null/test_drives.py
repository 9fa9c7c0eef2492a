"""How far references cover the judged drives."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.gap.null.drives import coverage, overlap


def steady(speed: float, turn: float, seconds: float) -> np.ndarray:
    return np.tile([speed, turn], (round(seconds / DT_S), 1))


def test_the_same_drive_is_covered() -> None:
    drive = steady(0.8, 0.4, 20.0)
    found = coverage([drive], [drive, drive])
    assert found.covered == pytest.approx(1.0)
    assert found.missing == ()


def test_one_reference_covers_several_runs_of_its_own_drive() -> None:
    """It spends less than a second in each part, and less there than both runs together."""
    drive = np.concatenate([steady(0.3 * k, 0.0, 0.8) for k in range(1, 6)])
    assert coverage([drive, drive], [drive]).covered == pytest.approx(1.0)


def test_what_references_never_drove_is_named_with_its_time() -> None:
    judged = np.concatenate([steady(0.6, 0.0, 30.0), steady(1.2, -0.6, 10.0)])
    found = coverage([judged], [steady(0.6, 0.0, 60.0)])
    assert found.covered == pytest.approx(0.75, abs=0.03)
    assert found.missing[0].startswith("1.2 m/s, turning -0.6 rad/s, steady (10 s")


def test_half_the_speed_is_another_drive_for_a_slow_robot_too() -> None:
    """In cells as wide as for a fast one all its drives were alike, and limited no answer."""
    found = coverage([steady(0.2, 0.25, 20.0)], [steady(0.4, 0.4, 60.0)])
    assert found.covered == pytest.approx(0.0)
    assert found.limits()


def test_a_moment_does_not_cover() -> None:
    found = coverage([steady(0.9, 0.0, 10.0)], [steady(0.9, 0.0, 0.5)])
    assert found.covered == pytest.approx(0.0)


def test_drives_may_differ_from_the_references_as_these_do_among_themselves() -> None:
    """One of four references is unlike the others, and the judged drive is like that one."""

    def drive(*speeds_mps: float) -> np.ndarray:
        return np.concatenate([np.full((3000, 2), [v, 0.0]) for v in speeds_mps])

    usual, other = drive(0.6, 1.2), drive(1.2, 1.8)
    assert overlap([other], [usual, usual, usual, other]) == 1.0
    assert overlap([other], [usual] * 4) < 0.6


def test_overlap_is_beside_that_of_the_references_themselves() -> None:
    slow, fast = steady(0.3, 0.0, 20.0), steady(0.9, 0.0, 20.0)
    both = np.concatenate([slow, fast])
    assert overlap([both], [both, both, both]) == pytest.approx(1.0, abs=0.02)
    assert overlap([fast], [both, both, both]) == pytest.approx(0.5, abs=0.03)
    assert overlap([fast], [slow, slow, slow]) < 0.05
    mixed = [slow, fast, slow, fast]  # they differ among themselves
    assert overlap([fast], mixed) > overlap([fast], [both] * 4)
