"""The IMU: unit and presence of gravity, mounting, gyro bias at standstill.

Gravity shows which axis points up; the specific force along and across the path (change of speed, speed
times yaw rate) which one points forward; gyro and wheels whether the gyro shares the accelerometer's axes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import permutations

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.finding import (
    CheckContext,
    Finding,
    Repair,
    changed,
    changed_field,
    once,
    scaled,
    with_fields,
)
from terrafusion.datasets.checks.signals import ROLLED_OVER, without_stuck
from terrafusion.datasets.checks.timing import GAP_PERIODS, GAP_S
from terrafusion.datasets.core.arrays import Array, Complex, Mask
from terrafusion.datasets.core.bootstrap import interval_of, resampled_rows
from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.frames import GRAVITY_MPS2, turned_by
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import AXES, axes_matrix

Axes = tuple[str, ...]

REMOVED_SHARE = 0.15
"""Mean specific force over g below which gravity has been removed."""
REST_S, MARGIN_S = 2.0, 0.5
"""Wheels at zero for this long, less a margin at both ends, are a standstill."""
LARGE_BIAS_RADPS, STILL_RADPS = 0.02, 0.05
"""1.1 deg/s is beyond the bias of MEMS gyros of robots; with a standard deviation above the second the
robot is not at rest."""
IMPOSSIBLE_BIAS_RADPS = 0.1
"""5.7 deg/s; no gyro of a robot is so far off: the axis is broken, or its value is not a rate."""
LEAST_REST_ROWS = 50
CIRCLING_MPS2 = 3.0
"""Mean speed times rate of turn, about any axis, above which the mean force is not gravity (assumed)."""
MOST_TILT = np.cos(np.radians(30.0))
"""Slopes of up to 25 deg tilt the mean specific force by as much."""
WINDOW_S, SMOOTH_S = 0.5, 8.0
"""Motion is compared over the first, less its mean over the second: slopes and biases change slowly."""
LEAST_C, SIGMAS = 0.25, 5.0
"""A correlation counts above the first, and above this many standard errors of noise."""
MOSTLY, MORE = 0.8, 0.5
"""Net way backwards over the way rolled, above which wheels run backwards nearly all the time, and above
which they, not the IMU, are taken to stand the wrong way round (assumed)."""
NEAR_AXIS = np.radians(25.0)
SIGNIFICANT_TURN = np.radians(12.0)
"""Slopes, and lever arms of the IMU, seem to turn those of good field logs by up to 8 deg."""
BLOCK, LEAST_BLOCKS = 20, 4
"""Windows of a block of the bootstrap, and blocks that are needed."""
LEAST_GAIN = 0.4
"""Measured acceleration over that of the wheels: a stuck robot only shakes with its wheels."""
LEAST_MIRROR_MARGIN = 0.1
"""By how much the correlation with the turns must differ from that with mirrored turns."""
LEAST_ACCEL = 0.02
"""m/s2; a run at more constant speed determines nothing."""


@once
def gravity(context: CheckContext) -> Array | None:
    """Mean specific force (3,), m/s2, where all three axes are known."""
    imu = context.recording.imu
    if imu is None or not imu.has_accel() or len(imu) < 10:
        return None
    rows = _not_circling(context, imu)
    if rows.sum() < LEAST_REST_ROWS <= len(imu):
        return None
    return np.asarray(_mounting(context) @ np.nanmean(imu.accel_mps2[rows], axis=0))


def _not_circling(context: CheckContext, imu: Imu) -> Mask:
    """Mask (N,) of samples without the force of a turn, where that would be taken for gravity; else all."""
    driven, every = motion.wheel_speed(context), np.ones(len(imu), dtype=bool)
    if driven is None:
        return every
    speed = np.interp(motion.seconds(imu.t_ns, context.recording.start_ns), *driven)
    turning = np.nan_to_num(speed[:, None] * imu.gyro_radps)
    if np.linalg.norm(turning.mean(axis=0)) <= CIRCLING_MPS2:
        return every
    return np.asarray(np.linalg.norm(turning, axis=1) < CIRCLING_MPS2)


def _mounting(context: CheckContext) -> Array:
    """Rotation (3, 3) of the IMU's readings into body axes, as far as the vehicle file knows its angles."""
    from scipy.spatial.transform import Rotation

    angles = [context.known(f"imu_{name}_rad") for name in ("roll", "pitch", "yaw")]
    return np.asarray(Rotation.from_euler("xyz", angles).as_matrix())


