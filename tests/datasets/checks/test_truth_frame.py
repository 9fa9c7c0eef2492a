"""The frame of the truth against that of the fixes."""

import dataclasses

import numpy as np

from terrafusion.datasets.checks import repair, run_checks
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.recording import Recording
from tests.datasets.checks.test_physical_faults import lively_drive

TURN_70 = np.array([[0.34202014, -0.93969262], [0.93969262, 0.34202014]])


def elsewhere(r: Recording, turn: np.ndarray, yaw_rad: float, shift_m: tuple[float, float]) -> Recording:
    assert r.truth is not None
    east, north = turn @ r.truth.position_m[:, :2].T + np.array([shift_m]).T
    yaw = r.truth.yaw_rad() + yaw_rad
    quaternion = rpy_to_quaternion(np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1))
    position = np.stack([east, north, r.truth.position_m[:, 2]], axis=1)
    return dataclasses.replace(
        r, truth=dataclasses.replace(r.truth, position_m=position, quaternion=quaternion)
    )


def codes(r: Recording) -> list[str]:
    return [finding.code for finding in run_checks(r)]


def test_truth_of_a_motion_capture_is_found_and_laid_onto_the_fixes() -> None:
    good = lively_drive()
    moved = elsewhere(good, TURN_70, np.radians(70.0), (40.0, -3.0))
    (finding,) = run_checks(moved)
    assert (finding.code, finding.severity, finding.channel) == ("truth-frame", "warning", "truth")
    assert "turned by 70.0 deg" in finding.what
    repaired, _ = repair(moved)
    assert codes(repaired) == []
    assert repaired.truth is not None
    assert good.truth is not None
    np.testing.assert_allclose(repaired.truth.position_m, good.truth.position_m, atol=0.02)
    off = np.angle(np.exp(1j * (repaired.truth.yaw_rad() - good.truth.yaw_rad())))
    np.testing.assert_allclose(off, 0.0, atol=0.001)


def test_a_shift_below_a_metre_is_a_bias_of_the_receiver() -> None:
    assert codes(elsewhere(lively_drive(), np.eye(2), 0.0, (0.6, -0.6))) == []
    assert codes(elsewhere(lively_drive(), np.eye(2), 0.0, (2.0, 0.0))) == ["truth-frame"]
