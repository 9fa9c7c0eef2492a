"""A change of ground in an outage is seen a second late: the slip is opened where it happened."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimator import estimator
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import replay
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

IN_AND_OUT_OF_SAND = Scenario(
    "in and out of sand, uphill",
    60.0,
    drive=(DriveSegment(60.0, 1.0, 0.0),),
    route=(
        RouteLeg("asphalt", 25.0), RouteLeg("loose_sand", 18.0),
        RouteLeg("asphalt", 30.0), RouteLeg("loose_sand", 60.0),
    ),
    slope_deg=4.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def drives() -> list[Recording]:
    return [simulate(IN_AND_OUT_OF_SAND, seed=seed) for seed in (1, 2, 3)]


def errors_m(drives: list[Recording]) -> list[float]:
    runs = [replay(drive, mode="adaptive", outages=[Outage(20.0, 38.0)]) for drive in drives]
    return [run.scores.outages[0].median_m for run in runs]


def test_slip_opened_where_the_ground_changed_halves_the_error(
    drives: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = errors_m(drives)
    monkeypatch.setattr(estimator, "SWITCHED", 9.0)  # no change of ground is as large: never opened
    assert np.median(opened) < 0.5 * np.median(errors_m(drives))
