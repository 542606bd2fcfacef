"""`Workers`, the search on all processors, and the program of its processes.

A process imports the checker and the search only: neither JAX, which takes a second, nor the main
module of the user, as a process of `multiprocessing` would.
"""

import contextlib
import importlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import time
import types
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

_SECONDS = 1.0
"""Processes start after so many seconds: about as many may be left, and a start takes 0.2 s."""


class Workers:
    """A `map` in this process or, if the work takes long, in up to `count` processes.

    If a process ends early, the others are ended, and this process continues alone, with a warning.
    """

    def __init__(self, count: int) -> None:
        self.count, self.seconds, self.processes = count, 0.0, []
        self.free: queue.SimpleQueue = queue.SimpleQueue()
        self.threads = ThreadPoolExecutor(count)  # each waits for one process
        if not sys.executable or getattr(sys, "frozen", False):  # there is no Python to start
            self.count = 1

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: Any) -> None:
        for process in self.processes:
            process.kill()
        self.threads.shutdown(cancel_futures=True)
        for process in self.processes:
            process.wait()
            process.stdout.close()
            with contextlib.suppress(OSError):  # closing sends what is not yet sent
                process.stdin.close()

    def map(self, precision: int, function: Callable, items: list) -> Iterator[Any]:
        """The results of a function of the search for all items, in order, with so many bits."""
        if self.seconds > _SECONDS:
            self._start(min(self.count, len(items)))
        if not self.processes or len(items) == 1:
            for item in items:
                began = time.monotonic()
                result = function(item)
                self.seconds += time.monotonic() - began
                yield result
            return
        task = pickle.dumps((precision, function))
        results = self.threads.map(lambda item: self._ask(task, item), items)
        for item, result in zip(items, results, strict=True):
            # A function that has failed there fails here again, with its error.
            yield function(item) if result is None else result
        statuses = [process.poll() for process in self.processes]
        if any(status is not None for status in statuses):
            self._continue_alone(f"ended early (exit statuses {statuses})")

    def _start(self, count: int) -> None:
        while 1 < count > len(self.processes):
            try:
                process = subprocess.Popen(
                    [sys.executable, "-P", __file__],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
                )
            except OSError as error:
                return self._continue_alone(f"did not start ({error})")
            self.processes.append(process)
            self.free.put(process)
            with contextlib.suppress(OSError):  # it has ended, which `map` reports
                _send(process.stdin, sys.path)

    def _ask(self, task: bytes, item: Any) -> Any:
        """The result of the next free process; None if it has failed or ended."""
        process = self.free.get()
        try:
            _send(process.stdin, (task, item))
            return pickle.load(process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            return None
        finally:
            self.free.put(process)

    def _continue_alone(self, event: str) -> None:
        # Not at the top: this file is also a program that does not import the package.
        from ..base.keywords import user_level

        self.__exit__()
        self.count, self.processes = 1, []
        warnings.warn(
            f"a process of bound_drift {event}. The search continues in one process: this takes "
            "longer, the result is the same. If memory is the cause, allow fewer processors.",
            RuntimeWarning,
            stacklevel=user_level(),
        )


def _send(pipe: Any, message: Any) -> None:
    pickle.dump(message, pipe)
    pipe.flush()


def _serve() -> None:
    """The program of a process: read a function and an item, write the result, until the end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that is interrupted ends this one
    requests, results = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout, current_task, function = sys.stderr, b"", len
    sys.path[:] = pickle.load(requests)
    for name in ("dvi_jax", "dvi_jax.proof"):  # without their __init__.py, which import JAX
        sys.modules[name] = types.ModuleType(name)
    sys.modules["dvi_jax.proof"].__path__ = [str(Path(__file__).parent)]
    flint = importlib.import_module("flint")
    while True:
        task, item = pickle.load(requests)
        if task != current_task:
            current_task, (flint.ctx.prec, function) = task, pickle.loads(task)
        try:
            result = function(item)
        except Exception:
            result = None
        _send(results, result)


if __name__ == "__main__":
    with contextlib.suppress(EOFError, OSError):
        _serve()
