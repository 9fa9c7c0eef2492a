"""What self-calibration has learned, in the result, the metrics and on the screen."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.cli.replay import summary
from terrafusion.fusion.outputs.replay_files import metrics_of
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.simulate import simulate

AHEAD_M = 0.6


@pytest.fixture(scope="module")
def moved() -> ReplayResult:
    """A drive whose antenna sits further ahead than the vehicle file says."""
    drive = simulate("figure_eight", terrain="asphalt", seed=5)
    return replay(with_antenna_ahead(drive), mode="fixed")


def with_antenna_ahead(drive: Recording) -> Recording:
    assert drive.gnss is not None
    assert drive.truth is not None
    yaw = np.interp(drive.gnss.t_ns, drive.truth.t_ns, np.unwrap(drive.truth.yaw_rad()))
    off = AHEAD_M * np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=1)
    return dataclasses.replace(drive, gnss=dataclasses.replace(drive.gnss, enu_m=drive.gnss.enu_m + off))


def test_a_moved_antenna_is_among_the_learned_numbers(moved: ReplayResult) -> None:
    found = {number.state: number for number in moved.learned}
    antenna = found["antenna_x_m"]
    assert antenna.corrects
    assert antenna.value == pytest.approx(AHEAD_M, abs=4.0 * antenna.sigma)
    assert antenna.sigma < 0.5 * antenna.prior_sigma
    assert not found["turn_scale"].corrects


def test_metrics_and_screen_tell_the_correction(moved: ReplayResult) -> None:
    rows = {row["state"]: row for row in metrics_of(moved)["calibration"]}
    assert rows["antenna_x_m"]["corrects"]
    assert rows["antenna_x_m"]["observed"]
    told = [line for line in summary(moved) if line.startswith("self-calibration corrects")]
    assert any("antenna, further forward" in line for line in told)


def test_without_self_calibration_nothing_is_told() -> None:
    drive = until(simulate("straight", terrain="asphalt", seed=3), 20.0)
    run = replay(drive, settings={"self_calibrate": False})
    assert run.learned == ()
    assert metrics_of(run)["calibration"] == []