def is_metric(mean: Array) -> bool:
    """Whether a mean specific force is as long as gravity in m/s2."""
    return bool(0.85 * GRAVITY_MPS2 < np.linalg.norm(mean) < 1.15 * GRAVITY_MPS2)


def is_upright(context: CheckContext) -> bool:
    """Whether gravity, where it is known, is along +z."""
    mean = gravity(context)
    return mean is None or bool(mean[2] >= MOST_TILT * np.linalg.norm(mean))


def nearest_axis(vector: Array) -> str:
    """The axis that a vector lies nearest to, such as "-y"."""
    k = int(np.argmax(np.abs(vector)))
    return f"{'+' if vector[k] > 0 else '-'}{'xyz'[k]}"


def _mean_force(mean: Array) -> str:
    return f"mean specific force ({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) m/s2"


def check_gravity(context: CheckContext) -> Iterator[Finding]:
    """The mean specific force must be as long as gravity, in m/s2."""
    mean = gravity(context)
    if mean is None or is_metric(mean):
        return
    size = float(np.linalg.norm(mean))
    for unit, in_g in (("g", 1.0), ("mg", 1000.0)):
        if 0.85 < size / in_g < 1.15:
            factor = GRAVITY_MPS2 / in_g
            what, fix = f"acceleration looks like {unit}, not m/s2", f"multiply by {factor:.7g}"
            repair = scaled("imu", factor, "accel_mps2")
            yield Finding("accel-in-g", "error", "imu", what, _mean_force(mean), fix, repair)
            return
    what = f"mean specific force is {size:.2f} m/s2, not 9.8"
    fix, emptied = "give raw accelerometer data in m/s2, gravity included", None
    if size < REMOVED_SHARE * GRAVITY_MPS2:
        what += ": gravity has been removed"
        fix = f"leave the accelerometer out (better: {fix})"
        emptied = changed_field("imu", "accel_mps2", lambda accel: np.full_like(accel, np.nan))
    yield Finding("accel-magnitude", "error", "imu", what, _mean_force(mean), fix, emptied)


def check_bias(context: CheckContext) -> Iterator[Finding]:
    """The gyro must read next to nothing while the wheels stand, and never roll the robot over."""
    imu, resting = without_stuck(context).imu, at_rest(context)
    if imu is None:
        return
    if resting.sum() >= LEAST_REST_ROWS:
        bias = _bias_at_rest(imu.gyro_radps[resting])
        what, where = "at rest", f"in {resting.sum()} samples while the wheels stand"
    else:
        bias = _bias_of_tilt(imu) if is_upright(context) else np.zeros(3)
        what, where = "about x or y", "throughout, in which the robot would have rolled over"
    largest = float(np.abs(bias).max())
    if largest <= LARGE_BIAS_RADPS:
        return
    yield Finding(
        "gyro-bias", "error" if largest > IMPOSSIBLE_BIAS_RADPS else "warning", "imu",
        f"the gyro turns {what} by up to {np.degrees(largest):.1f} deg/s",
        f"mean ({', '.join(f'{value:.3f}' for value in bias)}) rad/s {where}",
        "subtract these means",
        changed_field("imu", "gyro_radps", lambda rates: rates - bias),
    )  # fmt: skip


def _bias_at_rest(gyro: Array) -> Array:
    """Mean rates (3,) of a robot at rest; 0 where unknown, or where it is not at rest."""
    known = np.isfinite(gyro).all(axis=0)
    values = np.where(known, np.nan_to_num(gyro), 0.0)
    return np.asarray(values.mean(axis=0) if values.std(axis=0).max() <= STILL_RADPS else np.zeros(3))


