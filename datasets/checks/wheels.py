"""The wheels: each against the others, left against right, and their sign against the motion."""

import dataclasses
from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair, changed
from terrafusion.datasets.checks.imu import (
    MORE,
    MOSTLY,
    at_rest,
    backwards_share,
    gravity,
    heading,
    turning_axis,
    wheels_turn_backwards,
)
from terrafusion.datasets.checks.path import measured_paths, scales
from terrafusion.datasets.checks.scale import is_firm
from terrafusion.datasets.checks.steering import axles
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.bootstrap import BootstrapInterval, interval_of, resampled_rows
from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.wrapped_angles import paired_sides, sampled_apart

DEAD, LEAST_R, ODD_SCALE = 0.02, 0.9, 0.15
"""Speed of a wheel over its partner's below which it is dead; correlation and scale error of an odd one."""
STRAIGHT_RAD = 0.3
"""A wheel that is turned so far rolls 5 % further than the other one of its side; it does in every curve."""
WIDEST_TRACK_M = 6.0
"""Sides at speeds -v and v spin a robot at v over half its effective track, which is below this."""
LEAST_S, LEAST_MPS = 10.0, 0.05
"""Shorter and slower runs do not show the direction of the wheels."""
MOSTLY_BACKWARDS = "they run backwards nearly all the time"
LEAST_PROGRESS = 0.3
"""Distance covered over distance rolled, if the sides turn the same way, above which it does not spin."""

LEAST_TURN_RADPS, TRACKS, SPINS = 0.15, 60, (0.3, 0.7)
"""Turns that are judged, and effective tracks tried; how near the sum of the sides must come to a turn, as a
share of it, and by how much their difference must miss it."""
LEAST_SPINS, SPIN_SHARE, MOST_LEFT = 10, 0.05, 0.15
"""Half seconds of spinning, and their share of the turns, at least; what the sum of the sides, where it is
nearer, may leave of the square error of their difference."""


def check_each_wheel(context: CheckContext) -> Iterator[Finding]:
    """Of four wheels, each must run as the other one of its side does."""
    wheels = context.recording.wheels
    if wheels is None or len(wheels.names) != 4:
        return
    speed = wheels.speed[np.isfinite(wheels.speed).all(axis=1) & _straight(context, wheels)]
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


def _straight(context: CheckContext, wheels: Wheels) -> NDArray[np.bool_]:
    """Rows (N,) in which no wheel is turned by more than `STRAIGHT_RAD`."""
    steering = context.recording.steering
    if steering is None or not len(steering):
        return np.ones(len(wheels), dtype=bool)
    most = np.abs(axles(context)).max(axis=1)
    return np.asarray(np.interp(wheels.t_ns, steering.t_ns, most) < STRAIGHT_RAD)


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
    evidence, wheels = runs_backwards(context), context.recording.wheels
    if evidence is None or wheels is None or sides_opposed(context) is not None:
        return
    if evidence == MOSTLY_BACKWARDS and not (wheels.has_sides() and turning_axis(context)):
        yield Finding(
            "wheel-reversed", "warning", "wheels",
            evidence,
            "nothing else shows which way the robot drove",
            "if it did not reverse, change the sign of all wheels",
        )  # fmt: skip
        return
    yield Finding(
        "wheel-reversed", "error", "wheels",
        "the wheels run backwards when the robot drives forward",
        evidence,
        *_reversal(context),
    )  # fmt: skip


def _reversal(context: CheckContext) -> tuple[str, Repair]:
    """What to do with wheels that run backwards; that they turn as the gyro does means swapped sides, too."""
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


