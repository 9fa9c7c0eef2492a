"""Units and ranges of numbers in parameter files, as annotations of dataclass fields.

`Quantity("m", 0, 5)` stands plain in the file, `Sourced("m", 0, 5)` with its source::

    mass_kg: {value: 32.0, source: "source study, Tab. 1"}

The unit is the suffix of the key, so that a number cannot be read without it. `valid: [low, high]` may stand
beside a sourced value: the range its source covers.
"""

import math
import reprlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Annotated, Any

from terrafusion.datasets.core.errors import ConfigError

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


class RejectedError(ValueError):
    """A value that is not allowed; in `what`, `{key}` stands for its key."""

    def __init__(self, what: str, remedy: str | None = None) -> None:
        super().__init__(what)
        self.what, self.remedy = what, remedy

    def at(self, key: str, file: Path | str) -> ConfigError:
        """The error as a user sees it."""
        return ConfigError(self.what.replace("{key}", key), file=file, remedy=self.remedy)


class Parsed(ABC):
    """Annotation of a field of a parameter file."""

    @abstractmethod
    def parse(self, raw: Any) -> Any:
        """The value of a field, checked and converted; a RejectedError where it is not allowed."""

    def parse_part(self, raw: Any, suffix: str) -> Any:
        """`parse` for a part of a value, whose errors add `suffix` to the key."""
        try:
            return self.parse(raw)
        except RejectedError as error:
            raise RejectedError(error.what.replace("{key}", f"{{key}}{suffix}"), error.remedy) from None

    @abstractmethod
    def schema(self) -> dict[str, Any]:
        """JSON schema of the value."""

    def hint(self) -> str:
        """What to write, for a key that is missing."""
        return ""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_plain_validator_function(self.parse)

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return self.schema()


@dataclass(frozen=True)
class Quantity(Parsed):
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

    def hint(self) -> str:
        return self.allowed()

    def parse(self, raw: Any) -> float | tuple[float, ...]:
        """`raw` as float (or tuple of floats); a RejectedError unless it has the type and the range."""
        items = list(raw) if self.size and isinstance(raw, (list, tuple)) else [raw]
        numeric = all(isinstance(x, Real) and not isinstance(x, bool) for x in items)
        if not numeric or len(items) != (self.size or 1):
            raise RejectedError(f"'{{key}}' is '{shown(raw)}'", f"give {self.allowed()}")
        numbers = tuple(float(x) if abs(x) < 1e300 else math.inf for x in items)
        if not all(math.isfinite(x) and self.low <= x <= self.high for x in numbers):
            remedy = f"give {self.allowed()}; is the unit right?"
            raise RejectedError(f"'{{key}}' is {shown(raw)}, out of range", remedy)
        return numbers if self.size else numbers[0]

    def schema(self) -> dict[str, Any]:
        bounds = {"minimum": self.low, "maximum": self.high}
        number: dict[str, Any] = {"type": "number"} | {k: v for k, v in bounds.items() if math.isfinite(v)}
        if self.size:
            number = {"type": "array", "items": number, "minItems": self.size, "maxItems": self.size}
        return number | {"description": self.allowed()}


@dataclass(frozen=True)
class Whole(Quantity):
    """A whole number, as int; `meaning` is what to give, where the range does not say it."""

    meaning: str = ""

    def allowed(self) -> str:
        return self.meaning or f"a whole number in [{self.low:g}, {self.high:g}] {self.unit}".rstrip()

    def parse(self, raw: Any) -> int:
        whole = isinstance(raw, int) and not isinstance(raw, bool)
        if not whole and not (isinstance(raw, float) and raw.is_integer() and not self.meaning):
            raise RejectedError(f"'{{key}}' is {shown(raw)}", f"give {self.allowed()}")
        if not self.low <= raw <= self.high:
            raise RejectedError(f"'{{key}}' is {shown(raw)}, out of range", f"give {self.allowed()}")
        return int(raw)

    def schema(self) -> dict[str, Any]:
        return super().schema() | {"type": "integer"}


@dataclass(frozen=True)
class Sourced(Quantity):
    """A quantity that stands in the file as `{value, source}`, optionally with `valid: [low, high]`."""

    def hint(self) -> str:
        return f"{{value: {self.allowed()}, source: where it comes from}}"

    def parse(self, raw: Any) -> float | tuple[float, ...]:
        if not isinstance(raw, Mapping):
            raise RejectedError(f"'{{key}}' is '{shown(raw)}' without a source", f"write {self.hint()}")
        for name in raw:
            if name not in ("value", "source", "valid"):
                why = " (the unit is the suffix of the key)" if name == "unit" else ""
                what = f"'{{key}}' has the unknown entry '{shown(name)}'{why}"
                raise RejectedError(what, "keep 'value', 'source' and 'valid' only")
        if not isinstance(raw.get("source"), str) or not raw["source"].strip():
            raise RejectedError("'{key}' has no source", "add source: data sheet, measurement or assumed")
        value = super().parse(raw.get("value"))
        if "valid" in raw:
            self._check_valid(value, raw["valid"])
        return value

    def _check_valid(self, value: float | tuple[float, ...], valid: Any) -> None:
        low, high = Quantity(self.unit, self.low, self.high, size=2).parse_part(valid, ".valid")
        if not all(low <= x <= high for x in (value if isinstance(value, tuple) else (value,))):
            what = f"'{{key}}' is {shown(value)}, outside its validity range"
            raise RejectedError(what, f"its source covers [{low:g}, {high:g}] {self.unit}".rstrip())

    def schema(self) -> dict[str, Any]:
        number = super().schema()
        span = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
        return {
            "type": "object",
            "description": number.pop("description"),
            "properties": {"value": number, "source": {"type": "string", "minLength": 1}, "valid": span},
            "required": ["value", "source"],
            "additionalProperties": False,
        }


Position = Annotated[tuple[float, ...], Sourced("m", -20.0, 20.0, size=3)]
"""A point in the body frame (x forward, y left, z up), metres."""


@dataclass(frozen=True)
class Word(Parsed):
    """One of a few words."""

    words: tuple[str, ...]

    def parse(self, raw: Any) -> str:
        if not isinstance(raw, str) or raw not in self.words:
            one_of = "one of " if len(self.words) > 1 else ""
            raise RejectedError(f"'{{key}}' is '{shown(raw)}'", f"give {one_of}{', '.join(self.words)}")
        return raw

    def schema(self) -> dict[str, Any]:
        return {"enum": list(self.words)}


class _Truth(Parsed):
    def parse(self, raw: Any) -> bool:
        if not isinstance(raw, bool):
            raise RejectedError(f"'{{key}}' is '{shown(raw)}'", "give true or false")
        return raw

    def schema(self) -> dict[str, Any]:
        return {"type": "boolean"}


Switch = Annotated[bool, _Truth()]
"""`true` or `false`, and nothing that could stand for them."""


def checked_number(
    value: Any, quantity: Quantity, *, file: Path | str, key: str
) -> float | tuple[float, ...]:
    """`value` as float (or tuple of floats); a ConfigError unless it has the type and range of `quantity`."""
    try:
        return quantity.parse(value)
    except RejectedError as error:
        raise error.at(key, file) from None
