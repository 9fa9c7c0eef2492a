"""Consistency of the yaw rates of gyro, wheels, fixes, truth and command.

Where two contradict each other, the smallest set of sources whose reversal makes all agree is at fault.
Where courses are too coarse to say, the path of the fixes is compared with its mirror image.
"""

from collections.abc import Iterator
from functools import partial
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair, changed, once, scaled
from terrafusion.datasets.checks.gnss_frame import reflection
from terrafusion.datasets.checks.imu import heading, is_upright
from terrafusion.datasets.checks.motion import course_agreement, gyro_angle
from terrafusion.datasets.checks.path import LONGEST_S, antenna, dead_reckoned, path_by
from terrafusion.datasets.checks.steering import steered_angle
from terrafusion.datasets.checks.wheels import runs_backwards, sides_opposed, swapped
from terrafusion.datasets.core.arrays import Array, Complex
from terrafusion.datasets.core.conventions import Conventions, apply

Agreements = dict[tuple[str, str], motion.Agreement]
Signs = dict[tuple[str, str], float]
"""By pair of yaw sources 1 where they turn alike, -1 where they turn against each other."""


class YawSource(NamedTuple):
    """How findings name a source of yaw rates, and the channel, code and severity of one on its sign."""

    label: str
    channel: str
    code: str
    severity: str


SOURCES = {
    "steering": YawSource("the steering", "steering", "steering-sign", "error"),
    "gyro": YawSource("gyro z", "imu", "yaw-sign", "error"),
    "wheels": YawSource("the wheels", "wheels", "wheel-swap", "error"),
    "gnss": YawSource("the path of the fixes", "gnss", "gnss-course", "error"),
    "truth": YawSource("the truth's yaw", "truth", "truth-turns", "warning"),
    "command": YawSource("the command", "command", "command-sign", "warning"),
    "accelerometer": YawSource("the specific force in turns", "imu", "accel-mirrored", "warning"),
}
"""In the order in which they are suspected where the data leave it open."""
CODES = {name: source.code for name, source in SOURCES.items()}
DEGREES_SLOPE = {"wheels": 15.0, "truth": 30.0, "command": 15.0}
"""Limits of gyro rate over another source's. In rad/s it is the inverse track (0.3 to 4 1/m) or 1."""
DEGREE = np.pi / 180.0
SAME_RATE, CLEARLY_R = (0.5, 2.0), 0.2
"""Range of the gyro's rate over that of the path, and by how much better it must correlate as deg/s."""
FASTEST_RADPS, LEAST_BEYOND, LEAST_SPAN_S = 12.0, 4, 10.0
"""Two turns a second, which no ground robot makes (assumed); so many half-second means beyond it, in a log of
so many seconds, at least."""
UNRELATED_R, LIVELY, MANY = 0.3, 0.05, 40
FINE_S, REACH_S, LATE_GAIN = 0.1, 5.0, 0.1
"""Step and reach of the search for a delay; how much better it must correlate than a changed sign."""


def check_gyro_unit(context: CheckContext) -> Iterator[Finding]:
    """The gyro must be in rad/s."""
    found = _far_larger(context) or _by_course(context) or _beyond_robots(context)
    if found is None:
        return
    than, evidence = found
    yield Finding(
        "gyro-in-degrees", "error", "imu",
        f"gyro z is far larger than {than}: it looks like deg/s",
        evidence,
        "multiply by pi / 180",
        scaled("imu", DEGREE, "gyro_radps"),
    )  # fmt: skip


def _far_larger(context: CheckContext) -> tuple[str, str] | None:
    """Another turn rate that the gyro exceeds by far, and the evidence."""
    found = _agreements(context)
    for other, limit in DEGREES_SLOPE.items():
        both = found.get(("gyro", other))
        if both is None or not both.is_significant() or not limit <= abs(both.slope) < limit / DEGREE:
            continue  # beyond, it would be too large as deg/s, too: counts of the sensor
        label = SOURCES[other].label
        unit = "rad/s per m/s between the sides" if other == "wheels" else f"times that of {label}"
        return f"the turn rate of {label}", f"{abs(both.slope):.0f} {unit}; correlation {both.r:.2f}"
    return None


