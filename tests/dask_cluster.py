"""A Dask cluster of real processes on this machine."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

PATIENCE_S = 60.0


@contextlib.contextmanager
def started(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """A `dask` process, in its own process group, ended at the end."""
    child = subprocess.Popen(
        [sys.executable, "-m", "dask", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield child
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()


@contextlib.contextmanager
def scheduler(folder: Path) -> Iterator[str]:
    """A scheduler without workers; its address."""
    file = folder / "scheduler.json"
    options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    with started("scheduler", *options):
        limit = time.monotonic() + PATIENCE_S
        while not file.is_file() or not file.read_text().strip():
            assert time.monotonic() < limit, "the scheduler did not start"
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"]


def worker(address: str, *more: str) -> contextlib.AbstractContextManager[subprocess.Popen[bytes]]:
    return started("worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny", *more)


def wait_for_workers(address: str, count: int) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=PATIENCE_S)


def slow_square(number: int) -> int:
    """A trial that takes a moment, for workers that are to be killed meanwhile."""
    time.sleep(0.15)
    return number * number
