"""Tasks on the devices of this process: one thread for each core or GPU."""

import contextlib
import math
import os
import platform
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from lanewise.jaxapi import x64_enabled

from .._results import STATUS_NAMES
from ..engine.threads import processors
from .layout import STATUS
from .plan import Task
from .program import Program
from .store import Memory, Store

_PAUSE = 0.2
"""Seconds between two checks of tasks that another process computes, and of an interrupt."""

_BEHIND = 2
"""Tasks for each thread that may wait to be written."""

GOOD = ("successful", "stopped")


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


class Counter:
    """Counts tasks and calls `report`. `before`: the tasks that were finished earlier."""

    def __init__(
        self, program: Program, before: Collection[int], report: Callable[..., None] | None
    ):
        self.program, self.report = program, report
        self.plan, self.began = program.plan, time.monotonic()
        self.before = len(before)
        self.lanes_before = sum(self.plan.task(i).lanes for i in before)
        self.done, self.lanes, self.steps, self.failed = 0, 0, 0, 0
        self._lock = threading.Lock()
        self._report()

    def add(self, task: Task, statuses: dict[str, int]) -> None:
        with self._lock:
            self.done += 1
            self.lanes += task.lanes
            self.steps += task.lanes * self.program.steps(task)
            self.failed += sum(n for name, n in statuses.items() if name not in GOOD)
            self._report()

    def _report(self) -> None:
        if self.report is None:
            return
        seconds = time.monotonic() - self.began
        todo = self.plan.lanes - self.lanes_before
        self.report(
            SweepProgress(
                tasks_done=self.before + self.done,
                num_tasks=self.plan.num_tasks,
                lanes_done=self.lanes_before + self.lanes,
                num_lanes=self.plan.lanes,
                failed=self.failed,
                rate=self.steps / seconds if seconds > 0 else 0.0,
                seconds=seconds,
                seconds_left=seconds * (todo / self.lanes - 1) if self.lanes else math.nan,
            )
        )


def compute(
    program: Program, task: Task, device: Any
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
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


def default_threads() -> int:
    """One for each processor, or each GPU."""
    devices = jax.local_devices()
    return processors() if devices[0].platform == "cpu" else len(devices)


class Queue:
    """The tasks to compute, and those that another process computes and may leave unfinished."""

    def __init__(
        self, todo: Iterator[int], sink: Memory | Store, done_elsewhere: Callable[[int], None]
    ):
        self.sink, self.done_elsewhere = sink, done_elsewhere
        self.stop = threading.Event()
        self._todo, self._open_again, self._theirs = todo, deque(), deque()
        self._lock = threading.Lock()

    def put_off(self, number: int) -> None:
        """Another process has claimed this task."""
        with self._lock:
            self._theirs.append(number)

    def __iter__(self) -> Iterator[int]:
        """Numbers of tasks until all are done or it is stopped; for several threads at a time."""
        while not self.stop.is_set():
            with self._lock:
                number = self._open_again.popleft() if self._open_again else next(self._todo, None)
                if number is None and not self._theirs:
                    return
            if number is not None:
                yield number
            elif not self.stop.wait(_PAUSE):
                self._check_others()

    def _check_others(self) -> None:
        done = []
        with self._lock:
            for _ in range(len(self._theirs)):
                number = self._theirs.popleft()
                (done if self.sink.is_done(number) else self._open_again).append(number)
        for number in done:
            self.done_elsewhere(number)


def run_here(
    program: Program,
    sink: Memory | Store,
    threads: int | None,
    report: Callable[[SweepProgress], None] | None,
) -> bool:
    """Compute the tasks that `sink` lacks, on all local devices. False: it was interrupted by
    Ctrl-C; the tasks that were being computed then have been stored. **Raises** the first error of
    a task or of its writing, once the other threads have ended."""
    plan, before = program.plan, set(sink.done())
    counter = Counter(program, before, report)
    queue = Queue(plan.todo(before), sink, lambda number: counter.add(plan.task(number), {}))
    devices, x64 = jax.local_devices(), x64_enabled()
    count = threads or default_threads()
    places = threading.Semaphore(_BEHIND * count)
    writer = ThreadPoolExecutor(2, "write")
    errors: list[BaseException] = []

    @contextlib.contextmanager
    def stopping_on_errors() -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            queue.stop.set()
            errors.append(error)

    def write(task: Task, results: Any, facts: Any, claim: contextlib.ExitStack) -> None:
        with stopping_on_errors():
            try:
                with claim:
                    sink.commit(task, results, facts)
                counter.add(task, facts["statuses"])
            finally:
                places.release()

    def work(device: Any) -> None:
        # enable_x64 may be a context of the caller, which threads do not inherit.
        with stopping_on_errors(), jax.enable_x64(x64):
            for number in queue:
                task = plan.task(number)
                with contextlib.ExitStack() as claim:
                    if not claim.enter_context(sink.claimed(task)):
                        queue.put_off(number)
                        continue
                    results, facts = compute(program, task, device)
                    places.acquire()
                    passed_on = claim.pop_all()
                writer.submit(write, task, results, facts, passed_on)

    interrupted = threading.Event()
    with (
        _instead_of_interrupt(interrupted, queue.stop),
        writer,
        ThreadPoolExecutor(count, "sweep") as pool,
    ):
        running = [pool.submit(work, devices[i % len(devices)]) for i in range(count)]
        try:
            while running:
                try:
                    running = wait(running, timeout=_PAUSE).not_done
                except KeyboardInterrupt:  # raised by another handler than Python's
                    if interrupted.is_set():
                        raise
                    interrupted.set()
                    queue.stop.set()
        finally:
            queue.stop.set()  # so that an exception does not wait for the end of the sweep
    if errors:
        raise errors[0]
    return not interrupted.is_set()


@contextlib.contextmanager
def _instead_of_interrupt(*events: threading.Event) -> Iterator[None]:
    """The first Ctrl-C sets these events. The exception that Python raises instead can occur at any
    line, and is lost in some, such as a callback of the garbage collector."""
    in_main = threading.current_thread() is threading.main_thread()
    before: Any = signal.getsignal(signal.SIGINT)
    # Python's handler, or one that wraps it.
    if not in_main or getattr(before, "__wrapped__", before) is not signal.default_int_handler:
        yield
        return

    def handle(number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, before)
        for event in events:
            event.set()

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
