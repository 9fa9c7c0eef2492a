"""How far antenna and delay of the fixes may be from those in use, by what a drive shows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.robot import ANTENNA_SIGMA_M
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    GNSS_DELAY,
    GNSS_DELAY_SIGMA_S,
    IMITATED,
    NUMBERS,
    Knowledge,
    assumed,
)
from terrafusion.fusion.calibration.place_belief import ON_TIME, PlaceBelief, late_probability

BEFORE = assumed(0.0, False, 0.05, 300.0, skids=True)
NONE, ALL = np.zeros(3, dtype=bool), np.ones(3, dtype=bool)


def shown(delay_s: float, sigma_s: float) -> Knowledge:
    """What is known after a drive that shows the delay."""
    mean, covariance = BEFORE.mean.copy(), BEFORE.covariance.copy()
    mean[GNSS_DELAY], covariance[GNSS_DELAY, GNSS_DELAY] = delay_s, sigma_s**2
    return dataclasses.replace(BEFORE, mean=mean, covariance=covariance)


def delay_sigma_s(known: Knowledge, used_s: float = 0.0, corrected: bool = False) -> float:
    """Root of the second moment of the delay's error."""
    belief = PlaceBelief.of(known, BEFORE, ALL if corrected else NONE)
    return float(np.sqrt(belief.moments(np.array([0.0, 0.0, used_s]))[2]))


def test_a_drive_that_shows_nothing_leaves_the_share_of_late_receivers() -> None:
    assert late_probability(0.0, GNSS_DELAY_SIGMA_S, GNSS_DELAY_SIGMA_S) == pytest.approx(1.0 - ON_TIME)


def test_fixes_that_the_drive_shows_on_time_are_hardly_doubted() -> None:
    assert delay_sigma_s(shown(0.01, 0.02)) < 0.01


def test_late_fixes_that_are_not_corrected_are_doubted_by_as_much() -> None:
    assert delay_sigma_s(shown(0.3, 0.05)) == pytest.approx(np.hypot(0.3, np.hypot(0.05, 0.03)), rel=0.01)


def test_a_delay_that_another_antenna_could_explain_counts_with_the_antenna_at_its_place() -> None:
    """At one speed both look alike: neither is clear, but together they are not as before."""
    known = shown(0.24, 0.19)
    covariance = known.covariance.copy()
    covariance[ANTENNA_X, ANTENNA_X] = 0.16**2
    covariance[ANTENNA_X, GNSS_DELAY] = covariance[GNSS_DELAY, ANTENNA_X] = 0.99 * 0.16 * 0.19
    mean = known.mean.copy()
    mean[ANTENNA_X] = -0.05
    known = dataclasses.replace(known, mean=mean, covariance=covariance)
    assert delay_sigma_s(known) > 0.25
    assert delay_sigma_s(shown(0.24, 0.19)) < 0.2


def test_a_corrected_number_has_its_stated_sigma_and_an_antenna_at_its_place_none() -> None:
    exact = dataclasses.replace(BEFORE, covariance=1e-12 * np.eye(len(NUMBERS)))
    imitated = IMITATED[[ANTENNA_X, ANTENNA_X, GNSS_DELAY]]
    corrected = PlaceBelief.of(exact, BEFORE, ALL).moments(np.zeros(3))
    assert np.sqrt(corrected) == pytest.approx(imitated, rel=1e-4)
    assert PlaceBelief.of(BEFORE, BEFORE, NONE).moments(np.zeros(3))[:2] == pytest.approx(0.0)


@pytest.mark.parametrize(("row", "number"), [(0, ANTENNA_X), (1, ANTENNA_Y)])
def test_an_assumed_antenna_that_the_drive_does_not_correct_may_be_where_the_drive_leaves_it(
    row: int, number: int
) -> None:
    """Anywhere on the robot before it drives; then off by what was found, and by what is left open."""
    used, known = np.zeros(3), shown(0.0, 0.02)
    known.mean[number], known.covariance[number, number] = 0.1, 0.05**2
    at_first = PlaceBelief.of(BEFORE, BEFORE, NONE, antenna_assumed=True).moments(used)
    later = PlaceBelief.of(known, BEFORE, NONE, antenna_assumed=True).moments(used)
    assert np.sqrt(at_first[row]) == pytest.approx(ANTENNA_SIGMA_M)
    assert later[row] == pytest.approx(0.1**2 + 0.05**2 + IMITATED[number] ** 2)
    assert later[2] == pytest.approx(PlaceBelief.of(known, BEFORE, NONE).moments(used)[2])


def test_what_was_in_use_before_a_correction_is_off_by_the_correction() -> None:
    known = shown(0.4, 1e-3)
    assert delay_sigma_s(known, 0.4, corrected=True) == pytest.approx(0.15, rel=0.01)
    assert delay_sigma_s(known, 0.0, corrected=True) == pytest.approx(np.hypot(0.4, 0.15), rel=0.01)


def test_slip_that_the_numbers_do_not_explain_imitates_them_in_proportion() -> None:
    known = dataclasses.replace(shown(0.4, 1e-3), misfit=4.0)
    assert delay_sigma_s(known, 0.4, corrected=True) == pytest.approx(0.3, rel=0.01)
