"""Coarse fixes beside sliding wheels: a drift that is too fast for a receiver is not the receiver's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimator.drift_watch import DriftEstimate, DriftWatch
from terrafusion.fusion.replay import ReplayResult, replay
from tests.studies.opponents.drives import Drive, drives_of, longest

SIGMA_M, TIME_S, WHITE_M, WHEELS_M = 1.34, 60.0, 0.67, 0.1
"""Drift and white noise of a stand-alone receiver of 1.5 m, and what the wheels get wrong in a second."""
LEAST_M = 0.45
"""Drift of a receiver that reports half a metre."""


def filtered(fixes: Array, hz: int = 1) -> tuple[Array, Array]:
    """Drift (N,) that a Kalman filter of position and drift finds in fixes (N,), and its variance."""
    keep = np.exp(-1.0 / TIME_S / hz)
    F, Q = np.diag([1.0, keep]), np.diag([WHEELS_M**2 / hz, SIGMA_M**2 * (1.0 - keep**2)])
    x, P, h = np.zeros(2), np.diag([4.0, SIGMA_M**2]), np.ones(2)
    out = []
    for fix in fixes:
        x, P = F @ x, F @ P @ F.T + Q
        gain = P @ h / (h @ P @ h + WHITE_M**2)
        x, P = x + gain * (fix - h @ x), P - np.outer(gain, h @ P)
        out.append((x[1], P[1, 1]))
    return tuple(np.array(out).T)


def alarms(rng: np.random.Generator, slide_m: float, hz: int = 1) -> int:
    """Alarms in two minutes; the robot slides so far, unseen by its wheels, in the second after one."""
    n, keep, wheels_m = 120 * hz, np.exp(-1.0 / TIME_S / hz), WHEELS_M / np.sqrt(hz)
    fixes = np.cumsum(wheels_m * rng.normal(size=(2, n)), axis=1) + WHITE_M * rng.normal(size=(2, n))
    drift = SIGMA_M * rng.normal(size=2)
    for k in range(n):
        drift = keep * drift + SIGMA_M * np.sqrt(1.0 - keep**2) * rng.normal(size=2)
        fixes[:, k] += drift
    fixes[0, n // 2 :] += slide_m
    (east, variance), (north, _) = filtered(fixes[0], hz), filtered(fixes[1], hz)
    watch, step_ns = DriftWatch(SIGMA_M, TIME_S), 10**9 // hz
    rows = zip(east, north, variance, strict=True)
    found = [watch.moved_too_far(DriftEstimate(k * step_ns, x, y, v)) for k, (x, y, v) in enumerate(rows)]
    return sum(one is not None for one in found)


@pytest.mark.parametrize(("hz", "most"), [(1, 18), (5, 28)])
def test_a_receiver_that_drifts_as_modelled_is_seldom_suspected(hz: int, most: int) -> None:
    """In 11 % of drives (200 drawn once), at 5 Hz in 20 %; 97.5 % points of so many out of 100."""
    rng = np.random.default_rng(1)
    assert sum(alarms(rng, 0.0, hz) > 0 for _ in range(100)) <= most


@pytest.mark.parametrize("hz", [1, 5])
def test_a_slide_of_several_metres_is_seen(hz: int) -> None:
    rng = np.random.default_rng(2)
    assert sum(alarms(rng, 4.0, hz) > 0 for _ in range(100)) >= 80


def learned_m(rng: np.random.Generator, true_m: float, seconds: int = 300) -> float:
    """Sigma of the drift after a drive, of fixes that report half a metre and drift by `true_m`."""
    keep, watch = np.exp(-1.0 / TIME_S), DriftWatch(SIGMA_M, TIME_S)
    x, P, h = np.zeros((2, 2)), np.diag([4.0, SIGMA_M**2]), np.ones(2)
    drift, off = true_m * rng.normal(size=2), np.zeros(2)
    for k in range(seconds):
        drift = keep * drift + true_m * np.sqrt(1.0 - keep**2) * rng.normal(size=2)
        off = off + WHEELS_M * rng.normal(size=2)
        F, Q = np.diag([1.0, keep]), np.diag([WHEELS_M**2, watch.sigma_m**2 * (1.0 - keep**2)])
        x, P = x @ F, F @ P @ F.T + Q
        gain = P @ h / (h @ P @ h + 0.2**2)
        left = off + drift + 0.2 * rng.normal(size=2) - x @ h
        x, P = x + np.outer(left, gain), P - np.outer(gain, h @ P)
        watch.learn(DriftEstimate(k * 10**9, *x[:, 1].tolist(), P[1, 1]), LEAST_M)
    return watch.sigma_m


def test_a_receiver_better_than_its_sheet_is_found_to_be() -> None:
    """Drift by the report: a third of the sheet's; one that drifts as the sheet says keeps most of it."""
    rng = np.random.default_rng(3)
    assert np.median([learned_m(rng, LEAST_M) for _ in range(20)]) < 0.65 * SIGMA_M
    usual = [learned_m(rng, SIGMA_M) for _ in range(20)]
    assert np.median(usual) > 0.85 * SIGMA_M
    assert max(usual) <= SIGMA_M


def test_drift_is_never_less_than_reported() -> None:
    assert learned_m(np.random.default_rng(4), 0.05, seconds=3000) >= LEAST_M


def test_a_new_drift_state_is_not_compared_with_the_old_one() -> None:
    watch = DriftWatch(SIGMA_M, TIME_S)
    assert watch.moved_too_far(DriftEstimate(0, 0.0, 0.0, 1.0)) is None
    watch.restart()
    assert watch.moved_too_far(DriftEstimate(10**9, 9.0, 0.0, 1.0)) is None
    assert watch.moved_too_far(DriftEstimate(2 * 10**9, 0.0, 0.0, 1.0)) is not None


def replayed(drive: Drive, monkeypatch: pytest.MonkeyPatch, watched: bool) -> ReplayResult:
    with monkeypatch.context() as patch:
        if not watched:
            patch.setattr(DriftWatch, "test_wheels", lambda *_: False)
        return replay(drive.recording, mode="fixed")


def consumer(name: str) -> Drive:
    return longest(drives_of(f"{name}@consumer"), 1)[0]


def test_on_gravel_the_position_follows_the_robot_and_its_ellipse_holds(
    husky_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of 3.2 m at a sigma of 1.2 m where the drift keeps what the wheels got wrong."""
    drive = consumer("norlab_drive/gravel_2024_8_6_11h37s32/windows")
    before, after = (replayed(drive, monkeypatch, watched) for watched in (False, True))
    assert before.scores.errors is not None
    assert after.scores.errors is not None
    assert np.nanmean(after.scores.errors.nees()) < 0.77 * np.nanmean(before.scores.errors.nees())
    assert np.nanmean(after.scores.errors.distance_m()) < 0.96 * np.nanmean(before.scores.errors.distance_m())


def test_on_asphalt_nothing_changes(husky_bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = consumer("norlab_drive/asphalt_2024_9_25_12h8s57/raw")
    before, after = (replayed(drive, monkeypatch, watched) for watched in (False, True))
    assert before.estimate.trajectory.position_m.tobytes() == after.estimate.trajectory.position_m.tobytes()
