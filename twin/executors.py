"""Executors for chunks of runs: this process, processes of this machine, or a Dask cluster.

joblib's loky and a Dask client both offer the executor of `concurrent.futures`, so that all backends run the
same code, and that the loss of all workers is noticed while waiting (joblib's own Dask backend would wait).
"""

import contextlib
import itertools
import logging
import platform
import socket
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from importlib import metadata
from typing import Any, TypeVar

from terrafusion.datasets.core.errors import ConfigError, TerrafusionError
from terrafusion.twin.engine.integrate import compiled
from terrafusion.twin.model.version import model_sha256, version

K = TypeVar("K")
T = TypeVar("T")

BACKENDS = ("loky", "dask")
REPLACED = "A worker stopped while some jobs"
"""Warning of loky when it replaces a worker whose memory has grown; no job is lost."""
CONNECT_S = 8.0
"""Timeout of the scheduler and of its first worker."""
WORKERLESS_S = 10.0
"""Timeout of a cluster without any worker."""
_POLL_S = 1.0
_MAX_GREETING = 1 << 20
_CONTINUE = "finished runs are kept, and the same command continues"


@dataclass(frozen=True)
class Workers:
    """An executor (None: this process), and how many jobs to submit ahead.

    Attributes:
        at_once: jobs submitted ahead of their results; None for all.
        check: raises when the workers are gone for good.
    """

    executor: Executor | None
    at_once: int | None = None
    check: Callable[[], None] = lambda: None

    def results(self, function: Callable[..., T], jobs: Iterable[tuple[Any, ...]]) -> Iterator[T]:
        """`function(*job)` of every job, in the order in which they finish.

        Raises:
            TerrafusionError: workers died or the connection was lost.
        """
        if self.executor is None:
            for job in jobs:
                yield function(*job)
            return
        queue = iter(jobs)
        waiting = {self.executor.submit(function, *job) for job in itertools.islice(queue, self.at_once)}
        while waiting:
            done, waiting = wait(waiting, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            results = [_result(future) for future in done]
            waiting |= {self.executor.submit(function, *job) for job in itertools.islice(queue, len(done))}
            yield from results
            if not done:
                self.check()

    def by_key(self, calls: Mapping[K, tuple[Callable[..., T], tuple[Any, ...]]]) -> Iterator[tuple[K, T]]:
        """Results of calls (function, arguments) with their keys, as they finish; raises as `results`."""
        return self.results(_keyed, ((key, *call) for key, call in calls.items()))


def _keyed(key: K, function: Callable[..., T], arguments: tuple[Any, ...]) -> tuple[K, T]:
    return key, function(*arguments)


@contextlib.contextmanager
def open_workers(backend: str, jobs: int, address: str | None = None) -> Iterator[Workers]:
    """`jobs` processes on this machine, or the workers of the Dask scheduler at `address`.

    Raises:
        ConfigError: unknown backend, no jobs, or an address missing or out of place.
        TerrafusionError: the package is not installed; nobody answers at the address; or the
            workers run another version of this library.
    """
    if backend not in BACKENDS:
        raise ConfigError(f"unknown backend '{backend}'", remedy=f"known are {', '.join(BACKENDS)}")
    if jobs < 1:
        raise ConfigError(f"{jobs} jobs", remedy="give a whole number from 1")
    if (address is not None) != (backend == "dask"):
        raise ConfigError(
            "the backend 'dask' needs an address, and no other has one",
            remedy="give the scheduler's address, such as tcp://10.0.0.5:8786",
        )
    if address is not None:
        with _dask(address) as workers:
            yield workers
    elif jobs == 1:
        yield Workers(None)
    else:
        with warnings.catch_warnings(), _loky(jobs) as executor:
            warnings.filterwarnings("ignore", message=REPLACED, category=UserWarning)
            # Less than loky queues at once (2 jobs + 1): it stops cleanly only when none waits inside it.
            yield Workers(executor, at_once=2 * jobs)


def _result(future: Future[T]) -> T:
    try:
        return future.result()
    except CancelledError:
        raise TerrafusionError("the connection to the cluster was lost", remedy=_CONTINUE) from None
    except BrokenExecutor as error:
        raise TerrafusionError(
            f"a worker process died ({_first_line(error)})",
            remedy=f"it may have run out of memory: give fewer --jobs; {_CONTINUE}",
        ) from None
    except Exception as error:
        if type(error).__name__ != "KilledWorker":  # of distributed, which need not be installed
            raise
        raise TerrafusionError(
            "the cluster's workers died again and again over the same runs",
            remedy=f"look into their logs (memory?); {_CONTINUE}",
        ) from None


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]


