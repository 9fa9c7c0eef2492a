"""Strict loading of parameter files into frozen dataclasses, by pydantic.

A section of a file is a dataclass, a number in it is annotated with unit and range (see `quantity`). All
errors of a file (unknown or missing keys, wrong types, numbers out of range) are reported together, a line
each: file, key, value and what is allowed. `schema` gives the JSON schema of a kind of file, for editors.
"""

import dataclasses
import difflib
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.quantity import Parsed, Quantity, RejectedError, shown

T = TypeVar("T")
MAX_ERRORS = 100
"""Errors of a file that are written out."""
_UNKNOWN = "unexpected_keyword_argument"
"""Pydantic's error about a key that a dataclass does not have."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """Annotation of a field whose raw value `prepare` brings into the form of its type.

    `short` is the JSON schema of the form that it takes, too.
    """

    prepare: Callable[[Any], Any]
    short: Mapping[str, Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_before_validator_function(self.prepare, handler(source))

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return {"anyOf": [handler(core), dict(self.short)]}


@dataclass(frozen=True)
class OneOf:
    """Annotation of a field of several types: `pick` gives the index in `kinds` for a raw value."""

    pick: Callable[[Any], int]
    kinds: tuple[Any, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        choices = {f"<{i}>": handler.generate_schema(kind) for i, kind in enumerate(self.kinds)}
        return core_schema.tagged_union_schema(choices, lambda raw: f"<{int(self.pick(raw))}>")


def structure(kind: type[T], raw: Any, *, file: Path | str, key: str = "", complete: bool = False) -> T:
    """The dataclass `kind` from the content `raw` of a file, strictly.

    Nested types are sections. `key` is the path of `raw` inside the file; with `complete`,
    keys with a default must be there, too.

    Raises:
        ConfigError: unknown or missing keys, missing sources, wrong types, numbers out of range; all of them.
    """
    from pydantic import ValidationError

    errors: list[Any] = list(_gaps(kind, raw, complete))
    try:
        found = _adapter(cast(Any, kind)).validate_python(raw)
    except ValidationError as error:
        errors += error.errors(include_url=False)
    if errors:
        raise ConfigError.joined(_errors(errors, kind, file, key)[:MAX_ERRORS])
    return cast(T, found)


def refuse(problems: Iterable[tuple[str, str]], file: Path | str) -> None:
    """Refuse a file (ConfigError) for what is wrong beyond its single values, as (what, remedy)."""
    errors = [ConfigError(what, file=file, remedy=remedy) for what, remedy in problems]
    if errors:
        raise ConfigError.joined(errors)


def quantities(kind: type, prefix: str = "") -> dict[str, Quantity]:
    """Dotted names of the plain numbers in a dataclass, with unit and range."""
    found: dict[str, Quantity] = {}
    for name, hint in _hints(kind).items():
        mark = _marker(hint)
        if dataclasses.is_dataclass(hint):
            found |= quantities(cast(type, hint), f"{prefix}{name}.")
        elif isinstance(mark, Quantity) and not mark.size and get_origin(hint) is Annotated:
            found[f"{prefix}{name}"] = mark
    return found


def schema(kind: Any, title: str) -> dict[str, Any]:
    """JSON schema (2020-12) of the files that `structure` loads as `kind`."""
    from pydantic.json_schema import GenerateJsonSchema

    class Generator(GenerateJsonSchema):
        """Without titles that repeat keys, nulls (a key has a value) and defaults of sections."""

        def field_title_should_be_set(self, schema: Any) -> bool:
            return False

        def nullable_schema(self, schema: Any) -> Any:
            return self.generate_inner(schema["schema"])

        def default_schema(self, schema: Any) -> Any:
            inner = self.generate_inner(schema["schema"])
            plain = inner.get("type") in ("number", "string", "integer", "boolean") or "enum" in inner
            given = schema.get("default")
            return inner | {"default": given} if plain and given is not None else inner

    content: dict[str, Any] = _adapter(kind).json_schema(schema_generator=Generator)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | content | {"title": title}


@functools.cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter, with_config

    section = get_args(kind)[1] if get_origin(kind) is dict else kind
    with_config({"extra": "forbid"})(section)  # holds for the dataclasses inside, too
    return TypeAdapter(kind)


def _gaps(hint: Any, raw: Any, complete: bool, place: tuple[Any, ...] = ()) -> Iterator[dict[str, Any]]:
    """Errors, as pydantic has them, of keys without a value and, with `complete`, of absent ones."""
    for name, kind in _hints(_bare(hint)).items() if isinstance(raw, dict) else ():
        if name not in raw:
            if complete:
                yield {"type": "missing", "loc": (*place, name)}
        elif raw[name] is None and get_origin(kind) in (Union, UnionType):
            yield {"type": "empty", "loc": (*place, name)}
        else:
            yield from _gaps(kind, raw[name], complete, (*place, name))


def _errors(found: Sequence[Any], kind: Any, file: Path | str, key: str) -> list[ConfigError]:
    """One error for each of pydantic's; a missing key that was only misspelt is left out."""
    errors, done = [], set()
    for error in sorted(found, key=lambda e: e["type"] != _UNKNOWN):
        place = tuple(error["loc"])
        if place in done:
            continue
        done.add(place)
        if error["type"] == _UNKNOWN:
            *parent, name = place
            rejected, meant = _unknown_key(str(name), _hints(_bare(_at(kind, parent))))
            done.add((*parent, meant))
            errors.append(rejected.at(_dotted(place, key), file))
        else:
            errors.append(_one_error(error, kind, file, _dotted(place, key)))
    return errors


