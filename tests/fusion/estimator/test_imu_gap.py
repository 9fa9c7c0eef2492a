"""A gap of the IMU while the wheels go on: they carry the robot, and its yaw is as sure as their turns."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Wheels
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.vehicle import load_vehicle, with_overrides
from terrafusion.twin.simulate import simulate

BEGIN_S, SECONDS = 40.0, 15.0


def with_gap(run: Recording) -> Recording:
    """The run without its IMU for some seconds."""
    assert run.imu is not None
    t_s = (run.imu.t_ns - run.start_ns) * 1e-9
    there = (t_s < BEGIN_S) | (t_s > BEGIN_S + SECONDS)
    return dataclasses.replace(run, imu=run.imu.select(there))


def nees(result: ReplayResult) -> dict[str, float]:
    """Mean per dimension over the whole run, by quantity."""
    return {one.quantity: one.mean for one in result.scores.consistency if one.terrain == "all"}


@pytest.mark.parametrize("terrain", ["grass", "medium_sand"])
@pytest.mark.parametrize("fixes", [True, False])
def test_wheels_carry_the_robot_through_a_gap_of_the_imu(terrain: str, fixes: bool) -> None:
    run = until(with_gap(simulate("figure_eight", vehicle="elevate", terrain=terrain, seed=1)), 75.0)
    outages = [] if fixes else [Outage(BEGIN_S, SECONDS + 5.0)]
    result = replay(run, mode="fixed", outages=outages)
    assert not any("heading was wrong" in note for note in result.estimate.notes)
    assert nees(result)["position"] < 2.0
    assert nees(result)["heading"] < 2.0
    path = result.estimate.trajectory
    end = int(np.searchsorted(path.t_ns, run.start_ns + round((BEGIN_S + SECONDS) * 1e9))) - 1
    assert path.covariance is not None
    sigma_rad = float(np.sqrt(path.covariance[end, 5, 5]))
    assert 0.02 < sigma_rad < (0.1 if fixes else 0.6)


def test_wheels_that_do_not_skid_turn_the_robot_by_what_they_say() -> None:
    """Of a differential drive: those of a robot that skids say twice as much."""
    vehicle = with_overrides(load_vehicle("elevate"), Overrides(drive="differential"))
    drive = until(simulate("figure_eight", vehicle="elevate", terrain="asphalt", seed=1), 62.0)
    run, rig = with_gap(drive), vehicle.rig()
    assert run.truth is not None
    assert run.truth.twist_body is not None
    u, r = run.truth.twist_body[:, 0], run.truth.twist_body[:, -1]
    sides = np.stack([u - 0.5 * rig.track_m * r, u + 0.5 * rig.track_m * r], axis=1) / rig.wheel_radius_m
    run = dataclasses.replace(run, wheels=Wheels(run.truth.t_ns, sides, ("left", "right"), "radps"))
    result = replay(run, vehicle=vehicle, mode="fixed", outages=[Outage(BEGIN_S, SECONDS + 5.0)])
    path, end_ns = result.estimate.trajectory, run.start_ns + round((BEGIN_S + SECONDS) * 1e9)
    end = int(np.searchsorted(path.t_ns, end_ns)) - 1
    true_rad = np.interp(path.t_ns[end], run.truth.t_ns, np.unwrap(run.truth.yaw_rad()))
    assert abs(np.angle(np.exp(1j * (path.yaw_rad()[end] - true_rad)))) < 0.1
