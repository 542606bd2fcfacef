"""Common parts of all commands: help pages, --json, --verbose, --debug, errors, exit codes."""

import functools
import inspect
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer.core import TyperCommand

from ._errors import InputError, in_toml, user_path
from ._names import VERSION
from ._show import console, print_error, print_json, print_tables

FAILURE = 1
BAD_INPUT = 2
INTERRUPTION = 130
RESUME_HINT = "On the command line: the same with --resume continues from what is done."
CODES = {"bad input": BAD_INPUT, "failed": FAILURE, "interrupted": INTERRUPTION, "fault": FAILURE}
"""Kind of an error → exit code."""


def _flag(*names: str, help: str) -> Any:
    return Annotated[bool, typer.Option(*names, help=help, rich_help_panel="Output")]


_COMMON = {
    "as_json": _flag("--json", help="One JSON object on stdout, nothing else there."),
    "verbose": _flag("--verbose", "-v", help="Report on stderr what is done, with what."),
    "debug": _flag("--debug", help="Show the whole traceback of an error."),
}


class Session:
    """One call of a command: its output, its notes and how it ends.

    - `unwritten`: text before an `OSError`; `interruption`: text for a Ctrl-C without one;
      `hint`: a line after both, for work that can be continued.
    """

    unwritten = "the results cannot be written"
    interruption = "by Ctrl-C or SIGTERM; nothing has been written"
    hint = ""

    def __init__(self, as_json: bool, verbose: bool, debug: bool):
        self.as_json, self.verbose, self.debug = as_json, verbose, debug
        self._began = time.perf_counter()
        self._compile_seconds: list[float] = []
        self._warnings: set[str] = set()

    def start_jax(self) -> None:
        """Set double precision and pictures without a window; with --verbose, show what JAX has."""
        import jax
        import matplotlib as mpl

        jax.config.update("jax_enable_x64", True)
        mpl.use("Agg")  # pictures go to files: no window, no display needed
        if not self.verbose:
            return
        jax.monitoring.register_event_duration_secs_listener(self._record_compilation)
        devices = jax.local_devices()
        self.note(
            f"dvi-jax {VERSION}, jax {jax.__version__}, Python {sys.version.split()[0]}; "
            f"{len(devices)} × {devices[0].device_kind} ({devices[0].platform}); double precision"
        )

    def _record_compilation(self, event: str, duration_secs: float, **kwargs: Any) -> None:
        if event.endswith("backend_compile_duration"):
            self._compile_seconds.append(duration_secs)

    def note(self, text: str) -> None:
        """A line on stderr, with --verbose."""
        if self.verbose:
            console(stderr=True).print(text, markup=False, soft_wrap=True, style="dim")

    def warn(self, message: Any, *_: Any) -> None:
        """A warning on stderr, once, without the line of Python that gave it."""
        text = f"warning: {in_toml(message)}"
        # An overflow in NumPy is in the results, with a status.
        if text not in self._warnings and " encountered in " not in text:
            self._warnings.add(text)
            console(stderr=True).print(text, markup=False, soft_wrap=True, style="yellow")

    def line(self, text: str, style: str | None = None) -> None:
        """A line for the reader, without --json."""
        if not self.as_json:
            console().print(text, markup=False, soft_wrap=True, style=style)

    def tables(self, tables: Iterable[Any], words: bool = False) -> None:
        """Tables for the reader, without --json."""
        if not self.as_json:
            print_tables(tables, words)

    def finish(self, contents: Mapping[str, Any], failure: str = "") -> None:
        """End a command: with --json its object, with `failure` an error."""
        if place := contents.get("folder") or contents.get("store"):
            self.note(f"written to {place}")
        failure = in_toml(failure)
        seconds, count = time.perf_counter() - self._began, len(self._compile_seconds)
        compilation = f"; XLA compiled {count} programs in {sum(self._compile_seconds):.1f} s"
        self.note(f"{seconds:.1f} s in all{compilation if count else ''}")
        if self.as_json:
            error = {"error": {"kind": "failed", "message": failure}} if failure else {}
            print_json({**contents, **error})
        elif failure:
            print_error("failed", failure)
        if failure:
            raise typer.Exit(FAILURE)

    def finish_report(self, report: Any) -> None:
        """End a command with the report of its work."""
        self.tables(report.tables)
        for note in report.notes:
            self.line(note, style="bold")
        contents, summary = report.contents, report.summary
        if report.files:
            contents = {"folder": str(report.folder), "files": report.files, **contents}
            summary += f"; written to {report.folder}: {', '.join(report.files)}"
        self.line(summary)
        self.finish(contents, report.message)

    def kind_and_message(self, error: BaseException) -> tuple[str, str]:
        """The kind of an exception, one of `CODES`, and the message for the reader."""
        # Those of dvi_jax are found by name, because a command without JAX must not import it.
        names = {kind.__name__ for kind in type(error).__mro__}
        if isinstance(error, KeyboardInterrupt):
            text = str(error).removeprefix("interrupted: ") or self.interruption
            return "interrupted", "\n".join(filter(None, (text, self.hint)))
        if isinstance(error, InputError) or "StoreMismatch" in names:
            return "bad input", str(error)
        if isinstance(error, OSError) or "StoreError" in names:
            return "failed", "\n".join(filter(None, (f"{self.unwritten}: {error}", self.hint)))
        if isinstance(error, MemoryError):
            return "failed", f"the machine does not have the memory for this: {error}"
        lines = str(error).strip().splitlines() or ["(without a message)"]
        if len(lines) > 12:
            lines[12:] = [f"… ({len(lines) - 12} more lines)"]
        remedy = "Please report it, with the traceback above."
        if not self.debug:
            remedy = "The same command with --debug shows where it comes from; please report that."
        cause = "\n".join([f"{type(error).__name__}: {lines[0]}", *lines[1:], remedy])
        return "fault", f"this is a fault of dvi_jax, not of your input.\n{cause}"


