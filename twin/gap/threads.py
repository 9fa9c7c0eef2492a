"""Threads of the diagnosis and those of the linear algebra."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Linear algebra in the calling thread.

    The matrices are small and the runs are in threads of their own: a second thread of BLAS only waits, which
    costs as much processor as all else. So the bits do not depend on the number of processors either.
    """
    import scipy.linalg.lapack  # noqa: F401  brings a BLAS of its own, which must be there to be told
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
