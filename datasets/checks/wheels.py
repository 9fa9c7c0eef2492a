"""The wheels compared with each other, and their sign compared with the motion of the robot."""

import dataclasses
from collections.abc import Iterator
from functools import partial

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair, changed
from terrafusion.datasets.checks.imu import (
    MORE,
    MOSTLY,
    backwards_share,
    gravity,
    heading,
    turning_axis,
    wheels_turn_backwards,
)
from terrafusion.datasets.checks.path import measured_paths
from terrafusion.datasets.checks.scale import is_firm
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.recording import Recording

DEAD, LEAST_R, ODD_SCALE = 0.02, 0.9, 0.15
"""Speed of a wheel over its partner's below which it is dead; correlation and scale error of an odd one."""
WIDEST_TRACK_M = 6.0
"""Sides at speeds -v and v spin a robot at v over half its effective track, which is below this."""
LEAST_S, LEAST_MPS = 10.0, 0.05
"""Shorter and slower runs do not show the direction of the wheels."""
LEAST_PROGRESS = 0.3
"""Distance covered over distance rolled, if the sides turn the same way, above which it does not spin."""


def check_each_wheel(context: CheckContext) -> Iterator[Finding]:
    """Of four wheels, each must run as the other one of its side does."""
    wheels = context.recording.wheels
    if wheels is None or len(wheels.names) != 4:
        return
    speed = wheels.speed[np.isfinite(wheels.speed).all(axis=1)]
    if len(speed) < 50 or not speed.any():
        return
    power = np.sqrt((speed**2).mean(axis=0))
    for front, rear in ((0, 2), (1, 3)):
        odd = _odd_one(speed, power, front, rear)
        if odd is None:
            continue
        wheel, partner, factor, evidence = odd
        yield Finding(
            "wheel-odd", "error", "wheels",
            f"{wheels.names[wheel].replace('_', ' ')} does not run as the other wheel of its side",
            evidence,
            f"multiply its speed by {factor:.3g}" if factor else "use the other wheel of the side for it",
            changed("wheels", _one_wheel, wheel=wheel, partner=partner, factor=factor),
        )  # fmt: skip


def _odd_one(speed: Array, power: Array, front: int, rear: int) -> tuple[int, int, float | None, str] | None:
    """The odd wheel of a side, its partner, the factor that repairs it or None, the evidence."""
    others = power[[k for k in range(4) if k not in (front, rear)]].mean()
    wheel, partner = sorted((front, rear), key=lambda k: -abs(power[k] - others))
    if power[partner] <= 0.0:
        return None
    if power[wheel] < DEAD * power[partner]:
        return wheel, partner, None, f"it moves {power[wheel] / power[partner]:.1%} as much"
    product = float((speed[:, front] * speed[:, rear]).mean())
    r = product / float(power[front] * power[rear])
    if r < -LEAST_R:  # the one that runs against the other side on straight stretches
        across = speed[:, [1, 3] if front == 0 else [0, 2]].mean(axis=1)
        along = [float((speed[:, k] * across).mean()) for k in (front, rear)]
        if max(along) <= 0.0:
            return None
        wheel = (front, rear)[int(np.argmin(along))]
        return wheel, front + rear - wheel, -1.0, f"correlation {r:.2f}"
    factor = float(power[partner] / power[wheel])
    partner_fits = others > 0.0 and abs(power[partner] / others - 1.0) < ODD_SCALE
    if r > LEAST_R and abs(factor - 1.0) > ODD_SCALE and partner_fits:
        return wheel, partner, factor, f"it runs {1.0 / factor:.2f} times as fast, correlation {r:.2f}"
    return None


def _one_wheel(wheels: Wheels, wheel: int, partner: int, factor: float | None) -> Wheels:
    speed = wheels.speed.copy()
    speed[:, wheel] = speed[:, partner] if factor is None else speed[:, wheel] * factor
    return dataclasses.replace(wheels, speed=speed, angle_rad=None)


