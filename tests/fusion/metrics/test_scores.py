"""Scores on drives whose errors are known in closed form."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.estimate.antenna import AntennaPlaces
from terrafusion.fusion.metrics.error_series import Errors, align_start, travelled_m
from terrafusion.fusion.metrics.scores import (
    Outage,
    Scores,
    parse_outage,
    path_pairs,
    relative_error_m,
    score,
)


def without_truth(recording: Recording) -> Recording:
    return dataclasses.replace(recording, truth=None)


def turned(trajectory: Trajectory, angle_rad: float, shift_m: tuple[float, float]) -> Trajectory:
    """The whole trajectory moved by one rigid motion of the plane."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    yaw = trajectory.yaw_rad() + angle_rad
    zero = np.zeros(len(yaw))
    covariance = trajectory.covariance
    if covariance is not None:
        J = np.kron(np.eye(2), R)
        covariance = J @ covariance @ J.T
    return dataclasses.replace(
        trajectory,
        position_m=trajectory.position_m @ R.T + np.array([*shift_m, 0.0]),
        quaternion=rpy_to_quaternion(np.stack([zero, zero, yaw], axis=1)),
        covariance=covariance,
    )


def numbers(scores: Scores) -> list[float]:
    values = [scores.ate_m, scores.yaw_rmse_rad, scores.velocity_rmse_mps, scores.nees_mean]
    values += list(scores.rpe_percent.values())
    return [np.nan if v is None else v for v in values]


def test_a_perfect_estimate_scores_zero(drive):
    d = drive()
    s = score(d.estimate, d.recording)
    assert s.against == "truth"
    assert numbers(s) == pytest.approx([0.0] * 7, abs=1e-9)
    assert s.held_out is None


@given(st.floats(-50, 50), st.floats(-50, 50))
@settings(max_examples=15, deadline=None)
def test_a_constant_offset_is_the_ate_and_no_rpe(drive, east, north):
    d = drive(offset_m=(east, north))
    s = score(d.estimate, d.recording)
    assert s.ate_m == pytest.approx(np.hypot(east, north), abs=1e-9)
    assert s.rpe_percent["50"] == pytest.approx(0.0, abs=1e-6)
    assert s.nees_mean == pytest.approx((east**2 + north**2) / 0.1**2 / 2.0, abs=1e-6)


def test_a_scale_error_on_a_straight_line_is_the_rpe(drive):
    d = drive(turn_radps=0.0, drift_mps=0.02)
    s = score(d.estimate, d.recording)
    assert list(s.rpe_percent) == ["10", "50", "100"]
    assert list(s.rpe_percent.values()) == pytest.approx([2.0, 2.0, 2.0], rel=5e-3)


def test_a_yaw_drift_on_a_straight_line_is_the_rpe_and_the_yaw_rmse(drive):
    """Only the heading drifts, by `a` a second, and the positions stay true.

    So the relative position, seen from the drifted heading, is turned by it: |e| = 2 L sin(a t / 2).
    """
    rate = 0.001
    d = drive(turn_radps=0.0, yaw_drift_radps=rate)
    s = score(d.estimate, d.recording)
    t = np.arange(1201) * 0.1
    starts = t[t <= 120.0 - 50.0 + 1e-9]
    assert s.rpe_percent["50"] == pytest.approx(float((200.0 * np.sin(rate * starts / 2)).mean()), rel=2e-2)
    assert s.yaw_rmse_rad == pytest.approx(float(np.sqrt(np.mean((rate * t) ** 2))), rel=1e-6)


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
@settings(max_examples=10, deadline=None)
def test_a_constant_velocity_error_in_body_axes_is_the_velocity_rmse(drive, forward, left):
    d = drive()
    yaw = d.estimate.trajectory.yaw_rad()
    c, s = np.cos(yaw), np.sin(yaw)
    error = np.stack([c * forward - s * left, s * forward + c * left, np.zeros(len(yaw))], axis=1)
    wrong = dataclasses.replace(d.estimate, velocity_mps=d.estimate.velocity_mps + error)
    assert score(wrong, d.recording).velocity_rmse_mps == pytest.approx(np.hypot(forward, left), abs=1e-6)