def _bias_of_tilt(imu: Imu) -> Array:
    """Mean rates (3,) about x and y, where together they would have turned the robot over; else 0."""
    bias = np.zeros(3)
    seconds = float(imu.t_ns[-1] - imu.t_ns[0]) * 1e-9
    for k in range(2):
        values = imu.gyro_radps[np.isfinite(imu.gyro_radps[:, k]), k]
        mean = float(values.mean()) if len(values) else 0.0
        bias[k] = mean if abs(mean) * seconds > ROLLED_OVER else 0.0
    return bias


def at_rest(context: CheckContext) -> Mask:
    """Mask (N,) of the IMU's samples during standstills of all wheels."""
    wheels, imu = context.recording.wheels, context.recording.imu
    if wheels is None or imu is None or len(wheels) < 2:
        return np.zeros(0 if imu is None else len(imu), dtype=bool)
    top = np.nanmax(np.abs(wheels.speed), initial=0.0) if np.isfinite(wheels.speed).any() else 0.0
    first, after = motion.runs(np.asarray((np.abs(wheels.speed) <= 1e-3 * top).all(axis=1)))
    begins, ends = wheels.t_ns[first], wheels.t_ns[after - 1]
    steps = np.diff(wheels.t_ns)
    gaps = wheels.t_ns[:-1][steps > max(GAP_PERIODS * float(np.median(steps)), GAP_S * 1e9)]
    whole = np.searchsorted(gaps, begins) == np.searchsorted(gaps, ends)  # motion in a gap is unknown
    rests = whole & ((ends - begins) * 1e-9 >= REST_S)
    margin = round(MARGIN_S * 1e9)
    begins, ends = begins[rests] + margin, ends[rests] - margin
    if not len(begins):
        return np.zeros(len(imu), dtype=bool)
    rest = np.searchsorted(begins, imu.t_ns, side="right") - 1
    return np.asarray((rest >= 0) & (imu.t_ns <= ends[np.maximum(rest, 0)]))


@dataclass(frozen=True)
class ForceHeading:
    """How the specific force answers wheels and turns.

    Attributes:
        angle: rad, to the left, from the body's forward axis to the first axis of the specific
            force; None where the gyro contradicts the accelerometer.
        turn: 1 where the specific force in turns fits the gyro, -1 where it points to the other side
            (the gyro has the wrong sign), 0 where the robot hardly turns.
        spread: half the 95 % interval of the angle, rad, by bootstrap over blocks of 10 s.
    """

    angle: float | None
    turn: float
    spread: float = np.inf


def heading_of(context: CheckContext, accel: Array, yaw_rate: Array) -> ForceHeading | None:
    """How the horizontal specific force answers the changes of speed and the turns.

    Args:
        accel: (N, 2) horizontal specific force, m/s2, the second axis left of the first.
        yaw_rate: (N,) about the upward axis, rad/s.

    Returns:
        None where the run is too short, too even or too noisy.
    """
    imu, start = context.recording.imu, context.recording.start_ns
    driven = motion.wheel_speed(context)
    if imu is None or driven is None:
        return None
    columns = [motion.integral(start, imu.t_ns, column) for column in (*accel.T, yaw_rate)]
    known = [column for column in columns if column is not None] + [
        motion.Integral(driven[0], motion.cumulative(*driven))
    ]
    first, last = max(one.t_s[0] for one in known), min(one.t_s[-1] for one in known)
    if len(known) < 4 or not last - first >= 2.0 * SMOOTH_S:
        return None
    grid = np.arange(first, last, WINDOW_S)
    along, across, turn, speed = (one.rates(grid) for one in known)
    measured = _detrended(0.5 * (along + 1j * across)[1:] + 0.5 * (along + 1j * across)[:-1])
    left = speed * turn
    predicted = _detrended(np.diff(speed) / WINDOW_S + 0.5j * (left[1:] + left[:-1]))
    power = float(np.sqrt(np.sum(np.abs(measured) ** 2) * np.sum(np.abs(predicted) ** 2)))
    if np.abs(predicted).std() < LEAST_ACCEL or power <= 0.0:
        return None
    common, mirrored = complex(np.sum(measured * np.conj(predicted))), complex(np.sum(measured * predicted))
    best = max(abs(common), abs(mirrored))
    gain = best / float(np.sum(np.abs(predicted) ** 2))
    noise = SIGMAS / np.sqrt(len(measured))
    if gain < LEAST_GAIN or best / power < max(LEAST_C, noise):
        return None
    apart = (abs(common) - abs(mirrored)) / power
    side = float(np.sign(apart)) if abs(apart) > max(LEAST_MIRROR_MARGIN, noise) else 0.0
    if side < 0.0:
        return ForceHeading(None, side)
    return ForceHeading(-float(np.angle(common)), side, _spread(measured * np.conj(predicted)))


