"""Runs in threads of their own, linear algebra in the calling thread."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def in_threads(jobs: int, function: Callable[..., T], *arguments: Iterable[object]) -> list[T]:
    """Results of the function for each set of arguments, in their order, from so many threads."""
    with ThreadPoolExecutor(jobs) as threads:
        return list(threads.map(function, *arguments))


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """One BLAS thread: the matrices are small and runs are in threads of their own, so a second one only
    waits. It also makes results independent of the number of processors."""
    import scipy.linalg.lapack  # noqa: F401  loads a BLAS of its own, which must be present to be limited
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
