"""Strict loading of YAML parameter files into frozen dataclasses.

A parameter is a dataclass field annotated with a `Quantity`: its unit and the
range it must lie in. In the file it stands as a mapping with its source::

    mass_kg: {value: 32.0, source: "source study, Tab. 1"}

The unit is the suffix of the key, so that a number cannot be read without it.
`valid: [low, high]` may stand beside it: the range its source covers, held against the value.
An unknown key, a missing source, a value out of range or of the wrong type is
a `ConfigError` that names the key, the value and what is allowed.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from terrafusion.datasets.core.errors import ConfigError

T = TypeVar("T")


@dataclass(frozen=True)
class Quantity:
    """Unit and closed range of a parameter; `size` entries for a vector, one number when 0."""

    unit: str
    low: float = -math.inf
    high: float = math.inf
    size: int = 0

    def allowed(self) -> str:
        """The range in words, as error messages quote it."""
        kind = f"{self.size} numbers" if self.size else "a number"
        bounds = f" in [{self.low:g}, {self.high:g}]" if math.isfinite(self.low + self.high) else ""
        return f"{kind}{bounds} {self.unit}".rstrip()


MAX_BYTES = 256 * 1024
"""A larger file is no parameter file: pure-Python YAML would take seconds over it."""

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 2


def shown(value: Any) -> str:
    """`value` as messages quote it: shortened, since aliases in YAML can stand for billions of entries."""
    if isinstance(value, str):
        return value if len(value) <= 80 else f"{value[:77]}..."
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python does not print integers of more than 4300 digits
        return "a huge number"


Position = Annotated[tuple[float, ...], Quantity("m", -20.0, 20.0, size=3)]
"""A point in the body frame (x forward, y left, z up), metres."""


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping at the top of a YAML 1.2 file; twice the same key is an error.

    Raises:
        ConfigError: the file is missing, very large, not UTF-8, not YAML, or not a mapping.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(
                f"the file has more than {MAX_BYTES // 1024} KiB", file=path, remedy="give a parameter file"
            )
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError("no such file", file=path, remedy="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", file=path, remedy="give a UTF-8 text file") from None
    try:
        content = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        problem = str(getattr(error, "problem", None) or error).split("\n")[0]
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark is not None else ""
        raise ConfigError(f"not valid YAML{line}: {problem}", file=path, remedy="mend that line") from None
    if content is None:
        return {}
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ConfigError("the top level must be a mapping of names to values", file=path)
    return content


def structure(cls: type[T], raw: Any, *, file: Path | str, key: str = "") -> T:
    """Build the frozen dataclass `cls` from the mapping `raw`, strictly.

    Nested dataclasses are sections. `key` is the path of `raw` inside the file.

    Raises:
        ConfigError: unknown or missing key, missing source, wrong type, out of range.
    """
    if not isinstance(raw, Mapping):
        raise ConfigError(
            f"'{shown(raw)}' is not a section",
            file=file,
            channel=key or None,
            remedy=f"give keys from {', '.join(_names(cls))}",
        )
    hints = get_type_hints(cls, include_extras=True)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    for name in raw:
        if name not in fields:
            raise _unknown_key(str(name), list(fields), file, key)
    values: dict[str, Any] = {}
    for name, field in fields.items():
        here = f"{key}.{name}" if key else name
        if name in raw:
            values[name] = _value(hints[name], raw[name], file, here)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ConfigError(f"'{here}' is missing", file=file, remedy=f"add it{_hint(hints[name])}")
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(str(error), file=file, channel=key or None) from None


def checked_number(
    value: Any, quantity: Quantity, *, file: Path | str, key: str
) -> float | tuple[float, ...]:
    """`value` as float (or tuple of floats) when it has the type and range of `quantity`.

    Raises:
        ConfigError: otherwise.
    """
    items = list(value) if quantity.size and isinstance(value, (list, tuple)) else [value]
    numeric = all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in items)
    if not numeric or len(items) != (quantity.size or 1):
        raise ConfigError(f"'{key}' is '{shown(value)}'", file=file, remedy=f"give {quantity.allowed()}")
    numbers = tuple(float(x) if abs(x) < 1e300 else math.inf for x in items)
    if not all(math.isfinite(x) and quantity.low <= x <= quantity.high for x in numbers):
        raise ConfigError(
            f"'{key}' is {shown(value)}, out of range",
            file=file,
            remedy=f"give {quantity.allowed()}; is the unit right?",
        )
    return numbers if quantity.size else numbers[0]


def _names(cls: type) -> list[str]:
    return [f.name for f in dataclasses.fields(cls)]


def _quantity(hint: Any) -> Quantity | None:
    if get_origin(hint) is Annotated:
        return next((a for a in get_args(hint)[1:] if isinstance(a, Quantity)), None)
    return None


def _present(hint: Any) -> Any:
    """`X` of `X | None`: a key that is there has a value."""
    if get_origin(hint) not in (Union, UnionType):
        return hint
    return next(kind for kind in get_args(hint) if kind is not type(None))


def _hint(hint: Any) -> str:
    quantity = _quantity(hint)
    return f": {{value: {quantity.allowed()}, source: where it comes from}}" if quantity else ""


def _value(hint: Any, raw: Any, file: Path | str, key: str) -> Any:
    hint = _present(hint)
    quantity = _quantity(hint)
    if quantity is not None:
        return _sourced(quantity, raw, file, key)
    if dataclasses.is_dataclass(hint):
        return structure(hint, raw, file=file, key=key)  # type: ignore[arg-type]
    if get_origin(hint) is dict:
        if not isinstance(raw, Mapping):
            raise ConfigError(f"'{key}' is '{shown(raw)}'", file=file, remedy="give a mapping")
        item = get_args(hint)[1]
        return {str(name): _value(item, value, file, f"{key}.{name}") for name, value in raw.items()}
    if get_origin(hint) is tuple:
        if not isinstance(raw, list) or not all(isinstance(x, str) for x in raw):
            raise ConfigError(f"'{key}' is '{shown(raw)}'", file=file, remedy="give a list of words")
        return tuple(raw)
    if hint is str:
        if not isinstance(raw, str):
            raise ConfigError(f"'{key}' is '{shown(raw)}'", file=file, remedy="give a text")
        return raw
    raise TypeError(
        f"{key}: a field of type {hint} cannot be loaded"
    )  # a defect of the dataclass, not of the file


def _sourced(quantity: Quantity, raw: Any, file: Path | str, key: str) -> Any:
    if not isinstance(raw, Mapping):
        raise ConfigError(
            f"'{key}' is '{shown(raw)}' without a source",
            file=file,
            remedy=f"write {{value: {quantity.allowed()}, source: where it comes from}}",
        )
    for name in raw:
        if name not in ("value", "source", "valid"):
            why = " (the unit is the suffix of the key)" if name == "unit" else ""
            raise ConfigError(
                f"'{key}' has the unknown entry '{shown(name)}'{why}",
                file=file,
                remedy="keep 'value', 'source' and 'valid' only",
            )
    if not isinstance(raw.get("source"), str) or not raw["source"].strip():
        raise ConfigError(f"'{key}' has no source", file=file, remedy="tell where the number comes from")
    value = checked_number(raw.get("value"), quantity, file=file, key=key)
    if "valid" in raw:
        _check_valid(value, raw["valid"], quantity, file, key)
    return value


def _check_valid(value: Any, valid: Any, quantity: Quantity, file: Path | str, key: str) -> None:
    """Refuses a number outside the range its source covers, `valid: [low, high]`."""
    both = dataclasses.replace(quantity, size=2)
    low, high = checked_number(valid, both, file=file, key=f"{key}.valid")  # type: ignore[misc]
    numbers = value if isinstance(value, tuple) else (value,)
    if not all(low <= number <= high for number in numbers):
        raise ConfigError(
            f"'{key}' is {shown(value)}, outside its validity range",
            file=file,
            remedy=f"its source covers [{low:g}, {high:g}] {quantity.unit}".rstrip(),
        )


def _unknown_key(name: str, known: list[str], file: Path | str, key: str) -> ConfigError:
    here = f"{key}.{name}" if key else name
    stem = name.rsplit("_", 1)[0]
    same = [k for k in known if k.rsplit("_", 1)[0] == stem]
    close = same or difflib.get_close_matches(name, known, n=1)
    remedy = f"did you mean '{close[0]}'?" if close else f"known here: {', '.join(known)}"
    if same:
        remedy = f"write '{same[0]}' (the unit is part of the name)"
    return ConfigError(f"unknown key '{shown(here)}'", file=file, remedy=remedy)
