"""Self-calibration while driving."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration import online
from terrafusion.fusion.calibration.motion import MotionSegment
from terrafusion.fusion.calibration.numbers import (
    COURSE_LAG,
    GNSS_DELAY,
    GYRO_BIAS,
    NUMBERS,
    SLIP_PER_GRADE,
    TURN_SCALE,
    Knowledge,
)
from terrafusion.fusion.calibration.online import MOST_NODES, SelfCalibration
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.twin.simulate import simulate
from tests.fusion.calibration.test_fit import NOISE, PRIOR, STEP_S, TRUE, figure


def driven(
    drive: MotionSegment,
    learning: SelfCalibration,
    begin_ns: int = 0,
    until: Callable[[], bool] = lambda: False,
) -> list[Knowledge]:
    """Gives a drive sample by sample; what was known after each step."""
    known, j, z, yaw = [], 0, 0j, 0.0
    for i, t_s in enumerate(drive.t_s):
        t_ns = begin_ns + round(t_s * 1e9)
        distance = float(drive.distance_m[i - 1]) if i else 0.0
        turn = float(drive.turn_rad[i - 1]) if i else 0.0
        yaw += turn
        z += distance * np.exp(1j * yaw)
        course = float(drive.course_rad[i - 1]) if i and drive.course_rad is not None else 0.0
        climb_m = float(drive.climb_m[i - 1]) if i and drive.climb_m is not None else 0.0
        grade = climb_m / abs(distance) if distance else 0.0
        learning.drive(t_ns, distance, turn, np.array([z.real, z.imag]), yaw, course, grade)
        while j < len(drive.fix) and drive.fix_t_s[j] <= t_s:
            fix = np.array([drive.fix[j].real, drive.fix[j].imag, 0.0])
            learning.fix(begin_ns + round(drive.fix_t_s[j] * 1e9), fix, float(drive.fix_sigma_m[j]))
            j += 1
        if learning.advance():
            known.append(learning.known)
        if until():
            break
    return known


def test_numbers_are_found_while_driving_and_their_sigmas_shrink() -> None:
    known = driven(figure(240.0, fix_sigma_m=0.05, slip=0.01), SelfCalibration(PRIOR, NOISE, 0j))
    found = [*range(6), SLIP_PER_GRADE]
    error = np.abs(known[-1].mean - TRUE)[found]
    assert (error < 4.0 * known[-1].sigma[found] + [2e-3, 2e-4, 3e-3, 0.02, 0.02, 0.02, 0.02]).all()
    assert (known[-1].sigma[found] < 0.4 * known[0].sigma[found]).all()


def test_wheels_that_are_steered_to_one_side_are_not_taken_for_a_wrong_antenna_or_delay() -> None:
    """Front and rear wheels turned alike: the robot moves aside, as it turns and changes its speed."""
    drive = figure(240.0, PRIOR.mean, fix_sigma_m=0.02, hill=0.0)
    course = 0.3 * np.sin(0.23 * drive.t_s[1:])
    yaw = np.cumsum(drive.turn_rad) - 0.5 * drive.turn_rad
    aside = np.cumsum(1j * np.tan(course) * drive.distance_m * np.exp(1j * yaw))
    moved = np.interp(drive.fix_t_s, drive.t_s[1:], aside.real) + 1j * np.interp(
        drive.fix_t_s, drive.t_s[1:], aside.imag
    )
    steered = dataclasses.replace(drive, fix=drive.fix + moved, course_rad=course)
    known = driven(steered, SelfCalibration(PRIOR, NOISE, 0j))[-1]
    assert (
        np.abs(known.mean) < 3.0 * known.sigma + [1e-3, 1e-4, 2e-3, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01]
    ).all()


def test_numbers_that_are_far_off_are_found_without_waiting_for_more_ground() -> None:
    """Fixes 1.5 s later than those of the drive, in 40 s; with a step every 4 s .25 s of them are left."""
    drive = figure(40.0, fix_sigma_m=0.03)
    drive = dataclasses.replace(drive, fix_t_s=drive.fix_t_s + 1.5)
    known = driven(drive, SelfCalibration(PRIOR, NOISE, 0j))[-1]
    assert abs(known.mean[GNSS_DELAY] - TRUE[GNSS_DELAY] - 1.5) < 0.1


def test_a_long_drive_is_cut_into_stretches_and_keeps_what_it_learned() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    known = driven(figure(600.0, fix_sigma_m=0.05), learning)
    assert len(learning._first) < MOST_NODES + 2
    assert np.allclose(known[-1].mean[:6], TRUE[:6], atol=[3e-3, 3e-4, 6e-3, 0.03, 0.03, 0.03])


def test_a_gyro_that_warms_up_is_not_taken_for_one_with_another_scale() -> None:
    """Its bias grows by .01 rad/s in ten minutes; if it were constant, the scale would be .5 % off."""
    drive = figure(700.0, fix_sigma_m=0.5, slip=0.02)
    warm = 0.012 * (1.0 - np.exp(-drive.t_s / 400.0))
    turn = drive.turn_rad + 0.5 * (warm[1:] + warm[:-1]) * np.diff(drive.t_s)
    learning = SelfCalibration(PRIOR, dataclasses.replace(NOISE, bias_walk_radps=1e-4), 0j)
    driven(dataclasses.replace(drive, turn_rad=turn), learning)
    learning.restart()
    error = np.abs(learning.known.mean - TRUE - warm[-1] * (np.arange(len(TRUE)) == GYRO_BIAS))
    assert error[TURN_SCALE] < 2.0 * learning.known.sigma[TURN_SCALE] < 0.004
    assert error[GYRO_BIAS] < 3.0 * learning.known.sigma[GYRO_BIAS] < 0.005


def test_missing_samples_end_a_stretch_but_not_what_was_learned() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    driven(figure(200.0, fix_sigma_m=0.05), learning)
    before = learning.known
    learning.drive(10**12, None, 0.0, np.zeros(2), 0.0)
    assert learning.known is before
    again = driven(figure(120.0, fix_sigma_m=0.05, seed=1), learning, 2 * 10**12)
    assert (again[-1].sigma < PRIOR.sigma).all()


def test_a_wrong_heading_takes_back_its_stretch() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    driven(figure(60.0, fix_sigma_m=0.05), learning)
    assert not same(learning.known.mean, PRIOR.mean)
    learning.restart(learning.before)
    assert same(learning.known.mean, PRIOR.mean)


def test_equal_input_gives_equal_bits() -> None:
    runs = [
        driven(figure(120.0, PRIOR.mean, fix_sigma_m=0.3, hill=0.0), SelfCalibration(PRIOR, NOISE, 0j))
        for _ in range(2)
    ]
    assert all(same(a.mean, b.mean) for a, b in zip(*runs, strict=True))


def same(a: Array, b: Array) -> bool:
    """Whether two vectors of numbers have the same bits."""
    return len(a) == len(NUMBERS) and a.tobytes() == b.tobytes()


def test_a_step_takes_many_short_slices() -> None:
    drive = figure(400.0, fix_sigma_m=0.05)
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    driven(drive, learning)
    while learning._work is None:
        t_ns = learning._start_ns + round((learning._now_s + 0.1) * 1e9)
        learning.drive(t_ns, 0.1, 0.0, np.zeros(2), 0.0)
        learning.advance()
    known, slices = learning.known, 0
    while learning._work is not None:
        assert learning.known is known
        assert learning.advance() == (learning._work is None)
        slices += 1
    assert learning.known is not known
    assert slices > 3
    assert slices * STEP_S < 4.0


def test_an_estimator_restored_within_a_step_learns_the_same() -> None:
    messages = list(simulate("figure_eight", terrain="asphalt", seed=5).messages())
    estimator = Estimator.for_vehicle("elevate")
    learning = estimator.learned.calibration
    assert learning is not None
    for place, message in enumerate(messages):  # noqa: B007
        estimator.add(message)
        if learning._work is not None and learning._work.done_nodes:
            break
    again = Estimator.restore(estimator.config, estimator.dump())
    for message in messages[place + 1 : place + 400]:
        estimator.add(message)
        again.add(message)
    assert learning._work is None
    assert again.learned.calibration is not None
    assert same(again.learned.calibration.known.mean, learning.known.mean)
    assert not same(learning.known.mean, learning.prior.mean)


def begun() -> SelfCalibration:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    learning.drive(10**9, 0.0, 0.0, np.zeros(2), 0.0)
    return learning


def test_fixes_closer_than_their_errors_last_are_left_out() -> None:
    learning = begun()
    for t_ms in (500, 1000, 1100, 1549, 1550, 1990, 2010):
        learning.fix(t_ms * 10**6, np.array([float(t_ms), 2.0, 3.0]), 0.1 * t_ms)
    assert [(round(t_s, 3), east, north) for t_s, east, north, _ in learning._fixes] == [
        (0.1, 1100.0, 2.0),
        (0.55, 1550.0, 2.0),
        (1.01, 2010.0, 2.0),
    ]
    assert learning.usual_sigma_m == pytest.approx(155.0)  # the median


def test_before_the_first_sample_a_fix_has_no_time() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    learning.fix(10**9, np.zeros(3), 0.1)
    learning.restart()
    assert (learning._fixes, learning.usual_sigma_m) == ([], 0.0)


def test_what_a_stretch_knows_grows_uncertain_but_never_beyond_the_first_prior() -> None:
    """The place of the antenna along x is given to a millimetre, and wheels that roll have no course lag: no
    drive tells these better.
    """
    covariance = PRIOR.covariance.copy()
    covariance[3, 3] = 1e-6
    given = dataclasses.replace(PRIOR, covariance=covariance)
    learning = SelfCalibration(given, NOISE, 0j)
    assert learning.known.mean[GNSS_DELAY] == PRIOR.mean[GNSS_DELAY]
    ended = driven(figure(300.0, fix_sigma_m=0.05), learning, until=lambda: learning.before is not given)
    known, begin = ended[-1], learning.before
    wider, prior = known.covariance * online.FORGOTTEN, np.diag(covariance)
    assert (np.diag(wider) > prior).tolist() == [i in (3, COURSE_LAG) for i in range(len(prior))]
    assert np.diag(begin.covariance) == pytest.approx(np.minimum(np.diag(wider), prior), rel=1e-9)
    correlations = [c / np.sqrt(np.outer(np.diag(c), np.diag(c))) for c in (wider, begin.covariance)]
    assert np.allclose(*correlations, atol=1e-9)
    assert same(begin.mean, known.mean)
    assert learning.known.mean[GNSS_DELAY] == known.mean[GNSS_DELAY] != PRIOR.mean[GNSS_DELAY]


def step_times(drive: MotionSegment) -> tuple[list[float], list[int]]:
    """When steps begin, and how many nodes there are then."""
    learning, times_s, nodes = SelfCalibration(PRIOR, NOISE, 0j), list[float](), list[int]()

    def look() -> bool:
        if learning._stepped_s != (times_s[-1] if times_s else 0.0):
            times_s.append(learning._stepped_s)
            nodes.append(len(learning._first))
        return False

    driven(drive, learning, until=look)
    return times_s, nodes


def test_a_step_waits_for_four_nodes_four_fixes_and_four_seconds() -> None:
    """Of a robot whose numbers are as assumed: no step is far off, so that the next one waits."""
    drive = figure(60.0, PRIOR.mean, fix_sigma_m=0.05, hill=0.0)
    times_s, nodes = step_times(drive)
    assert times_s[0] >= online.STEP_S
    assert nodes[0] == 4, "at once"
    assert np.diff(times_s) == pytest.approx(online.STEP_S, abs=0.11)
    late = dataclasses.replace(
        drive, fix_t_s=drive.fix_t_s[12:], fix=drive.fix[12:], fix_sigma_m=drive.fix_sigma_m[12:]
    )
    first = step_times(late)[0][0]
    assert drive.fix_t_s[15] <= first < drive.fix_t_s[15] + 0.25, "the fourth fix has come"


def test_a_robot_that_stands_makes_a_step_only_with_a_new_node() -> None:
    drive = figure(120.0, PRIOR.mean, fix_sigma_m=0.05, hill=0.0)
    still = drive.t_s[:-1] >= 40.0
    stopped = dataclasses.replace(
        drive,
        distance_m=np.where(still, 0.0, drive.distance_m),
        turn_rad=np.where(still, 0.0, drive.turn_rad),
        fix=np.where(drive.fix_t_s >= 40.0, drive.fix[drive.fix_t_s < 40.0][-1], drive.fix),
    )
    times_s, nodes = (np.array(one) for one in step_times(stopped))
    late = nodes[times_s > 41.0]
    resting = late[late > late[0]]  # since the first node at rest
    assert len(resting) >= 2
    assert (np.diff(resting) > 0).all()


def test_a_new_stretch_begins_from_what_is_known_or_is_given() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    driven(figure(60.0, fix_sigma_m=0.05), learning)
    known = learning.known
    learning.restart()
    assert learning.before is learning.known is known
    learning.restart(PRIOR)
    assert learning.before is learning.known is PRIOR
    learning.start_from(known)
    assert learning.prior is learning.before is learning.known is known


def test_fixes_that_no_numbers_explain_do_not_hurry_the_steps() -> None:
    drive = figure(60.0, PRIOR.mean, fix_sigma_m=0.05, hill=0.0)
    scatter = np.random.default_rng(0).normal(size=(2, len(drive.fix))) * 3.0
    times_s, _ = step_times(dataclasses.replace(drive, fix=drive.fix + scatter[0] + 1j * scatter[1]))
    assert np.diff(times_s)[2:] == pytest.approx(online.STEP_S, abs=0.11)


def test_new_nodes_begin_where_the_wheels_have_led() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    drive = figure(90.0, PRIOR.mean, fix_sigma_m=0.05, hill=0.0)
    driven(drive, learning)
    nodes = learning._nodes()
    assert len(nodes.state) > len(learning._state)
    chords = np.hypot(*np.diff(nodes.state[:, :2], axis=0).T)
    rolled = np.concatenate([[0.0], np.cumsum(drive.distance_m)])
    arcs = np.diff(rolled[np.array(learning._first)])
    assert (chords < 1.02 * arcs + 0.05).all()
    assert (chords > 0.6 * arcs).all()  # the drive winds


def test_before_a_drive_nothing_is_begun_anew() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    drive = learning._drive
    learning.restart()
    assert learning._drive is drive
    learning.drive(10**9, 0.0, 0.0, np.zeros(2), 0.0)
    learning.restart()
    assert learning._drive is not drive
