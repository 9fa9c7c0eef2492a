"""`run_sweep`: many runs of the twin, as one table; resumed where it was stopped.

    from terrafusion.twin.sweep.load import load_sweep
    from terrafusion.twin.sweep.run import run_sweep
    table = run_sweep(load_sweep("friction_slope"), "out", jobs=2)     # a pyarrow Table

The rows and their order depend on the sweep alone, not on the number of
workers, the backend or interruptions.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.executors import open_workers
from terrafusion.twin.sweep.plan import MAX_RUNS, Sweep, SweepPoint
from terrafusion.twin.sweep.rows import Row, run_chunk
from terrafusion.twin.sweep.store import RUNS_FILE, Store


def run_sweep(
    sweep: Sweep,
    out: Path | str,
    *,
    jobs: int = 1,
    backend: str = "loky",
    address: str | None = None,
    max_runs: int = MAX_RUNS,
    progress: Callable[[float], None] | None = None,
) -> Any:
    """Compute the runs that `out` does not hold yet, and return the table of all.

    Args:
        sweep: what to run.
        out: folder of the results, see `sweep.store`.
        jobs: processes on this machine; a Dask cluster has its own number.
        backend: "loky" (this machine) or "dask".
        address: of the Dask scheduler, such as "tcp://10.0.0.5:8786".
        max_runs: a sweep of more runs is refused.
        progress: called with the share of the runs done, 0 to 1.

    Returns:
        pyarrow `Table`, one row a run in the order of `sweep.cases()`; see `sweep.rows.columns`.

    Raises:
        ConfigError: too many runs, another sweep in `out`, or an option that makes no sense.
        TerrafusionError: a package is missing, nobody answers at the address, workers died, or
            the folder cannot be written. Finished chunks stay, and the same call continues.
    """
    if sweep.runs > max_runs:
        raise ConfigError(
            f"{sweep.runs} runs are more than {max_runs}",
            file=sweep.name,
            remedy="ask for them by --max-runs",
        )
    chunks = sweep.chunks()
    store = Store(Path(out), sweep, chunks)
    missing = store.missing()
    done = sweep.runs - sum(len(chunks[number]) for number in missing)
    if missing:
        cases = list(sweep.cases())
        work = [(sweep, number, [cases[run] for run in chunks[number]]) for number in missing]
        with open_workers(backend, min(jobs, len(missing)), address) as workers:
            for number, rows in workers.results(_numbered, work):
                store.write_part(number, rows)
                done += len(rows)
                if progress is not None:
                    progress(done / sweep.runs)
    store.assemble()
    return read_table(out)


def read_table(out: Path | str) -> Any:
    """The table of a finished sweep, a pyarrow `Table`."""
    import pyarrow.parquet as pq

    return pq.read_table(Path(out) / RUNS_FILE)


def _numbered(sweep: Sweep, number: int, cases: Sequence[SweepPoint]) -> tuple[int, list[Row]]:
    return number, run_chunk(sweep, cases)
