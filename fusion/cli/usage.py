"""Wrong usage of the command line, as one line with the nearest match."""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import typer
from typer.core import TyperGroup

UsageError: Any = typer.BadParameter.__base__
"""What typer raises for wrong usage; which module it comes from depends on typer's version."""

SHARED = ("--quiet", "-q", "--verbose", "--json", "--force")
"""Options that commands share."""


class CommandGroup(TyperGroup):
    """A group of commands that shows its help without words, and the nearest name for an unknown one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Words before the command; without any, `--help`."""
        return super().parse_args(ctx, args or ["--help"])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command of the first word; wrong usage where there is none of that name."""
        name = args[0]
        if not name.startswith("-") and self.get_command(ctx, name) is None:
            names = self.list_commands(ctx)
            meant = nearest(name, names) or f": one of {', '.join(names)}"
            ctx.fail(f"there is no command '{name}'{meant}")
        if (stray := behind_reference(args)) is not None:
            ctx.fail(
                f"'{stray}' behind --reference may be a run or a reference: write --reference before each "
                "reference, and the runs first"
            )
        return super().resolve_command(ctx, args)


def behind_reference(args: Sequence[str]) -> str | None:
    """A word behind the value of `--reference` after runs, as by `--reference may/*`; None where none is."""
    if len(args) < 2 or args[0] != "gap" or args[1].startswith("-"):
        return None
    behind = (args[i + 2] for i, word in enumerate(args[:-2]) if word == "--reference")
    return next((word for word in behind if not word.startswith("-")), None)


def nearest(word: str, known: Iterable[str]) -> str:
    """`; did you mean ...?` with the known word most like `word`; empty where none is like it."""
    found = difflib.get_close_matches(word, list(known), 1, 0.5)
    return f"; did you mean {found[0]}?" if found else ""


def refuse_options(given: Mapping[str, bool], why: str) -> None:
    """Options that were given but would have no effect are wrong usage (exit status 2)."""
    for option, is_given in given.items():
        if is_given:
            raise typer.BadParameter(why, param_hint=option)


def usage_line(error: Any) -> str:
    """The error of wrong usage in one line."""
    context = error.ctx
    if context is None:
        return str(error.format_message())
    text = error.format_message().replace("Value error, ", "").rstrip(".")
    if type(error).__name__ == "NoSuchOption":
        parameters = context.command.get_params(context)
        known = [name for one in parameters for name in (*one.opts, *one.secondary_opts) if name[0] == "-"]
        name = error.option_name
        text = f"there is no option {name}{nearest(name, known)}"
        if name in SHARED and context.parent is None:
            text = f"{name} stands behind the command"
    return f"{' '.join(text.split())} (see `{context.command_path} --help`)"
