"""`terrafusion convert LOG OUT`: any readable log to log folder or MCAP, repaired on request."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.fusion.cli.common import (
    ColumnsOption,
    LogArgument,
    RepairClockOption,
    StampsOption,
    TopicOption,
    VehicleOption,
    clock_accepted,
    load_rig,
    reading,
    refuse_impossible,
    rig_of,
)

if TYPE_CHECKING:
    from terrafusion.datasets.checks import Finding
    from terrafusion.datasets.core.recording import Recording
    from terrafusion.datasets.core.sensors import Rig


def convert(
    log: LogArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A name ending in .mcap, or a folder.")],
    vehicle: VehicleOption = None,
    topic: TopicOption = None,
    stamps: StampsOption = "header",
    columns: ColumnsOption = None,
    repair_clock: RepairClockOption = False,
    apply_fixes: Annotated[
        bool,
        typer.Option("--apply-fixes", help="Apply the repairs that `inspect` offers, and list them."),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an .mcap that exists.")] = False,
) -> None:
    """Convert a log to a log folder, or to a ROS 2 MCAP file when OUT ends in .mcap.

    Numbers are unchanged unless `--apply-fixes` requests the repairs of the
    log checks. Each repair is printed and written as a note of the log; what
    cannot be repaired is printed, too.

    Examples:

      terrafusion convert drive.bag drive_folder --vehicle husky

      terrafusion convert drive_folder drive.mcap

      terrafusion convert raw_log repaired_log --apply-fixes
    """
    import dataclasses

    from terrafusion.datasets.checks import repair, run_checks
    from terrafusion.datasets.readers import open_recording

    rig = load_rig(vehicle)
    recording = open_recording(log, **reading(rig, topic, stamps, columns, repair_clock or apply_fixes))
    if repair_clock:
        recording = clock_accepted(recording)
    rig = rig_of(recording, rig)
    if vehicle is not None:
        recording = dataclasses.replace(recording, vehicle=vehicle)
    for note in recording.notes:
        print(f"note: {note}")
    if apply_fixes:
        recording, repaired = repair(recording, rig)
        for finding in repaired:
            print(f"repaired: {_line(finding)}")
    for part in _write(log, recording, rig, out, overwrite):
        print(f"not in standard messages: {part}")
    for finding in run_checks(recording, rig):
        if apply_fixes or finding.severity == "error":
            print(f"{finding.severity}: {_line(finding)}{_why_left(finding, apply_fixes)}")
    rows = {name: len(channel) for name, channel in recording.channels().items()}
    if recording.truth is not None:
        rows["truth"] = len(recording.truth)
    print(f"{out}: {', '.join(f'{name} {count}' for name, count in rows.items())}")


def _write(log: str, recording: Recording, rig: Rig | None, out: Path, overwrite: bool) -> list[str]:
    """Write the log; returns what ROS has no standard message for."""
    from terrafusion.datasets.writers import write_log_folder, write_mcap

    if out.suffix != ".mcap":
        write_log_folder(recording, out)
        return []
    refuse_impossible(log, recording)  # their latitudes would be nonsense
    return list(write_mcap(recording, out, rig=rig, overwrite=overwrite))


def _line(finding: Finding) -> str:
    return f"{finding.code}, {finding.channel}: {finding.what} ({finding.evidence}); {finding.fix}"


def _why_left(finding: Finding, apply_fixes: bool) -> str:
    """Why a finding remains in the written log."""
    if finding.repair is None:
        return " [remains: the correct values are unknown]" if apply_fixes else ""
    return " [remains after its repair]" if apply_fixes else " [--apply-fixes repairs it]"
