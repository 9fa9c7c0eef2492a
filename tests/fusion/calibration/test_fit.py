"""The planar smoother of a robot's numbers: derivatives, recovery, honest sigmas."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration import reduction
from terrafusion.fusion.calibration.fit import information_gained, started
from terrafusion.fusion.calibration.motion import MotionSegment, dead_reckoned
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    COMMON_DELAY_S,
    COURSE_LAG,
    GNSS_DELAY,
    NUMBERS,
    SLIP_PER_GRADE,
    TURN_SCALE,
    TURN_SLIP_M,
    WHEEL_DELAY,
    WHEEL_SCALE,
    assumed,
    feigned_by_slip,
)
from terrafusion.fusion.calibration.reduction import BIAS, NODE, Nodes, Noise, Reduction
from tests.fusion.calibration.nodes import fit, node_starts, refined

NOISE = Noise(yaw_density_radps=1e-3, turn_share=0.0, drift_share=0.0, drift_time_s=60.0)
WANDERING = dataclasses.replace(NOISE, bias_walk_radps=1e-4)
TRUE = np.array([0.03, 0.002, -0.06, -0.35, 0.1, 0.8, 0.0, 0.004, 0.5])
PRIOR = assumed(0.005, yaw_of_wheels=False, slip_spread=0.03, slip_time_s=300.0, slip_per_grade=0.3)
STEP_S = 0.1


def figure(
    seconds: float,
    numbers: Array = TRUE,
    fix_sigma_m: float = 0.0,
    slip: float = 0.0,
    seed: int = 0,
    straight: bool = False,
    hill: float = 0.1,
) -> MotionSegment:
    """Winding at changing speed over hills, their sine up to `hill`: what a robot with `numbers` measures."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, STEP_S)
    middle = 0.5 * (t[1:] + t[:-1])
    speed = 1.0 + 0.4 * np.sin(0.3 * middle)
    rate = 0.0 * middle if straight else 0.5 * np.sin(0.17 * middle) + 0.2 * np.cos(0.05 * middle)
    turn = rate * STEP_S
    ratio = (
        1.0
        + numbers[WHEEL_SCALE]
        + slip * np.repeat(rng.normal(size=len(middle) // 80 + 1), 80)[: len(middle)]
    )
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    course = 0.5 * (yaw[1:] + yaw[:-1]) - numbers[COURSE_LAG] * rate
    z = np.concatenate([[0j], np.cumsum(speed * STEP_S * np.exp(1j * course))])
    measured = turn / (1.0 + numbers[0]) + numbers[1] * STEP_S
    stamps = np.arange(3.0, seconds - 1.0, 1.0)
    at = stamps - numbers[GNSS_DELAY]
    antenna = complex(numbers[3], numbers[4]) * np.exp(1j * np.interp(at, t, yaw))
    fix = np.interp(at, t, z.real) + 1j * np.interp(at, t, z.imag) + antenna
    fix = fix + fix_sigma_m * (rng.normal(size=len(at)) + 1j * rng.normal(size=len(at)))
    sigma = np.full(len(at), max(fix_sigma_m, 0.01))
    distance = (speed - numbers[WHEEL_DELAY] * np.gradient(speed, STEP_S)) * STEP_S / ratio
    grade = hill * np.sin(0.11 * middle)
    distance = distance / (1.0 - numbers[SLIP_PER_GRADE] * grade)
    first = node_starts(t, distance, float(sigma[0]))
    climb_m = np.abs(distance) * grade
    return MotionSegment(t, distance, measured, stamps, fix, sigma, 0j, first, None, climb_m)


def test_derivatives_of_the_path_are_those_of_finite_differences() -> None:
    drive, step = figure(60.0), 1e-6
    path = dead_reckoned(drive, TRUE)
    for number in range(len(NUMBERS)):
        more, less = TRUE.copy(), TRUE.copy()
        more[number] += step
        less[number] -= step
        up, down = dead_reckoned(drive, more), dead_reckoned(drive, less)
        assert np.allclose(path.yaw_by[:, number], (up.yaw_rad - down.yaw_rad) / (2 * step), atol=1e-5)
        assert np.allclose(path.z_by[:, number], (up.z - down.z) / (2 * step), atol=1e-4)


def kinds(nodes: Nodes, numbers: Array) -> list[tuple[Array, Array, Array]]:
    """Whitened rows, residuals and columns of fixes and of links."""
    path, count = dead_reckoned(nodes.drive, numbers), len(nodes.state)
    part = Reduction.of(nodes, numbers, 0.03, WANDERING)
    fixes = (*part._fix_rows(path, 0, slice(None)), part.node, 1)
    shared = NODE * count + np.arange(len(NUMBERS))
    return [
        (rows, left, np.array([[*(NODE * k + np.arange(NODE * span)), *shared] for k in node]))
        for rows, left, node, span in (fixes, *part._link_rows(path, 0, count))
    ]


def test_derivatives_of_all_rows_are_those_of_finite_differences() -> None:
    # Near the truth, where neither the robust weights nor the sigma of a link change to first order.
    nodes = started(figure(60.0), 0j, 0.0, TRUE)
    nodes.state[:, :2] *= 1.0 + TRUE[WHEEL_SCALE]
    nodes.state[:, BIAS] = 1e-4 * np.arange(len(nodes.state))
    here, count, step = nodes.state.copy(), len(nodes.state), 1e-6
    unknowns = NODE * count + len(NUMBERS)
    dense = []
    for rows, left, columns in kinds(nodes, TRUE):
        J = np.zeros((*left.shape, unknowns))
        for m in range(len(rows)):
            J[m][:, columns[m]] = rows[m]
        dense.append(J)
    for column in [*range(2 * NODE), *range(NODE * count, unknowns)]:
        both = []
        for sign in (1.0, -1.0):
            moved = np.zeros(unknowns)
            moved[column] = sign * step
            nodes.state = here + moved[: NODE * count].reshape(-1, NODE)
            both.append([left for _, left, _ in kinds(nodes, TRUE + moved[NODE * count :])])
        for J, up, down in zip(dense, *both, strict=True):
            atol = 1e-2 * np.abs(J).max(axis=(0, 2))
            assert np.allclose(J[..., column], (up - down) / (2 * step), atol=atol), column


def test_without_noise_the_numbers_are_found() -> None:
    found = fit([figure(300.0)], [(0j, 0.0)], PRIOR, NOISE)
    assert np.allclose(found.mean[:6], TRUE[:6], atol=[2e-3, 2e-4, 5e-3, 0.02, 0.02, 0.02])
    assert found.mean[SLIP_PER_GRADE] == pytest.approx(TRUE[SLIP_PER_GRADE], abs=0.02)


@pytest.mark.parametrize("sigma_m", [0.02, 0.5])
def test_errors_are_covered_by_their_sigmas(sigma_m: float) -> None:
    errors = []
    for seed in range(12):
        found = fit([figure(240.0, fix_sigma_m=sigma_m, slip=0.02, seed=seed)], [(0j, 0.0)], PRIOR, NOISE)
        errors.append((found.mean - TRUE) / found.sigma)
    found = np.array(errors)[:, [*range(6), SLIP_PER_GRADE]]
    assert np.mean(np.square(found)) < 2.0, found.round(1)
    assert np.mean(np.abs(found) < 2.0) > 0.85


def test_a_course_that_lags_in_turns_does_not_look_like_late_fixes() -> None:
    """A robot that skids drifts outwards: its fixes seem late against the gyro, and its wheels as late."""
    lagging = TRUE.copy()
    lagging[GNSS_DELAY], lagging[COURSE_LAG] = 0.0, 0.2
    drive = figure(300.0, lagging, fix_sigma_m=0.02, slip=0.01)
    skids = assumed(0.005, False, 0.03, 300.0, skids=True)
    found = fit([drive], [(0j, 0.0)], skids, NOISE)
    assert found.mean[COURSE_LAG] == pytest.approx(0.2, abs=0.05)
    assert abs(found.mean[GNSS_DELAY]) < 0.05
    rolling = fit([drive], [(0j, 0.0)], PRIOR, NOISE)
    assert rolling.mean[GNSS_DELAY] > 0.1


def test_wheels_that_slip_while_they_accelerate_are_ahead_by_a_time() -> None:
    """As if they were early; that is no reason for late fixes."""
    slipping = TRUE.copy()
    slipping[GNSS_DELAY], slipping[WHEEL_DELAY] = 0.0, -0.3
    drive = figure(120.0, slipping, fix_sigma_m=0.1, slip=0.01)
    found = fit([drive], [(0j, 0.0)], assumed(0.005, False, 0.03, 300.0, skids=True), NOISE)
    for number in (GNSS_DELAY, WHEEL_DELAY):
        assert abs(found.mean[number] - slipping[number]) < 2.0 * found.sigma[number]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_changes_that_slip_feigns_widen_what_a_drive_shows(side: float) -> None:
    """They are added to the covariance of the numbers, of robots that skid."""
    drive = figure(60.0)
    drive = dataclasses.replace(drive, turn_rad=side * np.abs(drive.turn_rad))
    part = Reduction.of(started(drive, 0j, 0.0, TRUE), TRUE, 0.03, dataclasses.replace(NOISE, skids=True))
    root = np.random.default_rng(0).normal(size=(len(NUMBERS), len(NUMBERS)))
    part.information = root @ root.T
    changes = feigned_by_slip(side)
    wider = np.linalg.inv(part.information) + changes @ changes.T
    assert np.allclose(np.linalg.inv(part.without_feigned()[0]), wider)
    assert changes[ANTENNA_Y, 1] == side * TURN_SLIP_M
    rolling = dataclasses.replace(part, noise=NOISE)
    assert rolling.without_feigned()[0] is rolling.information


def test_what_slip_feigns_depends_on_turns_to_one_side() -> None:
    assert feigned_by_slip(0.0)[ANTENNA_Y].tolist() == [0.0, 0.0]
    assert feigned_by_slip(0.0)[[GNSS_DELAY, WHEEL_DELAY, COURSE_LAG], 0].tolist() == [
        COMMON_DELAY_S,
        COMMON_DELAY_S,
        -COMMON_DELAY_S,
    ]


def test_a_course_that_leads_is_none_that_lags() -> None:
    """A robot that skids is carried outwards: what looks like the opposite is another number."""
    leading = TRUE.copy()
    leading[COURSE_LAG] = -0.1
    drive = figure(300.0, leading, fix_sigma_m=0.02, slip=0.01)
    skids = assumed(0.005, False, 0.03, 300.0, skids=True)
    found = fit([drive], [(0j, 0.0)], skids, NOISE)
    never = dataclasses.replace(skids, covariance=skids.covariance.copy())
    never.covariance[COURSE_LAG, COURSE_LAG] = 1e-6
    without = fit([drive], [(0j, 0.0)], never, NOISE)
    assert abs(found.mean[COURSE_LAG]) < 1e-9
    assert np.allclose(found.mean[:6], without.mean[:6], atol=0.2 * without.sigma[:6])
    assert np.allclose(found.sigma[:6], without.sigma[:6], rtol=0.05)


def correlated(count: int, sigma: float, share: float, rng: np.random.Generator) -> Array:
    """Noise (count, 2) of which each value keeps `share` of the one before."""
    noise = rng.normal(0.0, sigma, (count, 2))
    for i in range(1, count):
        noise[i] = share * noise[i - 1] + np.sqrt(1.0 - share**2) * noise[i]
    return noise


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_correlated_residuals_count_for_as_many_independent_ones(share: float) -> None:
    found = reduction._inflation(correlated(4000, 1.0, share, np.random.default_rng(4)))
    assert found == pytest.approx((1.0 + share) / (1.0 - share), rel=0.15)


def test_sigmas_cover_errors_of_fixes_that_move_together() -> None:
    square = []
    for seed in range(10):
        drive = figure(150.0, seed=seed)
        noise = correlated(len(drive.fix), 0.15, 0.8, np.random.default_rng(seed))
        fix, claimed = drive.fix + noise @ np.array([1.0, 1.0j]), np.full(len(noise), 0.02)
        found = fit([dataclasses.replace(drive, fix=fix, fix_sigma_m=claimed)], [(0j, 0.0)], PRIOR, NOISE)
        off = (found.mean - TRUE) / found.sigma
        square.append(off[[TURN_SCALE, ANTENNA_X, ANTENNA_Y, GNSS_DELAY]] ** 2)
    assert np.mean(square) < 1.5


def test_two_drives_tell_more_than_one() -> None:
    drives = [figure(120.0, fix_sigma_m=0.3, seed=seed) for seed in (1, 2)]
    one = fit(drives[:1], [(0j, 0.0)], PRIOR, NOISE)
    both = fit(drives, [(0j, 0.0)] * 2, PRIOR, NOISE)
    assert (both.sigma <= one.sigma).all()
    assert both.sigma[ANTENNA_X] < 0.85 * one.sigma[ANTENNA_X]


def test_a_straight_drive_tells_nothing_of_antenna_and_turn_scale() -> None:
    found = fit([figure(200.0, straight=True, fix_sigma_m=0.3)], [(0j, 0.0)], PRIOR, NOISE)
    gained = information_gained(PRIOR, found)
    assert gained[TURN_SCALE] < 0.1
    assert gained[WHEEL_SCALE] > 1.0


def test_wild_fixes_do_not_move_the_numbers() -> None:
    drive = figure(300.0, fix_sigma_m=0.05, seed=4)
    drive.fix[::9] += 40.0
    found = fit([drive], [(0j, 0.0)], PRIOR, NOISE)
    assert np.abs(found.mean[ANTENNA_X] - TRUE[ANTENNA_X]) < 0.1
    assert np.abs(found.mean[GNSS_DELAY] - TRUE[GNSS_DELAY]) < 0.1


def test_a_step_never_loses_information() -> None:
    nodes = started(figure(120.0, fix_sigma_m=0.3), 0j, 0.0, PRIOR.mean)
    after = refined([nodes], PRIOR, PRIOR, NOISE)
    assert (after.sigma <= PRIOR.sigma * (1 + 1e-9)).all()


def test_slices_give_the_dense_normal_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reduction, "CAUCHY_SQUARE", np.inf)
    monkeypatch.setattr(reduction, "MOST_SHARED", 0.0)
    nodes = started(figure(600.0, fix_sigma_m=0.0), 0j, 0.0, TRUE)
    nodes.state[:, :2] *= 1.0 + TRUE[WHEEL_SCALE]
    nodes.state[:, 0] += 0.005
    count, part = len(nodes.state), Reduction.of(nodes, TRUE, 0.03, WANDERING)
    slices = 1
    while not part.advance():
        slices += 1
    assert slices > 10
    unknowns = NODE * count + len(NUMBERS)
    H, g = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for rows, left, columns in kinds(nodes, TRUE):
        for row, own, places in zip(rows, left, columns, strict=True):
            H[np.ix_(places, places)] += row.T @ row
            g[places] -= row.T @ own
    n = NODE * count
    back = np.linalg.solve(H[:n, :n], np.column_stack([H[:n, n:], g[:n]]))
    information = H[n:, n:] - H[n:, :n] @ back[:, :-1]
    scale = 1.0 / np.sqrt(np.diag(information))
    assert np.allclose(
        scale * part.information * scale[:, None], scale * information * scale[:, None], atol=1e-6
    )
    right = g[n:] - H[n:, :n] @ back[:, -1]
    assert np.allclose(part.right * scale, right * scale, atol=1e-6 * np.abs(g).max() * scale.max())
