"""The wheels among themselves and beside the GNSS."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.doctor.finding import Finding, Patient
from terrafusion.datasets.doctor.motion import speed_ratios


def check_wheel_signs(patient: Patient) -> Iterator[Finding]:
    """Left and right must mostly turn the same way."""
    wheels = patient.recording.wheels
    if wheels is None or not wheels.has_sides():
        return
    sides = wheels.side_speeds_mps(1.0)
    sides = sides[np.isfinite(sides).all(axis=1)]
    moving = (np.abs(sides) > 0.05 * np.abs(sides).max(initial=0.0)).all(axis=1) & sides.any(axis=1)
    opposite = (np.sign(sides[:, 0]) != np.sign(sides[:, 1])) & moving
    if moving.sum() < 50 or opposite.sum() < 0.9 * moving.sum():
        return
    mean = np.abs(sides[moving]).mean()
    if np.abs(sides[moving].sum(axis=1)).mean() < 0.5 * mean:
        yield Finding(
            "wheel-sign",
            "warning",
            "wheels",
            "left and right turn against each other nearly always",
            f"in {opposite.sum() / moving.sum():.0%} of the samples that move",
            "if the robot did not only spin on the spot, change the sign of one side",
        )


def check_speed_scale(patient: Patient) -> Iterator[Finding]:
    """Wheel speed against GNSS speed on straight stretches."""
    wheels, gnss, radius = patient.recording.wheels, patient.recording.gnss, patient.wheel_radius_m()
    if wheels is None or gnss is None or radius is None or len(gnss) < 20 or len(wheels) < 20:
        return
    ratios = speed_ratios(wheels, gnss, radius)
    if len(ratios) < 5:
        return
    ratio = float(np.median(ratios))
    if abs(ratio - 1.0) > 0.2:
        yield Finding(
            "wheel-scale",
            "warning",
            "wheels",
            f"GNSS speed is {ratio:.2f} times the wheel speed",
            f"median of {len(ratios)} straight stretches, quartiles "
            f"{np.percentile(ratios, 25):.2f} to {np.percentile(ratios, 75):.2f}",
            "check wheel radius and unit; if they are right, the wheels slip",
        )
