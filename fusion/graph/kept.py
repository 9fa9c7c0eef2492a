"""Results that are costly to make and often asked for."""

import operator
from collections.abc import Callable
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class Kept(Generic[T]):
    """A result that is made again only where another object takes part in it."""

    def __init__(self) -> None:
        self._made_of: tuple[object, ...] = ()
        self._result: Any = None

    def of(self, made_of: tuple[object, ...], make: Callable[[], T]) -> T:
        """The result of `make`, which uses the objects `made_of`; none of them may change in place."""
        before = self._made_of
        if len(before) != len(made_of) or not all(map(operator.is_, before, made_of)):
            self._result, self._made_of = make(), made_of
        result: T = self._result
        return result