def test_short_drives_have_no_long_rpe(drive):
    s = score(drive(seconds=30.0).estimate, drive(seconds=30.0).recording)
    assert s.rpe_percent["10"] is not None
    assert s.rpe_percent["50"] is None
    assert s.rpe_percent["100"] is None


def test_errors_drawn_from_the_covariance_are_consistent():
    """NEES of N independent 2-D samples: chi-square of 2 N degrees of freedom, over 2 N."""
    from scipy.stats import chi2

    n, rng = 4000, np.random.default_rng(7)
    A = rng.normal(size=(n, 2, 2))
    P = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(2)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(P), rng.normal(size=(n, 2)))
    nothing = np.full(n, np.nan)
    errors = Errors(np.arange(n), error, np.zeros((n, 2)), nothing, nothing, np.zeros((n, 2)), P, nothing)
    low, high = chi2.ppf([0.0005, 0.9995], 2 * n) / (2 * n)
    assert low < errors.nees().mean() < high
    expected = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error) / 2
    np.testing.assert_allclose(errors.nees(), expected, rtol=1e-9)


@given(st.floats(-3.1, 3.1), st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
@settings(max_examples=15, deadline=None)
def test_scores_do_not_depend_on_the_frame(drive, angle, east, north):
    d = drive(drift_mps=0.02, noise_m=0.05, yaw_drift_radps=5e-4)
    truth = turned(d.recording.truth, angle, (east, north))
    body = turned(d.estimate.trajectory, angle, (east, north))
    c, s = np.cos(angle), np.sin(angle)
    velocity = d.estimate.velocity_mps @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    moved = dataclasses.replace(d.estimate, trajectory=body, velocity_mps=velocity)
    before = score(d.estimate, d.recording, outages=[Outage(30, 40)])
    after = score(moved, dataclasses.replace(d.recording, truth=truth), outages=[Outage(30, 40)])
    assert numbers(after) == pytest.approx(numbers(before), rel=1e-6, abs=1e-9)
    assert after.outages[0].end_error_m == pytest.approx(before.outages[0].end_error_m, rel=1e-6)


@pytest.mark.parametrize("by", ["truth", "fixes"])
def test_drift_injected_in_an_outage_is_recovered_without_realignment(drive, by):
    d = drive(turn_radps=0.0, offset_m=(0.5, 0.0), drift_mps=0.03, drift_from_s=40.0)
    recording = d.recording if by == "truth" else without_truth(d.recording)
    outage = Outage(40.0, 50.0)
    held = d.fixes.select(outage.covers(d.fixes.t_ns, recording.start_ns))
    scored = score(d.estimate, recording, held_out=held, outages=[outage]).outages[0]
    last = 49.9 if by == "truth" else 49.0
    assert scored.end_error_m == pytest.approx(0.5 + 0.03 * last, abs=1e-6)
    assert scored.median_m == pytest.approx(0.5 + 0.03 * last / 2, abs=1e-6)
    assert scored.distance_m == pytest.approx(last, abs=0.11)
    assert scored.percent == pytest.approx(100 * (0.5 + 0.03 * last) / scored.distance_m, rel=1e-6)


OUTAGE = Outage(40.0, 50.0)
LAST_S = 49.9
"""From the start of the outage to its last sample at 10 Hz."""


def moved_by(d, shift_m, yaw_rad=0.0):
    """The drive with `shift_m` (N, 2) and `yaw_rad` (N,) added to the estimate; N keyframes."""
    path = d.estimate.trajectory
    zero = np.zeros(len(path))
    yaw = path.yaw_rad() + yaw_rad
    moved = dataclasses.replace(
        path,
        position_m=path.position_m + np.column_stack([shift_m, zero]),
        quaternion=rpy_to_quaternion(np.stack([zero, zero, yaw], axis=1)),
    )
    return dataclasses.replace(d.estimate, trajectory=moved)


def in_outage_s(d):
    """Seconds (N,) since the outage began, 0 before it and constant after it."""
    t_s = (d.estimate.trajectory.t_ns - d.recording.start_ns) * 1e-9
    return np.clip(t_s - OUTAGE.start_s, 0.0, OUTAGE.seconds)


def scored_outage(d, estimate):
    return score(estimate, d.recording, outages=[OUTAGE]).outages[0]


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.0, 0.3))
@settings(max_examples=15, deadline=None)
def test_a_constant_velocity_drift_in_an_outage_is_recovered(drive, east_mps, north_mps, turn):
    """Error v t: v T at the end, v T / 2 in the median, whatever the path."""
    d = drive(turn_radps=turn)
    t = in_outage_s(d)
    scored = scored_outage(d, moved_by(d, np.outer(t, [east_mps, north_mps])))
    speed = np.hypot(east_mps, north_mps)
    assert scored.end_error_m == pytest.approx(speed * LAST_S, abs=1e-6)
    assert scored.max_m == pytest.approx(speed * LAST_S, abs=1e-6)
    assert scored.median_m == pytest.approx(speed * LAST_S / 2, abs=1e-6)
    assert scored.end_yaw_error_rad == pytest.approx(0.0, abs=1e-9)
    assert scored.percent == pytest.approx(100.0 * speed * LAST_S / scored.distance_m, abs=1e-4)


