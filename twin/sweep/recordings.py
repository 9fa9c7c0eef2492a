"""Chosen runs of a sweep once more, with all sensors, as logs."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from terrafusion.datasets.core.errors import ConfigError, TerrafusionError
from terrafusion.twin.executors import open_workers
from terrafusion.twin.simulate import simulate_run
from terrafusion.twin.sweep.plan import Sweep, SweepPoint
from terrafusion.twin.sweep.rows import arguments

FORMATS = ("folder", "mcap")


def check_runs(sweep: Sweep, runs: Sequence[int]) -> None:
    """Refuse numbers that are no runs of the sweep; a ConfigError names the first of them."""
    for run in runs:
        if not 0 <= run < sweep.runs:
            raise ConfigError(
                f"the sweep has no run {run}", file=sweep.name, remedy=f"give 0 to {sweep.runs - 1}"
            )


def write_recordings(
    sweep: Sweep,
    runs: Sequence[int],
    folder: Path | str,
    *,
    form: str = "folder",
    jobs: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[str]:
    """Write runs of the sweep as `run-000017` (a log folder) or `run-000017.mcap` into `folder`.

    Logs that are there already stay. They are written by this machine.

    Returns:
        One line for each run that could not be written, with the reason.

    Raises:
        ConfigError: no such run or format.
        TerrafusionError: a worker process died.
    """
    if form not in FORMATS:
        raise ConfigError(f"unknown format '{form}'", remedy=f"known are {', '.join(FORMATS)}")
    check_runs(sweep, runs)
    chosen = set(runs)
    work = [(sweep, case, Path(folder), form) for case in sweep.cases() if case.run in chosen]
    failures = []
    with open_workers("loky", min(jobs, len(work)) or 1) as workers:
        for number, failure in enumerate(workers.results(_write, work), 1):
            failures += [failure] if failure else []
            if progress is not None:
                progress(number / len(work))
    return sorted(failures)


def _write(sweep: Sweep, case: SweepPoint, folder: Path, form: str) -> str | None:
    """Write one run; why it could not be, or None."""
    from terrafusion.datasets.writers.log_folder import write_log_folder
    from terrafusion.datasets.writers.mcap import write_mcap

    name = f"run-{case.run:06d}"
    place = folder / (name if form == "folder" else f"{name}.mcap")
    if (place / "meta.yaml").is_file() or place.is_file():
        return None
    try:
        recording = dataclasses.replace(simulate_run(**arguments(sweep, case)).recording, name=name)
        if form == "folder":
            write_log_folder(recording, place)
        else:
            write_mcap(recording, place)
    except TerrafusionError as error:
        return f"{name}: {error}"
    return None