def check_unsigned(context: CheckContext) -> Iterator[Finding]:
    """Sides that never run backwards must turn the robot by their difference, not by their sum."""
    wheels, imu = context.recording.wheels, context.recording.imu
    if wheels is None or imu is None or not wheels.has_sides() or (wheels.speed < 0.0).any():
        return
    left, right = wheels.side_speeds_mps(context.wheel_radius_m() or motion.ANY_RADIUS_M).T
    start = context.recording.start_ns
    found = [motion.integral(start, wheels.t_ns, rate) for rate in (right - left, left + right)]
    gyro = motion.integral(start, imu.t_ns, _vertical_rate(context, imu))
    if gyro is None or found[0] is None or found[1] is None:
        return
    grid = np.arange(*motion.common_span(gyro, found[0]), motion.WINDOW_S)
    if len(grid) < 2:
        return
    turn, apart, together = (angle.rates(grid) for angle in (gyro, *found) if angle is not None)
    turns = np.abs(turn) > LEAST_TURN_RADPS
    turn, apart, together = turn[turns], np.abs(apart[turns]), together[turns]
    track = np.geomspace(LEAST_TRACK_M, WIDEST_TRACK_M, TRACKS)[:, None]
    by_difference = np.abs(np.abs(turn) - apart / track)
    by_sum = np.abs(np.abs(turn) - together / track)
    either = (np.minimum(by_difference, by_sum) ** 2).sum(axis=1)
    best = int(np.argmin(either))
    spins = (by_sum[best] < SPINS[0] * np.abs(turn)) & (by_difference[best] > SPINS[1] * np.abs(turn))
    share = spins.sum() / max(len(turn), 1)
    if spins.sum() < LEAST_SPINS or share < SPIN_SHARE:
        return
    if either[best] > MOST_LEFT * (by_difference**2).sum(axis=1).min():
        return
    yield Finding(
        "wheel-unsigned", "error", "wheels",
        "the speeds have no sign: no side ever runs backwards",
        f"in {share:.0%} of the turns the robot spins by the gyro as if the sides ran against each other",
        "log the direction, too: both channels of the encoder, or the sign of the command of each side",
    )  # fmt: skip


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
            moved = np.sqrt(max(float((steps**2).mean()) - 4.0 * path.sigma_m**2, 0.0))  # less the noise
            return moved * len(steps) / distance, path.source
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
    return MOSTLY_BACKWARDS if mostly and wheels_turn_backwards(context) else None


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


WINDOW_S, BLOCK, LEAST_BLOCKS = 1.0, 10, 8
"""Rates are averaged over windows; as many of them are one block of the bootstrap."""
STRAIGHT_R, STRAIGHT_MPS, LEAST_TRACK_M = 0.6, 0.1, 0.2
BIAS_RADPS, REST_BIAS_RADPS, MOST_BIAS_RADPS = 0.005, 0.0005, 0.02
"""1 sigma of the gyro's bias where the log shows no rest, and where it does; more is no bias."""
LARGE, SIGNIFICANT, WIDEST, MOST = 0.025, 0.015, 0.05, 0.3
"""A difference of radii counts from the first on, with its interval beyond the second and narrower than the
third. Tyres of one robot differ by up to that much: a Warthog's by 1.7 % (norlab_drive)."""
TURNS, ONE_BEND = (10.0, 90.0), 0.25
"""In one long bend a difference cannot be distinguished from the track, and on a slope slip varies with the
heading: these percentiles of the yaw rate, positive to the side of most turns, must differ by this factor."""
SLIP_FREE = 1.005


def check_apart(context: CheckContext) -> Iterator[Finding]:
    """Both sides must be known at one time."""
    wheels = context.recording.wheels
    if wheels is None or not sampled_apart(wheels):
        return
    whole = np.asarray(np.isfinite(wheels.speed).all(axis=1))
    yield Finding(
        "sides-apart", "error", "wheels",
        "left and right are sampled at different times",
        f"{int(whole.sum())} of {len(whole)} rows have both",
        "interpolate each side between its own samples",
        changed("wheels", paired_sides),
    )  # fmt: skip


