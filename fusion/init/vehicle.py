"""A vehicle file for a robot that the library has never seen, from one log of it.

    open the log -> geometry -> mounting and tilt of the IMU -> calibrate its sensors -> lines of the file

Each step opens or replays the log with the file as it is by then, so that what is written is what was used.
"""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from terrafusion.datasets.checks import Finding, repair, run_checks
from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.measures import Measures, measure
from terrafusion.datasets.checks.wheels import check_wheel_signs
from terrafusion.datasets.core.errors import ConfigError, DataError, errors_of
from terrafusion.datasets.core.files import expanded
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.datasets.core.scratch import scratch_folder
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.estimator.feed import wheels_of
from terrafusion.fusion.init.answers import Answers
from terrafusion.fusion.init.draft import Draft, DraftLine, write_draft
from terrafusion.fusion.init.geometry import geometry_lines, radius_line
from terrafusion.fusion.init.level import forward_line, measure_tilt, tilt_lines
from terrafusion.fusion.sensor_calibration import SensorCalibration, calibrate_sensors
from terrafusion.twin.model.choose import named_vehicle
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle

Open = Callable[[Rig | None], Recording]
"""Reads the log with the geometry of a robot."""
COMMENTS = {
    "antenna_m": "m; forward, left, up; found from the fixes",
    "gyro_scale": "true yaw rate over that of the gyro, less one",
    "gyro_bias_radps": "rad/s; reading of gyro z at rest",
    "yaw_factor": "true over geometric yaw rate of the wheels",
    "wheel_scale": "true distance over that of the wheels, less one; usual slip included",
    "gnss_delay_s": "s; lateness of the stamps of the fixes",
    "wheel_delay_s": "s; lateness of the stamps of the wheels",
    "course_lag_s": "s; by which the course follows the heading",
    "slip_per_grade": "slip over the sine of the slope, uphill",
    "imu_roll_rad": "rad; angle of the IMU about x",
    "imu_pitch_rad": "rad; angle of the IMU about y",
    "imu_yaw_rad": "rad; angle of the IMU about z, to the left",
}
"""Of every number that `calibrate_sensors` may find."""
FOLLOWED = "gnss-velocity"
"""A warning of numbers that the estimator follows, wrong as they are."""


@dataclass(frozen=True, eq=False)
class FirstVehicle:
    """The file, and the log as it was used.

    Attributes:
        draft: lines of the file.
        recording: the log read with them, repaired where `repaired` is not empty.
        repaired: findings that the file cannot hold; `terrafusion convert --apply-fixes` repairs them.
        findings: what the log checks still find.
        measured: between the channels of the log as it was first read.
        calibration: of the sensors; None where the log does not allow one.
        notes: what was not measured, and why.
    """

    draft: Draft
    recording: Recording
    repaired: tuple[Finding, ...]
    findings: tuple[Finding, ...]
    measured: Measures
    calibration: SensorCalibration | None
    notes: tuple[str, ...]


def base_of(recording: Recording) -> str:
    """The vehicle that the file extends: the one that the log names, where it is known, else the generic.

    A name, or the absolute path of a vehicle file.
    """
    named = named_vehicle(recording)
    if named is None:
        return "generic"
    return named if named in known_names("vehicles") else str(expanded(named).resolve())


def generic_rig() -> Rig:
    """The geometry with which a log of an unknown robot is read first."""
    return load_vehicle("generic").rig()


def first_vehicle(
    open_log: Open, first: Recording, answers: Answers, progress: Callable[[float], None] | None = None
) -> FirstVehicle:
    """Measure what the log shows, and lay out the file.

    Args:
        open_log: reads the log.
        first: the log as read with `generic_rig`.
        answers: what the user knows.
        progress: called with the share done of the longest step, 0 to 1.

    Raises:
        DataError: the log cannot be read, or is wrong in a way that no repair removes.
        ConfigError: an answer is out of range.
    """
    with errors_of(first.name):
        wheels_of(first)
    extended = base_of(first)
    base = load_vehicle(extended)
    rig = _with_geometry(base.rig(), answers)
    recording = first if rig == generic_rig() else open_log(rig)
    named = DraftLine(extended, "what is not below is as of this vehicle")
    head: Draft = {"extends": named, "name": DraftLine(answers.name, "of the robot")}
    tail = _messages(recording, answers)
    measured, geometry = _geometry(_turning_alike(recording, rig), answers, base, rig)
    with scratch_folder() as folder, _errors_of_log(folder, first.name):
        file = folder / "vehicle.yaml"
        recording, axes, repaired, findings = _mounted(open_log, head | geometry | tail, file)
        if axes or repaired:  # what is measured about z holds only now
            tail = axes | tail
            measured, geometry = _geometry(recording, answers, base, rig)
        draft = head | geometry | tail
        tilted, tilt_notes = tilt_lines(measure_tilt(recording, _rig(draft, file)), recording.name)
        draft |= tilted
        forward = forward_line(recording, _rig(draft, file))
        start = write_draft(file, draft | forward, "draft")
        calibration, notes = _calibrated(recording, start, progress)
        if calibration is not None:
            draft |= forward | _learned_lines(calibration, draft, recording.imu is not None)
            findings = run_checks(recording, _rig(draft, file))
    if extended != "generic":
        known = f"the log names its vehicle '{base.name}': --vehicle {extended} needs no new file"
        notes = (known, *notes)
    notes = (*tilt_notes, *notes)
    return FirstVehicle(draft, recording, tuple(repaired), tuple(findings), measured, calibration, notes)


