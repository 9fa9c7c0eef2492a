"""`terrafusion convert LOG OUT`: any readable log to log folder or MCAP, repaired on request."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.outputs import LOG_FILES, Output

if TYPE_CHECKING:
    from terrafusion.datasets.checks import Finding

OUTPUT = Output("A name ending in .mcap, or a folder.", LOG_FILES, mark=None)


def convert(
    log: common.LogArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A name ending in .mcap, or a folder.")],
    vehicle: common.VehicleOption = None,
    *,
    how: common.HowRead,
    apply_fixes: bool = False,
) -> Result:
    """Convert a log to a log folder, or to a ROS 2 MCAP file when OUT ends in .mcap.

    Numbers are unchanged unless `--apply-fixes` requests the repairs of the
    log checks. Each repair is printed and written as a note of the log; what
    cannot be repaired is printed, too.

    Examples:

      terrafusion convert drive.bag drive_folder --vehicle husky

      terrafusion convert drive_folder drive.mcap

      terrafusion convert raw_log repaired_log --apply-fixes

    Args:
        apply_fixes: Apply the repairs that `inspect` offers, and list them.
    """
    from terrafusion.datasets.checks import repair, run_checks
    from terrafusion.datasets.readers import open_recording

    rig = common.load_rig(vehicle)
    recording = open_recording(log, **replace(how, repair_clock=how.repair_clock or apply_fixes).options(rig))
    common.warn_of_log(log, [recording])
    if how.repair_clock:
        recording = common.clock_accepted(recording)
    rig = common.rig_of(recording, rig)
    if vehicle is not None:
        recording = replace(recording, vehicle=vehicle)
    lines = [f"note: {note}" for note in recording.notes]
    repaired: list[Finding] = []
    if apply_fixes:
        recording, repaired = repair(recording, rig)
        lines += [f"repaired: {_line(finding)}" for finding in repaired]
    if out.suffix == ".mcap":
        common.refuse_impossible(log, recording)  # their latitudes would be nonsense
    unseen = common.write_log(recording, out, rig)
    lines += [f"not in standard messages: {part}" for part in unseen]
    left = [one for one in run_checks(recording, rig) if apply_fixes or one.severity == "error"]
    lines += [f"{one.severity}: {_line(one)}{_why_left(one, apply_fixes)}" for one in left]
    rows = {name: len(channel) for name, channel in recording.channels().items()}
    if recording.truth is not None:
        rows["truth"] = len(recording.truth)
    document = {
        "out": str(out), "samples": rows, "notes": list(recording.notes), "not_in_standard_messages": unseen,
        "repaired": [_line(one) for one in repaired], "findings": [_line(one) for one in left],
    }  # fmt: skip
    return Result(lines, f"{out}: {', '.join(f'{name} {count}' for name, count in rows.items())}", document)


def _line(finding: Finding) -> str:
    return f"{finding.code}, {finding.channel}: {finding.what} ({finding.evidence}); {finding.fix}"


def _why_left(finding: Finding, apply_fixes: bool) -> str:
    """Why a finding remains in the written log."""
    if finding.repair is None:
        return " [remains: the correct values are unknown]" if apply_fixes else ""
    return " [remains after its repair]" if apply_fixes else " [--apply-fixes repairs it]"
