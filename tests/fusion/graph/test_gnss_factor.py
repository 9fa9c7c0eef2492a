"""The residual of a fix, term by term."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from terrafusion.fusion.graph.gnss_factor import GnssPosition, linearised
from terrafusion.fusion.graph.key_state import ANTENNA, DRIFT, GNSS_DELAY, LINEAR, NAV, KeyState

POSE = gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2.0), np.array([10.0, 20.0, 1.0]))
LEVER, FIX, VELOCITY = np.array([0.5, 0.1, 0.3]), np.array([9.0, 20.0, 1.0]), np.array([0.0, 2.0, 0.0])


def state(**values: float) -> KeyState:
    linear = np.zeros(len(LINEAR))
    for name, value in values.items():
        at = {"drift": DRIFT.start, "antenna": ANTENNA.start, "delay": GNSS_DELAY}[name]
        linear[at - NAV.stop] = value
    return KeyState(POSE, np.zeros(3), gtsam.imuBias.ConstantBias(), linear)


def residual(fix: GnssPosition, at: KeyState) -> np.ndarray:
    return linearised(fix, at)[0]


def test_a_fix_is_of_the_antenna_at_its_lever_arm() -> None:
    """Heading north, the lever's 0.5 m ahead lie north, its 0.1 m left lie west."""
    plain = GnssPosition(FIX, LEVER, np.ones(3))
    assert residual(plain, state()) == pytest.approx([0.9, 0.5, 0.3])
    assert residual(plain, state(antenna=0.2)) == pytest.approx([0.9, 0.7, 0.3])
    assert residual(plain, state(drift=0.4)) == pytest.approx([1.3, 0.5, 0.3])
    assert residual(plain, state(delay=0.1)) == pytest.approx([0.9, 0.5, 0.3])  # no velocity is given
    assert plain.weight == 1.0


def test_a_late_fix_lies_behind_by_what_is_not_allowed_for() -> None:
    moving = GnssPosition(FIX, LEVER, np.ones(3), velocity_mps=VELOCITY)
    assert residual(moving, state()) == pytest.approx([0.9, 0.5, 0.3])
    assert residual(moving, state(delay=0.1)) == pytest.approx([0.9, 0.3, 0.3])
    allowed = GnssPosition(FIX, LEVER, np.ones(3), velocity_mps=VELOCITY, delay_s=0.1)
    assert residual(allowed, state(delay=0.1)) == pytest.approx([0.9, 0.5, 0.3])


def test_a_fix_of_a_better_class_holds_a_share_of_the_drift() -> None:
    better = GnssPosition(FIX, LEVER, np.ones(3), drift_share=0.25)
    assert residual(better, state(drift=0.4)) == pytest.approx([1.0, 0.5, 0.3])
