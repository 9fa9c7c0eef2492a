"""Results of many tasks, kept one by one, so that a run goes on where it was stopped.

Tasks run in processes of this machine, which share what was loaded before, or on a Dask cluster.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.executors import BACKENDS, open_workers

ROOT = Path(__file__).parents[2]
LIBRARY = ("datasets", "twin", "fusion")


@dataclass(frozen=True)
class Task:
    """One piece of work: a unique name, the code that computes it, and what that is given."""

    name: str
    code: str
    what: Any

    def file(self, folder: Path) -> Path:
        """Where its result is kept."""
        return folder / f"{hashlib.sha256(f'{self.name} {self.code}'.encode()).hexdigest()[:16]}.json"


def library_code() -> str:
    """The last commit that changed the library."""
    command = ["git", "log", "-1", "--format=%h", "--", *LIBRARY]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.strip() or "unknown"


def code_of(*files: Path) -> str:
    """A short hash of files."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes() if file.is_file() else b"")
    return digest.hexdigest()[:8]


@dataclass(frozen=True)
class TaskWorkers:
    """Where tasks run: `jobs` processes of this machine ("loky") or the Dask cluster at `address` ("dask").

    `limit_s` is when to stop. Workers of a cluster call `load` once, in place of what processes here share.
    """

    jobs: int = 1
    backend: str = BACKENDS[0]
    address: str | None = None
    limit_s: float = float("inf")

    @classmethod
    def of(cls, given: argparse.Namespace) -> TaskWorkers:
        """As the options of `add_options` say."""
        return cls(given.jobs, given.backend, given.address, 60.0 * given.minutes)


def add_worker_options(parser: argparse.ArgumentParser) -> None:
    """Options of every command that runs on several processes or a cluster."""
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--backend", choices=BACKENDS, default=BACKENDS[0], help="this machine, or a cluster")
    parser.add_argument("--address", metavar="tcp://HOST:PORT", help="the Dask cluster's scheduler")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of every command whose tasks are kept one by one."""
    add_worker_options(parser)
    parser.add_argument("--minutes", type=float, default=600.0, help="stop after so long, with what there is")


Compute = Callable[[Any], Any]
_COMPUTE: Compute
_LOADED: set[str] = set()


def _done(task: Task) -> tuple[Task, Any]:
    return task, _COMPUTE(task.what)


def _done_afar(compute: Compute, task: Task, load: Callable[[], None] | None) -> tuple[Task, Any]:
    if load is not None and repr(load) not in _LOADED:
        load()
        _LOADED.add(repr(load))
    return task, compute(task.what)


@contextlib.contextmanager
def _results(
    missing: Sequence[Task], compute: Compute, workers: TaskWorkers, load: Callable[[], None] | None
) -> Iterator[Iterator[tuple[Task, Any]]]:
    global _COMPUTE
    if workers.backend == "dask":
        with open_workers("dask", workers.jobs, workers.address) as cluster:
            yield cluster.results(_done_afar, [(compute, task, load) for task in missing])
        return
    _COMPUTE = compute
    with multiprocessing.get_context("fork").Pool(workers.jobs, maxtasksperchild=50) as pool:
        yield pool.imap_unordered(_done, missing)


def run_all(
    tasks: Sequence[Task], compute: Compute, folder: Path, workers: TaskWorkers,
    load: Callable[[], None] | None = None,
) -> None:  # fmt: skip
    """Compute what the folder lacks, in the order of the tasks; stops when the time is over.

    Args:
        load: see `TaskWorkers`; with a cluster it and `compute` are found by name.

    Raises:
        TerrafusionError: nobody answers at the address, or all workers of the cluster are gone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = [task for task in tasks if not task.file(folder).is_file()]
    begun = time.monotonic()
    with _results(missing, compute, workers, load) as results:
        for k, (task, result) in enumerate(results, 1):
            partial = task.file(folder).with_suffix(".partial")
            partial.write_text(
                json.dumps({"name": task.name, "code": task.code, "result": result}), encoding="utf-8"
            )
            partial.replace(task.file(folder))
            if sys.stderr.isatty():
                print(f"\r\x1b[K{k} of {len(missing)}: {task.name}", end="", file=sys.stderr, flush=True)
            if time.monotonic() - begun > workers.limit_s:
                break


def answers(
    items: Sequence[Any], compute: Compute, workers: TaskWorkers, out: Path | None
) -> list[Any]:  # fmt: skip
    """`compute` of each item, as JSON gives it; kept in `out`, if there is one, for this commit.

    Raises:
        TerrafusionError: the time is over before all are done, or as `run_all`.
    """
    code = library_code()
    with tempfile.TemporaryDirectory() as empty:
        folder = Path(empty) if out is None else out / "parts"
        tasks = [Task(f"{compute.__module__} {item!r}", code, item) for item in items]
        run_all(tasks, compute, folder, workers)
        missing = sum(not task.file(folder).is_file() for task in tasks)
        if missing:
            remedy = "give more --minutes" if out is None else "the same command continues"
            raise TerrafusionError(f"{missing} of {len(tasks)} trials are missing", remedy=remedy)
        return [result_of(task, folder) for task in tasks]


@dataclass(frozen=True)
class Ended:
    """A command that has ended: its status, and what it printed."""

    returncode: int
    stdout: str
    stderr: str


def command(words: Sequence[str]) -> Ended:
    """Run Python with these words in the folder of the repository."""
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    return Ended(done.returncode, done.stdout, done.stderr)


def command_at(address: str | None, words: Sequence[str]) -> Ended:
    """The same on a worker of the Dask cluster at `address`, which has to see the folders in the words.

    Raises:
        TerrafusionError: nobody answers at the address, or all workers of the cluster are gone.
    """
    with open_workers("dask", 1, address) as cluster:
        return next(iter(cluster.results(command, [(list(words),)])))


def result_of(task: Task, folder: Path) -> Any:
    """The result of a task; None where it has not been run."""
    file = task.file(folder)
    return json.loads(file.read_text(encoding="utf-8"))["result"] if file.is_file() else None
