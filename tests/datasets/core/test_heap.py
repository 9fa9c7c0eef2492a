"""The collector of cycles while messages are processed."""

from __future__ import annotations

import gc
import weakref

from terrafusion.datasets.core.heap import older_objects_unsearched


class _Cycle:
    def __init__(self) -> None:
        self.self = self


def test_older_objects_are_not_searched_inside_and_are_afterwards() -> None:
    old = weakref.ref(_Cycle())
    with older_objects_unsearched():
        new = weakref.ref(_Cycle())
        gc.collect()
        assert new() is None
        assert old() is not None
    gc.collect()
    assert old() is None


def test_a_heap_that_the_caller_froze_stays_frozen() -> None:
    gc.freeze()
    try:
        with older_objects_unsearched():
            pass
        assert gc.get_freeze_count()
    finally:
        gc.unfreeze()