@contextmanager
def _errors_of_log(folder: Path, name: str) -> Iterator[None]:
    """Attributes errors of files in the scratch folder to the log that their numbers are from."""
    try:
        yield
    except ConfigError as error:
        if error.file is None or folder not in Path(error.file).parents:
            raise
        raise error.of(name) from None


def _geometry(
    recording: Recording, answers: Answers, base: VehicleParams, rig: Rig
) -> tuple[Measures, Draft]:
    """What is measured between the channels, and the lines of the geometry that follow."""
    measured = measure([recording], rig)
    lines = radius_line(recording, measured, answers, base)
    radius_m = rig.wheel_radius_m
    for line in list(lines.values()):  # the effective track scales with it
        if isinstance(line.value, KnownNumber):
            radius_m = line.value.number
            measured = measure([recording], dataclasses.replace(rig, wheel_radius_m=radius_m))
    lines |= geometry_lines(recording, measured, answers, base, radius_m)
    if base.name != "generic":  # what nobody measured here is better known in its own file
        lines = {name: line for name, line in lines.items() if not line.assumed}
    return measured, lines


def _turning_alike(recording: Recording, rig: Rig) -> Recording:
    """The log with both sides forwards, as it is repaired later: their mean gives the radius."""
    found = check_wheel_signs(CheckContext(recording, rig))
    return next((finding.repair(recording) for finding in found if finding.repair), recording)


def _messages(recording: Recording, answers: Answers) -> Draft:
    """Lines of the IMU's frame, and of the topics that the user chose."""
    lines: Draft = {}
    if recording.imu_frame_id:
        lines["imu_frame"] = DraftLine(recording.imu_frame_id.lstrip("/"), "of the IMU's messages")
    if answers.topics:
        lines["topics"] = DraftLine(answers.topics, "chosen among several sensors of a kind")
    return lines


def _with_geometry(rig: Rig, answers: Answers) -> Rig:
    radius, track, antenna = answers.wheel_radius_m, answers.track_m, answers.antenna_m
    known = rig.known if antenna is None else dataclasses.replace(rig.known, antenna_m=antenna)
    return dataclasses.replace(
        rig,
        known=known,
        wheel_radius_m=rig.wheel_radius_m if radius is None else radius.number,
        track_m=rig.track_m if track is None else track.number,
    )


def _mounted(
    open_log: Open, draft: Draft, file: Path
) -> tuple[Recording, Draft, list[Finding], list[Finding]]:
    """The log with its IMU in body axes: by the lines of the file given beside it, else by the repairs beside
    those; and what the checks still find.

    Raises:
        DataError: it has an error that no repair removes.
    """
    recording, rig = _read(open_log, draft, file)
    findings = run_checks(recording, rig)
    axes: Draft = {}
    wrong = next((finding for finding in findings if finding.imu_axes), None)
    if wrong is not None:
        frame = DraftLine(recording.imu_frame_id.lstrip("/"), "of the IMU's messages")
        comment = f"IMU axes along body x, y, z: {wrong.evidence}"
        lines: Draft = {"imu_axes": DraftLine(wrong.imu_axes, comment), "imu_frame": frame}
        turned, turned_rig = _read(open_log, draft | lines, file)
        found = run_checks(turned, turned_rig)
        if not any(finding.imu_axes for finding in found):  # the reader of the log turns by the file
            recording, rig, findings, axes = turned, turned_rig, found, lines
    repaired: list[Finding] = []
    if any(finding.severity == "error" or finding.code == FOLLOWED for finding in findings):
        recording, repaired = repair(recording, rig)
        findings = run_checks(recording, rig)
    for finding in findings:
        if finding.severity == "error":
            raise DataError(
                f"{finding.what} ({finding.evidence})",
                file=recording.name,
                channel=finding.channel,
                remedy=f"{finding.fix}; then run this again",
            )
    return recording, axes, repaired, findings


def _read(open_log: Open, draft: Draft, file: Path) -> tuple[Recording, Rig]:
    rig = _rig(draft, file)
    return open_log(rig), rig


def _rig(draft: Draft, file: Path) -> Rig:
    return load_vehicle(write_draft(file, draft, "draft")).rig()


def _calibrated(
    recording: Recording, file: Path, progress: Callable[[float], None] | None
) -> tuple[SensorCalibration | None, tuple[str, ...]]:
    """What the log shows of its sensors, and notes."""
    if recording.gnss is None or not len(recording.gnss):
        return None, ("no fixes: wheel scale, antenna, gyro scale and delays are not measured",)
    try:
        return calibrate_sensors([recording], file, progress=progress), ()
    except DataError as error:
        return None, (f"the sensors are not calibrated: {error.what}",)


def _learned_lines(calibration: SensorCalibration, draft: Draft, has_imu: bool) -> Draft:
    """Lines of the numbers that the log determines; the user's own and those measured directly stay.

    Wheels that are the only sensor of motion are late against none.
    """
    found: Draft = {}
    for name, number in vars(calibration.known()).items():
        if number is None or number.known != "calibrated" or (name == "wheel_delay_s" and not has_imu):
            continue
        before = draft.get(name)
        if before is not None and isinstance(before.value, KnownNumber) and not before.assumed:
            continue
        found[name] = DraftLine(dataclasses.replace(number, gained_nats=None), COMMENTS[name])
    return found
