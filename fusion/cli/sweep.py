"""`terrafusion sweep`: many runs of the twin on one machine or a Dask cluster, as one table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.outputs import Output

if TYPE_CHECKING:
    from terrafusion.twin.sweep.plan import Sweep

OUTPUT = Output(
    "Folder for the results; an unfinished one goes on.",
    ("config.json", "sweep.json", "runs.parquet", "parts", "recordings", "report.html"),
    ("sweep.json",),
    goes_on=True,
)


def sweep(
    sweep: Annotated[str, typer.Argument(help="Name of a built-in sweep, or a YAML file.")],
    out: Path,
    jobs: common.JobsOption = None,
    backend: common.BackendOption = "loky",
    address: common.AddressOption = None,
    max_runs: Annotated[int, typer.Option(min=1, help="Refuse a sweep of more runs.")] = 100_000,
    plots: Annotated[bool, typer.Option("--plots/--no-plots", help="Write report.html.")] = True,
    recordings: list[str] | None = None,
    recordings_format: Literal["folder", "mcap"] = "folder",
) -> Result:
    """Run a scenario over friction, terrain, slope, payload, speed and seeds.

    Writes runs.parquet (a row a run), sweep.json and report.html. A sweep that was stopped
    continues with the same command. Built-in sweeps: friction_slope, payload_energy, random_ground,
    sensors_by_ground.

    Example: terrafusion sweep friction_slope --out results --jobs 2

    Args:
        recordings (N|all): Also write run N, or all, with its sensors as a log; repeat for more.
        recordings_format: folder: log folders; mcap: ROS 2 bags.
    """
    from terrafusion.twin.sweep.load import load_sweep
    from terrafusion.twin.sweep.recordings import check_runs, write_recordings
    from terrafusion.twin.sweep.run import run_sweep

    common.check_backend(backend, address)
    plan = load_sweep(sweep)
    chosen = _numbers(recordings or [], plan)
    check_runs(plan, chosen)
    count = common.processes(jobs)
    print(f"{plan.name}: {plan.design()}", flush=True)
    with common.progress_bar(f"sweep {plan.name}") as progress:
        table = run_sweep(
            plan, out, jobs=count, backend=backend, address=address, max_runs=max_runs, progress=progress
        )
    failures = []
    if chosen:
        with common.progress_bar("recordings") as progress:
            failures = write_recordings(
                plan, chosen, out / "recordings", form=recordings_format, jobs=count, progress=progress
            )
    if plots:
        from terrafusion.fusion.reports.sweep import write_sweep_report

        write_sweep_report(out, plan, table, {"command": common.command_line()})
    statuses, errors = (table.column(name).to_pylist() for name in ("status", "error"))
    lines = [*summary_lines(statuses, errors), *failures]
    all_failed = bool(statuses) and set(statuses) == {"failed"}
    return Result(
        lines,
        f"written to {out}",
        common.read_json(out / "sweep.json"),
        int(all_failed),
        vehicle=plan.vehicle,
    )


def summary_lines(statuses: Sequence[str], errors: Sequence[str | None]) -> list[str]:
    """How the runs ended, in a line; where some failed, why the first did."""
    from terrafusion.twin.sweep.rows import STATUSES

    counts = [f"{statuses.count(word)} {word}" for word in STATUSES if word in statuses]
    lines = [f"{len(statuses)} run{'s' if len(statuses) != 1 else ''}: {', '.join(counts)}"]
    if "failed" in statuses:
        first = statuses.index("failed")
        lines.append(f"run {first} failed: {errors[first]} (column 'error' has the others)")
    return lines


def _numbers(entries: list[str], plan: Sweep) -> list[int]:
    """Numbers of the runs to record."""
    if "all" in entries:
        return list(range(plan.runs))
    for entry in entries:
        if not entry.isdecimal():
            raise typer.BadParameter(f"'{entry}' is neither a number nor 'all'", param_hint="--recordings")
    return sorted({int(entry) for entry in entries})
