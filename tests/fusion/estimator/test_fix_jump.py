"""Fixes that jump and stay: no skid of the wheels."""

from __future__ import annotations

import cmath
import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.fusion.estimate.estimate import JUMPED
from terrafusion.fusion.estimator.dead_reckoning import FixPair
from terrafusion.fusion.estimator.fix_jump import FixJump
from terrafusion.fusion.estimator.notes import notes_of
from terrafusion.fusion.replay import replay
from tests.fusion.estimator.test_plausibility import changed, drive, run

OFF_M = np.array([0.6, -0.5, 0.0])


def offset(begin_s: float, end_s: float, every: int = 1):
    def wrong(t: np.ndarray, enu: np.ndarray) -> np.ndarray:
        return enu + ((t > begin_s) & (t < end_s))[:, None] * OFF_M

    return wrong


@pytest.mark.parametrize("mode", ["adaptive", "fixed"])
def test_fixes_that_jump_are_held_off_until_they_come_back(mode: str) -> None:
    result = run(changed(offset(25.0, 45.0)), mode)
    assert result.error_m.max() < 0.35
    assert result.nees[result.t_s > 10.0].max() < 7.0
    assert JUMPED in result.reasons()
    assert result.states[-1].status == "running"
    notes = notes_of(result.estimator)
    assert any(JUMPED in note for note in notes)
    assert not any("skidded" in note for note in notes)


def test_a_jump_is_a_reason_to_doubt_the_run() -> None:
    found = replay(changed(offset(25.0, 45.0)), mode="fixed").verdict
    assert found is not None
    assert found.value == "doubtful"
    assert "they jumped there as no robot moves" in " ".join(found.reasons)


def pairs(points: list[complex], step_s: float, driven_m: float, sigma_m: float) -> list[FixPair]:
    return [
        FixPair(round(i * step_s * 1e9), i * driven_m + 0j, p, sigma_m, i * driven_m)
        for i, p in enumerate(points)
    ]


TURN = cmath.rect(1.0, 0.7)


def jump(
    offsets: list[complex], step_s: float, driven_m: float, sigma_m: float = 0.014, white: float = 1.0
) -> FixJump | None:
    """The jump of two used fixes and the rejected ones after them, so far off a straight path."""
    points = [TURN * (i * driven_m + off) for i, off in enumerate(offsets)]
    both = pairs(points, step_s, driven_m, sigma_m)
    return FixJump.of(both[:2], both[2:], TURN, 1.0, white)


def test_only_a_constant_offset_that_needs_too_much_acceleration_is_a_jump() -> None:
    wrong, slow = jump([0, 0, 0.8j, 0.8j], 0.2, 0.24), jump([0, 0, 0.8j, 0.8j], 1.0, 0.5)
    assert wrong is not None
    assert wrong.impossible
    assert slow is not None
    assert not slow.impossible
    assert jump([0, 0, 0.4j, 0.8j], 0.2, 0.24) is None
    assert jump([0, 0, 0.05j, 0.05j], 0.2, 0.24) is None


def test_coarse_fixes_that_jump_further_than_wheels_can_skid_are_no_skid() -> None:
    wrong = jump([0, 0, 6j, 6j], 1.0, 1.4, 1.2, 0.4)
    assert wrong is not None
    assert wrong.impossible
    assert jump([0, 0, 2.8j, 2.8j], 1.0, 1.4, 1.2, 0.4) is None
    assert jump([0, 0, 6j, 6j], 1.0, 1.4, 1.2, 1.0) is None  # all of the sigma is white
    assert jump([0, 0, 6j, 6j], 1.0, 3.0, 1.2, 0.4) is None  # a faster robot may have skidded there


def test_a_fix_that_is_nearer_to_the_place_before_does_not_continue_a_jump() -> None:
    both = pairs([TURN * (1.4 * i + off) for i, off in enumerate([0, 0, 6j, 6j, 5j, 2.5j])], 1.0, 1.4, 1.2)
    found = FixJump.of(both[:2], both[2:4], TURN, 1.0, 0.4)
    assert found is not None
    assert found.continued(both[3], both[4])
    assert not found.continued(both[3], both[5])


def test_a_jump_leads_back_where_most_fixes_before_lay() -> None:
    offs = [0.0] * 30 + [0.5 * i * 1j for i in range(12)] + [6j] * 15
    both = pairs([TURN * (1.4 * i + off) for i, off in enumerate([*offs, 0.0, 0.0])], 1.0, 1.4, 1.2)
    found = FixJump.of(both[-4:-2], both[-2:], TURN, 1.0, 0.4)
    assert found is not None
    assert found.impossible
    assert found.leads_back(both[:-2], both[-2])
    assert not found.leads_back(both[40:-2], both[-2])


def test_a_reflected_signal_neither_moves_the_robot_nor_makes_its_wheels_useless() -> None:
    """Fixes at 1 Hz that are right to a metre, and for a quarter of a minute seven metres off."""
    recording = drive()
    gnss, noise = recording.gnss, np.random.default_rng(4)
    assert gnss is not None
    t_s = (gnss.t_ns - recording.start_ns) * 1e-9
    rows = np.flatnonzero(np.diff(np.floor(t_s), prepend=-1.0) > 0.0)
    off = np.where(((t_s > 30.0) & (t_s < 45.0))[:, None], [5.0, -5.0, 0.0], 0.0)
    enu_m = (gnss.enu_m + off + noise.normal(0.0, 0.5, gnss.enu_m.shape))[rows]
    single = np.full(len(rows), Fix.SINGLE, dtype=np.uint8)
    fixes = Gnss(gnss.t_ns[rows], enu_m, np.ones_like(enu_m), single)
    result = run(dataclasses.replace(recording, gnss=fixes), "adaptive")
    assert result.error_m[result.t_s > 10.0].max() < 2.0
    assert not any("skidded" in note for note in notes_of(result.estimator))