def _by_course(context: CheckContext) -> tuple[str, str] | None:
    """Whether gyro z as deg/s follows the course of the fixes, and as rad/s does not."""
    gnss, yaw, start_ns = context.recording.gnss, gyro_angle(context.recording), context.recording.start_ns
    if gnss is None or yaw is None:
        return None
    both = course_agreement(motion.Integral(yaw.t_s, DEGREE * yaw.value), gnss, start_ns)
    if both is None or not both.is_significant():
        return None
    raw = course_agreement(yaw, gnss, start_ns)
    if not SAME_RATE[0] < abs(both.slope) < SAME_RATE[1] or (raw and abs(raw.r) > abs(both.r) - CLEARLY_R):
        return None
    return (
        "the turn rate of the path of the fixes",
        f"as deg/s {abs(both.slope):.2f} times that of the path; correlation {both.r:.2f} in "
        f"{both.windows} stretches",
    )


def _beyond_robots(context: CheckContext) -> tuple[str, str] | None:
    """Whether gyro z turns, again and again, as no ground robot does."""
    yaw = gyro_angle(context.recording)
    if yaw is None or float(np.ptp(yaw.t_s)) < LEAST_SPAN_S:
        return None
    rates = np.abs(yaw.rates(np.arange(yaw.t_s[0], yaw.t_s[-1], motion.WINDOW_S)))
    beyond = int((rates > FASTEST_RADPS).sum())
    usual, top = np.percentile(rates, [50.0, 100.0]).tolist()
    # A reading that is stuck is no turn: see signals.
    if beyond < LEAST_BEYOND or usual > 0.5 * top or DEGREE * top > FASTEST_RADPS:
        return None
    return (
        "a ground robot turns",
        f"{top:.0f} rad/s at most and beyond {FASTEST_RADPS:g} in {beyond} half-second means",
    )


def check_turns(context: CheckContext) -> Iterator[Finding]:
    """All yaw sources must turn to the same side; the fewest that contradict are at fault."""
    found = _agreements(context)
    signs = _signs(context, found)
    against = [pair for pair, sign in signs.items() if sign < 0.0]
    if not against:
        return
    blamed = contradictors(signs)
    if not blamed:
        one, other = against[0]
        yield Finding(
            "yaw-contradiction", "warning", "imu",
            f"{SOURCES[one].label} {_verb(one)} against {SOURCES[other].label}",
            _evidence(against, signs, found) + "; no single sign explains all",
            "check the axes and signs of all of them",
        )  # fmt: skip
        return
    if frozenset({"wheels"}) in blamed and runs_backwards(context) is not None:
        return  # one fault explains both: see wheels.check_direction
    for name in sorted(blamed[0]):
        pairs = [pair for pair in against if name in pair]
        if not pairs or (name == "gyro" and not is_upright(context)):
            continue  # an IMU that is not upright: see imu.check_axes
        fix, repair = _remedy(context, name)
        source, other = SOURCES[name], next(SOURCES[one].label for one in pairs[0] if one != name)
        if len(blamed) > 1:
            fix += f" (assumed: no third source shows whether {source.label} or {other} is wrong)"
        yield Finding(
            CODES[name], source.severity, source.channel,
            f"{source.label} {_verb(name)} against {other}",
            _evidence(pairs, signs, found),
            fix,
            repair,
        )  # fmt: skip


def check_unrelated(context: CheckContext) -> Iterator[Finding]:
    """Gyro z must follow the wheels, whatever its sign."""
    both = _agreements(context).get(("gyro", "wheels"))
    if both is None or both.windows < MANY or min(both.spread) < LIVELY:
        return
    if both.is_significant() or both.r > UNRELATED_R:
        return
    yield Finding(
        "yaw-unrelated", "warning", "imu",
        "gyro z does not follow the wheels",
        f"correlation {both.r:.2f} of the half-second means",
        "check the IMU's axes, the clocks, and that both are of one robot; slippery ground does it, too",
    )  # fmt: skip


@once
def _agreements(context: CheckContext) -> Agreements:
    """What can be compared, without wheels of which one side has the wrong sign: they show no turn."""
    found = agreements(context)
    if any("wheels" in pair for pair in found) and sides_opposed(context) is not None:
        found = {pair: both for pair, both in found.items() if "wheels" not in pair}
    return found


@once
def agreements(context: CheckContext) -> Agreements:
    """Agreement of every pair of yaw sources that can be compared, in the order of `SOURCES`."""
    known = _sources(context)
    found: dict[tuple[str, str], motion.Agreement | None] = {}
    for one, other in combinations(SOURCES, 2):
        if one in known and other in known:
            window_s = motion.TRUTH_WINDOW_S if "truth" in (one, other) else motion.WINDOW_S
            found[one, other] = motion.agreement(known[one], known[other], window_s)
    gnss, track_m = context.recording.gnss, context.rig.track_m if context.rig else 1.0
    if gnss is not None:
        for name, unit in (("gyro", 1.0), ("wheels", track_m)):
            if name in known:
                yaw = motion.Integral(known[name].t_s, known[name].value / unit)
                found[name, "gnss"] = motion.course_agreement(yaw, gnss, context.recording.start_ns)
    return {pair: both for pair, both in found.items() if both is not None}


