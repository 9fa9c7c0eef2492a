"""A robot that stops on sand and drives on without fixes expects the slip that it had before."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import replay
from terrafusion.fusion.weighting.driven_slip import DrivenSlip
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

STOP_ON_SAND = Scenario(
    "a stop on sand",
    66.0,
    drive=(DriveSegment(3.0), DriveSegment(33.0, 1.0), DriveSegment(4.0), DriveSegment(26.0, 1.0)),
    max_accel_mps2=0.5,
    route=(RouteLeg("loose_sand"),),
)


def test_slip_after_a_stop_is_that_of_the_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loaded or empty, the robot slips otherwise than the policy's mean of both."""
    drives = [simulate(STOP_ON_SAND, payload_kg=load, seed=5) for load in (0.0, 30.0)]

    def end_m() -> float:
        runs = [replay(d, mode="adaptive", outages=[Outage(38.0, 27.0)], findings=()) for d in drives]
        return float(np.mean([run.scores.outages[0].end_error_m for run in runs]))

    own = end_m()
    monkeypatch.setattr(DrivenSlip, "add", lambda *_: None)
    assert own < 0.7 * end_m()
