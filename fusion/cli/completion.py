"""`terrafusion completion bash|zsh|fish`: the script by which a shell completes commands and options."""

import os
from typing import Annotated

import typer

from terrafusion.fusion.cli.command import Result

SHELLS = ("bash", "zsh", "fish")
VARIABLE = "_TERRAFUSION_COMPLETE"
"""Variable of the environment by which the script asks the program itself."""


def answer_shells() -> None:
    """Teach the parser the protocols of the shells, where one of them asks."""
    if VARIABLE in os.environ:
        from typer.completion import completion_init

        completion_init()


def completion(shell: Annotated[str, typer.Argument(help="bash, zsh or fish.")]) -> Result:
    """Print the script that completes commands and options in a shell.

    Example: terrafusion completion bash >> ~/.bashrc

    Example: terrafusion completion zsh >> ~/.zshrc

    Example: terrafusion completion fish > ~/.config/fish/completions/terrafusion.fish
    """
    from typer.completion import get_completion_script

    if shell not in SHELLS:
        raise typer.BadParameter(f"'{shell}' is none of {', '.join(SHELLS)}", param_hint="SHELL")
    script = get_completion_script(prog_name="terrafusion", complete_var=VARIABLE, shell=shell)
    return Result((), script)
