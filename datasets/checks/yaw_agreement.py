"""Gyro, wheels, fixes, truth and command must turn alike: who contradicts the others?"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks.directions import runs_backwards, sides_opposed
from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair
from terrafusion.datasets.checks.gnss_frame import reflection
from terrafusion.datasets.checks.mounting import heading, stands_up
from terrafusion.datasets.checks.yaw_signals import (
    Agreement,
    accounts,
    agreements,
    contradictors,
    is_late,
)
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.recording import Recording

Pairs = dict[tuple[str, str], Agreement]
Signs = dict[tuple[str, str], float]

DEGREES_SLOPE = {"wheels": 15.0, "truth": 30.0, "command": 15.0}
"""Gyro rate over another's: the inverse track, 0.3 to 4 1/m, for the wheels, else 1; above these in deg/s."""
UNRELATED_R, LIVELY, MANY = 0.3, 0.05, 40
NAMES = {
    "gyro": "gyro z",
    "wheels": "the wheels",
    "gnss": "the path of the fixes",
    "truth": "the truth's yaw",
    "command": "the command",
    "accelerometer": "the specific force in turns",
}
CHANNELS = {"gyro": "imu", "accelerometer": "imu"}
CODES = {
    "gyro": "yaw-sign",
    "wheels": "wheel-swap",
    "gnss": "gnss-course",
    "truth": "truth-turns",
    "command": "command-sign",
    "accelerometer": "accel-mirrored",
}


def check_gyro_unit(context: CheckContext) -> Iterator[Finding]:
    """The gyro must be in rad/s."""
    found = _pairs(context)
    for other, limit in DEGREES_SLOPE.items():
        both = found.get(("gyro", other))
        if both is None or not both.is_sure() or abs(both.slope) < limit:
            continue
        unit = (
            "rad/s for each m/s between the sides"
            if other == "wheels"
            else f"times the turn of {NAMES[other]}"
        )
        yield Finding(
            "gyro-in-degrees",
            "error",
            "imu",
            f"gyro z is far larger than the turn of {NAMES[other]}: it looks like deg/s",
            f"{abs(both.slope):.0f} {unit}; correlation {both.r:.2f}",
            "multiply by pi / 180",
            _to_radians,
        )
        return


def check_turns(context: CheckContext) -> Iterator[Finding]:
    """All channels must turn to the same side; the fewest that contradict are at fault."""
    found = _pairs(context)
    signs = _signs(context, found)
    against = [pair for pair, sign in signs.items() if sign < 0.0]
    if not against:
        return
    blamed = contradictors(signs)
    if not blamed:
        one, other = against[0]
        yield Finding(
            "yaw-contradiction",
            "warning",
            "imu",
            f"{NAMES[one]} {_verb(one)} against {NAMES[other]}",
            _told(against, signs, found) + "; no single sign explains all",
            "check the axes and signs of all of them",
        )
        return
    if frozenset({"wheels"}) in blamed and runs_backwards(context) is not None:
        return  # one fault explains both: see wheels.check_direction
    for name in sorted(blamed[0]):
        pairs = [pair for pair in against if name in pair]
        if not pairs or (name == "gyro" and not stands_up(context)):
            continue  # an IMU that does not stand up: see mounting.check_axes
        fix, repair = _remedy(context, name)
        other = next(one for one in pairs[0] if one != name)
        if len(blamed) > 1:
            fix += f" (assumed: no third channel tells whether {NAMES[name]} or {NAMES[other]} is wrong)"
        yield Finding(
            CODES[name],
            "error" if name in ("gyro", "wheels", "gnss") else "warning",
            CHANNELS.get(name, name),
            f"{NAMES[name]} {_verb(name)} against {NAMES[other]}",
            _told(pairs, signs, found),
            fix,
            repair,
        )


def _signs(context: CheckContext, found: Pairs) -> Signs:
    """By pair of channels 1 where they surely turn alike, -1 where they turn against each other."""
    known = accounts(context)
    signs = {}
    for (a, b), both in found.items():
        late = both.r < 0.0 and a in known and b in known and is_late(known[a], known[b], both.r)
        if both.is_sure() and not late:
            signs[a, b] = float(np.sign(both.r))
    pressed = heading(context)
    if pressed is not None and pressed.turn and ("gyro", "wheels") in signs:
        signs["gyro", "accelerometer"] = pressed.turn
    return signs


def _verb(name: str) -> str:
    return "turn" if name == "wheels" else "turns"


def _told(pairs: list[tuple[str, str]], signs: Signs, found: Pairs) -> str:
    parts = [f"correlation {found[p].r:.2f} of {NAMES[p[0]]} and {NAMES[p[1]]}" for p in pairs if p in found]
    pressed = signs.get(("gyro", "accelerometer"), 0.0)
    if pressed:
        parts.append(
            f"the specific force in turns is {'as' if pressed > 0.0 else 'against what'} gyro z says"
        )
    return ", ".join(parts)


def _remedy(context: CheckContext, name: str) -> tuple[str, Repair | None]:
    """What to do where one channel turns the wrong way."""
    if name == "gyro":
        return "change the sign of gyro z (left turn positive)", _gyro_sign
    if name == "wheels":
        return "swap left and right wheels", _swap_sides
    if name == "gnss":
        return reflection(context.recording)
    if name == "truth":
        return "check the truth's frame: its yaw must grow to the left", None
    if name == "accelerometer":
        return "check the accelerometer's axes: x, y and z must make a right-handed frame", None
    return "change the sign of the commanded yaw rate (left turn positive)", _command_sign


def check_unrelated(context: CheckContext) -> Iterator[Finding]:
    """Gyro z must follow the wheels, whatever its sign."""
    both = _pairs(context).get(("gyro", "wheels"))
    if (
        both is None
        or both.windows < MANY
        or min(both.spread) < LIVELY
        or both.is_sure()
        or both.r > UNRELATED_R
    ):
        return
    yield Finding(
        "yaw-unrelated",
        "warning",
        "imu",
        "gyro z does not follow the wheels",
        f"correlation {both.r:.2f} of the half-second means",
        "check the IMU's axes and the two clocks; on slippery ground it may be real",
    )


def _pairs(context: CheckContext) -> Pairs:
    """What can be compared, without wheels of which one side has the wrong sign: they tell no turn."""
    found = agreements(context)
    if any("wheels" in pair for pair in found) and sides_opposed(context) is not None:
        found = {pair: both for pair, both in found.items() if "wheels" not in pair}
    return found


def _to_radians(recording: Recording) -> Recording:
    assert recording.imu is not None
    imu = dataclasses.replace(recording.imu, gyro_radps=np.radians(recording.imu.gyro_radps))
    return dataclasses.replace(recording, imu=imu)


def _gyro_sign(recording: Recording) -> Recording:
    return apply(recording, Conventions(gyro_z_sign=-1.0))


def _swap_sides(recording: Recording) -> Recording:
    wheels = recording.wheels
    assert wheels is not None
    other = [0] if len(wheels.names) == 1 else [k ^ 1 for k in range(len(wheels.names))]
    angle = None if wheels.angle_rad is None else wheels.angle_rad[:, other]
    swapped = dataclasses.replace(wheels, speed=wheels.speed[:, other], angle_rad=angle)
    return dataclasses.replace(recording, wheels=swapped)


def _command_sign(recording: Recording) -> Recording:
    command = recording.command
    assert command is not None
    turned = dataclasses.replace(command, yaw_rate_radps=-command.yaw_rate_radps)
    return dataclasses.replace(recording, command=turned)