@given(st.floats(-0.02, 0.02).filter(lambda w: abs(w) > 1e-4))
@settings(max_examples=15, deadline=None)
def test_a_heading_drift_in_an_outage_is_recovered(drive, rate):
    """Dead reckoning at v along a straight line whose heading drifts by w runs on a circle of radius v / w.

    e = v / w (sin wt - wt, 1 - cos wt), and the heading is wrong by w T at the end.
    """
    d = drive(turn_radps=0.0)
    angle = rate * in_outage_s(d)
    shift = np.stack([np.sin(angle) - angle, 1.0 - np.cos(angle)], axis=1) / rate
    scored = scored_outage(d, moved_by(d, shift, angle))
    a = rate * LAST_S
    assert scored.end_error_m == pytest.approx(np.hypot(np.sin(a) - a, 1 - np.cos(a)) / abs(rate), abs=1e-6)
    assert scored.end_yaw_error_rad == pytest.approx(abs(a), abs=1e-6)


def test_a_jump_in_an_outage_is_recovered(drive):
    """0.3 m, and 5 m from 30 s into the outage on: median before the jump, end and maximum after."""
    d = drive(offset_m=(0.3, 0.0))
    jump = np.outer(in_outage_s(d) >= 30.0, [-0.3 + 3.0, 4.0])
    scored = scored_outage(d, moved_by(d, jump))
    assert scored.end_error_m == pytest.approx(5.0, abs=1e-6)
    assert scored.max_m == pytest.approx(5.0, abs=1e-6)
    assert scored.median_m == pytest.approx(0.3, abs=1e-6)
    assert scored.nees_mean == pytest.approx((0.6 * 0.3**2 + 0.4 * 5.0**2) / 0.1**2 / 2.0, rel=1e-6)


def test_segments_are_never_realigned(drive):
    """An error and a wrong heading from before the outage count in full, and two outages do not heal it."""
    d = drive(turn_radps=0.0)
    t_s = (d.estimate.trajectory.t_ns - d.recording.start_ns) * 1e-9
    late = (t_s >= 10.0).astype(float)
    estimate = moved_by(d, np.outer(late, [0.0, 2.0]), 0.1 * late)
    scored = score(estimate, d.recording, outages=[Outage(20.0, 10.0), Outage(60.0, 10.0)]).outages
    for one in scored:
        assert one.end_error_m == pytest.approx(2.0, abs=1e-6)
        assert one.median_m == pytest.approx(2.0, abs=1e-6)
        assert one.end_yaw_error_rad == pytest.approx(0.1, abs=1e-9)


