"""What all commands share: options, the place of results, what is printed, and how they end."""

import contextlib
import functools
import inspect
import io
import json
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.common import PROGRESS, HowRead, Line, styled
from terrafusion.fusion.cli.outputs import Output, check_file, parts_of

INTERRUPTED = 130


@dataclass(frozen=True)
class Result:
    """What a command reports.

    Attributes:
        lines: printed in full, unless `--quiet`.
        done: the last line.
        document: what `--json` prints.
        status: exit status.
        details: printed with `--verbose`.
        short: printed with `--quiet` and `--json`; by default `done`.
        vehicle: `VehicleParams` of the run, for `config.json`.
    """

    lines: Sequence[str | Line] = ()
    done: str = ""
    document: Any = None
    status: int = 0
    details: Sequence[str] = ()
    short: str = ""
    vehicle: Any = None


_shared = functools.partial(typer.Option, rich_help_panel="Options of all commands")
FLAGS = {
    "quiet": _shared("--quiet", "-q", help="Print one line and errors."),
    "verbose": _shared("--verbose", help="Print details, all options, and where an error arose."),
    "as_json": _shared("--json", help="Print one JSON document, all else to stderr."),
    "force": _shared("--force", help="Replace what this command did not write."),
}
"""The options that commands share."""


def add_command(
    app: typer.Typer,
    name: str,
    body: Callable[..., Result],
    *,
    output: Output | None = None,
    instead: tuple[str, Output] | None = None,
    files: Mapping[str, str | None] | None = None,
    as_json: bool = True,
) -> None:
    """Make a function a command that has the shared options.

    Args:
        body: takes the command's own options and, where it writes, `out: Path`; returns what to print.
            The section `Args` of its docstring describes options, as `name: help` or `name (METAVAR): help`.
            A parameter of the type `HowRead` stands for the options of that class; the first one then is
            the log or the logs.
        output: what it writes at `out`; gives a plain `out: Path` the option `--out`.
        instead: what it writes with an option that is called so.
        files: options that are further files to write, each with a word of the files it may replace.
        as_json: whether it has `--json`.
    """
    shared = ["quiet", "verbose"]
    shared += ["as_json"] if as_json else []
    shared += ["force"] if output is not None or files else []
    signature, own, about = _own_options(body, output)
    how_read = next((one.name for one in signature.parameters.values() if one.annotation is HowRead), None)

    @functools.wraps(body)
    def command(context: typer.Context, **given: Any) -> None:
        quiet, verbose, in_json, force = (given.pop(word, False) for word in FLAGS)
        PROGRESS.bar, PROGRESS.lines = not quiet, verbose
        called = context.command_path.partition(" ")[2]
        kind = instead[1] if instead is not None and given[instead[0]] else output
        if kind is not None:
            given["out"] = kind.place(given["out"], called, subject_of(given[next(iter(own))]), force)
        for option, mark in (files or {}).items():
            if given[option] is not None:
                check_file(given[option], force, mark)
        if verbose:
            print("\n".join(f"{key} = {value}" for key, value in given.items()), file=sys.stderr)
        with _ending_reported(given.get("out"), kind, verbose), _redirected(quiet, in_json):
            if how_read is not None:
                common.check_existence(given[next(iter(own))])
            result = body(**_gathered(given, how_read))
            if kind is not None and "config.json" in kind.names:
                from terrafusion.fusion.cli.used_config import write_config

                write_config(given["out"], called, given, result.vehicle)
        show(result, quiet, verbose, in_json)
        if result.status:
            raise typer.Exit(result.status)

    command.__doc__ = about
    asked = [
        inspect.Parameter(
            word, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, FLAGS[word]]
        )
        for word in shared
    ]
    context = inspect.Parameter("context", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)
    everything = [context, *own.values(), *asked]
    command.__signature__ = signature.replace(parameters=everything)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in everything}
    app.command(name)(command)


def _own_options(
    body: Callable[..., Result], output: Output | None
) -> tuple[inspect.Signature, dict[str, inspect.Parameter], str]:
    """Signature of a command's body, its options by name, described by its docstring, and its help."""
    signature = inspect.signature(body, eval_str=True)
    about, described = _described(body.__doc__ or "")
    own = {one.name: one for one in _spread_out(signature.parameters.values())}
    own |= {
        name: own[name].replace(annotation=Annotated[own[name].annotation, option])
        for name, option in described.items()
    }
    if output is not None and own["out"].annotation is Path:
        option = Annotated[Path | None, typer.Option("--out", help=f"{output.help} Default: a dated name.")]
        own["out"] = own["out"].replace(annotation=option, default=None)
    return signature, own, about


