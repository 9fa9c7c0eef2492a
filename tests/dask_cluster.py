"""A Dask cluster of real processes on this machine."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import time
from collections.abc import Iterator
from multiprocessing.context import ForkServerProcess
from pathlib import Path

PATIENCE_S = 60.0
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload([
    "distributed.cli.dask_scheduler", "distributed.cli.dask_worker", "terrafusion.fusion.replay",
    "terrafusion.twin.simulate",
])  # fmt: skip


def _dask(command: str, words: tuple[str, ...]) -> None:
    """`dask COMMAND WORDS` in this process, without a word."""
    import importlib

    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    module = importlib.import_module(f"distributed.cli.dask_{command}")
    module.main.main(list(words), standalone_mode=False)


@contextlib.contextmanager
def started(command: str, *words: str) -> Iterator[ForkServerProcess]:
    """A `dask` process, ended at the end. It is forked from one that has all in memory, to start at once."""
    child = SERVER.Process(target=_dask, args=(command, words))
    child.start()
    try:
        yield child
    finally:
        child.kill()
        child.join()


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


def worker(address: str, *more: str) -> contextlib.AbstractContextManager[ForkServerProcess]:
    return started("worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny", *more)


def wait_for_workers(address: str, count: int) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=PATIENCE_S)


def slow_square(number: int) -> int:
    """A trial that takes a moment, for workers that are to be killed meanwhile."""
    time.sleep(0.15)
    return number * number