def test_an_outage_without_reference_is_not_scored(drive):
    d = drive()
    beyond = score(d.estimate, d.recording, outages=[Outage(500.0, 10.0)]).outages[0]
    assert (beyond.end_error_m, beyond.median_m, beyond.percent) == (None, None, None)
    inside = score(d.estimate, without_truth(d.recording), outages=[Outage(10.0, 20.0)]).outages[0]
    assert inside.end_error_m is None
    assert inside.distance_m == pytest.approx(19.9, abs=0.2)


def test_an_outage_whose_references_end_at_its_start_is_not_scored(drive):
    d = drive()
    truth = d.recording.truth
    until = truth.select((truth.t_ns - d.recording.start_ns) * 1e-9 < 41.0)
    log = dataclasses.replace(d.recording, truth=until)
    early, whole = score(d.estimate, log, outages=[Outage(40.0, 30.0), Outage(20.0, 21.0)]).outages
    assert (early.end_error_m, early.median_m, early.percent) == (None, None, None)
    assert early.distance_m > 0.0
    assert whole.end_error_m is not None


def test_held_out_fixes_are_compared_at_the_antenna(drive):
    d = drive(turn_radps=0.0)
    ahead = dataclasses.replace(d.fixes, enu_m=d.fixes.enu_m + np.array([0.4, 0.0, 0.0]))
    plain = score(d.estimate, without_truth(d.recording), held_out=ahead)
    assert plain.against == "gnss_held_out"
    assert any("noise of the fixes" in note for note in plain.notes)
    assert not any("noise of the fixes" in note for note in score(d.estimate, d.recording).notes)
    assert plain.held_out.median_m == pytest.approx(0.4)
    assert plain.held_out.fixes == len(ahead)
    assert plain.yaw_rmse_rad is None
    armed = score(d.estimate, without_truth(d.recording), held_out=ahead, antenna_m=(0.4, 0.0, 0.3))
    assert armed.held_out.p95_m == pytest.approx(0.0, abs=1e-9)