@contextlib.contextmanager
def _loky(jobs: int) -> Iterator[Executor]:
    from joblib.externals.loky import get_reusable_executor

    # One thread of linear algebra a process: the arrays are small.
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    executor = get_reusable_executor(max_workers=jobs, reuse=False, env=threads)
    try:
        yield executor
    finally:
        # loky's thread fails on jobs still in its queue when the workers are killed. It takes them in order:
        # once it has seen one more, the queue is empty.
        with contextlib.suppress(BrokenExecutor):
            last = executor.submit(int)
            last.cancel()
            wait([last], timeout=_POLL_S)
        executor.shutdown(wait=True, kill_workers=True)


@contextlib.contextmanager
def _dask(address: str) -> Iterator[Workers]:
    try:
        from distributed import Client
    except ImportError:
        raise TerrafusionError(
            "the package distributed is not installed", remedy="pip install 'terrafusion[cluster]'"
        ) from None
    _knock(address)
    with _quiet("distributed"), contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=CONNECT_S, set_as_default=False))
        except Exception as error:  # of many kinds: what answers may be anything
            raise _no_scheduler(address, _first_line(error)) from None
        _check_workers(client, address)
        yield Workers(client.get_executor(pure=False), check=_Watch(client, address))


def _knock(address: str) -> None:
    """Refuse an address where no scheduler answers, faster than the timeout of a client."""
    scheme, _, place = address.rpartition("://")
    host, _, port = place.rpartition(":")
    if scheme not in ("tcp", "tls") or not host or not port.isdecimal():
        raise ConfigError(
            f"'{address}' is no address of a scheduler", remedy="give one such as tcp://10.0.0.5:8786"
        )
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S) as line:
            # A scheduler speaks first: the length of its greeting, eight bytes.
            greeting = line.recv(8, socket.MSG_WAITALL) if scheme == "tcp" else bytes(8)
    except (OSError, OverflowError) as error:
        raise _no_scheduler(address, _first_line(error)) from None
    if len(greeting) < 8 or int.from_bytes(greeting, "little") > _MAX_GREETING:
        raise _no_scheduler(address, "something else does")


def _no_scheduler(address: str, why: str) -> TerrafusionError:
    return TerrafusionError(
        f"no Dask scheduler answers ({why})",
        file=address,
        remedy="start one with `dask scheduler` and give the address it prints",
    )


@contextlib.contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Mute the log of a package: what matters in it is raised as an error."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


def installed() -> dict[str, str]:
    """Versions that must be the same on all machines of a sweep."""
    found = {"Python": ".".join(platform.python_version_tuple()[:2])}
    for name in ("numpy", "scipy", "casadi"):
        found[name] = metadata.version(name)
    engine = "C" if compiled() else "CasADi's virtual machine"
    return found | {"terrafusion": version(), "the twin's sources": model_sha256()[:12], "engine": engine}


def _check_workers(client: Any, address: str) -> None:
    """Refuse a cluster without workers, or with workers that would compute something else."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError:
        raise TerrafusionError(
            "the Dask scheduler has no worker", file=address, remedy=f"start some: `dask worker {address}`"
        ) from None
    own = installed()
    for worker, found in client.run(installed, on_error="return").items():
        if not isinstance(found, dict):
            raise TerrafusionError(
                f"the worker {worker} cannot run the twin ({_first_line(found)})",
                file=address,
                remedy="install the same terrafusion there",
            )
        for name, mine in own.items():
            if found[name] != mine:
                raise TerrafusionError(
                    f"the worker {worker} has {name} {found[name]}, here it is {mine}",
                    file=address,
                    remedy="install the same versions, and a C compiler, on all machines",
                )


class _Watch:
    """Raises when the cluster has had no worker for `WORKERLESS_S`, or the scheduler is gone."""

    def __init__(self, client: Any, address: str) -> None:
        self.client, self.address, self.seen_s = client, address, time.monotonic()

    def __call__(self) -> None:
        alive = False
        with contextlib.suppress(OSError):
            alive = self.client.status == "running" and bool(self.client.scheduler_info()["workers"])
        now = time.monotonic()
        if alive:
            self.seen_s = now
        elif now - self.seen_s > WORKERLESS_S:
            raise TerrafusionError(
                "the cluster has no workers any more",
                file=self.address,
                remedy=f"start some: `dask worker {self.address}`; {_CONTINUE}",
            )