def _spread(products: Complex) -> float:
    """Half the 95 % interval of the angle of a sum of products (N,), rad."""
    blocks = np.add.reduceat(products, np.arange(0, len(products), BLOCK))
    if len(blocks) < LEAST_BLOCKS:
        return float(np.inf)
    drawn = blocks[resampled_rows(len(blocks))].sum(axis=1)
    off = interval_of(0.0, np.angle(drawn * np.conj(blocks.sum())), len(blocks))
    return max(-off.low, off.high)


def _detrended(values: Array | Complex) -> Complex:
    """A signal less its running mean."""
    kernel = np.ones(round(SMOOTH_S / WINDOW_S) + 1)
    count = np.convolve(np.ones(len(values)), kernel, "same")
    return np.asarray(values - np.convolve(values, kernel, "same") / count)


@once
def heading(context: CheckContext) -> ForceHeading | None:
    """`heading_of` the IMU's x and y, with its gyro z; None where z is not up."""
    imu = context.recording.imu
    if imu is None or not is_upright(context):
        return None
    R = _mounting(context)
    return heading_of(context, turned_by(R, imu.accel_mps2)[:, :2], turned_by(R, imu.gyro_radps)[:, 2])


def turning_axis(context: CheckContext) -> str | None:
    """The axis of the gyro, with its sign, that turns as the wheels (else the truth) do."""
    known = motion.yaw_angles(context)
    other = known.get("wheels") or known.get("truth")
    if other is None:
        return None
    best, name = 0.0, None
    for k, axis in enumerate("xyz"):
        turned = motion.gyro_angle(context.recording, k)
        both = motion.agreement(turned, other) if turned is not None else None
        if both is not None and both.is_significant() and abs(both.r) > best:
            best, name = abs(both.r), f"{'+' if both.r > 0 else '-'}{axis}"
    return name


def wheels_turn_backwards(context: CheckContext) -> bool:
    """Whether the wheels turn against gyro z; on a straight run, whether they mostly run backwards."""
    driven, wheels = motion.wheel_speed(context), context.recording.wheels
    axis = turning_axis(context) if wheels is not None and wheels.has_sides() else None
    return axis == "-z" or (axis is None and driven is not None and float(driven[1].mean()) < 0.0)


def backwards_share(context: CheckContext) -> float | None:
    """Net way backwards by the wheels over the way rolled; None where a command says which way it was."""
    driven = motion.wheel_speed(context)
    if driven is None or context.recording.command is not None or not driven[1].any():
        return None
    return -float(driven[1].sum() / np.abs(driven[1]).sum())


def check_axes(context: CheckContext) -> Iterator[Finding]:
    """Gravity must be along +z, and the specific force must answer the wheels along +x and +y."""
    mean, imu = gravity(context), context.recording.imu
    if mean is None or imu is None or not is_metric(mean):
        return
    if is_upright(context):
        yield from _check_forward(context)
        return
    evidence, repair = _mean_force(mean), None
    axes: Axes = ()
    if np.abs(mean).max() < MOST_TILT * np.linalg.norm(mean):
        what, fix = "gravity lies between the axes", "rotate the IMU to x forward, y left, z up"
    else:
        up = nearest_axis(mean)
        what = f"gravity stands on {up}, not on +z"
        more, fix, repair, axes = _uprighted(context, imu, up)
        evidence += more
    yield Finding("imu-axes", "error", "imu", what, evidence, fix, repair, axes)


