"""What an effect of the catalogue is, its laws, and how to check it on the robot."""

from __future__ import annotations

import difflib
import functools
from pathlib import Path

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.twin.effects.catalogue import catalogue


@functools.cache
def effect_words() -> dict[str, list[str]]:
    """What each built-in effect is and how to check it, a sentence each, by name."""
    words = read_yaml(Path(__file__).with_name("effect_words.yaml"))
    return {name: [str(sentence) for sentence in pair] for name, pair in words.items()}


def explanation(effect: str) -> list[str]:
    """Lines about an effect: what it is, how to check it, its laws with typical sizes.

    Raises:
        ConfigError: no effect has this name.
    """
    forms = [form for form in catalogue().values() if form.effect == effect]
    if not forms:
        names = sorted({form.effect for form in catalogue().values()})
        near = difflib.get_close_matches(effect, names, 1)
        raise ConfigError(
            f"there is no effect '{effect}'",
            remedy=f"did you mean {near[0]}?" if near else f"known are {', '.join(names)}",
        )
    lines = [effect]
    if effect in effect_words():
        what, check = effect_words()[effect]
        lines += [f"  what: {what}", f"  check: {check}"]
    for form in forms:
        lines.append(f"  {form.key}: {form.equation} (source: {form.source})")
        for p in form.parameters:
            unit = f" {p.unit}" if p.unit else ""
            lines.append(
                f"    {form.parameter_key(p)}: typical {p.scale:g}{unit}, {p.low:g} to {p.high:g}{unit}"
            )
    return lines