def test_an_antenna_learned_on_the_way_is_where_it_was_taken_to_be(drive):
    """Fixes of the second half lie 0.4 m ahead: so does the antenna, for the estimator, from then on."""
    d = drive(turn_radps=0.0)
    half = int(d.fixes.t_ns[len(d.fixes) // 2])
    ahead = np.outer(d.fixes.t_ns >= half, [0.4, 0.0, 0.0])
    moved = dataclasses.replace(d.fixes, enu_m=d.fixes.enu_m + ahead)
    places = AntennaPlaces.fixed((0.0, 0.0, 0.3)).then(half, (0.4, 0.0, 0.3))
    for antenna, expected in ((places, 0.0), ((0.4, 0.0, 0.3), 0.4)):
        s = score(d.estimate, without_truth(d.recording), held_out=moved, antenna_m=antenna)
        assert s.held_out.p95_m == pytest.approx(expected, abs=1e-9)


def test_late_fixes_are_compared_with_the_estimate_when_they_were_measured(drive):
    """At 1 m/s half a second is half a metre, unless the estimator has learned it."""
    d = drive(turn_radps=0.0)
    late_ns = 500_000_000
    late = dataclasses.replace(d.fixes, t_ns=d.fixes.t_ns + late_ns)
    plain = AntennaPlaces.fixed((0.0, 0.0, 0.3))
    learned = dataclasses.replace(plain, late_ns=(late_ns,))
    unknown, known = (
        score(d.estimate, without_truth(d.recording), held_out=late, antenna_m=places).held_out
        for places in (plain, learned)
    )
    assert unknown.median_m > 0.2
    assert known.p95_m == pytest.approx(0.0, abs=1e-9)


def test_truth_of_the_antenna_is_compared_at_the_antenna(drive):
    d = drive()
    lever = (0.3, -0.2, 0.35)
    antenna = d.recording.truth.points_at(d.recording.truth.t_ns, lever)
    truth = dataclasses.replace(d.recording.truth, position_m=antenna)
    recording = dataclasses.replace(
        d.recording, truth=truth, truth_frame="antenna", truth_channels=("position", "yaw")
    )
    s = score(d.estimate, recording, antenna_m=lever)
    assert s.ate_m == pytest.approx(0.0, abs=1e-3)
    assert s.velocity_rmse_mps is None


def test_channels_that_are_not_listed_as_true_are_not_scored(drive):
    d = drive()
    s = score(d.estimate, dataclasses.replace(d.recording, truth_channels=("position",)))
    assert s.ate_m is not None
    assert s.yaw_rmse_rad is None
    assert s.velocity_rmse_mps is None
    s = score(d.estimate, dataclasses.replace(d.recording, truth_channels=("yaw",)), held_out=d.fixes)
    assert s.against == "gnss_held_out"
    assert s.yaw_rmse_rad is not None


def test_nothing_to_score_against_gives_none(drive):
    d = drive()
    s = score(d.estimate, without_truth(d.recording))
    assert s.against is None
    assert np.isnan(numbers(s)).all()
    assert s.held_out is None


@pytest.mark.parametrize("channels", [("position", "yaw"), ("position",)])
def test_a_local_path_is_aligned_once_and_says_so(drive, channels):
    d = drive()
    local = dataclasses.replace(d.estimate, trajectory=turned(d.estimate.trajectory, 1.1, (40.0, -7.0)))
    recording = dataclasses.replace(d.recording, truth_channels=channels)
    assert score(local, recording).ate_m > 10.0
    s = score(local, recording, aligned=True)
    assert s.ate_m == pytest.approx(0.0, abs=1e-6)
    assert any("without GNSS the path is local" in note for note in s.notes)


def test_gaps_and_keyframes_without_a_pose_are_left_out_and_told(drive):
    d = drive(offset_m=(1.0, 0.0))
    t_s = (d.recording.truth.t_ns - d.recording.start_ns) * 1e-9
    truth = d.recording.truth.select((t_s < 20.0) | (t_s > 60.0))
    position = d.estimate.trajectory.position_m.copy()
    position[:3] = np.nan
    status = d.estimate.status.copy()
    status[3:10] = "aligning"
    path = dataclasses.replace(d.estimate.trajectory, position_m=position)
    estimate = dataclasses.replace(d.estimate, trajectory=path, status=status)
    s = score(estimate, dataclasses.replace(d.recording, truth=truth))
    assert s.ate_m == pytest.approx(1.0)
    assert len(s.errors.t_ns) == pytest.approx(1201 - 10 - 400, abs=3)
    assert sum("not scored" in note for note in s.notes) == 2


def test_noise_at_rest_is_not_travel():
    rng = np.random.default_rng(0)
    standing = rng.normal(size=(2000, 2)) * 0.01
    assert travelled_m(standing)[-1] < 0.2
    line = np.stack([np.linspace(0.0, 100.0, 5001), np.zeros(5001)], axis=1)
    assert travelled_m(line)[-1] == pytest.approx(100.0, abs=0.11)


@pytest.mark.parametrize(("text", "start", "seconds"), [("120:60", 120.0, 60.0), ("0:1.5", 0.0, 1.5)])
def test_outages_are_parsed(text, start, seconds):
    assert parse_outage(text) == Outage(start, seconds)


@pytest.mark.parametrize("text", ["", "120", "a:b", "-1:5", "5:0", "5:-1", "nan:5", "5:inf", "1:2:3", ":"])
def test_nonsense_outages_are_one_line_errors(text):
    with pytest.raises(TerrafusionError, match="is not an outage") as caught:
        parse_outage(text)
    assert "\n" not in str(caught.value)


def test_scoring_a_long_drive_is_quick(drive):
    """50 ms of processor time here; what else the machine does is not counted."""
    d = drive(seconds=400.0, truth_hz=100)
    spent = []
    for _ in range(5):
        begun = time.process_time()
        score(d.estimate, d.recording, held_out=d.fixes, outages=[Outage(100, 60)], antenna_m=(0.1, 0, 0.3))
        spent.append(time.process_time() - begun)
    assert min(spent) < 0.25


def test_pairs_without_a_reference_heading_are_compared_in_the_world(drive):
    errors = score((d := drive(drift_mps=0.02)).estimate, d.recording).errors
    first, last = path_pairs(errors, 10.0)
    blind = dataclasses.replace(errors, reference_yaw_rad=np.full(len(errors.t_ns), np.nan))
    moved = errors.position_error_m()[last] - errors.position_error_m()[first]
    np.testing.assert_allclose(relative_error_m(blind, first, last), np.hypot(*moved.T))
    nothing = np.zeros(0, dtype=int)
    assert len(relative_error_m(blind, nothing, nothing)) == 0


def test_travel_begins_where_the_position_is_first_known():
    unknown = [[np.nan, np.nan]]
    path = np.concatenate([unknown, [[1.0, 0.0], [3.0, 0.0]], unknown, [[3.0, 1.0]]])
    assert travelled_m(path).tolist() == [0.0, 0.0, 2.0, 2.0, 3.0]
    assert travelled_m(unknown).tolist() == [0.0]


def straight(heading: bool) -> Errors:
    """Four positions a metre apart along east, the first unknown; the estimate runs north from elsewhere."""
    x, n = np.arange(5.0), 5
    reference, estimate = np.stack([x, 0.0 * x], axis=1), np.stack([0.0 * x + 7.0, x + 3.0], axis=1)
    reference[0] = np.nan
    yaw = np.zeros(n) if heading else np.full(n, np.nan)
    return Errors(
        np.arange(n) * 10**9, estimate, reference, np.full(n, np.pi / 2.0), yaw, np.zeros((n, 2)),
        np.tile(np.diag([4.0, 1.0]), (n, 1, 1)), np.full(n, 0.1),
    )  # fmt: skip


@pytest.mark.parametrize("heading", [True, False])
def test_a_start_is_aligned_by_its_heading_or_by_least_squares(heading):
    moved, how = align_start(straight(heading))
    assert moved.position_error_m()[1:] == pytest.approx(np.zeros((4, 2)), abs=1e-9)
    assert moved.estimate_yaw_rad == pytest.approx(np.zeros(5), abs=1e-9)
    np.testing.assert_allclose(moved.covariance_m2[1], np.diag([1.0, 4.0]), atol=1e-9)
    assert np.isfinite(moved.velocity_error_mps).all() == heading  # of fixes: east-north of another frame
    said = "its first position and the mean heading over its first metre"
    assert how == (said if heading else "a least-squares fit over the first 3.0 m")


@pytest.mark.parametrize(("step_m", "turned"), [(0.45, True), (0.3, False)])
def test_a_path_of_less_than_a_metre_has_no_direction(step_m, turned):
    errors = straight(heading=False)
    north_east = errors.reference_m[:, :1] * np.sqrt([0.5, 0.5])
    short = dataclasses.replace(
        errors, estimate_m=step_m * errors.estimate_m, reference_m=step_m * north_east
    )
    moved, _ = align_start(short)
    yaw = moved.estimate_yaw_rad - errors.estimate_yaw_rad
    assert yaw == pytest.approx(np.full(5, -np.pi / 4.0 if turned else 0.0), abs=1e-9)


def test_a_heading_that_drifts_after_the_first_metre_turns_nothing():
    errors = straight(heading=True)
    yaw = errors.estimate_yaw_rad + 0.5 * (np.arange(5) > 2)  # more than a metre on
    moved, _ = align_start(dataclasses.replace(errors, estimate_yaw_rad=yaw))
    assert moved.estimate_yaw_rad == pytest.approx([0.0, 0.0, 0.0, 0.5, 0.5], abs=1e-9)
