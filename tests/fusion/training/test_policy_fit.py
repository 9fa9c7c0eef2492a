"""The policy's statistics on made-up errors, and the file on drives of the twin."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.noise.policy import Policy, load_policy, within_ranges
from terrafusion.fusion.training.ground_samples import (
    LAG_S,
    SLIP_S,
    STUCK_COUNTS_S,
    GroundSamples,
    samples_of,
)
from terrafusion.fusion.training.policy_fit import (
    RADIUS_SIGMA,
    UNKNOWN_SPREAD,
    default_grid,
    fingerprint_of,
    fit_policy,
    noise_of,
    write_policy,
)
from terrafusion.fusion.training.simulated_runs import Grid
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

GRID = Grid(("staircase",), (3.0,), (0.0,), (5,))


@pytest.fixture(scope="module")
def policy() -> Policy:
    return fit_policy(GRID)


def ornstein_uhlenbeck(mean: float, sigma: float, tau_s: float, n: int, seed: int) -> GroundSamples:
    rng = np.random.default_rng(seed)
    keep = np.exp(-SLIP_S / tau_s)
    slip = np.empty(n)
    slip[0] = rng.normal()
    for i in range(1, n):
        slip[i] = keep * slip[i - 1] + np.sqrt(1.0 - keep**2) * rng.normal()
    slip = mean + sigma * slip
    lag = round(LAG_S / SLIP_S)

    def noise(scale: float) -> np.ndarray:
        return scale * rng.normal(size=n)

    pairs = np.stack([slip[:-lag], slip[lag:]], axis=1)
    flat, level = np.zeros(n), np.zeros_like(pairs)
    return GroundSamples(
        slip,
        flat,
        pairs,
        level,
        noise(0.03),
        noise(0.1) - 0.5,
        noise(0.05),
        noise(7.0),
        noise(3.0),
        noise(12.0),
        noise(1.4),
    )


def test_a_known_process_is_found_again() -> None:
    row = noise_of([ornstein_uhlenbeck(0.2, 0.1, 6.0, 100_000, 0)])
    assert row.slip_mean == pytest.approx(0.2, abs=0.01)
    assert row.slip_sigma == pytest.approx(np.hypot(0.1, RADIUS_SIGMA), rel=0.03)
    assert row.slip_time_s == pytest.approx(6.0, rel=0.1)
    assert row.wheel_sigma_mps == pytest.approx(0.03, rel=0.03)
    assert row.yaw_scale_mean == pytest.approx(-0.5, abs=0.01)
    assert row.yaw_scale_sigma == pytest.approx(0.1, rel=0.05)
    assert row.side_slip_sigma == pytest.approx(0.05, rel=0.03)
    assert row.gyro_inflation == pytest.approx(7.0, rel=0.03)
    assert row.gyro_yaw_inflation == pytest.approx(3.0, rel=0.03)
    assert row.accel_inflation == pytest.approx(12.0, rel=0.03)
    assert row.gnss_inflation == pytest.approx(1.4, rel=0.03)


def test_slip_that_follows_the_grade_is_told_from_scatter() -> None:
    rng = np.random.default_rng(4)
    flat = ornstein_uhlenbeck(0.1, 0.02, 5.0, 20_000, 3)
    grade = rng.choice([-0.1, 0.0, 0.1], 20_000)
    lag = round(LAG_S / SLIP_S)
    pairs = np.stack([grade[:-lag], grade[lag:]], axis=1)
    sloped = dataclasses.replace(
        flat,
        grade=grade,
        grade_pairs=pairs,
        slip=flat.slip + 1.5 * grade,
        slip_pairs=flat.slip_pairs + 1.5 * pairs,
    )
    row = noise_of([sloped])
    assert row.slip_per_grade == pytest.approx(1.5, abs=0.02)
    assert row.slip_mean == pytest.approx(0.1, abs=0.01)
    assert row.slip_sigma == pytest.approx(np.hypot(0.02, RADIUS_SIGMA), rel=0.05)
    assert row.slip_time_s == pytest.approx(noise_of([flat]).slip_time_s, rel=0.05)


def test_pooled_grounds_are_the_moment_match_of_their_rows() -> None:
    grounds = [
        ornstein_uhlenbeck(0.0, 0.02, 3.0, 4000, 1),
        ornstein_uhlenbeck(0.4, 0.2, 9.0, 20_000, 2),  # more drives must not weigh more
    ]
    rows = [noise_of([ground]) for ground in grounds]
    pooled = noise_of(grounds)
    matched = Policy({"a": rows[0], "b": rows[1]}, rows[0], "").blend([0.5, 0.5])
    assert pooled.slip_mean == pytest.approx(matched.slip_mean, rel=1e-9)
    assert pooled.slip_sigma >= matched.slip_sigma * (1 - 1e-9)  # the rms is least about the mean
    assert pooled.accel_inflation == pytest.approx(matched.accel_inflation, rel=1e-9)


def test_a_row_beyond_what_a_file_may_hold_is_brought_inside() -> None:
    row = load_policy().fixed
    wild = dataclasses.replace(row, yaw_scale_mean=-0.997, slip_sigma=1.3, slip_per_grade=55.0)
    tame = within_ranges(wild)
    assert (tame.yaw_scale_mean, tame.slip_sigma, tame.slip_per_grade) == (-0.95, 1.0, 20.0)
    assert within_ranges(row) == row


def test_any_soil_of_the_library_is_covered_by_the_row_of_unknown() -> None:
    # Soils without a row are *unknown* to the estimator; so its row must hold for them.
    row = load_policy().classes["unknown"]
    for soil in ("gravel", "grass", "ploughed_soil", "snow"):
        for condition in Grid(("staircase",), (0.0, 6.0), (30.0,), (9,), (soil,)).conditions():
            evidence = samples_of(condition.run())
            away = (evidence.slip - row.slip_mean - row.slip_per_grade * evidence.grade) / row.slip_sigma
            assert np.mean(np.abs(away) < 2.0) > 0.95, (soil, condition.slope_deg)
            assert noise_of([evidence]).side_slip_sigma < row.side_slip_sigma
            assert noise_of([evidence]).gyro_inflation < row.gyro_inflation
            assert noise_of([evidence]).gyro_yaw_inflation < row.gyro_yaw_inflation


def test_a_ground_whose_wheels_never_turned_is_refused() -> None:
    nothing = GroundSamples(
        *(np.empty(0), np.empty(0), np.empty((0, 2)), np.empty((0, 2)), *(np.empty(0) for _ in range(7)))
    )
    with pytest.raises(ValueError, match="never turned"):
        noise_of([nothing])


def test_of_a_robot_that_spins_on_the_spot_only_the_onset_counts() -> None:
    stuck = Scenario(
        name="stuck", duration_s=60.0, drive=(DriveSegment(2.0), DriveSegment(58.0, v_mps=1.0)),
        route=(RouteLeg("mud"),), slope_deg=20.0,
    )  # fmt: skip
    recording = simulate(stuck, seed=1)
    evidence = samples_of(recording)
    full = evidence.slip > 0.95
    spells = 1 + np.count_nonzero(np.diff(full.astype(int)) > 0)
    assert full.sum() * SLIP_S <= spells * (STUCK_COUNTS_S + 1.0)


def test_noiseless_drives_leave_almost_no_sensor_error() -> None:
    recording: Recording = simulate("figure_eight", terrain="asphalt", noiseless=True)
    evidence = samples_of(recording)
    assert np.sqrt(np.mean(evidence.gyro**2)) < 1e-6
    assert np.sqrt(np.mean(evidence.accel**2)) < 1e-6
    assert np.abs(evidence.gnss).max() < 1e-6


def test_made_again_the_file_has_the_same_bytes(policy: Policy, tmp_path: Path) -> None:
    write_policy(policy, tmp_path / "a.yaml", made_by="a test")
    write_policy(fit_policy(GRID), tmp_path / "b.yaml", made_by="a test")
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    again = load_policy(tmp_path / "a.yaml")
    assert again.classes == policy.classes
    assert again.fixed == policy.fixed
    assert again.inputs_sha256 == fingerprint_of(GRID)
    assert fingerprint_of(dataclasses.replace(GRID, seeds=(6,))) != again.inputs_sha256


def test_rows_are_in_the_order_the_grounds_suggest(policy: Policy) -> None:
    rows = policy.classes
    assert rows["asphalt"].slip_sigma < rows["loose_sand"].slip_sigma
    assert rows["asphalt"].slip_mean < rows["loose_sand"].slip_mean
    assert abs(rows["medium_sand"].slip_mean) < 0.05
    matched = Policy({n: r for n, r in rows.items() if n != "unknown"}, policy.fixed, "").blend(
        np.full(4, 0.25)
    )
    assert rows["unknown"].slip_mean == pytest.approx(matched.slip_mean, rel=1e-3)
    assert rows["unknown"].slip_sigma == pytest.approx(UNKNOWN_SPREAD * matched.slip_sigma, rel=1e-3)
    assert policy.fixed.slip_mean == pytest.approx(matched.slip_mean, rel=1e-2, abs=1e-3)
    # The line is no mean, so the rms about the common line is not quite the sum of the parts.
    assert policy.fixed.slip_sigma == pytest.approx(matched.slip_sigma, rel=0.05)


def test_the_shipped_policy_is_of_the_present_parameter_files() -> None:
    # If this fails, a soil, scenario or vehicle changed: run `terrafusion policy fit --out ...` again.
    assert load_policy().inputs_sha256 == fingerprint_of(default_grid(3))
