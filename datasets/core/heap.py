"""Pauses of Python's collector of cycles while messages are processed."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def older_objects_unsearched() -> Iterator[None]:
    """Inside, the collector searches only objects made inside.

    A full collection of all that the imports have made takes as long as thirty keyframes. The collector
    stays on, and where the caller has frozen the heap, all is left as it is.
    """
    if gc.get_freeze_count():
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