def check_radii(context: CheckContext) -> Iterator[Finding]:
    """Both sides must roll as far on straights, where the gyro shows no turn."""
    found = radius_difference(context)
    if found is None or not LARGE < abs(found.value) < MOST:
        return
    if not found.is_beyond(SIGNIFICANT) or found.high - found.low > WIDEST:
        return
    fast, slow = ("right", "left") if found.value > 0.0 else ("left", "right")
    known = [scale.ratio for scale, _ in scales(context)]
    raised = bool(known) and min(known) > SLIP_FREE  # both would be too slow with the fast side reduced
    ends = sorted([abs(found.low), abs(found.high)])
    side = slow if raised else fast
    factor = 1.0 + abs(found.value) if raised else 1.0 / (1.0 + abs(found.value))
    yield Finding(
        "wheel-sides", "warning", "wheels",
        f"{fast} rolls {abs(found.value):.1%} further than {slow} where the gyro shows no turn",
        f"95 % interval {ends[0]:.1%} to {ends[1]:.1%}: a deflated tyre, or another radius",
        f"multiply the {side} speeds by {factor:.4f}",
        changed("wheels", _scaled, side=side, factor=factor),
    )  # fmt: skip


def radius_difference(context: CheckContext) -> BootstrapInterval | None:
    """Right over left wheel speed on straights, less 1.

    Right minus left speed is regressed on yaw rate (the effective track), speed (the difference of the radii)
    and a constant (the gyro's bias, which a rest shows). None on soft ground, where the sides slip.
    """
    known, wheels = motion.yaw_angles(context), context.recording.wheels
    if wheels is None or "gyro" not in known or "wheels" not in known or not is_firm(context.recording):
        return None
    gyro, apart, bias = known["gyro"], known["wheels"], _rest_bias(context)
    both = motion.agreement(gyro, apart)
    driven = motion.wheel_speed(context)
    if (
        both is None
        or both.r < STRAIGHT_R
        or driven is None
        or (bias is not None and abs(bias) > MOST_BIAS_RADPS)
    ):
        return None
    rolled = motion.Integral(driven[0], motion.cumulative(*driven))  # mean of both sides, as `yaw_angles`
    start, end = motion.common_span(gyro, apart)
    grid = np.arange(start, end, WINDOW_S)
    columns = np.stack([rolled.rates(grid), gyro.rates(grid), np.ones(len(grid) - 1)], axis=1)
    difference = apart.rates(grid)
    blocks = np.arange(len(difference)) // BLOCK
    moving = np.abs(columns[:, 0]) > STRAIGHT_MPS
    if moving.sum() < LEAST_BLOCKS * BLOCK or len(np.unique(blocks[moving])) < LEAST_BLOCKS:
        return None
    columns, difference, blocks = columns[moving], difference[moving], blocks[moving]
    slow, fast = np.percentile(columns[:, 1] * np.sign(columns[:, 1].sum()), TURNS)
    if slow > ONE_BEND * fast:
        return None
    fit, *_ = np.linalg.lstsq(columns, difference, rcond=None)
    track, noise = max(float(fit[1]), LEAST_TRACK_M), float(np.std(difference - columns @ fit))
    sigma = track * (BIAS_RADPS if bias is None else REST_BIAS_RADPS)
    weight = np.diag([1e-9, 1e-9, (noise / sigma) ** 2])
    pulled = weight @ np.array([0.0, 0.0, -track * (bias or 0.0)])
    rows = [blocks == block for block in np.unique(blocks)]
    H = np.array([columns[r].T @ columns[r] for r in rows])
    h = np.array([columns[r].T @ difference[r] for r in rows])
    draws = np.concatenate([np.arange(len(rows))[None], resampled_rows(len(rows))])
    right = h[draws].sum(axis=1) + pulled
    drawn = np.linalg.solve(H[draws].sum(axis=1) + weight, right[..., None])[:, 0, 0]
    return interval_of(float(drawn[0]), drawn[1:], len(rows))


def _rest_bias(context: CheckContext) -> float | None:
    resting, imu = at_rest(context), context.recording.imu
    if imu is None or resting.sum() < 50:
        return None
    values = imu.gyro_radps[resting, 2]
    return float(np.nanmean(values)) if np.isfinite(values).any() else None


def _scaled(wheels: Wheels, side: str, factor: float) -> Wheels:
    factors: Array = np.array([factor if side in name else 1.0 for name in wheels.names])
    angle = None if wheels.angle_rad is None else wheels.angle_rad * factors
    return dataclasses.replace(wheels, speed=wheels.speed * factors, angle_rad=angle)