def _described(docstring: str) -> tuple[str, dict[str, Any]]:
    """A command's help without the section `Args` of its docstring, and the options that this describes."""
    about, _, section = inspect.cleandoc(docstring).partition("\n\nArgs:\n")
    about = re.sub(r"(\S)\n(?=\S)", r"\1 ", about)  # the width of the terminal breaks its lines
    entries = re.findall(r"^    (\w+)(?: \((.+?)\))?: (.+(?:\n {8}.+)*)", section, re.MULTILINE)
    return about, {
        name: typer.Option(
            f"--{name.replace('_', '-')}", metavar=metavar or None, help=" ".join(text.split())
        )
        for name, metavar, text in entries
    }


def _spread_out(parameters: Iterable[inspect.Parameter]) -> Iterator[inspect.Parameter]:
    """The parameters by keyword; in place of one of the type `HowRead` its options."""
    kinds = get_type_hints(HowRead, vars(common), include_extras=True)
    for one in parameters:
        if one.annotation is not HowRead:
            yield one.replace(kind=one.KEYWORD_ONLY)
            continue
        for option in fields(HowRead):
            kind = kinds[option.name]
            yield inspect.Parameter(option.name, one.KEYWORD_ONLY, default=option.default, annotation=kind)


def _gathered(given: Mapping[str, Any], how_read: str | None) -> dict[str, Any]:
    """The arguments of a command's body, with the options of `HowRead` in its parameter of that name."""
    if how_read is None:
        return dict(given)
    options = {option.name: given[option.name] for option in fields(HowRead)}
    return {name: value for name, value in given.items() if name not in options} | {
        how_read: HowRead(**options)
    }


@contextlib.contextmanager
def _ending_reported(out: Path | None, kind: Output | None, verbose: bool) -> Iterator[None]:
    """Say what an interrupted command leaves, and with `--verbose` where a known error arose."""
    try:
        yield
    except BaseException as error:
        if is_interrupt(error):
            print(f"error: {interrupted(out, kind)}", file=sys.stderr)
            sys.exit(INTERRUPTED)
        if verbose and isinstance(error, TerrafusionError):
            traceback.print_exc()
        raise


@contextlib.contextmanager
def _redirected(quiet: bool, as_json: bool) -> Iterator[None]:
    """Send what is printed during the work to nowhere, or to standard error, as the options ask."""
    if not (quiet or as_json):
        yield
        return
    with contextlib.redirect_stdout(io.StringIO() if quiet else sys.stderr):
        yield


def show(result: Result, quiet: bool, verbose: bool, as_json: bool) -> None:
    """Print a result; with `as_json` its document alone is on standard output."""
    details = result.details if verbose else ()
    short = [result.short or result.done]  # with `--json`, the rest is in the document
    lines: list[str | Line] = [*short] if quiet or as_json else [*result.lines, *details, result.done]
    for line in lines if lines[-1] else lines[:-1]:
        print(styled(line), file=sys.stderr if as_json else sys.stdout)
    if as_json:
        print(json.dumps(result.document, indent=2, allow_nan=False))


def subject_of(first: object) -> str:
    """The log, or other thing, that the command is about: its first argument, if that is a text."""
    first = first[0] if isinstance(first, list) and first else first
    return first if isinstance(first, str) else ""


def is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is the cause: a library that is being loaded turns it into an error of its own."""
    while error is not None and not isinstance(error, (KeyboardInterrupt, typer.Abort)):
        error = error.__cause__ or error.__context__
    return error is not None


def interrupted(out: Path | None, output: Output | None) -> str:
    """What is kept of an interrupted command, and where."""
    places = (
        [] if output is None or out is None else [place for place in (out, parts_of(out)) if place.exists()]
    )
    if output is None or not places:
        return "interrupted; nothing was written"
    more = "; the same command with this --out continues" if output.goes_on else ""
    return f"interrupted; what was finished is kept in {places[-1]}{more}"
