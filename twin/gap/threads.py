"""Linear algebra in the calling thread."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """One BLAS thread: the matrices are small and runs are in threads of their own, so a second one only
    waits. It also makes results independent of the number of processors."""
    import scipy.linalg.lapack  # noqa: F401  loads a BLAS of its own, which must be present to be limited
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
