"""The application that commands are added to, and what it says to words that it does not know."""

import difflib
import re
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ._help import WithExamples, shown_examples
from ._session import BAD_INPUT, INTERRUPTED, version
from ._show import complain, print_json

_USAGE: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
"""The base of errors in the words of a command line: typer has it under no public name."""


class Commands(WithExamples, TyperGroup):
    """All commands. Wrong words are told in the manner of every other error."""

    def main(self, args: Any = None, *rest: Any, standalone_mode: bool = True, **more: Any) -> Any:
        words = list(sys.argv[1:] if args is None else args)
        try:
            code = super().main(args, *rest, standalone_mode=False, **more)
        except _USAGE as error:
            if not standalone_mode:
                raise
            code = BAD_INPUT
            if type(error).__name__ != "NoArgsIsHelpError":  # then the help has been shown
                _refuse(error, "--json" in words)
        except typer.Abort:
            code = INTERRUPTED
        if standalone_mode:
            sys.exit(code if isinstance(code, int) else 0)
        return code


def _refuse(error: Any, as_json: bool) -> None:
    context = error.ctx
    message = re.split(r"\.? Did you mean|\.? \((?:Possible|Did)", error.format_message())[0]
    nearest = _nearest(message, context)
    message = message.rstrip(".") + (f" (did you mean {nearest}?)" if nearest else "")
    if context is not None:
        message += f"\n  {context.command_path} --help says what there is"
    if as_json:
        print_json({"error": {"kind": "bad input", "message": message}})
    else:
        complain("bad input", message)


def _nearest(message: str, context: Any) -> str:
    """The command or option that a mistyped one may have been."""
    seen = re.search(r"No such (?:command|option):? '?([^'\s]+)'?", message)
    if seen is None or context is None:
        return ""
    names = [option for p in context.command.params for option in p.opts]
    names += list(getattr(context.command, "commands", ()))
    return next(iter(difflib.get_close_matches(seen[1].rstrip("."), names, n=1)), "")


app = typer.Typer(
    name="dvi-jax",
    cls=Commands,
    help="Differentiable variational integrators for disturbed Hamiltonian systems.\n\n"
    "Exit codes: 0 done, 1 failed, 2 bad input, 130 Ctrl-C. Every command has --help with "
    "examples, --json for programs, -v to say what it does.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    epilog=shown_examples(
        [
            "dvi-jax new spring                  begin: a system, TOML files, a notebook",
            "dvi-jax systems                     the library of systems",
            "dvi-jax run run.toml                one trajectory, report, pictures",
            "dvi-jax sweep sweep.toml --resume   many; goes on after whatever ended it",
            "dvi-jax fit fit.toml --json         parameters from observations",
            "dvi-jax paper --out paper-out       the paper's figures and numbers",
            "dvi-jax --install-completion        completion in bash, zsh, fish",
        ]
    ),
)

RUNS, INVERSE, TRUST, START = "Trajectories", "From data", "Trust", "Begin"


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dvi-jax {version()}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    pass
