"""`terrafusion init LOG`: from the first log of a robot to its vehicle file and a first verdict."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from terrafusion.datasets.core.errors import ConfigError, errors_of
from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.init_page import ask, choose_sensors, contents_lines, document_of, result_lines
from terrafusion.fusion.cli.inspect_page import print_lines

if TYPE_CHECKING:
    from terrafusion.datasets.core.recording import Recording
    from terrafusion.datasets.core.sensors import Rig
    from terrafusion.fusion.init.vehicle import FirstVehicle
    from terrafusion.fusion.metrics.verdict import Verdict


def init(
    log: common.LogArgument,
    out: Path = Path("my_robot.yaml"),
    vehicle_name: str | None = None,
    drive: str | None = None,
    wheel_radius: str | None = None,
    track: str | None = None,
    wheelbase: str | None = None,
    antenna: str | None = None,
    imu_position: str | None = None,
    mass: str | None = None,
    no_verdict: bool = False,
    *,
    how: common.HowRead,
) -> Result:
    """Write the vehicle file of a robot from its first log, and replay the log with it.

    Lists what the log holds; measures mounting of the IMU, wheel radius, effective track, delays and
    antenna where the log shows them; asks for the rest on a terminal. What nobody knows is assumed as of the
    generic vehicle, and every assumption is printed. Numbers are taken as measured; 0.4:data_sheet says
    where one is from.

    Example: terrafusion init drive.mcap --out my_robot.yaml

    Example: terrafusion init drive.mcap --topic imu=/front/imu --drive tracked --track 0.62

    Args:
        out: The vehicle file to write.
        vehicle_name: Name of the robot. Default: that of the file.
        drive: differential, skid_steer, tracked, ackermann or four_wheel_steer.
        wheel_radius (METRES): Wheel radius; without it the fixes give it.
        track (METRES): Distance of left and right wheels.
        wheelbase (METRES): Distance of the axles, if it steers.
        antenna (X,Y,Z): GNSS antenna from the middle of the wheels' contacts.
        imu_position (X,Y,Z): IMU, likewise.
        mass (KG): Mass; only the twin uses it.
        no_verdict: Write the file only; do not replay the log with it.
    """
    from terrafusion.datasets.readers.ros.streams import decoded_once
    from terrafusion.fusion.init.answers import Answers
    from terrafusion.fusion.init.vehicle import base_of, first_vehicle, generic_rig

    common.refuse_no_yaml(out)
    texts = {
        "drive": drive, "wheel_radius_m": wheel_radius, "track_m": track, "wheelbase_m": wheelbase,
        "antenna_m": antenna, "imu_m": imu_position, "mass_kg": mass,
    }  # fmt: skip
    given: dict[str, Any] = {name: _parsed(text, name) for name, text in texts.items() if text is not None}
    answers = Answers(vehicle_name or out.stem, **given)
    how.options(None)  # reports wrong usage before anything is read
    first_log = _FirstLog(log, how)
    with decoded_once():
        first_log.topics = choose_sensors(log, common.parse_topics(how.topic))
        first = first_log.read(generic_rig())
        if Path(base_of(first)) == out.resolve():
            what = "the log names this file as its vehicle, and the new file extends it"
            raise ConfigError(what, file=out, remedy="give another --out")
        print_lines(contents_lines(first))
        answers = ask(answers, first_log.topics)
        with common.progress_bar("calibrating the sensors") as progress:
            found = first_vehicle(first_log.read, first, answers, progress)
    _write(out, found)
    print_lines(result_lines(found, out))
    verdict = None if no_verdict else _verdict(found, out)
    lines = ["", *([] if verdict is None else [*verdict.lines(), ""])]
    first_step, command = _next_commands(log, out, first_log.options(), bool(found.repaired))
    document = document_of(found, out, verdict) | {
        "next": [line.partition(": ")[2] for line in (*first_step, command)]
    }
    return Result([*lines, *first_step], command, document, short=f"written to {out}")


@dataclass
class _FirstLog:
    """The log and how it is read, with the topics chosen so far."""

    log: str
    how: common.HowRead
    topics: dict[str, str] = field(default_factory=dict)
    held: tuple[Any, Recording] | None = None

    def read(self, rig: Rig | None) -> Recording:
        """The recording of a robot; another reading only where the robot can change it."""
        receiver = rig.sensors.gnss if rig is not None else None
        if self.held is not None and self.held[0] == receiver:
            return self.held[1]
        entries = [f"{channel}={name}" for channel, name in self.topics.items()]
        recording = replace(self.how, topic=entries).open(self.log, rig)
        if not self._is_bag():  # all that the vehicle changes in other logs is the sigma of fixes without one
            self.held = receiver, recording
        return recording

    def _is_bag(self) -> bool:
        from terrafusion.datasets.readers.formats import format_of
        from terrafusion.datasets.readers.open import find_log

        return format_of(find_log(self.log)[0]).name in ("ros1", "ros2")

    def options(self) -> str:
        """The options by which another command reads the log alike; the file holds most topics itself."""
        joints = {name: topic for name, topic in self.topics.items() if name.startswith("joint.")}
        words = [f"--topic {shlex.quote(f'{name}={topic}')}" for name, topic in joints.items()]
        words += [f"--stamps {self.how.stamps}"] if self.how.stamps != "header" else []
        words += [f"--columns {shlex.quote(str(self.how.columns))}"] if self.how.columns is not None else []
        words += ["--repair-clock"] if self.how.repair_clock else []
        return "".join(f" {word}" for word in words)


def _next_commands(log: str, out: Path, again: str, repaired: bool) -> tuple[list[str], str]:
    """What to type next: for a log with faults a line that repairs it, and the replay."""
    vehicle = f"--vehicle {shlex.quote(str(out))}"
    if not repaired:
        return [], f"next: terrafusion replay {shlex.quote(log)} {vehicle}{again} --out results"
    fixed = shlex.quote(f"{Path(log).stem}_fixed")
    convert = f"next: terrafusion convert {shlex.quote(log)} {fixed} --apply-fixes {vehicle}{again}"
    return [convert], f"then: terrafusion replay {fixed} {vehicle} --out results"


def _parsed(text: str, name: str) -> Any:
    """An answer; a malformed one is wrong usage (exit status 2)."""
    from terrafusion.fusion.init.answers import parse
    from terrafusion.fusion.init.geometry import FLAGS

    try:
        return parse(text, name)
    except ConfigError as error:
        raise typer.BadParameter(str(error), param_hint=FLAGS[name]) from None


def _write(out: Path, found: FirstVehicle) -> None:
    from terrafusion.fusion.init.draft import write_draft
    from terrafusion.fusion.outputs.robot_file import seen_from

    draft, base = found.draft, str(found.draft["extends"].value)
    if Path(base).is_absolute():
        draft = draft | {"extends": replace(draft["extends"], value=seen_from(out, Path(base)))}
    about = f"Vehicle file of the log '{found.recording.name}', written by: {common.command_line()}"
    write_draft(out, draft, about)


def _verdict(found: FirstVehicle, out: Path) -> Verdict:
    """The verdict on a replay of the log with the file."""
    from terrafusion.fusion.replay import replay

    with common.progress_bar("replaying") as progress, errors_of(found.recording.name):
        result = replay(found.recording, vehicle=out, findings=found.findings, progress=progress)
    return result.verdict
