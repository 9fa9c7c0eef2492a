"""`run_checks` a recording, and `repair` what it finds."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from terrafusion.datasets.checks import delays as offsets
from terrafusion.datasets.checks import (
    dilution,
    environment,
    gnss,
    gnss_frame,
    inertial,
    mounting,
    outliers,
    scale,
    signals,
    timing,
    truth,
    wheels,
)
from terrafusion.datasets.checks import yaw_agreement as turns
from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.plausibility import check_magnitude
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig

Check = Callable[[CheckContext], Iterator[Finding]]

CHECKS: tuple[Check, ...] = (
    timing.check_spans,
    timing.check_steps,
    timing.check_coarse,
    timing.check_jitter,
    timing.check_duplicates,
    signals.check_held,
    signals.check_stuck,
    signals.check_dead,
    signals.check_missing,
    outliers.check_saturated,
    outliers.check_spikes,
    offsets.check_clocks,
    inertial.check_gravity,
    wheels.check_each_wheel,
    wheels.check_wheel_signs,
    mounting.check_axes,
    wheels.check_direction,
    turns.check_gyro_unit,
    turns.check_turns,
    turns.check_unrelated,
    inertial.check_bias,
    gnss_frame.check_degrees,
    gnss.check_classes,
    gnss.check_sigma,
    gnss.check_velocity_sigma,
    gnss.check_frozen,
    gnss.check_jumps,
    gnss.check_scatter,
    dilution.check_dilution,
    gnss_frame.check_velocity,
    truth.check_unit,
    truth.check_yaw,
    scale.check_speed_scale,
    environment.check_pressure,
    environment.check_field,
)

UNIT_CHECKS: tuple[Check, ...] = (turns.check_gyro_unit, scale.check_speed_scale)
UNIT_CODES = ("gyro-in-degrees", "wheel-unit")
LARGEST = 1e6
"""Numbers up to this may be small units (mm/s, deg/s); larger ones are not computed with."""

MAX_ROUNDS = 20
SEVERAL = ("wheel-odd", "clock-jump")


def run_checks(recording: Recording, rig: Rig | None = None) -> list[Finding]:
    """All findings of all checks, errors first.

    Args:
        recording: the drive.
        rig: geometry of the robot; without it wheel rates (rad/s) are not compared with GNSS speed.
    """
    context = CheckContext(recording, rig)
    findings = list(check_magnitude(context))
    if not findings:  # the others would compute with impossible numbers
        findings = [finding for check in CHECKS for finding in check(context)]
    elif _may_be_units(recording, findings):
        units = [finding for check in UNIT_CHECKS for finding in check(context) if finding.code in UNIT_CODES]
        explained = {finding.channel for finding in units}
        findings = units + [finding for finding in findings if finding.channel not in explained]
    return sorted(findings, key=lambda finding: finding.severity != "error")


def _may_be_units(recording: Recording, impossible: list[Finding]) -> bool:
    """Whether impossible numbers are those of wheels and IMU only, and no larger than a unit makes them."""
    told = [] if recording.wheels is None else [recording.wheels.speed]
    told += [] if recording.imu is None else [recording.imu.gyro_radps, recording.imu.accel_mps2]
    largest = max((float(np.nanmax(np.abs(v), initial=0.0)) for v in told), default=0.0)
    explicable = {(f.channel, f.code) for f in impossible} <= {
        (c, "impossible-value") for c in ("wheels", "imu")
    }
    return explicable and largest < LARGEST


def _fault(finding: Finding) -> tuple[str, str, str]:
    """What is mended once; of some kinds a channel can have several, which are told apart by their words."""
    return finding.code, finding.channel, finding.what if finding.code in SEVERAL else ""


def repair(recording: Recording, rig: Rig | None = None) -> tuple[Recording, list[Finding]]:
    """Make the repairs that the findings propose, one after the other, looking again after each.

    Returns:
        The mended recording, with a note for every repair, and the findings that were mended, in
        the order of their repairs. What `run_checks` still finds afterwards nobody could mend.
    """
    mended: list[Finding] = []
    for _ in range(MAX_ROUNDS):
        done = {_fault(finding) for finding in mended}
        open_findings = [f for f in run_checks(recording, rig) if f.repair and _fault(f) not in done]
        if not open_findings:
            break
        first = open_findings[0]
        assert first.repair is not None
        note = f"repaired: {first.channel}: {first.what} ({first.evidence}); {first.fix}"
        recording = first.repair(recording).with_notes(note)
        mended.append(first)
    return recording, mended
