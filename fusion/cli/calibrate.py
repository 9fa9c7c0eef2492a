"""`terrafusion calibrate`: soil and vehicle parameters, or sensor numbers, from logs, with their sigma."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.outputs import Output
from terrafusion.fusion.cli.usage import refuse_options

if TYPE_CHECKING:
    from terrafusion.twin.calibrate.coordinates import Prior
    from terrafusion.twin.calibrate.result import Calibration

LogsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="LOG...",
        help="Log folders, bags or catalogue names of one vehicle; "
        "LOG@60-105 is a segment of one, LOG@/45 all of its segments of 45 s.",
    ),
]
OUTPUT = Output(
    "Folder for calibration.json, YAML files, report.html; with --sensors a YAML file.",
    ("config.json", "calibration.json", "vehicle.yaml", "soil*.yaml", "report.html"),
    ("calibration.json",),
)
INPUT, WINDOW_S = "auto", 10.0
"""Defaults of options."""
SENSORS_OUTPUT = Output("A vehicle file.", suffix=".yaml", mark="known: calibrated")


def calibrate(
    logs: LogsArgument,
    out: Path,
    vehicle: str | None = None,
    sensors: bool = False,
    terrain: list[str] | None = None,
    parameters: str | None = None,
    prior: list[str] | None = None,
    source: Annotated[
        str, typer.Option("--input", help="What drives the twin: auto, command, wheels.")
    ] = INPUT,
    truth: bool = False,
    robust: bool = False,
    channels: str | None = None,
    window_s: float = WINDOW_S,
    slope_deg: float = 0.0,
    aspect_deg: float = 0.0,
    payload_kg: float = 0.0,
    suggest: bool = False,
    *,
    how: common.HowRead,
) -> Result:
    """Fit soil and vehicle parameters to logs, with their sigma and what the logs cannot identify.

    Writes calibration.json, vehicle.yaml and soil.yaml with the new numbers, and report.html.

    Example: terrafusion calibrate drive --terrain loose_sand --parameters soil.shear.friction_cap --out fit

    Example: terrafusion calibrate monday tuesday --sensors --out my_robot.yaml

    Args:
        vehicle: Vehicle to start from, by name or YAML file. Default: the logs'.
        sensors: Learn antenna, gyro, wheel scale and delays from fixes, without any twin; writes a vehicle
            file. Takes --vehicle and how logs are read, no other option.
        terrain (SOIL|LABEL=SOIL): Soil of all logs, by name or YAML file; or of one label (repeat). Default:
            the logs' labels.
        parameters: Dotted names with commas, such as soil.shear.friction_cap.
        prior (NAME=VALUE+-SIGMA): Prior of a parameter; repeat for more.
        truth: Use the reference pose, too.
        robust: Down-weight outliers (Huber).
        channels: Use these channels only, with commas.
        window_s: The pose starts anew after so long.
        slope_deg: Slope of the ground, 0 to 25 deg.
        aspect_deg: Direction uphill, deg from east to the left.
        payload_kg: Payload at the centre of gravity, kg.
        suggest: Suggest manoeuvres that would identify the unresolved parameters.
    """
    if sensors:
        of_the_twin = {
            "--terrain": bool(terrain), "--parameters": parameters is not None, "--prior": bool(prior),
            "--input": source != INPUT, "--truth": truth, "--robust": robust,
            "--channels": channels is not None, "--window-s": window_s != WINDOW_S,
            "--slope-deg": slope_deg != 0.0, "--aspect-deg": aspect_deg != 0.0,
            "--payload-kg": payload_kg != 0.0, "--suggest": suggest,
        }  # fmt: skip
        refuse_options(of_the_twin, "does not go with --sensors")
        return _sensors(logs, vehicle, how, out)
    from terrafusion.fusion.reports.calibration import write_calibration
    from terrafusion.twin.calibrate.calibrate import PARAMETERS
    from terrafusion.twin.calibrate.calibrate import calibrate as fit
    from terrafusion.twin.model.choose import vehicle_of_logs

    _check_slope(slope_deg)
    priors = dict(parse_prior(text) for text in prior or [])
    soils = parse_terrain(terrain)
    recordings = how.open_all(logs, common.load_rig(vehicle))
    with common.progress_bar("calibrating") as progress:
        found = fit(
            recordings, vehicle, soils, split(parameters) or PARAMETERS, priors=priors, source=source,
            truth=truth, robust=robust, channels=split(channels) or None, window_s=window_s,
            slope_deg=slope_deg, aspect_deg=aspect_deg, payload_kg=payload_kg, progress=progress,
        )  # fmt: skip
    given = dict.fromkeys(found.model.soils, soils) if isinstance(soils, str) else soils
    began = str(vehicle_of_logs(recordings, vehicle)[0])
    write_calibration(out, found, began, given, {"command": common.command_line()})
    return _shown(found, began, out, suggest)


def _check_slope(slope_deg: float) -> None:
    """A slope that no scenario may have is wrong usage (exit status 2)."""
    from terrafusion.twin.scenario.scenario import MAX_SLOPE_DEG

    if not 0.0 <= slope_deg <= MAX_SLOPE_DEG:
        raise typer.BadParameter(f"{slope_deg:g} is not in 0 to {MAX_SLOPE_DEG:g}", param_hint="--slope-deg")


def _shown(found: Calibration, vehicle: str, out: Path, suggest: bool) -> Result:
    """What the command prints, on request with the manoeuvres that would identify the rest."""
    from terrafusion.twin.calibrate.suggest import suggest as suggestions
    from terrafusion.twin.model.vehicle import load_vehicle

    lines = summary(found) + [one.sentence() for one in (suggestions(found) if suggest else ())]
    document = common.read_json(out / "calibration.json")
    return Result(lines, f"written to {out}", document, vehicle=load_vehicle(vehicle))


def _sensors(logs: list[str], vehicle: str | None, how: common.HowRead, out: Path) -> Result:
    """Learn the sensor numbers of a robot, and write its file."""

    from terrafusion.fusion.outputs.robot_file import write_robot
    from terrafusion.fusion.sensor_calibration import calibrate_sensors

    common.refuse_no_yaml(out)
    recordings = how.open_all(logs, common.load_rig(vehicle))
    for recording in recordings:
        common.refuse_impossible(recording.name, recording)
    with common.progress_bar("calibrating") as progress:
        found = calibrate_sensors(recordings, vehicle, progress=progress)
    write_robot(out, found)
    numbers = {name: one and dataclasses.asdict(one) for name, one in vars(found.known()).items()}
    return Result(found.summary(), f"written to {out}", {"out": str(out), "robot": numbers})


def split(text: str | None) -> tuple[str, ...]:
    """Words between commas."""
    return tuple(word.strip() for word in (text or "").split(",") if word.strip())


def parse_terrain(entries: list[str] | None) -> str | dict[str, str] | None:
    """One soil for all logs, or soils by label; a mixture of both is wrong usage (exit status 2)."""
    entries = entries or []
    if not any("=" in entry for entry in entries):
        if len(entries) > 1:
            raise typer.BadParameter("give one soil, or LABEL=SOIL for each label", param_hint="--terrain")
        return entries[0] if entries else None
    return common.parse_pairs(entries, "LABEL=SOIL; one soil for all logs stands alone", "--terrain")


def parse_prior(text: str) -> tuple[str, Prior]:
    """`NAME=VALUE+-SIGMA`; a malformed one is wrong usage (exit status 2)."""
    from terrafusion.twin.calibrate.coordinates import Prior

    name, _, rest = text.partition("=")
    value, _, sigma = rest.partition("+-")
    try:
        return name.strip(), Prior(float(value), float(sigma))
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not NAME=VALUE+-SIGMA", param_hint="--prior") from None


def summary(found: Calibration) -> list[str]:
    """The result in a few lines of text."""
    from terrafusion.twin.calibrate.identifiability import COMBINED, IDENTIFIED, NOT_IDENTIFIED

    words = {COMBINED: "identified only in combination", NOT_IDENTIFIED: "not identified"}
    width = max(len(f.name) for f in found.fitted)
    count = len(found.sensor_errors)
    logs = f"{count} log{'s' if count > 1 else ''}, {found.seconds_of_data:.0f} s"
    lines = [f"{found.model.vehicle.name}, {logs}; {found.sentence}"]
    for f in found.fitted:
        status = "" if f.status == IDENTIFIED else f"   {words[f.status]}"
        status += "" if found.converged() else "   sigma not valid"
        lines.append(
            f"{f.name:{width}s}  {f.value:.5g} +- {f.sigma:.2g} {f.unit}".rstrip()
            + f" (was {f.start:.5g}){status}"
        )
    lines += [direction.sentence for direction in found.identifiability.weak]
    return lines + [f"note: {note}" for note in found.notes]
