"""Habits of a command line: `-h`, one line with the nearest match, a fast `--help`."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest
import typer

from terrafusion.fusion.cli.command import Result, add_command, show
from terrafusion.fusion.cli.main import app


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("reply x", ("no command 'reply'", "did you mean replay?", "terrafusion --help")),
        ("zzz", ("no command 'zzz'", "one of", "inspect")),
        ("policy fitt", ("no command 'fitt'", "did you mean fit?")),
        ("replay x --ot y", ("no option --ot", "did you mean --out?", "terrafusion replay --help")),
        ("inspect x --jsn", ("no option --jsn", "did you mean --json?")),
        ("--versoin", ("no option --versoin", "did you mean --version?")),
        ("replay x --out y --mode magic", ("--mode", "'magic'", "adaptive")),
        ("--quiet inspect x", ("--quiet stands behind the command",)),
        ("gap a --reference r1 r2", ("'r2' behind --reference may be a run or a reference",)),
        ("inspect", ("LOG", "terrafusion inspect --help")),
    ],
)
def test_wrong_usage_is_one_line_with_the_nearest_match(
    words: str, told: tuple[str, ...], terrafusion
) -> None:
    outcome = terrafusion(*words.split())
    assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1), outcome
    assert outcome.err.startswith("error: ")
    for word in told:
        assert word in outcome.err


def test_an_interrupt_while_options_are_built_is_one_line(
    terrafusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("typer.main.get_command", interrupted)
    outcome = terrafusion("replay", "log")
    assert (outcome.status, outcome.out) == (130, "")
    assert outcome.err == "error: interrupted; nothing was written\n"


@pytest.mark.parametrize("words", ["-h", "replay -h", "terrain -h", "policy fit -h", "", "policy"])
def test_help(words: str, terrafusion) -> None:
    outcome = terrafusion(*words.split())
    assert (outcome.status, outcome.err) == (0, "")
    assert "Usage: terrafusion" in outcome.out
    assert "-h" in outcome.out


def test_the_package_runs_as_a_module() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "terrafusion", "replay", "-h"], capture_output=True, text=True, check=True
    )
    assert done.stdout.lstrip().startswith("Usage: terrafusion replay")


def test_paragraphs_of_help_are_broken_by_the_terminal_alone(terrafusion) -> None:
    lines = terrafusion("init", "-h").out.splitlines()
    first = next(i for i, line in enumerate(lines) if "Lists what the log holds" in line)
    paragraph = [
        line.strip() for line in lines[first : lines.index(next(x for x in lines if "Example" in x))]
    ]
    full = [line for line in paragraph if line][:-1]
    assert all(len(line) > 55 for line in full), full


def heavy_packages_of(*words: str) -> str:
    """Those that a command line loads."""
    code = (
        f"import sys; from terrafusion.fusion.cli.main import main; sys.argv = ['terrafusion', *{words}]\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print(*sorted({'numpy', 'gtsam', 'casadi', 'pandas', 'matplotlib', 'joblib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def test_help_loads_no_heavy_package() -> None:
    begun = time.monotonic()
    assert heavy_packages_of("--help") == ""
    assert time.monotonic() - begun < 5.0, "0.2 s on an idle machine"


@pytest.mark.parametrize("command", ["replay", "live"])
def test_a_misspelt_log_is_reported_before_heavy_packages_are_loaded(command: str) -> None:
    assert heavy_packages_of(command, "no.bag") == "numpy"


def described(big: bool = False, place: str | None = None) -> Result:
    """Do it.

    Args:
        big: Do much of it,
            and more.
        place (X,Y): Where: in metres.
    """
    return Result([f"{big} {place}"])


def test_options_are_described_in_the_docstring_of_their_command() -> None:
    """Its section `Args` is not part of the help; long entries go on in lines that stand deeper."""
    small = typer.Typer()
    add_command(small, "do", described)
    command = typer.main.get_command(small)
    options = {one.name: one for one in command.params}
    assert command.help == "Do it."
    assert (options["big"].opts, options["big"].secondary_opts) == (["--big"], [])
    assert options["big"].help == "Do much of it, and more."
    assert (options["place"].metavar, options["place"].help) == ("X,Y", "Where: in metres.")


def test_every_option_has_a_help() -> None:
    commands = list(typer.main.get_command(app).commands.values())
    commands += [inner for one in commands for inner in getattr(one, "commands", {}).values()]
    missing = [f"{c.name} {p.name}" for c in commands for p in c.params if not p.help]
    assert not missing


def test_a_terminal_shows_styles_and_no_controls_of_a_log(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    show(Result([("bold", "drive of a log"), ("", "\x1b[31mred")]), quiet=False, verbose=False, as_json=False)
    assert capsys.readouterr().out == "\x1b[1mdrive\x1b[0m of a log\n\\x1b[31mred\n"