def command(
    group: typer.Typer, name: str, panel: str | None = None, jax: bool = True
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A command of a group: a function of a `Session` and of its own arguments and options.

    It gets --json, --verbose and --debug. Its docstring is the help; the lines below "Examples" are
    shown as they are. An exception is shown in one block and becomes an exit code; with --debug it
    is raised. `jax`: whether it needs JAX, which is then set up before it begins.
    """

    def register(function: Callable[..., None]) -> Callable[..., None]:
        kind = inspect.Parameter.KEYWORD_ONLY
        options = list(inspect.signature(function).parameters.values())[1:]
        # Shells leave ~ alone in --out=~/x.
        hints = {p.name: get_args(p.annotation) for p in options}
        paths = {n: h[1].metavar or f"--{n}" for n, h in hints.items() if h and _is_path(h[0])}
        common = [
            inspect.Parameter(n, kind, default=False, annotation=a) for n, a in _COMMON.items()
        ]

        @functools.wraps(function)
        def call(as_json: bool, verbose: bool, debug: bool, **values: Any) -> None:
            session = Session(as_json, verbose, debug)
            showwarning = warnings.showwarning
            try:
                if not debug:
                    warnings.showwarning = session.warn
                if jax:
                    session.start_jax()
                for name in paths.keys() & values.keys():
                    if values[name] is not None:
                        values[name] = user_path(paths[name], values[name])
                function(session, **values)
                sys.stdout.flush()  # so that a closed pipe raises here
            except (typer.Exit, typer.Abort):
                raise
            except BrokenPipeError:
                quiet()
                raise typer.Exit(FAILURE) from None
            except (Exception, KeyboardInterrupt) as error:
                kind, message = session.kind_and_message(error)
                is_raised = debug and kind != "interrupted"  # the entry point shows it in full
                if as_json or not is_raised:
                    print_error(kind, message, as_json)
                if is_raised:
                    raise
                raise typer.Exit(CODES[kind]) from None
            finally:
                warnings.showwarning = showwarning

        del call.__dict__["__wrapped__"]  # its signature is not this one's
        parameters = [*(p.replace(kind=kind) for p in options), *common]
        call.__dict__["__signature__"] = inspect.Signature(parameters)
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        text, _, examples = (inspect.getdoc(function) or "").partition("\n\nExamples\n")
        # Each paragraph in one line: a terminal has another width than this file.
        text = "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))
        epilog = shown_examples(inspect.cleandoc(examples).splitlines())
        group.command(name, cls=Command, help=text, epilog=epilog, rich_help_panel=panel)(call)
        return function

    return register


def _is_path(hint: Any) -> bool:
    return Path in (hint, *get_args(hint))


def shown_examples(lines: Iterable[str]) -> str:
    """The end of a help page: examples, each on a line of its own."""
    return "\n".join([" Examples", *(f"   {line}" for line in lines)])


class WithExamples:
    """A command whose epilog is shown line by line: Typer's versions differ in how they join it."""

    epilog: str | None

    def format_help(self, ctx: Any, formatter: Any) -> None:
        text, self.epilog = self.epilog, None
        try:
            super().format_help(ctx, formatter)  # type: ignore[misc]
        finally:
            self.epilog = text
        if text:
            console().print(text, markup=False, soft_wrap=True)


class Command(WithExamples, TyperCommand):
    """A command with examples below its help."""


def quiet() -> None:
    """Let the interpreter end without a message about a closed pipe."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
