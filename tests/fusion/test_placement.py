"""GNSS that comes only after the start: the local path is laid onto the map."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.frames import wrap_angle
from terrafusion.datasets.recording import Fix, Recording
from terrafusion.fusion.config import EstimatorConfig
from terrafusion.fusion.estimate import State
from terrafusion.fusion.estimator import Estimator
from terrafusion.fusion.replay import Replay, replay
from terrafusion.twin.scenario import load_scenario
from terrafusion.twin.simulate import simulate
from terrafusion.twin.vehicle import load_vehicle

WITHOUT_S = 50.0


def drive(heading_deg: float, fix: Fix | None = None, terrain: str = "asphalt", seed: int = 100) -> Recording:
    """A figure of eight whose receiver finds itself after 50 s."""
    scenario = dataclasses.replace(load_scenario("figure_eight"), heading_deg=heading_deg, gnss_fix=fix)
    recording = simulate(scenario, terrain=terrain, seed=seed)
    assert recording.gnss is not None
    late = recording.gnss.t_ns > recording.start_ns + round(WITHOUT_S * 1e9)
    return dataclasses.replace(recording, gnss=recording.gnss.select(late))


def yaw_errors(result: Replay) -> np.ndarray:
    errors = result.scores.errors
    assert errors is not None
    return np.abs(wrap_angle(errors.estimate_yaw_rad - errors.reference_yaw_rad))


@pytest.mark.parametrize("heading_deg", [0.0, 137.0, -100.0])
@pytest.mark.parametrize("terrain", ["asphalt", "loose_sand"])
def test_the_path_lies_where_the_robot_was_whatever_its_heading(heading_deg: float, terrain: str) -> None:
    result = replay(drive(heading_deg, terrain=terrain))
    errors = result.scores.errors
    assert errors is not None
    status = result.estimate.status
    assert list(dict.fromkeys(status)) == ["no_gnss", "running"]
    told_s = (errors.t_ns[0] - result.recording.start_ns) * 1e-9
    assert WITHOUT_S < told_s < WITHOUT_S + 3.0  # five fixes of a moving robot
    assert len(errors.t_ns) == (status == "running").sum()
    assert np.nanmedian(errors.distance_m()) < 0.05
    assert np.degrees(np.median(yaw_errors(result))) < 1.0
    assert any("GNSS laid the path onto the map" in note for note in result.estimate.notes)
    assert any(
        "before GNSS laid the path onto the map are not scored" in note for note in result.scores.notes
    )


def test_with_stand_alone_fixes_it_waits_until_they_tell_the_heading() -> None:
    nees = []
    for seed in range(100, 104):
        result = replay(drive(60.0, Fix.SINGLE, seed=seed))
        errors = result.scores.errors
        assert errors is not None
        assert (errors.t_ns[0] - result.recording.start_ns) * 1e-9 > WITHOUT_S + 3.0
        assert np.nanmax(errors.distance_m()) < 6.0
        nees.append(np.nanmean(errors.nees()))
    assert np.mean(nees) / 2.0 < 1.5


def test_a_batch_knows_the_path_from_its_first_moment() -> None:
    result = replay(drive(137.0), batch=True)
    errors = result.scores.errors
    assert errors is not None
    assert "no_gnss" not in result.estimate.status
    assert (errors.t_ns[0] - result.recording.start_ns) * 1e-9 < 1.0
    assert np.nanmax(errors.distance_m()) < 0.3
    assert np.nanmean(errors.nees()) / 2.0 < 1.5


def test_what_lies_before_is_shown_where_it_was() -> None:
    """The local part, moved as the fixes told, meets the rest without a jump."""
    result = replay(drive(137.0))
    path = result.estimate.trajectory
    local = result.estimate.status == "no_gnss"
    truth = result.recording.truth
    assert truth is not None
    off = path.position_m[local, :2] - truth.positions_at(path.t_ns[local])[:, :2]
    assert np.linalg.norm(off, axis=1).max() < 0.5
    seam = np.linalg.norm(np.diff(path.position_m[:, :2], axis=0), axis=1)
    assert seam[np.flatnonzero(local)[-1]] < 0.3


def test_a_robot_that_hardly_moves_stays_local() -> None:
    recording = drive(30.0, Fix.SINGLE, "mud")
    truth, gnss = recording.truth, recording.gnss
    assert truth is not None
    assert gnss is not None
    assert np.ptp(truth.position_m[truth.t_ns > gnss.t_ns[0]], axis=0).max() < 1.0
    result = replay(recording)
    assert set(result.estimate.status) == {"no_gnss"}
    assert any("did not show the heading" in note for note in result.estimate.notes)


def test_an_estimator_restored_before_the_fixes_is_placed_with_the_same_bits() -> None:
    recording = drive(137.0)
    vehicle = load_vehicle("elevate")
    config = EstimatorConfig(vehicle.rig(), vehicle.name)
    imu, wheels, gnss = recording.imu, recording.wheels, recording.gnss
    assert imu is not None
    assert wheels is not None
    assert gnss is not None
    sides = wheels.side_speeds_mps(vehicle.wheel.radius_m)
    end = recording.start_ns + 55_000_000_000
    rows = sorted(
        (int(t), name, i)
        for name, channel in (("gnss", gnss), ("imu", imu), ("wheels", wheels))
        for i, t in enumerate(channel.t_ns)
        if t < end
    )

    def run(broken_at_s: float | None) -> list[State]:
        states: list[State] = []
        estimator = Estimator(config, on_state=states.append)
        for t_ns, name, i in rows:
            if broken_at_s is not None and (t_ns - recording.start_ns) * 1e-9 > broken_at_s:
                estimator, broken_at_s = (
                    Estimator.restore(config, estimator.dump(), on_state=states.append),
                    None,
                )
            if name == "imu":
                estimator.add_imu(t_ns, imu.gyro_radps[i], imu.accel_mps2[i])
            elif name == "wheels":
                estimator.add_wheels(t_ns, *sides[i].tolist())
            else:
                estimator.add_gnss(t_ns, gnss.enu_m[i], gnss.sigma_enu_m[i], fix=int(gnss.fix[i]))
        assert estimator.gnss.placed is not None
        return states

    whole, broken = run(None), run(50.3)
    assert len(whole) == len(broken)
    for a, b in zip(whole, broken, strict=True):
        assert (a.position_m == b.position_m).all()
        assert (a.covariance == b.covariance).all()
