"""The steering: turns of the bicycle model by its angles, against those of the gyro, else of the truth."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.finding import CheckContext, Finding, once, scaled
from terrafusion.datasets.core.arrays import Array

LARGEST_RAD = 1.3
"""Wheels are turned no further (75 deg; assumed): larger angles are another unit, or a steering wheel's."""
BEYOND = 0.02
"""Share of larger angles above which they are no single errors."""
USUAL_RATIO = 16.0
"""Angle of a car's steering wheel over that of its front wheels (assumed)."""
DEGREE = np.pi / 180.0
UNITS = (1.0, DEGREE, DEGREE / USUAL_RATIO)
"""The last one is that of a steering wheel in deg, or in rad."""
SURE_R, SAME = 0.8, 1.5
"""Least correlation that shows a scale, and up to which factor turns are the same."""
UNRELATED_R, MANY = 0.3, 40


@once
def steered_angle(context: CheckContext) -> motion.Integral | None:
    """Angle turned by speed and steering angles, rad; without a wheelbase times its length in metres."""
    return _turned(context, 1.0)


def _turned(context: CheckContext, unit: float) -> motion.Integral | None:
    """The same with all angles times `unit`; those that are too large are left out."""
    steering, driven = context.recording.steering, motion.wheel_speed(context)
    if steering is None or driven is None:
        return None
    angles = unit * axles(context)
    angles[np.abs(angles) > LARGEST_RAD] = np.nan
    front, rear = np.tan(angles).T
    t_s = motion.seconds(steering.t_ns, context.recording.start_ns)
    rate = np.interp(t_s, *driven) * (front - rear) / (_wheelbase_m(context) or 1.0)
    return motion.integral(context.recording.start_ns, steering.t_ns, rate)


def axles(context: CheckContext) -> Array:
    """Mean angle (N, 2) of front and rear wheels, rad."""
    steering, rig = context.recording.steering, context.rig
    if steering is None:
        return np.zeros((0, 2))
    known = rig.steering.ratio if rig is not None and rig.steering is not None else None
    return steering.axle_angles_rad(context.recording.overrides.steering_ratio or known or USUAL_RATIO)


def _wheelbase_m(context: CheckContext) -> float | None:
    return context.recording.overrides.wheelbase_m or (context.rig.wheelbase_m if context.rig else None)


def check_steering(context: CheckContext) -> Iterator[Finding]:
    """The angles must turn the robot as far as it turns; for their sign see `yaw_agreement`."""
    known = motion.yaw_angles(context)
    turned, steering = known.get("gyro") or known.get("truth"), context.recording.steering
    if turned is None or steering is None or not len(steering) or steering.names == ("steering_wheel",):
        return
    source = "gyro" if "gyro" in known else "truth"
    if not np.ptp(steering.angle_rad, axis=0).any():
        yield from _dead(turned, source)
        return
    largest = float(np.nanmax(np.abs(steering.angle_rad), initial=0.0))
    unit = next((u for u in UNITS if _fits(u * steering.angle_rad)), UNITS[-1])
    own = _turned(context, unit)
    both = motion.agreement(turned, own) if own is not None else None
    if both is None:
        return
    sure, scale = abs(both.r) > SURE_R and both.is_significant(), abs(both.slope)
    metric = _wheelbase_m(context) is not None and context.wheel_radius_m() is not None
    if unit != 1.0:
        factor = unit if unit == DEGREE and (not metric or 1.0 / SAME < scale < SAME) else unit * scale
        fix = "check their unit: rad, of the wheels"
        if sure and factor == DEGREE:
            fix = "multiply by pi / 180"
        elif sure:
            fix = f"multiply by {factor:.3g}, or call them `steering_wheel_rad` and state `steering_ratio`"
        yield Finding(
            "steering-unit", "error", "steering",
            f"the angles reach {largest:.3g} rad: no wheels turn so far",
            f"times {factor:.3g} they turn the robot about as the {source} does; correlation {both.r:.2f}"
            if sure
            else f"in deg they do not turn the robot as the {source} does; correlation {both.r:.2f}",
            fix,
            scaled("steering", factor, "angle_rad") if sure and metric else None,
        )  # fmt: skip
    elif sure and metric and not 1.0 / SAME < scale < SAME:
        yield Finding(
            "steering-scale", "warning", "steering",
            f"the robot turns {scale:.3g} times as far as the angles say",
            f"by the {source}, with a wheelbase of {_wheelbase_m(context):.3g} m; correlation {both.r:.2f}",
            f"correct `wheelbase_m`, or multiply the angles by {scale:.3g}",
            scaled("steering", scale, "angle_rad"),
        )  # fmt: skip
    elif not both.is_significant() and abs(both.r) < UNRELATED_R and both.windows > MANY:
        yield Finding(
            "steering-unrelated", "warning", "steering",
            "the robot does not turn as it is steered",
            f"correlation {both.r:.2f} of the half-second means by {source} and by the angles",
            "check the channel: is it the angle as measured, of this robot, on the same clock?",
        )  # fmt: skip


def _fits(angle_rad: Array) -> bool:
    return float((np.abs(angle_rad) > LARGEST_RAD).mean()) <= BEYOND


def _dead(turned: motion.Integral, source: str) -> Iterator[Finding]:
    grid = np.arange(turned.t_s[0], turned.t_s[-1], motion.WINDOW_S)
    if len(grid) <= MANY or turned.rates(grid).std() < motion.LEAST_RATE:
        return
    yield Finding(
        "dead", "error", "steering",
        "the angles are constant",
        f"the {source} turns by {turned.rates(grid).std():.2g} rad/s (RMS) meanwhile",
        "leave the steering out",
        lambda recording: dataclasses.replace(recording, steering=None),
    )  # fmt: skip
