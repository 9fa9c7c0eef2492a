"""Optional effects on the command line: `--effect NAME=VALUE`, and their list."""

from __future__ import annotations

import typer


def effect_values(words: list[str]) -> dict[str, float]:
    """Values by name of `NAME=VALUE` words; names and ranges are checked by the twin."""
    values: dict[str, float] = {}
    for word in words:
        name, equals, number = word.partition("=")
        try:
            value = float(number)
        except ValueError:
            equals = ""
        if not equals:
            raise typer.BadParameter(f"'{word}' is not NAME=VALUE", param_hint="--effect")
        if name in values:
            raise typer.BadParameter(f"'{name}' is given twice", param_hint="--effect")
        values[name] = value
    return values


def listed(words: list[str] | None) -> list[str] | None:
    """Prints all effects and leaves where 'help' is among the words."""
    if words and "help" in words:
        for line in effect_lines():
            print(line)
        raise typer.Exit
    return words


def effect_lines() -> list[str]:
    """A line a parameter: name, typical size, range, unit, equation."""
    from terrafusion.twin.effects.catalogue import parameters

    rows = [
        (key, f"{p.scale:g}", f"{p.low:g} to {p.high:g} {p.unit}".rstrip(), form.equation)
        for key, (form, p) in parameters().items()
    ]
    head = ("effect", "typical", "range", "equation (e is the value)")
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(3)]
    return ["  ".join([*(row[i].ljust(widths[i]) for i in range(3)), row[3]]) for row in [head, *rows]]
