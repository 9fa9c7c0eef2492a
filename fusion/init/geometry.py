"""Lines of a vehicle file for a robot's geometry: given by the user, by the log, measured, or assumed."""

import math
from collections.abc import Iterator
from operator import attrgetter

from terrafusion.datasets.checks.measures import Measures, SpeedRatio, YawFit
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.datasets.core.sensors import STEERED_DRIVES
from terrafusion.fusion.config.assumptions import NUMBERS
from terrafusion.fusion.config.sensor_config import imu_kind
from terrafusion.fusion.init.answers import Answers
from terrafusion.fusion.init.draft import Draft, DraftLine
from terrafusion.fusion.init.wheelbase import measured_wheelbase
from terrafusion.twin.model.vehicle import VehicleParams

LEAST_RADIUS_SIGMA, LEAST_TRACK_SIGMA = 0.005, 0.03
"""Relative 1 sigma: slip of firm ground, and of the track that a robot seems to have on it (assumed)."""
LEAST_RADIUS_M, MOST_RADIUS_M = 0.03, 1.0
"""Wheels of ground robots; a radius beyond is a unit other than rad/s."""
LEAST_FACTOR, MOST_FACTOR = 0.05, 2.0
"""A yaw factor beyond shows a wrong track or swapped sides, which the log checks report."""
FLAGS = {
    "wheel_radius_m": "--wheel-radius",
    "track_m": "--track",
    "wheelbase_m": "--wheelbase",
    "antenna_m": "--antenna",
    "imu_m": "--imu-position",
    "mass_kg": "--mass",
    "drive": "--drive",
}
STATED = "as the log states"
"""How the line of a number of the log ends."""
USUAL = {
    "wheel_radius_m": "odometry.wheel_radius_m",
    "track_m": "odometry.track_m",
    "wheelbase_m": "body.wheelbase_m",
    "antenna_m": "sensors.gnss.antenna_m",
    "imu_m": "sensors.imu.position_m",
    "mass_kg": "body.mass_kg",
}
"""Where a vehicle has the number that is assumed of another robot."""


def geometry_lines(
    recording: Recording, measured: Measures, answers: Answers, base: VehicleParams, wheel_radius_m: float
) -> Draft:
    """The lines of drive, track, axles, sensors' places and mass; the arguments as in `radius_line`."""
    drive = _drive(recording, answers, base)
    others = {
        "wheelbase_m": drive.value in STEERED_DRIVES,
        "antenna_m": recording.gnss is not None,
        "imu_m": imu_kind(recording.imu) == "six_axis",
        "mass_kg": True,
    }
    lines = {"drive": drive} | _track(recording, measured.yaw, answers, base, str(drive.value))
    lines |= {name: _given(name, recording, answers, base) for name, wanted in others.items() if wanted}
    known = answers.wheelbase_m is not None or recording.overrides.wheelbase_m is not None
    found = measured_wheelbase(recording, wheel_radius_m) if others["wheelbase_m"] and not known else None
    if found is not None:
        number = KnownNumber(round(found[0], 3), "calibrated", round(found[1], 3), (recording.name,))
        lines["wheelbase_m"] = DraftLine(number, "m; steering angles against the gyro")
    return lines


def _drive(recording: Recording, answers: Answers, base: VehicleParams) -> DraftLine:
    if answers.drive is not None:
        return DraftLine(answers.drive, "given")
    if recording.overrides.drive is not None:
        return DraftLine(recording.overrides.drive, STATED)
    if recording.steering is not None:
        return DraftLine(recording.steering.drive(), "the log has steering angles")
    return DraftLine(base.drive.type, f"assumed, as of '{base.name}'; else give {FLAGS['drive']}")


