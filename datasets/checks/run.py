"""Run all checks on a recording, and apply the repairs they offer."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from terrafusion.datasets.checks import (
    delays,
    environment,
    gnss,
    gnss_frame,
    imu,
    outliers,
    scale,
    signals,
    steering,
    timing,
    truth,
    wheels,
    yaw_agreement,
)
from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.outliers import check_magnitude
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig

Check = Callable[[CheckContext], Iterator[Finding]]

CHECKS: tuple[Check, ...] = (
    timing.check_spans,
    timing.check_steps,
    timing.check_coarse,
    timing.check_jitter,
    timing.check_duplicates,
    timing.check_rates,
    signals.check_held,
    outliers.check_zeros,
    signals.check_stuck,
    signals.check_dead,
    signals.check_missing,
    outliers.check_saturated,
    outliers.check_spikes,
    delays.check_clocks,
    wheels.check_apart,
    imu.check_gravity,
    wheels.check_each_wheel,
    wheels.check_wheel_signs,
    wheels.check_unsigned,
    imu.check_axes,
    wheels.check_direction,
    yaw_agreement.check_gyro_unit,
    yaw_agreement.check_turns,
    yaw_agreement.check_unrelated,
    yaw_agreement.check_mirrored,
    steering.check_steering,
    imu.check_bias,
    scale.check_gyro_scale,
    wheels.check_radii,
    gnss_frame.check_degrees,
    gnss.check_classes,
    gnss.check_sigma,
    gnss.check_velocity_sigma,
    gnss.check_frozen,
    scale.check_standing,
    gnss.check_jumps,
    gnss.check_scatter,
    gnss.check_dilution,
    gnss_frame.check_velocity,
    gnss_frame.check_upward_velocity,
    truth.check_unit,
    truth.check_yaw,
    truth.check_frame,
    scale.check_speed_scale,
    environment.check_pressure,
    environment.check_field,
)

UNIT_CHECKS: tuple[Check, ...] = (yaw_agreement.check_gyro_unit, scale.check_speed_scale)
UNIT_CODES = ("gyro-in-degrees", "wheel-unit")
_SCALES = {"wheel-radius", "wheel-scale", "wheel-sides", "gyro-scale"}
_COMPARED = _SCALES | {"sigma-too-small", "standing", "yaw-unrelated"}
CONSEQUENCES = {
    ("gyro-in-degrees", "imu"): _COMPARED | {"gyro-bias"},
    ("stuck", "imu"): _COMPARED,
    ("zero-filled", "imu"): _COMPARED | {"gyro-bias", "accel-magnitude", "uneven-sampling"},
    ("zero-filled", "wheels"): _COMPARED | {"clock-offset"},
    ("dead", "imu"): _COMPARED,
    ("dead", "wheels"): _COMPARED | {"clock-offset", "carried"},
    ("clock-offset", "gnss"): {"standing", "carried"},
    ("spikes", "imu"): _SCALES,
    ("wheel-sign", "wheels"): _COMPARED,
    ("gnss-degrees", "gnss"): _COMPARED | {"gnss-jumps"},
}
"""Findings that another one, by code and channel, may bring about: they count once it is repaired."""
LARGEST = 1e6
"""Numbers up to this may be in small units (mm/s, deg/s); larger ones are not computed with."""

MAX_ROUNDS = 20
SEVERAL = ("wheel-odd", "clock-jump", "gnss-velocity")
"""Codes of which one channel can have several findings, identified by their description."""


def run_checks(recording: Recording, rig: Rig | None = None) -> list[Finding]:
    """All findings, errors first; without `rig` wheel rates (rad/s) are not compared with GNSS speed."""
    with np.errstate(over="ignore", invalid="ignore"):  # signalling NaN and huge numbers warn
        return _findings(CheckContext(recording, rig))


def _findings(context: CheckContext) -> list[Finding]:
    findings = list(check_magnitude(context))
    if not findings:  # the others would compute with impossible numbers
        findings = [finding for check in CHECKS for finding in check(context)]
    elif _may_be_units(context.recording, findings):
        units = [finding for check in UNIT_CHECKS for finding in check(context) if finding.code in UNIT_CODES]
        explained = {finding.channel for finding in units}
        findings = units + [finding for finding in findings if finding.channel not in explained]
    found = [_consequences(finding) for finding in findings]
    findings = [finding for finding in findings if not any(finding.code in codes for codes in found)]
    return sorted(findings, key=lambda finding: finding.severity != "error")


def _consequences(finding: Finding) -> set[str]:
    """Codes that a finding may bring about: times that are a little off, a warning, make no robot stand."""
    small = finding.code == "clock-offset" and finding.severity != "error"
    return set() if small else CONSEQUENCES.get((finding.code, finding.channel), set())


def _may_be_units(recording: Recording, impossible: list[Finding]) -> bool:
    """Whether impossible numbers are those of wheels and IMU only, and no larger than a unit makes them."""
    values = [] if recording.wheels is None else [recording.wheels.speed]
    values += [] if recording.imu is None else [recording.imu.gyro_radps, recording.imu.accel_mps2]
    largest = max((float(np.nanmax(np.abs(v), initial=0.0)) for v in values), default=0.0)
    kinds = {(finding.channel, finding.code) for finding in impossible}
    return kinds <= {(c, "impossible-value") for c in ("wheels", "imu")} and largest < LARGEST


def repair(recording: Recording, rig: Rig | None = None) -> tuple[Recording, list[Finding]]:
    """Apply the repairs that the findings offer, one at a time, running the checks again after each.

    Returns:
        The repaired recording, with a note for every repair, and the repaired findings in the order
        of their repairs. What `run_checks` still finds afterwards cannot be repaired.
    """
    repaired: list[Finding] = []
    for _ in range(MAX_ROUNDS):
        done = {_identity(finding) for finding in repaired}
        repairable = (f for f in run_checks(recording, rig) if f.repair and _identity(f) not in done)
        first = next(repairable, None)
        if first is None or first.repair is None:
            break
        note = f"repaired: {first.channel}: {first.what} ({first.evidence}); {first.fix}"
        before, recording = recording, first.repair(recording).with_notes(note)
        if first.code in ("imu-axes", "imu-forward"):  # what is turned now, a vehicle must not turn again
            still = tuple(n for n in before.unturned if getattr(recording, n) is getattr(before, n))
            recording = dataclasses.replace(recording, unturned=still)
        repaired.append(first)
    return recording, repaired


def _identity(finding: Finding) -> tuple[str, str, str]:
    """A finding with the same identity is repaired only once."""
    return finding.code, finding.channel, finding.what if finding.code in SEVERAL else ""
