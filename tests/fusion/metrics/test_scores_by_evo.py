"""Scores beside those of evo (Grupp 2017) on the same paths."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.metrics.scores import (
    path_pairs,
    relative_error_m,
    score,
)


def evo_poses(trajectory: Trajectory):
    """The trajectory as evo (Grupp 2017) has it; its licence keeps it out of the dependencies."""
    evo = pytest.importorskip("evo.core.trajectory")
    wxyz = np.roll(trajectory.quaternion, 1, axis=1)
    return evo.PoseTrajectory3D(trajectory.position_m, wxyz, (trajectory.t_ns - trajectory.t_ns[0]) * 1e-9)


def evo_case(drive):
    """Winding, noisy, drifting in position and heading; every step of the truth counts as travel (0.13 m)."""
    d = drive(
        speed_mps=1.3, offset_m=(0.3, -0.2), drift_mps=0.02, noise_m=0.05, yaw_drift_radps=1e-3, truth_hz=10
    )
    pair = evo_poses(d.recording.truth), evo_poses(d.estimate.trajectory)
    return score(d.estimate, d.recording), pair


def test_ate_and_yaw_agree_with_evo(drive):
    """evo's absolute pose error, nothing aligned: its translation, and its angle in the plane."""
    evo = pytest.importorskip("evo.core.metrics")
    s, pair = evo_case(drive)
    for relation, ours in (("translation_part", s.ate_m), ("rotation_angle_rad", s.yaw_rmse_rad)):
        ape = evo.APE(evo.PoseRelation[relation])
        ape.process_data(pair)
        assert ours == pytest.approx(ape.get_statistic(evo.StatisticsType.rmse), abs=1e-6)


@pytest.mark.parametrize("frames", [1, 10, 137])
def test_rpe_over_frames_agrees_with_evo(drive, frames):
    evo = pytest.importorskip("evo.core.metrics")
    s, pair = evo_case(drive)
    rpe = evo.RPE(evo.PoseRelation.translation_part, frames, evo.Unit.frames, all_pairs=True)
    rpe.process_data(pair)
    first = np.arange(len(s.errors.t_ns) - frames)
    np.testing.assert_allclose(relative_error_m(s.errors, first, first + frames), rpe.error, atol=1e-6)


@pytest.mark.parametrize("length", [10.0, 50.0, 100.0])
def test_rpe_over_a_path_length_agrees_with_evo(drive, length):
    """evo's consecutive pairs also end at the first pose at least a length away: they are among ours."""
    evo = pytest.importorskip("evo.core.metrics")
    s, pair = evo_case(drive)
    rpe = evo.RPE(evo.PoseRelation.translation_part, length, evo.Unit.meters, pairs_from_reference=True)
    rpe.process_data(pair)
    ends = [0, *rpe.delta_ids]
    first, last = path_pairs(s.errors, length)
    assert set(itertools.pairwise(ends)) <= set(zip(first.tolist(), last.tolist(), strict=True))
    ours = relative_error_m(s.errors, np.array(ends[:-1]), np.array(ends[1:]))
    np.testing.assert_allclose(ours, rpe.error, atol=1e-6)


@pytest.mark.parametrize("length", [10.0, 50.0])
def test_rpe_percent_is_evos_error_over_the_path_of_each_pair(drive, length):
    """All pairs of ours, each error by evo's formula, divided by the true path between the pair."""
    evo = pytest.importorskip("evo.core.metrics")
    s, (reference, estimate) = evo_case(drive)
    first, last = path_pairs(s.errors, length)
    path, theirs = s.errors.path_m(), []
    for i, j in zip(first.tolist(), last.tolist(), strict=True):
        Q, P = reference.poses_se3, estimate.poses_se3
        E = evo.RPE.rpe_base(Q[i], Q[j], P[i], P[j])
        theirs.append(100.0 * np.linalg.norm(E[:3, 3]) / (path[j] - path[i]))
    assert s.rpe_percent[f"{length:g}"] == pytest.approx(np.mean(theirs), abs=1e-6)


def test_without_a_true_heading_rpe_is_evos_difference_of_displacements(drive):
    """Displacements compared in the world frame: evo's formula where every pose has the same heading."""
    evo = pytest.importorskip("evo.core.metrics")
    d = drive(speed_mps=1.3, drift_mps=0.02, noise_m=0.05, yaw_drift_radps=1e-3, truth_hz=10)
    errors = score(d.estimate, dataclasses.replace(d.recording, truth_channels=("position",))).errors
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(errors.t_ns), 1))
    pair = tuple(
        evo_poses(dataclasses.replace(t, quaternion=level))
        for t in (d.recording.truth, d.estimate.trajectory)
    )
    rpe = evo.RPE(evo.PoseRelation.translation_part, 50, evo.Unit.frames, all_pairs=True)
    rpe.process_data(pair)
    first = np.arange(len(errors.t_ns) - 50)
    np.testing.assert_allclose(relative_error_m(errors, first, first + 50), rpe.error, atol=1e-6)
