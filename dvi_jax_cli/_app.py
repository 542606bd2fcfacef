"""All commands, and how the process ends."""

import io
import os
import sys
import traceback

# Each adds its commands to the application; in the order of the help page, not of the alphabet.
# isort: off
from . import _new, _runs, _explore, _checks  # noqa: F401

# isort: on
from ._group import app
from ._session import CODES, Session, quiet
from ._show import print_error

__all__ = ["app", "run"]


def run() -> None:
    """Run the command that the arguments name, and end with its exit code."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed, as by >&-
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without ε shows ?
            stream.reconfigure(errors="replace")
    try:
        app(prog_name="dvi-jax")
    except BrokenPipeError:
        quiet()
        sys.exit(CODES["failed"])
    except Exception as error:  # raised with --debug, or of the command line itself
        debug = "--debug" in sys.argv
        if debug:
            traceback.print_exc()
        kind, message = Session(False, False, debug).kind_and_message(error)
        print_error(kind, message)
        sys.exit(CODES[kind])
