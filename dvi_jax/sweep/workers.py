"""Tasks on the devices of this process: one thread for each core, two for each GPU."""

import contextlib
import math
import os
import platform
import queue
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from lanewise.jaxprs.jaxapi import x64_enabled

from ..base.machine import processors
from ..base.printing import printable
from ..base.results import STATUS_NAMES
from .layout import STATUS
from .plan import SweepTask
from .program import SweepProgram
from .store import MemorySink, Store

_PAUSE = 0.2  # Seconds between two checks of tasks that another process computes
_WRITES = 2  # Tasks for each thread that may wait to be written
_PER_GPU = 2  # Tasks at a time: the results of one are copied while the GPU computes the other
GOOD = ("successful", "stopped")


@printable
@dataclass(frozen=True)
class SweepProgress:
    """Progress of a sweep.

    - `tasks_done`, `num_tasks`, `lanes_done`, `num_lanes`: tasks and trajectories, those of earlier
      runs included.
    - `failed`: trajectories of this run with a status other than successful or stopped.
    - `rate`: trajectory steps per second in this run. `seconds`: since it began. `seconds_left`:
      estimated from the finished trajectories; NaN before there are any.
    """

    tasks_done: int
    num_tasks: int
    lanes_done: int
    num_lanes: int
    failed: int
    rate: float
    seconds: float
    seconds_left: float


Report = Callable[[SweepProgress], None] | None


class Counter:
    """Counts tasks and calls `report`. `done_tasks`: those that were finished earlier."""

    def __init__(self, program: SweepProgram, done_tasks: Collection[int], report: Report):
        self.program, self.report = program, report
        self.plan, self.began = program.plan, time.monotonic()
        self.tasks_before = len(done_tasks)
        self.lanes_before = sum(self.plan.task(i).lanes for i in done_tasks)
        self.tasks, self.lanes, self.steps, self.failures = 0, 0, 0, 0
        self._lock = threading.Lock()
        self._report()

    def add(self, task: SweepTask, statuses: dict[str, int]) -> None:
        with self._lock:
            self.tasks += 1
            self.lanes += task.lanes
            self.steps += task.lanes * self.program.steps(task)
            self.failures += sum(n for name, n in statuses.items() if name not in GOOD)
            self._report()

    def _report(self) -> None:
        if self.report is None:
            return
        seconds = time.monotonic() - self.began
        todo = self.plan.lanes - self.lanes_before
        tasks = self.tasks_before + self.tasks, self.plan.num_tasks
        lanes = self.lanes_before + self.lanes, self.plan.lanes
        rate = self.steps / seconds if seconds > 0 else 0.0
        left = seconds * (todo / self.lanes - 1) if self.lanes else math.nan
        self.report(SweepProgress(*tasks, *lanes, self.failures, rate, seconds, left))


def compute(program: SweepProgram, task: SweepTask, device: Any):
    """The results of a task and the facts for its record."""
    began = time.monotonic()  # not time.time(): the clock of the machine may be set back meanwhile
    results = program(task, device)
    codes, counts = np.unique(results[STATUS], return_counts=True)
    facts = {
        "statuses": {STATUS_NAMES[c]: int(n) for c, n in zip(codes, counts, strict=True)},
        "seconds": round(time.monotonic() - began, 3),
        "finished": time.time(),
        "host": platform.node(),
        "pid": os.getpid(),
        "device": device.device_kind,
    }
    return results, facts


def cores(devices: Sequence[Any]) -> int:
    """The processors, or the GPUs."""
    return processors() if devices[0].platform == "cpu" else len(devices)


def run_here(program: SweepProgram, sink: MemorySink | Store, threads: Any, report: Report) -> bool:
    """Compute the tasks that `sink` lacks. False: it was interrupted by Ctrl-C; the tasks that were
    being computed then have been stored. **Raises** the first error of a task or of its writing,
    once the other threads have ended."""
    plan, done_tasks = program.plan, set(sink.done_tasks())
    counter = Counter(program, done_tasks, report)
    devices, x64 = program.devices, x64_enabled()
    per_core = 1 if devices[0].platform == "cpu" else _PER_GPU
    count = threads or per_core * cores(devices)
    free: queue.SimpleQueue[Any] = queue.SimpleQueue()
    for i in range(count):
        free.put(devices[i % len(devices)])
    places = threading.Semaphore(_WRITES * count)
    stop, interrupt = threading.Event(), threading.Event()
    errors: list[BaseException] = []

    @contextlib.contextmanager
    def stopping_on_errors() -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            stop.set()
            errors.append(error)

    def compute_one(task: SweepTask, device: Any, claim: contextlib.ExitStack) -> None:
        try:
            # enable_x64 may be a context of the caller, which threads do not inherit.
            with stopping_on_errors(), claim, jax.enable_x64(x64):
                results, facts = compute(program, task, device)
                places.acquire()
                writer.submit(write, task, results, facts, claim.pop_all())
        finally:
            free.put(device)

    def write(task: SweepTask, results: Any, facts: Any, claim: contextlib.ExitStack) -> None:
        with stopping_on_errors():
            try:
                with claim:
                    sink.commit(task, results, facts)
                counter.add(task, facts["statuses"])
            finally:
                places.release()

    def submit(numbers: Iterable[int]) -> list[int]:
        """Those that another process computes, and may leave unfinished, are returned."""
        theirs = []
        for number in numbers:
            task, device, claim = plan.task(number), free.get(), contextlib.ExitStack()
            if stop.is_set():
                break
            if claim.enter_context(sink.claim(task)):
                pool.submit(compute_one, task, device, claim)
                continue
            claim.close()
            free.put(device)
            if sink.is_done(number):
                counter.add(task, {})
            else:
                theirs.append(number)
        return theirs

    with (
        _instead_of_interrupt(interrupt, stop),
        ThreadPoolExecutor(2, "write") as writer,
        ThreadPoolExecutor(count, "sweep") as pool,
    ):
        try:
            theirs = submit(plan.todo(done_tasks))
            while theirs and not stop.wait(_PAUSE):
                theirs = submit(theirs)
        except KeyboardInterrupt:  # raised by another handler than Python's
            interrupt.set()
    if errors:
        raise errors[0]
    return not interrupt.is_set()


@contextlib.contextmanager
def _instead_of_interrupt(*events: threading.Event) -> Iterator[None]:
    """The first Ctrl-C, or SIGTERM where it is handled in the same way, sets these events. The
    exception that Python raises instead can occur at any line, and is lost in some, such as a
    callback of the garbage collector."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers: dict[int, Any] = {number: signal.getsignal(number) for number in numbers}
    # Python's handler, or one that wraps it.
    handlers = {
        number: handler
        for number, handler in handlers.items()
        if getattr(handler, "__wrapped__", handler) is signal.default_int_handler
    }
    if threading.current_thread() is not threading.main_thread():
        handlers = {}

    def restore() -> None:
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def handle(number: int, frame: Any) -> None:
        restore()
        for event in events:
            event.set()

    for number in handlers:
        signal.signal(number, handle)
    try:
        yield
    finally:
        restore()
