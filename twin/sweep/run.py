"""`run_sweep`: many runs of the twin, as one table; resumed where it was stopped.

    from terrafusion.twin.sweep.load import load_sweep
    from terrafusion.twin.sweep.run import run_sweep
    table = run_sweep(load_sweep("friction_slope"), "out", jobs=2)     # a pyarrow Table

The rows and their order depend on the sweep alone, not on the number of workers, the backend or
interruptions. Files of a sweep:

    sweep.json        the sweep, its hash, whether it is complete; the same on every machine
    parts/            one Parquet file a chunk, written beside its place and moved there when whole
    runs.parquet      all rows, when all chunks are there; the parts are then removed

A killed process loses only the chunks it was computing.
"""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import ConfigError, DataError, TerrafusionError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.scratch import is_part
from terrafusion.twin.executors import open_workers
from terrafusion.twin.model.version import model_sha256, version
from terrafusion.twin.sweep.plan import MAX_RUNS, Sweep
from terrafusion.twin.sweep.rows import Row, columns, run_chunk

SCHEMA = 1
SWEEP_FILE, RUNS_FILE, PARTS_FOLDER = "sweep.json", "runs.parquet", "parts"
_HASH_KEY = b"terrafusion_sweep_sha256"


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
        out: folder of the results, see the files above.
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
        work = {number: (run_chunk, (sweep, [cases[run] for run in chunks[number]])) for number in missing}
        with open_workers(backend, min(jobs, len(missing)), address) as workers:
            for number, rows in workers.by_key(work):
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


class Store:
    """The folder of one sweep.

    Raises:
        TerrafusionError: pyarrow is missing, or the folder cannot be written.
        ConfigError: the folder holds another sweep.
    """

    def __init__(self, folder: Path, sweep: Sweep, chunks: Sequence[range]) -> None:
        _require_pyarrow()
        self.folder, self.sweep, self.chunks = folder, sweep, chunks
        self.sha256 = sweep.sha256()
        self._check_same()
        if not self.complete():  # before any part: this file says whose folder it is
            self._write_about(None)

    def complete(self) -> bool:
        """Whether the table of all runs is there."""
        return self._holds(self.folder / RUNS_FILE, self.sweep.runs)

    def missing(self) -> list[int]:
        """Numbers of the chunks that are still to be computed."""
        if self.complete():
            return []
        return [i for i, chunk in enumerate(self.chunks) if not self._holds(self._part(i), len(chunk))]

    def write_part(self, number: int, rows: Sequence[Row]) -> None:
        """Write the rows of one chunk."""
        self._write_table(self._part(number), self._table(rows))

    def assemble(self) -> None:
        """Join the parts, in the order of the runs, into the table of all runs; remove the parts."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not self.complete():
            parts = [pq.read_table(self._part(i)) for i in range(len(self.chunks))]
            self._write_table(self.folder / RUNS_FILE, pa.concat_tables(parts).combine_chunks())
        counts = pq.read_table(self.folder / RUNS_FILE, columns=["status"])["status"].to_pylist()
        self._write_about({word: counts.count(word) for word in sorted(set(counts))})
        shutil.rmtree(self.folder / PARTS_FOLDER, ignore_errors=True)

    def _part(self, number: int) -> Path:
        return self.folder / PARTS_FOLDER / f"part-{number:06d}.parquet"

    def _check_same(self) -> None:
        about = self.folder / SWEEP_FILE
        if not about.is_file():
            if self.folder.is_dir() and not all(is_part(path.name) for path in self.folder.iterdir()):
                raise ConfigError(
                    "the folder is not empty and holds no sweep", file=self.folder, remedy="give a new folder"
                )
            return
        try:
            found = json.loads(about.read_text(encoding="utf-8"))
            known = (found["sha256"], found["terrafusion"], found["model_sha256"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"cannot be read ({error})", file=about, remedy="give a new folder") from None
        begun = any((self.folder / PARTS_FOLDER).glob("part-*.parquet")) or (self.folder / RUNS_FILE).exists()
        if known[0] == self.sha256 or not begun:
            return
        same_code = known[1:] == (version(), model_sha256())
        what = "another sweep" if same_code else "a sweep of another version of terrafusion"
        raise ConfigError(
            f"the folder holds {what} (sha256 {str(known[0])[:12]}, now {self.sha256[:12]})",
            file=self.folder,
            remedy="give a new --out, or remove the folder to begin anew",
        )

    def _write_about(self, outcome: dict[str, int] | None) -> None:
        about = {
            "schema": SCHEMA,
            "name": self.sweep.name,
            "sha256": self.sha256,
            "terrafusion": version(),
            "model_sha256": model_sha256(),
            "runs": self.sweep.runs,
            "complete": outcome is not None,
            "outcome": outcome,
            "columns": {c.name: c.about for c in columns(self.sweep.sensors)},
            "config": self.sweep.config(),
        }
        text = json.dumps(about, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        write_atomically(self.folder / SWEEP_FILE, lambda part: part.write_text(text, encoding="utf-8"))

    def _holds(self, file: Path, rows: int) -> bool:
        """Whether `file` is a whole table of this sweep with so many rows."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            about = pq.read_metadata(file)
        except (OSError, pa.ArrowInvalid):  # missing, or cut short by a disk that lost power
            return False
        return about.num_rows == rows and (about.metadata or {}).get(_HASH_KEY) == self.sha256.encode()

    def _table(self, rows: Sequence[Row]) -> Any:
        import pyarrow as pa

        kinds = {"int": pa.int64(), "float": pa.float64(), "text": pa.string()}
        fields = [
            pa.field(c.name, kinds[c.kind], metadata={"about": c.about}) for c in columns(self.sweep.sensors)
        ]
        schema = pa.schema(fields, metadata={_HASH_KEY: self.sha256.encode()})
        return pa.Table.from_pylist(list(rows), schema=schema)

    def _write_table(self, file: Path, table: Any) -> None:
        import pyarrow.parquet as pq

        write_atomically(file, lambda part: pq.write_table(table, part))


def _require_pyarrow() -> None:
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise TerrafusionError(
            "a sweep writes Parquet, and the package pyarrow is not installed",
            remedy="pip install 'terrafusion[parquet]'",
        ) from None
