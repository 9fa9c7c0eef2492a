"""Arguments of the public functions: a wrong one is a `ConfigError` that says what to give."""

from collections.abc import Iterable
from numbers import Integral
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import ConfigError


def checked_names(value: Any, what: str) -> tuple[str, ...]:
    """One name, or several, as a tuple.

    Raises:
        ConfigError: neither.
    """
    names = (value,) if isinstance(value, str) or not isinstance(value, Iterable) else tuple(value)
    if not all(isinstance(name, str) for name in names):
        raise ConfigError(f"'{what}' is {value!r}", remedy="give a name, or a list of names")
    return names


def checked_whole(value: Any, what: str, least: int = 0) -> int:
    """A whole number from `least` on.

    Raises:
        ConfigError: anything else.
    """
    if not isinstance(value, Integral) or value < least:
        raise ConfigError(f"'{what}' is {value!r}", remedy=f"give a whole number from {least}")
    return int(value)


def checked_progress(value: Any) -> Any:
    """A function to call as work goes on, or None.

    Raises:
        ConfigError: anything else.
    """
    if value is None or callable(value):
        return value
    raise ConfigError(f"'progress' is {value!r}", remedy="give a function to call, or None")


def checked_path(value: Any, what: str) -> Path:
    """A file or folder to write.

    Raises:
        ConfigError: it is no path.
    """
    if not isinstance(value, str | Path):
        raise ConfigError(f"'{what}' is {value!r}", remedy="give a path")
    return Path(value)
