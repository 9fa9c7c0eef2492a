"""`terrafusion convert LOG OUT`: any readable log -> log folder or MCAP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terrafusion.fusion.cli.common import (
    LogArgument,
    StampsOption,
    TopicOption,
    VehicleOption,
    load_rig,
    open_log,
    refuse_impossible,
    rig_of,
)


def convert(
    log: LogArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A name ending in .mcap, or a folder.")],
    vehicle: VehicleOption = None,
    topic: TopicOption = None,
    stamps: StampsOption = "header",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an .mcap that exists.")] = False,
) -> None:
    """Convert a log to a log folder, or to a ROS 2 MCAP file when OUT ends in .mcap.

    Examples:

      terrafusion convert drive.bag drive_folder --vehicle husky

      terrafusion convert drive_folder drive.mcap
    """
    import dataclasses

    from terrafusion.datasets.doctor import examine
    from terrafusion.datasets.writers import write_log_folder, write_mcap

    rig = load_rig(vehicle)
    recording = open_log(log, rig, topic, stamps)
    rig = rig_of(recording, rig)
    if vehicle is not None:
        recording = dataclasses.replace(recording, vehicle=vehicle)
    for note in recording.notes:
        print(f"note: {note}")
    if out.suffix == ".mcap":
        refuse_impossible(log, recording)  # their latitudes would be nonsense
        for part in write_mcap(recording, out, rig=rig, overwrite=overwrite):
            print(f"left out: {part}")
    else:
        write_log_folder(recording, out)
    held = ", ".join(f"{name} {len(channel)}" for name, channel in recording.channels().items())
    for finding in examine(recording, rig):
        if finding.severity == "error":
            print(
                f"{finding.severity}: {finding.channel}: {finding.what} ({finding.evidence}); {finding.fix}"
            )
    print(f"{out}: {held}{f', truth {len(recording.truth)}' if recording.truth is not None else ''}")