def _check_forward(context: CheckContext) -> Iterator[Finding]:
    found = heading(context)
    if found is None or found.angle is None:
        return
    angle, sure = found.angle, abs(found.angle) - found.spread > SIGNIFICANT_TURN
    if abs(angle) < 0.25 * np.pi and not sure:
        return
    quarter = round(angle / (0.5 * np.pi)) % 4
    if quarter == 2 and (wheels_turn_backwards(context) or (backwards_share(context) or 0.0) > MORE):
        return  # one fault explains both: see wheels.check_direction
    off = abs(np.angle(np.exp(1j * (angle - 0.5 * np.pi * quarter))))
    axes = {1: ("-y", "+x", "+z"), 2: ("-x", "-y", "+z"), 3: ("+y", "-x", "+z")}.get(quarter, ())
    near = bool(axes) and off < NEAR_AXIS
    fix = "give the IMU's mounting"
    repair: Repair | None = None
    if near:
        fix, repair = _pointing("IMU", axes), partial(_turned, axes=axes, gyro=True)
    elif sure:
        fix = f"turn the IMU by {np.degrees(-angle):.0f} deg about z"
        repair = changed("imu", _turned_by, angle=angle)
    interval = f" +- {np.degrees(found.spread):.0f}" if np.isfinite(found.spread) else ""
    yield Finding(
        "imu-forward", "error" if near else "warning", "imu",
        "x does not point forward",
        f"by change of speed and speed times yaw rate it is turned by {np.degrees(angle):.0f}{interval} deg",
        fix,
        repair,
        axes if near else (),
    )  # fmt: skip


def _turned_by(imu: Imu, angle: float) -> Imu:
    """The readings in body axes of an IMU that is turned by `angle` (rad) about z, to the left."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Imu(imu.t_ns, turned_by(R, imu.gyro_radps), turned_by(R, imu.accel_mps2))


def _pointing(sensor: str, axes: Axes) -> str:
    return f"turn the {sensor} so that {', '.join(axes)} point forward, left, up"


def _uprighted(context: CheckContext, imu: Imu, up: str) -> tuple[str, str, Repair, Axes]:
    """Further evidence of the mounting, what to do, the repair, and the axes of the whole IMU."""
    turning = turning_axis(context)
    alone = turning == "+z"  # the gyro is right as it is: the accelerometer has other axes
    if alone and up == "-z":
        evidence, fix = "; gyro z turns with the wheels", "change the sign of the specific force"
        return evidence, fix, scaled("imu", -1.0, "accel_mps2"), ()
    axes, evidence = _axes_for(context, imu, up, alone)
    if turning is not None:
        evidence = f"; the gyro turns with the wheels about {turning}{evidence}"
    fix = _pointing("accelerometer" if alone else "IMU", axes)
    turned = partial(_turned, axes=axes, gyro=not alone)
    return evidence, fix, turned, () if alone else axes


def _axes_for(context: CheckContext, imu: Imu, up: str, alone: bool) -> tuple[Axes, str]:
    """The axes with z `up` that the run determines, else those nearest to the log's; and which it was."""
    orders = (axes for axes in permutations(AXES, 3) if axes[2] == up)
    choices = [axes for axes in orders if np.linalg.det(np.array([AXES[name] for name in axes])) > 0.5]
    nearest = max(choices, key=lambda axes: (np.trace(axes_matrix(axes)), axes[0] == "+x"))
    R = axes_matrix(nearest)
    accel = imu.accel_mps2 @ R.T
    upward = imu.gyro_radps[:, "xyz".index(up[1])] * (1.0 if up[0] == "+" else -1.0)
    found = heading_of(context, accel[:, :2], imu.gyro_radps[:, 2] if alone else upward)
    if found is None or found.angle is None:
        return nearest, "; nothing shows which axis is forward: the nearest rotation is assumed"
    quarter = round(found.angle / (0.5 * np.pi)) % 4
    turn = np.linalg.matrix_power(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), quarter)
    axes = next(a for a in choices if np.allclose(axes_matrix(a), turn @ R))
    return axes, f"; acceleration follows the wheels along {axes[0]}"


def _turned(recording: Recording, axes: Axes, *, gyro: bool) -> Recording:
    """The recording with `axes` of its IMU along x, y, z; of the accelerometer alone without `gyro`."""
    turned = apply(recording, Conventions(imu_axes=axes))
    if gyro or recording.imu is None:
        return turned
    return with_fields(turned, "imu", gyro_radps=recording.imu.gyro_radps)
