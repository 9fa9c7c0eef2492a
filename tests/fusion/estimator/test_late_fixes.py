"""Fixes late by seconds refute the wheels as a slide does; the delay is learned all the same."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.replay import replay
from terrafusion.twin.simulate import simulate

LATE_S = 1.5


@pytest.fixture(scope="module")
def late() -> Recording:
    run = simulate("figure_eight", terrain="asphalt", seed=2)
    assert run.gnss is not None
    gnss = dataclasses.replace(run.gnss, t_ns=run.gnss.t_ns + int(LATE_S * 1e9))
    return dataclasses.replace(run, gnss=gnss)


def test_fixes_late_by_seconds_are_corrected_though_they_look_like_a_slide(late: Recording) -> None:
    found = replay(late, mode="fixed")
    delay = next(n for n in found.learned if n.state == "gnss_delay_s")
    assert any("the wheels skidded" in note for note in found.estimate.notes)
    assert delay.corrects
    assert abs(delay.value - LATE_S) < 2.0 * delay.sigma


def test_fixes_that_wait_are_corrected_with_those_to_come() -> None:
    """Else they move the place, in doubt since the correction, to where the robot was before."""
    gnss = Estimator.for_vehicle("husky").gnss
    fix = GnssFix(10**10, np.zeros(3), np.ones(3), Fix.SINGLE)
    gnss.queue(fix)
    gnss.correct(10**10, np.zeros(2), LATE_S)
    gnss.queue(dataclasses.replace(fix, enu_m=np.ones(3)))
    assert [waiting.t_ns for waiting in gnss.waiting] == [10**10 - int(LATE_S * 1e9)] * 2
    gnss.correct(10**10, np.zeros(2), 1.0)
    assert [waiting.t_ns for waiting in gnss.waiting] == [9 * 10**9] * 2
