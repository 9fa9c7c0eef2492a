"""GNSS that comes only after the start: the local path is laid onto the map."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.frames import wrap_angle
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate
from tests.fusion.metrics.test_aided_drives import aided

WITHOUT_S = 50.0


def drive(
    heading_deg: float,
    fix: Fix | None = None,
    terrain: str = "asphalt",
    seed: int = 100,
    end_s: float = 75.0,
) -> Recording:
    """A figure of eight whose receiver finds itself after 50 s, cut off after `end_s`."""
    scenario = dataclasses.replace(load_scenario("figure_eight"), heading_deg=heading_deg, gnss_fix=fix)
    recording = simulate(scenario, terrain=terrain, seed=seed)
    assert recording.gnss is not None
    late = recording.gnss.t_ns > recording.start_ns + round(WITHOUT_S * 1e9)
    return until(dataclasses.replace(recording, gnss=recording.gnss.select(late)), end_s)


@functools.cache
def replayed(heading_deg: float, terrain: str = "asphalt") -> ReplayResult:
    """Several tests look at the same replay."""
    return replay(drive(heading_deg, terrain=terrain))


UP_M, END_S = 30.0, 85.0


def aided_drive(heading_deg: float, until_s: float) -> Recording:
    """The same with barometer and magnetometer, 30 m above the local frame; no fixes after `until_s`."""
    scenario = dataclasses.replace(load_scenario("figure_eight"), heading_deg=heading_deg)
    recording = simulate(scenario, terrain="asphalt", vehicle=aided("elevate"), seed=100)
    gnss = recording.gnss
    assert gnss is not None
    t_s = (gnss.t_ns - recording.start_ns) * 1e-9
    lifted = dataclasses.replace(gnss, enu_m=gnss.enu_m + np.array([0.0, 0.0, UP_M]))
    return until(
        dataclasses.replace(recording, gnss=lifted.select((t_s > WITHOUT_S) & (t_s < until_s))), END_S
    )


def yaw_errors(result: ReplayResult) -> np.ndarray:
    errors = result.scores.errors
    assert errors is not None
    return np.abs(wrap_angle(errors.estimate_yaw_rad - errors.reference_yaw_rad))


@pytest.mark.parametrize(
    ("heading_deg", "terrain"),
    [(0.0, "asphalt"), (137.0, "asphalt"), (-100.0, "loose_sand"), (137.0, "loose_sand")],
)
def test_the_path_lies_where_the_robot_was_whatever_its_heading(heading_deg: float, terrain: str) -> None:
    result = replayed(heading_deg, terrain)
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


@pytest.mark.parametrize(("heading_deg", "until_s"), [(137.0, 65.0), (-100.0, 1e9)])
def test_compass_and_barometer_follow_onto_the_map(heading_deg: float, until_s: float) -> None:
    """What they told in the local frame is left there: heading and height are the map's from the first
    moment, and what they tell from then on agrees with it, also once the fixes are gone again."""
    result = replay(aided_drive(heading_deg, until_s), magnetometer=True)
    estimate, path = result.estimate, result.estimate.trajectory
    placed = estimate.status != "no_gnss"
    assert 0 < placed.sum() < len(placed)
    truth = result.recording.truth
    assert truth is not None
    rows = np.searchsorted(truth.t_ns, path.t_ns).clip(0, len(truth) - 1)
    off = np.abs(np.degrees(wrap_angle(path.yaw_rad() - truth.yaw_rad()[rows])))[placed]
    assert off[0] < 3.0
    assert off.max() < 4.0
    assert np.abs(path.position_m[placed, 2] - UP_M).max() < 1.5
    (note,) = [note for note in estimate.notes if note.startswith("magnetometer")]
    used, refused = (int(word) for word in note.replace(",", "").split() if word.isdigit())
    assert used > 0.9 * (path.t_ns[-1] - path.t_ns[0]) * 1e-9, "those of the wait for fixes, too"
    assert refused == 0
    told = [i for i in estimate.innovations if i.sensor == "magnetometer"]
    after = [i for i in told if i.t_ns >= path.t_ns[placed][0]]
    assert max(abs(float(np.degrees(i.value[0]))) for i in after[1:]) < 15.0


def test_a_batch_of_them_is_on_the_map_from_its_first_moment() -> None:
    result = replay(aided_drive(137.0, 1e9), batch=True, magnetometer=True)
    assert np.degrees(np.nanmax(yaw_errors(result))) < 1.0
    assert np.abs(result.estimate.trajectory.position_m[:, 2] - UP_M).max() < 1.5


def test_with_stand_alone_fixes_it_waits_until_they_tell_the_heading() -> None:
    nees = []
    for seed in range(100, 104):
        result = replay(drive(60.0, Fix.SINGLE, seed=seed, end_s=106.0))
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
    result = replayed(137.0)
    path = result.estimate.trajectory
    local = result.estimate.status == "no_gnss"
    truth = result.recording.truth
    assert truth is not None
    off = path.position_m[local, :2] - truth.positions_at(path.t_ns[local])[:, :2]
    assert np.linalg.norm(off, axis=1).max() < 0.5
    seam = np.linalg.norm(np.diff(path.position_m[:, :2], axis=0), axis=1)
    assert seam[np.flatnonzero(local)[-1]] < 0.3


def test_a_robot_that_hardly_moves_stays_local() -> None:
    recording = drive(30.0, Fix.SINGLE, "mud", end_s=106.0)
    truth, gnss = recording.truth, recording.gnss
    assert truth is not None
    assert gnss is not None
    assert np.ptp(truth.position_m[truth.t_ns > gnss.t_ns[0]], axis=0).max() < 1.0
    result = replay(recording)
    assert set(result.estimate.status) == {"no_gnss"}
    assert any("did not show the heading" in note for note in result.estimate.notes)


def test_an_estimator_restored_before_the_fixes_is_aligned_with_the_same_bits() -> None:
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
        assert estimator.gnss.alignment is not None
        return states

    whole, broken = run(None), run(50.3)
    assert len(whole) == len(broken)
    for a, b in zip(whole, broken, strict=True):
        assert (a.position_m == b.position_m).all()
        assert (a.covariance == b.covariance).all()


def test_fixes_without_height_leave_height_and_horizontal_sigma_alone() -> None:
    """On a slope an unknown height would otherwise be an unknown place."""
    drive = simulate("figure_eight", terrain="asphalt", slope_deg=5.0, seed=100)
    gnss = drive.gnss
    assert gnss is not None
    flat = dataclasses.replace(gnss, enu_m=gnss.enu_m * [1.0, 1.0, np.nan])
    late = flat.select(gnss.t_ns > drive.start_ns + round(WITHOUT_S * 1e9))
    estimate = replay(until(dataclasses.replace(drive, gnss=late), 75.0)).estimate
    mapped = estimate.status != "no_gnss"
    covariance = estimate.trajectory.covariance
    assert covariance is not None
    assert np.sqrt(covariance[mapped][:, [0, 1], [0, 1]].max()) < 5.0
    assert np.abs(np.diff(estimate.trajectory.position_m[mapped, 2])).max() < 0.5
