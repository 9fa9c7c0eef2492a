"""Does a value fit the annotation of a dataclass field?"""

import functools
import types
import typing
from collections.abc import Mapping
from typing import Any


@functools.cache
def hints_of(cls: type) -> Mapping[str, Any]:
    """The annotations of a class, evaluated."""
    return typing.get_type_hints(cls)


def fits(value: Any, hint: Any) -> bool:
    """Whether `value` is of the annotated type; containers are looked into, arrays by kind only."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return True
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is None or hint is type(None):
        return value is None
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, one) for one in arguments)
    if origin is typing.Annotated:
        return fits(value, arguments[0])
    if not isinstance(value, origin or hint):
        return False
    if origin in (list, set) or (origin is tuple and arguments[-1] is Ellipsis):
        return all(fits(one, arguments[0]) for one in value)
    if origin is tuple:
        return len(value) == len(arguments) and all(map(fits, value, arguments))
    if origin is dict:
        return all(fits(k, arguments[0]) and fits(v, arguments[1]) for k, v in value.items())
    return True
