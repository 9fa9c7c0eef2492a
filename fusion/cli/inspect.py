"""`terrafusion inspect LOG`: contents of a log and findings of the log checks on one page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.inspect_page import contents_lines, finding_lines

if TYPE_CHECKING:
    from terrafusion.datasets.core.sensors import Rig


def inspect(
    log: common.LogArgument,
    vehicle: common.VehicleOption = None,
    topic: common.TopicOption = None,
    stamps: common.StampsOption = "header",
    columns: common.ColumnsOption = None,
    report: Path | None = None,
) -> Result:
    """Show the contents of a log, measures between its channels, and the findings of the log checks.

    Changes nothing; `terrafusion convert --apply-fixes` applies the repairs.
    The keys of `--json` are in docs/reference/conventions.md. Clock steps are
    findings, too. Several recordings in one file are summarised; LOG#0 shows
    the first alone. Exit status 1 where a finding is an error.

    Examples:

      terrafusion inspect drive.bag --vehicle husky

      terrafusion inspect drive.mcap --topic imu=/imu/data_raw --topic wheels=/odom

      terrafusion inspect wvu_pathfinder/s5t1

      terrafusion inspect my_log_folder --json

    Args:
        report (FILE.html): Also write this as a page.
    """
    page = _inspected(log, common.load_rig(vehicle), common.HowRead(topic, stamps, columns, True))
    contents = list(contents_lines(page))
    if report is not None:
        from terrafusion.fusion.reports.inspect import write_inspection

        write_inspection(report, page, [text for _, text in contents], common.command_line())
    done = "" if report is None else f"report: {report}"
    failed = any(finding["severity"] == "error" for finding in page.get("findings", ()))
    return Result([*contents, *finding_lines(page)], done, page, int(failed), short=_found(page))


def _found(page: dict[str, Any]) -> str:
    """How many findings there are, in words."""
    severities = [finding["severity"] for finding in page.get("findings", ())]
    counts = [f"{n} {s}{'s' if n > 1 else ''}" for s in ("error", "warning") if (n := severities.count(s))]
    return f"findings: {', '.join(counts) or 'none'}"


def _inspected(log: str, rig: Rig | None, how: common.HowRead) -> dict[str, Any]:
    """The page as plain data; see `terrafusion.datasets.checks.summary`."""
    from terrafusion.datasets.checks import run_checks
    from terrafusion.datasets.checks.measures import measure
    from terrafusion.datasets.checks.summary import summarise, summarise_all
    from terrafusion.datasets.readers import open_recordings

    recordings = open_recordings(log, **how.options(rig))
    common.warn_of_log(log, recordings)
    findings = [run_checks(recording, common.rig_of(recording, rig)) for recording in recordings]
    measures = measure(recordings, common.rig_of(recordings[0], rig))
    if len(recordings) == 1:
        return summarise(recordings[0], measures, findings[0])
    names = {recording.name.rpartition("#")[0] for recording in recordings}
    name = names.pop() if len(names) == 1 else ""
    return summarise_all(name or Path(log).name, recordings, measures, findings)
