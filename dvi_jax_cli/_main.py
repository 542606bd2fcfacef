"""The entry point. Signals end any command in the same way, also while it is being imported.

These are Ctrl-C, SIGTERM and SIGHUP; the exit code is 128 + the number of the signal.
"""

import functools
import os
import signal
import sys
import threading
import time
from _thread import interrupt_main
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

INTERRUPTION = 130

_LATER = 0.02
"""Seconds after which a Ctrl-C that was not raised is tried again."""

_PATIENCE = 10.0
"""Seconds for which a Ctrl-C waits for the end of an import, and SIGTERM for that of other code in
which Python cannot raise, such as a long run in XLA."""

_DEFAULTS = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
if hasattr(signal, "SIGHUP"):  # not on Windows
    _DEFAULTS[signal.SIGHUP] = signal.SIG_DFL


def main() -> None:
    """The entry point ``dvi-jax``."""
    code: Any = INTERRUPTION
    numbers: list[int] = []
    with suppress(KeyboardInterrupt), interrupts_guarded(numbers):
        try:
            from ._app import run  # inside, as it may take a second

            run()
            code = 0
        except SystemExit as error:
            code = error.code
    for number in _DEFAULTS:  # from here on there is nothing to interrupt
        signal.signal(number, signal.SIG_IGN)
    if code == INTERRUPTION:
        _leave(128 + numbers[0] if numbers else INTERRUPTION)
    if isinstance(code, int) and (numbers or _is_searching()):
        _leave(code)
    sys.exit(code)


def _leave(code: int) -> None:
    """End the process without the end of the interpreter: a thread of XLA that still compiles would
    then use what is no longer there (a segmentation fault), and timers of JAX would be waited for.
    """
    if files := sys.modules.get("dvi_jax.base.files"):
        files.release()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # it does not exist or is closed
            stream.flush()
    os._exit(code)


def _is_searching() -> bool:
    """Whether the page of `explore`, whose server handles Ctrl-C itself, still computes."""
    return "search for invariants" in {thread.name for thread in threading.enumerate()}


def _watch(reader: int, numbers: list[int]) -> None:
    """End the process after SIGTERM if Python cannot raise it, because XLA does not return."""
    while True:
        for number in os.read(reader, 64):
            numbers.append(number)  # also one for which a sweep has a handler of its own
            if number != signal.SIGINT:
                time.sleep(_PATIENCE)
                print(f"interrupted: by signal {number}", file=sys.stderr)
                _leave(128 + number)


@contextmanager
def interrupts_guarded(numbers: list[int]) -> Iterator[None]:
    """Inside of this Ctrl-C, SIGTERM and SIGHUP are raised as `KeyboardInterrupt` where it can be,
    and raised again where it was lost; `numbers` gets the numbers of the signals.

    Python raises `KeyboardInterrupt` on any line. In a callback of the garbage collector (JAX has
    one) it is only reported, to `sys.unraisablehook`; an extension module that is interrupted at
    its import gives an `ImportError` or ends the process. So it waits until imports have ended.
    """
    hook, began = sys.unraisablehook, -1.0

    @functools.wraps(signal.default_int_handler)
    def handle(number: int, frame: Any) -> None:
        nonlocal began
        began = time.monotonic() if began < 0 else began
        numbers.append(number)
        if _is_importing(frame) and time.monotonic() - began < _PATIENCE:
            _retry()
        else:
            signal.default_int_handler(number, frame)

    def report(event: Any) -> None:
        if issubclass(event.exc_type, KeyboardInterrupt):
            _retry()
        else:
            hook(event)

    # Those that are ignored, as after nohup, or handled otherwise, stay so.
    own = [n for n, handler in _DEFAULTS.items() if signal.getsignal(n) is handler]
    for number in own:
        signal.signal(number, handle)
    if own and os.name != "nt":
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)  # written to by C, at once
        threading.Thread(target=_watch, args=(reader, numbers), daemon=True).start()
    sys.unraisablehook = report
    try:
        yield
    finally:
        sys.unraisablehook = hook


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