def radius_line(recording: Recording, measured: Measures, answers: Answers, base: VehicleParams) -> Draft:
    """The radius; the fixes give it where neither user nor log does. No line for wheels in m/s.

    Args:
        recording: the log.
        measured: with the rig of `base` and the numbers of `answers`.
        answers: what the user said.
        base: the vehicle that the file extends.

    Raises:
        DataError: the radius that fits the fixes is none of a wheel.
    """
    name, wheels, stated = "wheel_radius_m", recording.wheels, recording.overrides.wheel_radius_m
    given = answers.wheel_radius_m
    if wheels is None or (wheels.unit == "mps" and given is None):
        return {}
    fit = best_ratio(measured)
    if given is None and stated is None and fit is not None:
        source, ratio = fit
        radius = ratio.ratio * base.odometry.wheel_radius_m
        if not LEAST_RADIUS_M < radius < MOST_RADIUS_M:
            raise DataError(
                f"a wheel radius of {radius:.4g} m would fit the {source}",
                file=recording.name,
                channel="wheels",
                remedy="are its speeds in rad/s? else give --wheel-radius: the log checks then name the unit",
            )
        sigma = max(0.5 * (ratio.high - ratio.low) / 1.96, LEAST_RADIUS_SIGMA * ratio.ratio)
        number = KnownNumber(
            round(radius, 4), "calibrated", round(sigma * base.odometry.wheel_radius_m, 4), (recording.name,)
        )
        return {
            name: DraftLine(number, f"m; path of the {source} over that of the wheels, usual slip included")
        }
    return {name: _given(name, recording, answers, base)}


def best_ratio(measured: Measures) -> tuple[str, SpeedRatio] | None:
    """Path over ground over path by wheels: by the fixes, else by the truth; the source first."""
    for source in ("gnss", "truth"):
        if source in measured.speed_ratio:
            return source, measured.speed_ratio[source]
    return None


def _track(
    recording: Recording, yaw: YawFit | None, answers: Answers, base: VehicleParams, drive: str
) -> Draft:
    """The track; and the yaw factor, where the gyro shows the effective one."""
    stated = recording.overrides.track_m
    effective = yaw.effective_track_m if yaw is not None and drive not in STEERED_DRIVES else None
    if effective is None or yaw is None:
        return {"track_m": _given("track_m", recording, answers, base)}
    windows = max(yaw.seconds / 0.5 - 2.0, 1.0)
    share = max(math.sqrt((1.0 / yaw.r**2 - 1.0) / windows), LEAST_TRACK_SIGMA)
    logs = (recording.name,)
    if answers.track_m is None and stated is None and drive == "differential":
        number = KnownNumber(round(effective, 4), "calibrated", round(share * effective, 4), logs)
        line = DraftLine(number, "m; side speeds against the gyro")
    else:
        line = _given("track_m", recording, answers, base)
    assert isinstance(line.value, KnownNumber)
    factor = line.value.number / effective
    if not LEAST_FACTOR < factor < MOST_FACTOR:
        return {"track_m": line}
    known = KnownNumber(round(factor, 4), "calibrated", round(share * factor, 4), logs)
    comment = f"true over geometric yaw rate: effective track {effective:.3f} m by the gyro"
    return {"track_m": line, "yaw_factor": DraftLine(known, comment)}


def _given(name: str, recording: Recording, answers: Answers, base: VehicleParams) -> DraftLine:
    """The line of a number by the first who knows it: the log, the user; else the assumption."""
    answer, stated = getattr(answers, name), getattr(recording.overrides, name, None)
    usual = attrgetter(USUAL[name])(base)
    unit = name.rpartition("_")[2] + ("; forward, left, up" if isinstance(usual, tuple) else "")
    if answer is not None:
        counts = stated not in (None, answer.value)
        other = f"; the log states {stated}, which counts for it" if counts else ""
        return DraftLine(answer, f"{unit}; given{other}")
    if stated is not None:
        value = tuple(round(v, 6) for v in stated) if isinstance(stated, tuple) else round(stated, 6)
        return DraftLine(KnownNumber(value, "assumed"), f"{unit}; {STATED}")
    spread = f" +- {NUMBERS[name].sigma:g}" if name in NUMBERS else ""
    words = f"{unit}; assumed{spread}, as of '{base.name}'; else give {FLAGS[name]}"
    return DraftLine(KnownNumber(usual, "assumed"), words + ("; only the twin uses it" * (name == "mass_kg")))


def unmeasured_lines(draft: Draft) -> Iterator[tuple[str, str]]:
    """What the file assumes or has from the log: which of them, and a sentence, each."""
    for name, line in draft.items():
        if line.assumed:
            value = line.value.value if isinstance(line.value, KnownNumber) else line.value
            shown = list(value) if isinstance(value, tuple) else value
            words = line.comment.replace("assumed, ", "").replace("assumed +-", "+-")
            by_log = line.comment.endswith(STATED)
            yield "from log" if by_log else "assumed", f"{name} = {shown} ({words})"
