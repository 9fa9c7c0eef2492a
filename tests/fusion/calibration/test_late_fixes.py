"""Fixes that are late refute the wheels, as a slide does, and their delay is found all the same."""

from __future__ import annotations

import dataclasses

from terrafusion.fusion.replay import replay
from terrafusion.twin.simulate import simulate

LATE_S = 1.5


def test_the_delay_of_fixes_that_refute_the_wheels_is_found() -> None:
    log = simulate("figure_eight", terrain="asphalt", seed=2)
    assert log.gnss is not None
    late = dataclasses.replace(log.gnss, t_ns=log.gnss.t_ns + round(LATE_S * 1e9))
    result = replay(dataclasses.replace(log, gnss=late), mode="fixed")
    assert any("slid beside its wheels" in note for note in result.estimate.notes)
    delay = next(number for number in result.learned if number.state == "gnss_delay_s")
    assert delay.corrects
    assert abs(delay.value - LATE_S) < 2.0 * delay.sigma
