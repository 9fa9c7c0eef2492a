"""`terrafusion study`: the source study, reproduced by the twin."""

from pathlib import Path
from typing import Annotated

import typer

from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.common import (
    AddressOption,
    BackendOption,
    JobsOption,
    check_backend,
    processes,
    progress_bar,
    read_json,
)
from terrafusion.fusion.cli.outputs import Output

OUTPUT = Output(
    "Folder for the tables, metrics.json and report.html.",
    ("config.json", "plan.json", "agreement.*", "metrics.json", "batch.csv", "report.html", "*.mcap"),
    ("plan.json",),
    mark='"quick"',
)


def study(
    out: Path,
    quick: bool = False,
    seeds: Annotated[
        int | None, typer.Option(help="Seeds a case (10; 2 when quick).", show_default=False)
    ] = None,
    jobs: JobsOption = None,
    backend: BackendOption = "loky",
    address: AddressOption = None,
    bags: bool = False,
) -> Result:
    """Reproduce the study this project starts from, and judge the twin against it, statement by statement.

    Runs mud, loose and medium sand, the batch over friction, slope and payload, and a drive like the field
    test. Prints Tab. 4 side by side; writes agreement.csv, metrics.json, batch.csv and report.html.

    Example: terrafusion study --out study-out --quick

    Args:
        quick: Two seeds and a small batch.
        bags: Also write the three runs as ROS 2 bags (MCAP).
    """
    from terrafusion.fusion.reports.study import write_bags, write_plan, write_study
    from terrafusion.twin.study.study import StudyPlan, run_study
    from terrafusion.twin.study.text import study_lines

    check_backend(backend, address)
    plan = StudyPlan(seeds=seeds, quick=quick, jobs=processes(jobs))
    write_plan(out, plan)
    with progress_bar("study") as progress:
        found = run_study(plan, progress, backend=backend, address=address)
    command = f"terrafusion study{' --quick' if quick else ''} --seeds {plan.seed_count()}"
    write_study(out, found, {"command": command})
    if bags:
        write_bags(out)
    return Result(study_lines(found), f"report: {out / 'report.html'}", read_json(out / "metrics.json"))
