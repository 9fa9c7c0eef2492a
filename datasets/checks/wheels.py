"""The wheels among themselves, and the way they run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.directions import runs_backwards, sides_opposed
from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair
from terrafusion.datasets.checks.scale import is_firm
from terrafusion.datasets.core.channels import Wheels
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.recording import Recording

Array = NDArray[np.float64]

DEAD, LEAST_R, ODD_SCALE = 0.02, 0.9, 0.15
"""Speed of a wheel over its partner's below which it is dead; correlation and error of scale that are odd."""


def check_each_wheel(context: CheckContext) -> Iterator[Finding]:
    """Of four wheels, each must run as the other one of its side does."""
    wheels = context.recording.wheels
    if wheels is None or len(wheels.names) != 4:
        return
    known = np.isfinite(wheels.speed).all(axis=1)
    speed = wheels.speed[known]
    if len(speed) < 50 or not speed.any():
        return
    power = np.sqrt((speed**2).mean(axis=0))
    for front, rear in ((0, 2), (1, 3)):
        odd = _odd_one(speed, power, front, rear)
        if odd is None:
            continue
        wheel, partner, factor, evidence = odd
        name = wheels.names[wheel].replace("_", " ")
        yield Finding(
            "wheel-odd",
            "error",
            "wheels",
            f"{name} does not run as the other wheel of its side",
            evidence,
            f"take it for {factor:.3g} of what it says"
            if factor
            else "take the other wheel of the side for it",
            _one_wheel(wheel, partner, factor),
        )


def _odd_one(speed: Array, power: Array, front: int, rear: int) -> tuple[int, int, float | None, str] | None:
    """The wheel of a side that is odd, its partner, the factor that mends it or None, the evidence."""
    others = power[[k for k in range(4) if k not in (front, rear)]].mean()
    wheel, partner = sorted((front, rear), key=lambda k: -abs(power[k] - others))
    if power[partner] <= 0.0:
        return None
    if power[wheel] < DEAD * power[partner]:
        return wheel, partner, None, f"it moves {power[wheel] / power[partner]:.1%} as much"
    product = float((speed[:, front] * speed[:, rear]).mean())
    r = product / float(power[front] * power[rear])
    if r < -LEAST_R:  # the one that runs against the other side, driving straight
        across = speed[:, [1, 3] if front == 0 else [0, 2]].mean(axis=1)
        along = [float((speed[:, k] * across).mean()) for k in (front, rear)]
        if max(along) <= 0.0:
            return None
        wheel = (front, rear)[int(np.argmin(along))]
        return wheel, front + rear - wheel, -1.0, f"correlation {r:.2f}"
    factor = float(power[partner] / power[wheel])
    if r > LEAST_R and abs(factor - 1.0) > ODD_SCALE and _same_scale(power[partner], others):
        return wheel, partner, factor, f"it runs {1.0 / factor:.2f} times as fast, correlation {r:.2f}"
    return None


def _same_scale(a: float, b: float) -> bool:
    return abs(a / b - 1.0) < ODD_SCALE if b > 0.0 else False


def _one_wheel(wheel: int, partner: int, factor: float | None) -> Repair:
    def mended(recording: Recording) -> Recording:
        assert recording.wheels is not None
        speed = recording.wheels.speed.copy()
        speed[:, wheel] = speed[:, partner] if factor is None else speed[:, wheel] * factor
        return dataclasses.replace(
            recording, wheels=dataclasses.replace(recording.wheels, speed=speed, angle_rad=None)
        )

    return mended


def check_wheel_signs(context: CheckContext) -> Iterator[Finding]:
    """Left and right must mostly turn the same way, unless the robot spins on the spot."""
    wheels, told = context.recording.wheels, sides_opposed(context)
    if wheels is None or told is None or (not told and not is_firm(context.recording)):
        return  # on soft ground a robot may well turn its wheels on the spot and not get round
    side = backward_side(wheels)
    yield Finding(
        "wheel-sign",
        "error" if told else "warning",
        "wheels",
        "left and right turn against each other nearly always",
        told or "nothing else tells whether the robot spins on the spot",
        f"change the sign of the {side} side"
        if told
        else "if the robot did not only spin on the spot, change the sign of one side",
        _signs(left=side == "left", right=side == "right") if told else None,
    )


def backward_side(wheels: Wheels) -> str:
    """The side that runs backwards more."""
    left, right = np.nansum(wheels.side_speeds_mps(1.0), axis=0)
    return "left" if left < right else "right"


def check_direction(context: CheckContext) -> Iterator[Finding]:
    """The wheels must run forwards when the robot does."""
    told = runs_backwards(context)
    if told is None or sides_opposed(context) is not None:
        return
    yield Finding(
        "wheel-reversed",
        "error",
        "wheels",
        "the wheels run backwards when the robot drives forward",
        told,
        "change the sign of all wheels",
        _signs(left=True, right=True),
    )


def _signs(*, left: bool, right: bool) -> Repair:
    def mended(recording: Recording) -> Recording:
        signs = Conventions(left_wheels_sign=-1.0 if left else 1.0, right_wheels_sign=-1.0 if right else 1.0)
        return apply(recording, signs)

    return mended
