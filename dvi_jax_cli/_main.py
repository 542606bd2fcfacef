"""The entry point: Ctrl-C ends any command with exit code 130, also while it is being imported."""

import functools
import signal
import sys
import threading
import time
from _thread import interrupt_main
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_LATER = 0.02
"""Seconds after which a Ctrl-C that was not raised is tried again."""

_PATIENCE = 10.0
"""Seconds for which a Ctrl-C waits for the end of an import."""


def main() -> None:
    """The entry point ``dvi-jax``."""
    try:
        with interrupts_guarded():
            from ._app import run  # inside, as it may take a second

            run()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        # The interpreter waits for timers: for a minute if JAX was interrupted before it cancelled
        # the one that warns of a slow start of a device.
        for thread in threading.enumerate():
            if isinstance(thread, threading.Timer):
                thread.cancel()


@contextmanager
def interrupts_guarded() -> Iterator[None]:
    """Inside of this a Ctrl-C is raised where it can be, and raised again where it was lost.

    Python raises `KeyboardInterrupt` on any line. In a callback of the garbage collector (JAX has
    one) it is only reported, to `sys.unraisablehook`; an extension module that is interrupted at
    its import gives an `ImportError` or ends the process. So it waits until imports have ended.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:  # ignored, say
        yield
        return
    hook, began = sys.unraisablehook, -1.0

    @functools.wraps(signal.default_int_handler)
    def handle(number: int, frame: Any) -> None:
        nonlocal began
        began = time.monotonic() if began < 0 else began
        if _is_importing(frame) and time.monotonic() - began < _PATIENCE:
            _retry()
        else:
            signal.default_int_handler(number, frame)

    def report(event: Any) -> None:
        if issubclass(event.exc_type, KeyboardInterrupt):
            _retry()
        else:
            hook(event)

    signal.signal(signal.SIGINT, handle)
    sys.unraisablehook = report
    try:
        yield
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _retry() -> None:
    """Have Ctrl-C handled again, a little later."""
    timer = threading.Timer(_LATER, interrupt_main)
    timer.daemon = True
    timer.start()


def _is_importing(frame: Any) -> bool:
    """Whether a frame, or one that called it, is an import statement's."""
    while frame is not None and frame.f_code.co_name != "_find_and_load":
        frame = frame.f_back
    return frame is not None