def _one_error(error: Any, kind: Any, file: Path | str, key: str) -> ConfigError:
    cause = error.get("ctx", {}).get("error")
    if isinstance(cause, RejectedError):
        return cause.at(key, file)
    if cause is not None:  # of a dataclass's own check
        return ConfigError(str(cause), file=file, channel=key or None)
    hint = _at(kind, error["loc"])
    if error["type"] == "empty":
        return ConfigError(f"'{key}' has no value", file=file, remedy="give one, or leave the key out")
    names = ", ".join(_hints(_bare(hint)))
    if error["type"] == "missing":
        example = f"keys from {names}" if names else getattr(_marker(hint), "hint", str)()
        return ConfigError(
            f"'{key}' is missing", file=file, remedy=f"add it: {example}" if example else "add it"
        )
    value = shown(error["input"])
    if error["type"] in ("dataclass_type", "dict_type"):
        remedy = f"give keys from {names}" if names else "give a mapping"
        return ConfigError(f"'{key}' is '{value}', not a section", file=file, remedy=remedy)
    remedies = {"string_type": "give a text, in quotes", "tuple_type": "give a list"}
    remedy = remedies.get(error["type"], error["msg"].lower())
    return ConfigError(f"'{key}' is '{value}'", file=file, remedy=remedy)


def _unknown_key(name: str, known: Mapping[str, Any]) -> tuple[RejectedError, str]:
    """The error about a key, and the one that may be meant ("" for none)."""
    stem = name.rsplit("_", 1)[0]
    with_unit = [k for k, hint in known.items() if getattr(_marker(hint), "unit", "")]
    same = [k for k in with_unit if k.rsplit("_", 1)[0] in (stem, name)]
    close = same or difflib.get_close_matches(name, known, n=1)
    remedy = f"known here: {', '.join(known)}"
    if same:
        remedy = f"write '{same[0]}' (the unit is part of the name)"
    elif close:
        remedy = f"did you mean '{close[0]}'? {remedy}"
    return RejectedError("unknown key '{key}'", remedy), close[0] if close else ""


def _dotted(place: Iterable[Any], key: str) -> str:
    """Place of a value as users write it: `route[0].length_m`."""
    for part in place:
        if isinstance(part, int):
            key += f"[{part}]"
        elif not str(part).startswith("<"):  # a choice of `OneOf`
            key += f".{shown(part)}" if key else shown(part)
    return key


def _at(hint: Any, place: Iterable[Any]) -> Any:
    """The type of the value at a place of a file, None where it has none."""
    for part in place:
        marker = _marker(hint)
        if isinstance(marker, OneOf):
            hint = marker.kinds[int(str(part).strip("<>"))]
            continue
        kind = _bare(hint)
        if get_origin(kind) is dict:
            hint = get_args(kind)[1]
        elif get_origin(kind) is tuple:
            hint = get_args(kind)[0 if get_args(kind)[-1] is ... else part]
        else:
            hint = _hints(kind).get(part)
    return hint


def _bare(hint: Any) -> Any:
    """`X` of `X | None`, `Annotated[X, ...]` or `Required[X]`."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return _bare(next(kind for kind in get_args(hint) if kind is not type(None)))
    if origin is not None and origin not in (dict, tuple):
        return _bare(get_args(hint)[0])
    return hint


def _marker(hint: Any) -> Any:
    """What a type is annotated with here, None where it is not."""
    while get_origin(hint) is not None and get_origin(hint) not in (dict, tuple):
        marks = [m for m in getattr(hint, "__metadata__", ()) if isinstance(m, (Parsed, OneOf))]
        if marks:
            return marks[0]
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    return None


def _hints(kind: Any) -> dict[str, Any]:
    """Keys of a section and their types; none for a type that is no section."""
    if dataclasses.is_dataclass(kind):
        return get_type_hints(kind, include_extras=True)
    return {}