def contradictors(signs: Signs) -> list[frozenset[str]]:
    """The smallest sets of sources whose reversal makes all pairs agree; [] where none does.

    One set: the data determine who is wrong. Several: the first is the most suspect.
    [frozenset()]: no contradiction.
    """
    names = [name for name in SOURCES if any(name in pair for pair in signs)]
    consistent = []
    for flips in product((1.0, -1.0), repeat=len(names)):
        sign = dict(zip(names, flips, strict=True))
        if all(sign[a] * sign[b] == s for (a, b), s in signs.items()):
            consistent.append(frozenset(name for name in names if sign[name] < 0.0))
    fewest = min((len(flipped) for flipped in consistent), default=0)
    smallest = [flipped for flipped in consistent if len(flipped) == fewest]
    return sorted(smallest, key=lambda flipped: [name not in flipped for name in SOURCES])


def _sources(context: CheckContext) -> dict[str, motion.Integral]:
    """Angles turned by all sources but the fixes."""
    steered = steered_angle(context)
    return motion.yaw_angles(context) | ({} if steered is None else {"steering": steered})


def _signs(context: CheckContext, found: Agreements) -> Signs:
    known = _sources(context)
    signs = {}
    for (a, b), both in found.items():
        delayed = both.r < 0.0 and a in known and b in known and is_delayed(known[a], known[b], both.r)
        if both.is_significant() and not delayed:
            signs[a, b] = float(np.sign(both.r))
    centripetal = heading(context)
    if centripetal is not None and centripetal.turn and ("gyro", "wheels") in signs:
        signs["gyro", "accelerometer"] = centripetal.turn
    if min(signs.values(), default=0.0) < 0.0 and "gyro" in known and ("gyro", "gnss") not in signs:
        image = _image(context)  # where the course of the fixes is too coarse to judge between the others
        if image:
            signs["gyro", "gnss"] = -image
    return signs