def check_wheel_signs(context: CheckContext) -> Iterator[Finding]:
    """Left and right must mostly turn the same way, unless the robot spins on the spot."""
    wheels, evidence = context.recording.wheels, sides_opposed(context)
    if wheels is None or evidence is None or (not evidence and not is_firm(context.recording)):
        return  # on soft ground a robot may turn its wheels on the spot and not get round
    left, right = np.nansum(wheels.side_speeds_mps(1.0), axis=0)
    side = "left" if left < right else "right"
    yield Finding(
        "wheel-sign", "error" if evidence else "warning", "wheels",
        "left and right turn against each other nearly always",
        evidence or "no other channel shows whether the robot spins on the spot",
        f"change the sign of the {side} side"
        if evidence
        else "if the robot did not only spin on the spot, change the sign of one side",
        partial(_change_signs, sides=(side,)) if evidence else None,
    )  # fmt: skip


def check_direction(context: CheckContext) -> Iterator[Finding]:
    """The wheels must run forwards when the robot does."""
    evidence = runs_backwards(context)
    if evidence is None or sides_opposed(context) is not None:
        return
    yield Finding(
        "wheel-reversed", "error", "wheels",
        "the wheels run backwards when the robot drives forward",
        evidence,
        *_reversal(context),
    )  # fmt: skip


def _reversal(context: CheckContext) -> tuple[str, Repair]:
    """What to do with wheels that run backwards; where they turn as the gyro does, their sides are swapped,
    too."""
    wheels, signs = context.recording.wheels, partial(_change_signs, sides=("left", "right"))
    if wheels is None or not wheels.has_sides() or turning_axis(context) != "+z":
        return "change the sign of all wheels", signs
    swap = changed("wheels", swapped)
    return "change the sign of all wheels and swap left and right", lambda recording: swap(signs(recording))


def swapped(wheels: Wheels) -> Wheels:
    """With left and right exchanged."""
    other = [0] if len(wheels.names) == 1 else [k ^ 1 for k in range(len(wheels.names))]
    angle = None if wheels.angle_rad is None else wheels.angle_rad[:, other]
    return dataclasses.replace(wheels, speed=wheels.speed[:, other], angle_rad=angle)


def _change_signs(recording: Recording, sides: tuple[str, ...]) -> Recording:
    left, right = (-1.0 if side in sides else 1.0 for side in ("left", "right"))
    return apply(recording, Conventions(left_wheels_sign=left, right_wheels_sign=right))


def sides_opposed(context: CheckContext) -> str | None:
    """Evidence that one side has the wrong sign; "" where nothing decides, None where none has.

    Sides of opposite sign nearly all the time may be a robot that spins on the spot: then the gyro
    turns with them.
    """
    wheels = context.recording.wheels
    if wheels is None or not wheels.has_sides():
        return None
    sides = wheels.side_speeds_mps(context.wheel_radius_m() or motion.ANY_RADIUS_M)
    known = np.isfinite(sides).all(axis=1)
    t_ns, sides = wheels.t_ns[known], sides[known]
    moving = (np.abs(sides) > 0.05 * np.abs(sides).max(initial=0.0)).all(axis=1) & sides.any(axis=1)
    opposite = (np.sign(sides[:, 0]) != np.sign(sides[:, 1])) & moving
    if moving.sum() < 50 or opposite.sum() < 0.9 * moving.sum():
        return None
    apart, together = np.abs(sides[:, 1] - sides[:, 0]), sides.sum(axis=1)
    if np.abs(together[moving]).mean() > 0.5 * np.abs(sides[moving]).mean():
        return None
    imu, start = context.recording.imu, context.recording.start_ns
    gyro = None if imu is None else motion.integral(start, imu.t_ns, _vertical_rate(context, imu))
    if gyro is not None:
        rate = float(np.abs(gyro.rates(np.linspace(gyro.t_s[0], gyro.t_s[-1], 200))).mean())
        if rate * WIDEST_TRACK_M > float(apart.mean()):
            return None
        summed = motion.integral(start, t_ns, together)
        by_sum = motion.agreement(gyro, summed) if summed is not None else None
        if by_sum is not None and by_sum.is_significant():
            return f"the gyro follows their sum (correlation {abs(by_sum.r):.2f})"
    covered = _progress(context, motion.integral(start, t_ns, 0.5 * apart))
    if covered is None:
        return ""
    progress, source = covered
    if progress <= LEAST_PROGRESS:
        return None
    return f"by the {source} the robot covers {progress:.0%} of the distance rolled"


