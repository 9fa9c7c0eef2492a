"""Sigmas of fixes whose receiver reports none."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.sensors import with_assumed_sigma
from terrafusion.twin.model.vehicle import load_vehicle


def horizontal_m(
    classes: list[Fix], every: list[Fix] | None = None, vehicle: str = "elevate"
) -> tuple[list[float], str]:
    """Horizontal sigmas without any reported, and the note; the receiver of 'elevate' has 0.02 m."""
    fix = np.array(classes, dtype=np.uint8)
    of_log = None if every is None else np.array(every, dtype=np.uint8)
    rig = load_vehicle(vehicle).rig()
    sigma, notes = with_assumed_sigma(rig, np.full((len(fix), 3), np.nan), fix, of_log)
    assert (sigma[:, 2] > sigma[:, 0]).all()
    return sigma[:, 0].tolist(), notes[0]


def test_the_sigma_of_the_vehicle_is_that_of_its_best_fixes() -> None:
    """A stand-alone fix between RTK ones is no fix of 2 cm."""
    sigma, note = horizontal_m([Fix.FIXED, Fix.FLOAT, Fix.SINGLE])
    assert sigma == pytest.approx([0.02, 0.5, 3.0])
    assert "the vehicle's receiver, 0.02 m flat, and by class: single 3 m, float 0.5 m" in note


def test_fixes_of_one_class_are_those_of_the_vehicle() -> None:
    sigma, note = horizontal_m([Fix.SINGLE, Fix.SINGLE])
    assert sigma == pytest.approx([0.02, 0.02])
    assert note.endswith("the vehicle's receiver, 0.02 m flat")


def test_better_fixes_with_a_sigma_of_their_own_count_too() -> None:
    sigma, _ = horizontal_m([Fix.SINGLE], every=[Fix.FIXED, Fix.SINGLE])
    assert sigma == pytest.approx([3.0])


def test_fixes_better_than_the_receiver_have_the_sigma_of_their_class() -> None:
    """A vehicle file that extends 'generic' says 1.5 m, of a stand-alone receiver; the log has RTK."""
    sigma, note = horizontal_m([Fix.FIXED, Fix.SINGLE], vehicle="generic")
    assert sigma == pytest.approx([0.02, 3.0])
    assert note.endswith("taken from their class (assumed, flat): single 3 m, fixed 0.02 m")
    assert horizontal_m([Fix.SINGLE], vehicle="generic")[0] == pytest.approx([1.5])
