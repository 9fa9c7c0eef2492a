"""All forms of all effects by name; forms of the user's own join by `register`."""

import difflib
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.effects.form import STAGES, Form, Parameter

_OWN: dict[str, Form] = {}
MOST_GROWTH = 40.0
"""Load of a wheel times its radius of the largest robot, over that of the nominal one."""


@functools.cache
def built_in() -> dict[str, Form]:
    """The forms that come with the library, by key `effect/form`."""
    from terrafusion.twin.effects import chassis, environment, sensing, terrain, vehicle

    forms = (*terrain.FORMS, *vehicle.FORMS, *sensing.FORMS, *environment.FORMS, *chassis.FORMS)
    return {form.key: form for form in forms}


def catalogue() -> dict[str, Form]:
    """All known forms by key, the user's own last."""
    return {**built_in(), **_OWN}


@functools.cache
def of_drives() -> dict[str, Form]:
    """Terms by key that a vehicle's drive brings; they are no effects."""
    from terrafusion.twin.effects.steered import STEERED

    return {STEERED.key: STEERED}


def register(form: Form) -> Form:
    """Adds a form of the user's own; it takes part in everything that goes by names. Returns the form.

    A process that is to know the form must register it (do so where a module is imported).

    Raises:
        ConfigError: another form has this key, or two parameters have one name.
    """
    known = catalogue().get(form.key)
    if known is not None and known is not form:
        raise ConfigError("a form of this name exists already", channel=form.key, remedy="name it otherwise")
    if len({p.name for p in form.parameters}) != len(form.parameters):
        raise ConfigError("two parameters have one name", channel=form.key, remedy="name each of several")
    _OWN[form.key] = form
    return form


def effect_names() -> tuple[str, ...]:
    """Names of all effects, in the order of the catalogue."""
    return tuple(dict.fromkeys(form.effect for form in catalogue().values()))


def parameters() -> dict[str, tuple[Form, Parameter]]:
    """Every parameter by its key."""
    return {form.parameter_key(p): (form, p) for form in catalogue().values() for p in form.parameters}


def lookup(key: str) -> tuple[Form, Parameter]:
    """Form and parameter of a key.

    Raises:
        ConfigError: there is none; the nearest ones are named.
    """
    known = parameters()
    if key in known:
        return known[key]
    stem = key.split("/")[0]
    near = [name for name in known if name.split("/")[0] == stem]
    near = near or difflib.get_close_matches(key, list(known), n=3, cutoff=0.4)
    raise _unknown(key, near or [name for name in known if stem and stem in name][:3])


def forms_of(effect: str) -> list[Form]:
    """The forms of an effect.

    Raises:
        ConfigError: there is none; the nearest names are listed.
    """
    forms = [form for form in catalogue().values() if form.effect == effect]
    if not forms:
        raise _unknown(effect, difflib.get_close_matches(effect, effect_names(), n=3, cutoff=0.5))
    return forms


def _unknown(name: str, near: Sequence[str]) -> ConfigError:
    remedy = (
        f"did you mean {' or '.join(near)}"
        if near
        else "`terrafusion simulate spin --effect help` lists them"
    )
    return ConfigError(f"unknown effect '{name}'", remedy=remedy)


def parameter_key(name: str) -> str:
    """The key that a name stands for: a bare effect, such as "slope", means its first form."""
    forms = [form for form in catalogue().values() if form.effect == name]
    if forms and len(forms[0].parameters) == 1:
        return forms[0].parameter_key(forms[0].parameters[0])
    return name


def by_key(values: Mapping[str, float]) -> dict[str, float]:
    """The values by key; a bare effect means its first form.

    Raises:
        ConfigError: they are no mapping, or two names mean the same parameter.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"effects are {values!r}", remedy='give {"slope": 0.05}, or several so')
    out = dict[str, float]()
    for name, value in values.items():
        key = parameter_key(name)
        if key in out:
            raise ConfigError(f"effect '{key}' is given twice, once as '{name}'", remedy="give it once")
        out[key] = value
    return out


def checked(values: Mapping[str, float]) -> dict[str, float]:
    """The values as floats, sorted by key, those of zero left out; a bare effect means its first form.

    Raises:
        ConfigError: an unknown key, or a value that is no number or out of its range.
    """
    out: dict[str, float] = {}
    for key, value in sorted(by_key(values).items()):
        _, parameter = lookup(key)
        most = MOST_GROWTH if parameter.grows else 1.0
        low, high = most * parameter.low, most * parameter.high
        if not (isinstance(value, Real) and math.isfinite(value) and low <= value <= high):
            raise ConfigError(
                f"effect '{key}' is {value}, out of range",
                remedy=f"give {low:g} to {high:g} {parameter.unit}".rstrip(),
            )
        if value != 0.0:
            out[key] = float(value)
    return out


def moves(key: str) -> bool:
    """Whether a parameter changes how the robot moves (and not only what is measured)."""
    return not lookup(key)[0].senses_only()


class Terms:
    """The terms of some parameters, as a graph is built: `symbols` are their expressions."""

    def __init__(self, keys: Iterable[str], symbols: Any) -> None:
        given = {key: symbols[i] for i, key in enumerate(keys)}
        forms = {form.key: form for form in (of_drives().get(key) or lookup(key)[0] for key in given)}
        self._active = [
            (form, tuple(given.get(form.parameter_key(p), 0.0) for p in form.parameters))
            for form in (
                {**of_drives(), **catalogue()}[key] for key in (*of_drives(), *catalogue()) if key in forms
            )
        ]

    def at(self, stage: str) -> bool:
        """Whether anything acts at a stage."""
        return any(stage in form.terms for form, _ in self._active)

    def apply(self, stage: str, quantities: Mapping[str, Any]) -> dict[str, Any]:
        """The quantities after the terms of a stage, one after the other in the order of the catalogue."""
        out = dict(quantities)
        for form, values in self._active:
            if stage in form.terms:
                changes = form.terms[stage](out, *values)
                foreign = set(changes) - set(STAGES[stage])
                if foreign:
                    raise ConfigError(
                        f"sets {', '.join(sorted(foreign))} in the stage '{stage}'", channel=form.key,
                        remedy=f"it may set {', '.join(STAGES[stage])}",
                    )  # fmt: skip
                out.update(changes)
        return out
