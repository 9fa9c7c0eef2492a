"""Results of many tasks, kept one by one, so that a run goes on where it was stopped."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]
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


_COMPUTE: Callable[[Any], Any]


def _done(task: Task) -> tuple[Task, Any]:
    return task, _COMPUTE(task.what)


def run_all(
    tasks: Sequence[Task], compute: Callable[[Any], Any], folder: Path, jobs: int, limit_s: float
) -> None:
    """Compute what the folder lacks, in the order of the tasks; stops when `limit_s` have passed.

    Workers are forked: they share what was loaded before.
    """
    global _COMPUTE
    _COMPUTE = compute
    folder.mkdir(parents=True, exist_ok=True)
    missing = [task for task in tasks if not task.file(folder).is_file()]
    begun = time.monotonic()
    with multiprocessing.get_context("fork").Pool(jobs, maxtasksperchild=50) as pool:
        for k, (task, result) in enumerate(pool.imap_unordered(_done, missing), 1):
            partial = task.file(folder).with_suffix(".partial")
            partial.write_text(
                json.dumps({"name": task.name, "code": task.code, "result": result}), encoding="utf-8"
            )
            partial.replace(task.file(folder))
            if sys.stderr.isatty():
                print(f"\r\x1b[K{k} of {len(missing)}: {task.name}", end="", file=sys.stderr, flush=True)
            if time.monotonic() - begun > limit_s:
                pool.terminate()
                break


def result_of(task: Task, folder: Path) -> Any:
    """The result of a task; None where it has not been run."""
    file = task.file(folder)
    return json.loads(file.read_text(encoding="utf-8"))["result"] if file.is_file() else None
