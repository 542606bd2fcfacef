"""Tasks on the devices of this process: one thread a core or a GPU, results kept as they come."""

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from math import nan
from typing import Any

import jax
import numpy as np

from .._results import STATUS_NAMES
from ..engine.threads import processors
from .plan import Task
from .program import Program
from .sinks import Sink
from .store import STATUS

_PATIENCE = 0.2
"""Seconds between two looks at tasks that another process works on, and at an interrupt."""

_BEHIND = 2
"""Tasks for each thread that may wait to be written."""

GOOD = ("successful", "stopped")


@dataclass(frozen=True)
class SweepProgress:
    """How far a sweep is.

    - `tasks_done`, `num_tasks`, `lanes_done`, `num_lanes`: tasks and trajectories, those of earlier
      runs included.
    - `failed`: trajectories of this run with a status other than successful or stopped.
    - `rate`: trajectory steps a second, of this run. `seconds`: since it began. `seconds_left`:
      estimated from the trajectories done; NaN before there are any.
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
    """Counts tasks and tells a callback."""

    def __init__(self, program: Program, todo: list[int], report: Callable[..., None] | None):
        self.program, self.report = program, report
        self.plan, self.began = program.plan, time.monotonic()
        self.lanes_todo = sum(self.plan.task(i).lanes for i in todo)
        self.todo, self.done, self.lanes, self.steps, self.failed = len(todo), 0, 0, 0, 0
        self._lock = threading.Lock()
        self._tell()

    def add(self, task: Task, statuses: dict[str, int]) -> None:
        with self._lock:
            self.done += 1
            self.lanes += task.lanes
            self.steps += task.lanes * self.program.steps(task)
            self.failed += sum(n for name, n in statuses.items() if name not in GOOD)
            self._tell()

    def _tell(self) -> None:
        if self.report is None:
            return
        seconds = time.monotonic() - self.began
        before = self.plan.lanes - self.lanes_todo
        self.report(
            SweepProgress(
                tasks_done=self.plan.num_tasks - self.todo + self.done,
                num_tasks=self.plan.num_tasks,
                lanes_done=before + self.lanes,
                num_lanes=self.plan.lanes,
                failed=self.failed,
                rate=self.steps / seconds if seconds > 0 else 0.0,
                seconds=seconds,
                seconds_left=seconds * (self.lanes_todo / self.lanes - 1) if self.lanes else nan,
            )
        )


def compute(
    program: Program, task: Task, device: Any
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The results of a task and what its record says about them."""
    began = time.time()
    results = program(task, device)
    codes, counts = np.unique(results[STATUS], return_counts=True)
    facts = {
        "statuses": {STATUS_NAMES[c]: int(n) for c, n in zip(codes, counts, strict=True)},
        "seconds": round(time.time() - began, 3),
        "finished": time.time(),
        "host": os.uname().nodename if hasattr(os, "uname") else "",
        "pid": os.getpid(),
        "device": device.device_kind,
    }
    return results, facts


def run_here(
    program: Program,
    sink: Sink,
    threads: int | None,
    report: Callable[[SweepProgress], None] | None,
) -> bool:
    """Do the tasks that `sink` lacks, on all local devices. False: interrupted by Ctrl-C, once the
    tasks that were being computed had been kept.

    **Raises** whatever a task or its writing raises, once the other threads have ended.
    """
    todo = sink.todo()
    counter = Counter(program, todo, report)
    queue, theirs, stop = deque(todo), deque(), threading.Event()
    devices = jax.local_devices()
    count = threads or (processors() if devices[0].platform == "cpu" else len(devices))
    room = threading.Semaphore(_BEHIND * count)
    writer = ThreadPoolExecutor(2, "write")
    written: list[Future] = []

    def keep(task: Task, results: Any, facts: Any, claim: contextlib.ExitStack) -> None:
        try:
            with claim:
                sink.commit(task, results, facts)
            counter.add(task, facts["statuses"])
        except BaseException:
            stop.set()
            raise
        finally:
            room.release()

    def work(device: Any) -> None:
        try:
            for number in _next(queue, theirs, stop):
                task = program.plan.task(number)
                with contextlib.ExitStack() as claim:
                    if not claim.enter_context(sink.claimed(task)):
                        theirs.append(number)
                        continue
                    results, facts = compute(program, task, device)
                    room.acquire()
                    passed_on = claim.pop_all()
                written.append(writer.submit(keep, task, results, facts, passed_on))
        except BaseException:
            stop.set()
            raise

    interrupted = False
    with ThreadPoolExecutor(count, "sweep") as pool:
        running = [pool.submit(work, devices[i % len(devices)]) for i in range(count)]
        while True:
            try:
                if not wait(running, timeout=_PATIENCE).not_done:
                    break
            except KeyboardInterrupt:
                if interrupted:
                    raise
                interrupted = True
                stop.set()
            if not stop.is_set() and theirs and not queue:
                _look_again(queue, theirs, sink, counter, program)
    writer.shutdown()
    for future in (*running, *written):
        future.result()
    return not interrupted


def _next(queue: deque, theirs: deque, stop: threading.Event) -> Iterator[int]:
    """Numbers of tasks, until there are none, nor any that another process may leave undone."""
    while not stop.is_set():
        try:
            yield queue.popleft()
        except IndexError:
            if not theirs:
                return
            time.sleep(_PATIENCE)


def _look_again(queue: deque, theirs: deque, sink: Sink, counter: Counter, program: Program):
    """Take up again what other processes had claimed, if it is not done."""
    for _ in range(len(theirs)):
        number = theirs.popleft()
        if sink.is_done(number):
            counter.add(program.plan.task(number), {})
        else:
            queue.append(number)
