"""`terrafusion completion bash|zsh|fish`: the script by which a shell completes commands and options."""

import os
from typing import Annotated, Literal

import typer

from terrafusion.fusion.cli.command import Result

VARIABLE = "_TERRAFUSION_COMPLETE"
"""Variable of the environment by which the script asks the program itself."""


def answer_shells() -> None:
    """Teach the parser the protocols of the shells, where one of them asks."""
    if VARIABLE in os.environ:
        from typer.completion import completion_init

        completion_init()


ShellArgument = Annotated[Literal["bash", "zsh", "fish"], typer.Argument(help="Shell to write it for.")]


def completion(shell: ShellArgument) -> Result:
    """Print the script that completes commands and options in a shell.

    Example: terrafusion completion bash >> ~/.bashrc

    Example: terrafusion completion zsh >> ~/.zshrc

    Example: terrafusion completion fish > ~/.config/fish/completions/terrafusion.fish
    """
    from typer.completion import get_completion_script

    script = get_completion_script(prog_name="terrafusion", complete_var=VARIABLE, shell=shell)
    return Result((), script)