def is_delayed(a: motion.Integral, b: motion.Integral, r: float) -> bool:
    """Whether two rates of negative correlation `r` agree clearly better unchanged but shifted in time."""
    grid = np.arange(*motion.common_span(a, b), FINE_S)
    if len(grid) < 3:
        return False
    kernel = np.ones(round(motion.WINDOW_S / FINE_S)) * FINE_S / motion.WINDOW_S
    one, other = (np.convolve(x.rates(grid), kernel, "valid") for x in (a, b))
    reach = min(round(REACH_S / FINE_S), len(one) // 4)
    if reach < 1 or min(one.std(), other.std()) <= 0.0:
        return False
    one, other = (one - one.mean()) / one.std(), (other - other.mean()) / other.std()
    middle = one[reach:-reach]
    best = float(np.correlate(other, middle, "valid").max()) / len(middle)
    return best > LATE_GAIN - r


def _verb(name: str) -> str:
    return "turn" if name == "wheels" else "turns"


def _evidence(pairs: list[tuple[str, str]], signs: Signs, found: Agreements) -> str:
    parts = [
        f"correlation {found[one, other].r:.2f} of {SOURCES[one].label} and {SOURCES[other].label}"
        for one, other in pairs
        if (one, other) in found
    ]
    turn = signs.get(("gyro", "accelerometer"), 0.0)
    if turn:
        parts.append(f"the specific force in turns {'agrees with' if turn > 0.0 else 'contradicts'} gyro z")
    if ("gyro", "gnss") in signs and ("gyro", "gnss") not in found:
        image = "mirror image of the " if signs["gyro", "gnss"] < 0.0 else ""
        parts.append(f"the path of the fixes is the {image}path by gyro z")
    return ", ".join(parts)


def _remedy(context: CheckContext, name: str) -> tuple[str, Repair | None]:
    """What to do where one source turns the wrong way."""
    if name == "gnss":
        return reflection(context.recording)
    gyro_sign = partial(apply, conventions=Conventions(gyro_z_sign=-1.0))
    command_sign = scaled("command", -1.0, "yaw_rate_radps")
    remedies: dict[str, tuple[str, Repair | None]] = {
        "gyro": ("change the sign of gyro z (left turn positive)", gyro_sign),
        "wheels": ("swap left and right wheels", changed("wheels", swapped)),
        "truth": ("check the truth's frame: its yaw must grow to the left", None),
        "command": ("change the sign of the commanded yaw rate (left turn positive)", command_sign),
        "steering": (
            "change the sign of the angles (left positive); are they `rear_rad`, beside a `front_rad` of 0?",
            scaled("steering", -1.0, "angle_rad"),
        ),
        "accelerometer": ("check the accelerometer's axes: x, y and z must make a right-handed frame", None),
    }
    return remedies[name]


LEAST_FIXES = 20
"""Fixes a piece, at least; more are averaged to so many, for noise of single fixes hides both images."""
CLEARER, LEAST_OFF_M, SCALES = 3.0, 1.0, (0.5, 1.5)
"""Ratio of what is left of the fixes about the path and about its image, and the least of the former, from
which on the image is meant: a straight path and its image differ by nothing, noise and drift bring both near
each other. What fits better must have about the scale of the path."""


def check_mirrored(context: CheckContext) -> Iterator[Finding]:
    """The path of the fixes must not be the mirror image of that of wheels and gyro."""
    gnss, yaw = context.recording.gnss, gyro_angle(context.recording)
    if gnss is None or yaw is None or course_agreement(yaw, gnss, context.recording.start_ns) is not None:
        return  # see yaw_agreement.check_turns
    wheels = agreements(context).get(("gyro", "wheels"))
    if wheels is not None and wheels.r < 0.0:
        return  # the gyro is wrong
    left = residuals_m(context)
    if left is None or _image(context) <= 0.0:
        return
    # Latitudes and longitudes have no image: then it is a gyro that no wheels confirm.
    name = "gyro" if wheels is None and context.recording.datum is not None else "gnss"
    fix, repair = _remedy(context, name)
    yield Finding(
        CODES[name], "error", SOURCES[name].channel,
        "the path of the fixes is the mirror image of that of wheels and gyro",
        f"{left[1]:.2f} m RMS are left about the image, {left[0]:.2f} m about the path itself",
        fix,
        repair,
    )  # fmt: skip


def _image(context: CheckContext) -> float:
    """1 where the fixes fit the mirror image of the dead-reckoned path, -1 where the path, 0 if unclear."""
    own, image = residuals_m(context) or (0.0, 0.0)
    if max(own, image) < max(LEAST_OFF_M, CLEARER * min(own, image)):
        return 0.0
    return float(np.sign(own - image))


@once
def residuals_m(context: CheckContext) -> tuple[float, float] | None:
    """RMS distance of the fixes from the dead-reckoned path, and from its image; None where not comparable.

    Both are turned, shifted and scaled onto the fixes every `LONGEST_S`, after averages over equal times.
    """
    measured, reckoned = path_by(context.recording, "gnss"), dead_reckoned(context, antenna(context))
    if measured is None or reckoned is None:
        return None
    t, _, path = reckoned
    inside = (measured.t_s >= t[0]) & (measured.t_s <= t[-1])
    t_s, fix = measured.t_s[inside], measured.place[inside]
    if len(t_s) < LEAST_FIXES:
        return None
    z = np.interp(t_s, t, path)
    piece = ((t_s - t_s[0]) // LONGEST_S).astype(int)
    squares, count = np.zeros(2), 0
    for k in range(piece[-1] + 1):
        rows = piece == k
        if rows.sum() < LEAST_FIXES:
            continue
        path, place = _averaged(t_s[rows], z[rows], fix[rows])
        own, image = _left(path, place), _left(path.conj(), place)
        if not SCALES[0] <= min(own, image)[1] <= SCALES[1]:
            return None
        squares += [own[0], image[0]]
        count += len(place)
    return (float(np.sqrt(squares[0] / count)), float(np.sqrt(squares[1] / count))) if count else None


def _averaged(t_s: Array, *places: Complex) -> list[Complex]:
    """Means over `LEAST_FIXES` equal times, of those that hold fixes."""
    at = np.minimum((t_s - t_s[0]) * LEAST_FIXES / max(float(np.ptp(t_s)), 1e-9), LEAST_FIXES - 1).astype(int)
    count = np.bincount(at, minlength=LEAST_FIXES)
    sums = (np.bincount(at, p.real).astype(complex) + 1j * np.bincount(at, p.imag) for p in places)
    return [one[count > 0] / count[count > 0] for one in sums]


def _left(path: Complex, fix: Complex) -> tuple[float, float]:
    """Sum of squares that a turned, shifted and scaled path leaves of the fixes, and its scale."""
    path, fix = path - path.mean(), fix - fix.mean()
    power = float(np.vdot(path, path).real)
    if power == 0.0:
        return float(np.vdot(fix, fix).real), 0.0
    turn = np.vdot(path, fix) / power
    return float(np.sum(np.abs(fix - turn * path) ** 2)), float(abs(turn))
