"""`terrafusion.sweep` and `terrafusion.benchmark`: many runs at once, as tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from terrafusion.datasets.core.arguments import checked_names, checked_path, checked_progress, checked_whole
from terrafusion.twin.sweep.load import load_sweep
from terrafusion.twin.sweep.plan import Sweep
from terrafusion.twin.sweep.run import run_sweep

if TYPE_CHECKING:
    import pandas as pd


def sweep(
    plan: str | Path | Sweep,
    out: str | Path,
    *,
    jobs: int = 1,
    backend: str = "loky",
    address: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> pd.DataFrame:
    """Run the twin over friction, slope, payload and seeds; one row a run.

    A sweep that was interrupted continues where it was stopped.

    Args:
        plan: name, YAML file or `Sweep`.
        out: folder of the results.
        jobs: processes on this machine.
        backend: "loky" (this machine) or "dask", then with the `address` of its scheduler.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigError: an unknown sweep, or another one in `out`.
        TerrafusionError: a package is missing, workers died, or the folder cannot be written.
    """
    out = checked_path(out, "out")
    checked_progress(progress)
    loaded = plan if isinstance(plan, Sweep) else load_sweep(plan)
    table = run_sweep(
        loaded, out, jobs=checked_whole(jobs, "jobs", 1), backend=backend, address=address, progress=progress
    )
    frame: pd.DataFrame = table.to_pandas()
    return frame


def benchmark(
    out: str | Path,
    *,
    quick: bool = False,
    seeds: int | None = None,
    only: str | Sequence[str] = (),
    jobs: int = 1,
    backend: str = "loky",
    address: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> pd.DataFrame:
    """Compare adaptive weights with fixed ones and other baselines; one row a drive and method.

    Writes benchmark.json, benchmark.md and report.html into `out`, as `terrafusion benchmark`.

    Args:
        out: folder of the results; a benchmark that was interrupted continues there.
        quick: few drives.
        seeds: drives of each family on each plant.
        only: families, such as "mixed" or "mixed=3".
        jobs: processes on this machine.
        backend: "loky" (this machine) or "dask", then with the `address` of its scheduler.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigError: an unknown family.
        TerrafusionError: nothing to run, workers died, or the folder cannot be written.
    """
    import pandas as pd

    from terrafusion.fusion.benchmark.compare import as_json
    from terrafusion.fusion.benchmark.plan import BenchmarkPlan, families_of
    from terrafusion.fusion.benchmark.run import run_benchmark
    from terrafusion.fusion.reports.benchmark import at_the_end, origin_of, write_benchmark

    out = checked_path(out, "out")
    checked_progress(progress)
    seeds = None if seeds is None else checked_whole(seeds, "seeds", 1)
    plan = BenchmarkPlan(families_of(checked_names(only, "only")), seeds, quick)
    origin = origin_of(plan, "terrafusion.benchmark")
    result = run_benchmark(
        plan,
        out,
        jobs=checked_whole(jobs, "jobs", 1),
        backend=backend,
        address=address,
        progress=progress,
    )
    write_benchmark(out, result, at_the_end(origin))
    return pd.json_normalize([as_json(row) for row in result.rows])