def _vertical_rate(context: CheckContext, imu: Imu) -> Array:
    """Angular rate (N,) about the direction of gravity, up to its sign; about z where that is unknown."""
    mean = gravity(context)
    if mean is None or not imu.has_gyro() or not np.linalg.norm(mean) > 0.0:
        return imu.gyro_radps[:, 2]
    return np.asarray(imu.gyro_radps @ (mean / np.linalg.norm(mean)))


def _progress(context: CheckContext, rolled: motion.Integral | None) -> tuple[float, str] | None:
    """Distance covered over distance rolled, both in steps of 10 s, and the source of positions."""
    for path in measured_paths(context.recording):
        grid = np.arange(path.t_s[0], path.t_s[-1], 10.0)
        if rolled is None or len(grid) < 3:
            continue
        steps = np.abs(np.diff(np.interp(grid, path.t_s, path.place)))
        distance = float(np.sum(rolled.rates(grid)) * 10.0)
        if distance > 10.0 * max(path.sigma_m, 0.1):
            return float(steps.sum()) / distance, path.source
    return None


def runs_backwards(context: CheckContext) -> str | None:
    """Evidence that the wheels report backwards when the robot drives forward; None where there is none."""
    driven = motion.wheel_speed(context)
    if driven is None:
        return None
    found = heading(context)
    if found is not None and found.angle is not None:
        if abs(found.angle) <= 0.75 * np.pi:
            return None
        if wheels_turn_backwards(context):
            return "acceleration answers them with the opposite sign"
        # Either wheels or IMU stand the wrong way round: few robots drive backwards, fewer with such an IMU.
        share = backwards_share(context)
        if share is None or share < MORE:
            return None
        return f"net {share:.0%} of the way is backwards; acceleration answers with the opposite sign"
    t, v = driven
    rolled = motion.Integral(t, motion.cumulative(t, v))
    for name, forward in _forward_distances(context).items():
        start, end = motion.common_span(rolled, forward)
        if end - start < LEAST_S:
            continue
        grid = np.arange(start, end, 0.5)
        a, b = rolled.rates(grid), forward.rates(grid)
        power = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
        if power > 0.0 and np.abs(a).mean() > LEAST_MPS:
            r = float(np.sum(a * b)) / power
            return f"{name} goes the other way (correlation {r:.2f})" if r < -motion.SURE_R else None
    total = float(np.abs(v).sum())
    mostly = total > 0.0 and float(v.sum()) / total < -MOSTLY and t[-1] - t[0] > LEAST_S
    return "they run backwards nearly all the time" if mostly and wheels_turn_backwards(context) else None


def _forward_distances(context: CheckContext) -> dict[str, motion.Integral]:
    """Signed distance driven forward (m) by truth and command."""
    recording, start = context.recording, context.recording.start_ns
    truth, command = recording.truth, recording.command
    found: dict[str, motion.Integral | None] = {}
    if truth is not None and truth.quaternion is not None:
        known = np.isfinite(truth.position_m[:, :2]).all(axis=1) & np.isfinite(truth.quaternion).all(axis=1)
        if known.sum() > 10:
            t, yaw = motion.seconds(truth.t_ns[known], start), truth.yaw_rad()[known]
            forward = np.real(np.diff(motion.on_plane(truth.position_m[known])) * np.exp(-1j * yaw[:-1]))
            found["the truth"] = motion.Integral(t, np.concatenate([[0.0], np.cumsum(forward)]))
    if command is not None:
        found["the command"] = motion.integral(start, command.t_ns, command.v_mps)
    return {name: distance for name, distance in found.items() if distance is not None}
