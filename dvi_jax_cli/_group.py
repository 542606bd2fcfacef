"""The application that commands are added to, and errors in the arguments."""

import re
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ._errors import nearest
from ._names import VERSION
from ._session import BAD_INPUT, INTERRUPTION, WithExamples, shown_examples
from ._show import print_error

_USAGE: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
"""The base class of errors in the arguments; it is not public in typer."""


class Commands(WithExamples, TyperGroup):
    """All commands. Errors in the arguments are shown like every other error."""

    def main(
        self, args: Any = None, *values: Any, standalone_mode: bool = True, **options: Any
    ) -> Any:
        words = list(sys.argv[1:] if args is None else args)
        try:
            code = super().main(args, *values, standalone_mode=False, **options)
        except _USAGE as error:
            if not standalone_mode:
                raise
            code = BAD_INPUT
            if type(error).__name__ != "NoArgsIsHelpError":  # then the help has been shown
                _refuse(error, "--json" in words)
        except typer.Abort:
            code = INTERRUPTION
        if standalone_mode:
            sys.exit(code if isinstance(code, int) else 0)
        return code


def _refuse(error: Any, as_json: bool) -> None:
    """Show an error in the arguments, with our own suggestion in place of that of typer."""
    message = re.split(r"\.? Did you mean|\.? \((?:Possible|Did)", error.format_message())[0]
    message = message.rstrip(".")
    if error.ctx is not None:
        command = error.ctx.command
        names = [o for p in command.params for o in p.opts] + list(getattr(command, "commands", ()))
        if match := re.search(r"No such (?:command|option):? '?([^'\s]+)'?", message):
            message += nearest(match[1], names)
        message += f"\n  {error.ctx.command_path} --help lists the commands and options"
    print_error("bad input", message, as_json)


app = typer.Typer(
    name="dvi-jax",
    cls=Commands,
    help="Differentiable variational integrators for perturbed Hamiltonian systems.\n\n"
    "Exit codes: 0 done, 1 failed, 2 bad input, 130 Ctrl-C. Every command has --help with "
    "examples, --json for programs, -v for details.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    epilog=shown_examples(
        [
            "dvi-jax new spring                  a new project: system, TOML files, notebook",
            "dvi-jax systems                     the library of systems",
            "dvi-jax run run.toml                one trajectory, report, pictures",
            "dvi-jax sweep sweep.toml --resume   many; continues after an interruption",
            "dvi-jax fit fit.toml --json         parameters from observations",
            "dvi-jax report results/run          one HTML page about the results",
            "dvi-jax paper --out paper-out       the paper's figures and numbers",
            "dvi-jax --install-completion        completion in bash, zsh, fish",
        ]
    ),
)

RUNS, INVERSE, RESULTS = "Trajectories", "From data", "Results"
CHECKING, START = "Checks", "Getting started"


def _show_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(f"dvi-jax {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    pass
