"""All commands, and how the process ends."""

import io
import os
import sys
import traceback

# Each adds its commands to the application; in the order of the help page, not of the alphabet.
# isort: off
from . import _new, _runs, _sweeps, _inverse, _checks  # noqa: F401

# isort: on
from ._group import app
from ._session import CODES, Session, quiet
from ._show import complain

__all__ = ["app", "run"]


def run() -> None:
    """The command that the words of the command line name, and its exit code."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed, as by >&-: nobody reads
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # an ε on a terminal that knows none is no error
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
        kind, message = Session(False, False, debug).judge(error)
        complain(kind, message)
        sys.exit(CODES[kind])
