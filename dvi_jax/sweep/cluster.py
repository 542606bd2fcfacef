"""Tasks on the workers of a Dask cluster: each commits its own, the scheduler only hands them out.

A worker that dies, a task that runs twice, a scheduler that is lost cost at most the tasks that
were being computed: what is in the store stays, and is never computed again.
"""

import contextlib
import hashlib
import os
import pickle
import threading
import uuid
from collections import deque
from collections.abc import Callable
from typing import Any

import jax

from lanewise.jaxapi import backends_are_initialized, x64_enabled

from .plan import Plan
from .program import Program, Sweep
from .sinks import Sink
from .store import Store, StoreError
from .workers import Counter, SweepProgress, compute

_AHEAD = 4
"""Tasks for each thread of the cluster that are handed out at a time."""

_LARGE = 2**20
"""Bytes of a sweep, pickled, above which they are not sent with each task."""

_LIVES = 10
"""Times that a task may be lost with its worker before it is held to be the cause."""


class ClusterError(RuntimeError):
    """The cluster is gone, or a task kills the workers that it runs on. What was finished is in the
    store; the same call goes on from there."""


def run_on(
    client: Any,
    sweep: Sweep,
    plan: Plan,
    sink: Sink,
    report: Callable[[SweepProgress], None] | None,
) -> bool:
    """Do the tasks that `sink` lacks on the workers of a `distributed.Client`. False: interrupted.

    **Raises** `ClusterError` where the cluster fails, `StoreError` for a store that a worker does
    not see, and what a task raises.
    """
    import cloudpickle
    from distributed import as_completed

    program = Program(sweep, plan)
    before = set(sink.done())
    todo, again = plan.todo(before), deque[int]()
    counter = Counter(program, before, report)
    where = (str(sink.path.resolve()), sink.sha) if isinstance(sink, Store) else (None, None)
    job = cloudpickle.dumps((sweep, plan, *where, x64_enabled()))
    lost: dict[int, int] = {}
    numbers: dict[Any, int] = {}
    waiting: dict[Any, Any] = {}
    attempts, run = 0, uuid.uuid4().hex[:12]
    done = as_completed()

    payload = job
    if len(job) > _LARGE:  # an axis of many values: once to each worker, not with each task
        payload = client.scatter(job, broadcast=True, hash=False)

    def hand_out() -> None:
        nonlocal attempts
        threads = max(sum(client.nthreads().values()), 1)
        while len(numbers) < _AHEAD * threads:
            number = again.popleft() if again else next(todo, None)
            if number is None:
                return
            attempts += 1
            future = client.submit(
                _task, payload, number, pure=False, key=f"dvi-task-{run}-{number}-{attempts}"
            )
            numbers[future.key] = number
            waiting[future.key] = future
            done.add(future)

    try:
        hand_out()
        while numbers:
            future = next(done)
            number = numbers.pop(future.key)
            del waiting[future.key]
            if future.status == "finished":
                results, statuses = future.result()
                task = plan.task(number)
                if results is not None:
                    sink.commit(task, results, {})
                counter.add(task, statuses)
            else:
                _look_at(future, number, lost)
                again.append(number)
            hand_out()
    except KeyboardInterrupt:
        return False
    except _OfTaskError as error:
        raise error.error from None
    except (OSError, TimeoutError) as error:
        raise ClusterError(f"the cluster is lost ({error!r}). {ClusterError.__doc__}") from error
    finally:
        with contextlib.suppress(OSError, TimeoutError):
            client.cancel([*waiting.values()])
    return True


class _OfTaskError(Exception):
    """What a task raised, told apart from what the cluster raises."""

    def __init__(self, error: BaseException):
        super().__init__(str(error))
        self.error = error


def _look_at(future: Any, number: int, lost: dict[int, int]) -> None:
    """Raise what a task raised, unless it was lost with its worker, for which it may try again."""
    from distributed import CancelledError, KilledWorker

    try:
        future.result()
    except KilledWorker as error:
        lost[number] = lost.get(number, 0) + 1
        if lost[number] >= _LIVES:
            raise ClusterError(
                f"task {number} was lost {_LIVES} times with its worker, so that it seems to be "
                f"the cause (memory?): take fewer lanes_per_task. ({error})"
            ) from error
    except CancelledError as error:
        raise OSError(f"task {number} was cancelled") from error
    except Exception as error:
        raise _OfTaskError(error) from error


class _Job:
    """What a worker keeps of a sweep between tasks."""

    def __init__(self, pickled: bytes):
        _start_jax()
        self.sweep, self.plan, self.path, self.sha, self.x64 = pickle.loads(pickled)
        self.program = Program(self.sweep, self.plan)


def _start_jax() -> None:
    """Start JAX in a worker with as many threads as the worker has.

    XLA's threads look for work without pause. Those of a worker that was given one core would do so
    on the cores of its neighbours; how many there are XLA reads from NPROC, once.
    """
    if backends_are_initialized() or "NPROC" in os.environ:
        return
    from distributed import get_worker

    try:
        threads = get_worker().state.nthreads
    except ValueError:  # not in a worker
        return
    os.environ["NPROC"] = str(threads)
    try:
        jax.local_devices()
    finally:
        del os.environ["NPROC"]


_lock = threading.Lock()
_jobs: dict[str, _Job] = {}
"""The last sweep of this worker, by the hash of its pickle."""


def _job(pickled: bytes) -> _Job:
    key = hashlib.sha256(pickled).hexdigest()
    with _lock:
        if key not in _jobs:
            made = _Job(pickled)
            _jobs.clear()
            _jobs[key] = made
        return _jobs[key]


def _task(pickled: bytes, number: int) -> tuple[Any, dict[str, int]]:
    """On a worker: compute a task, commit it where there is a store, and say how it went."""
    job = _job(pickled)
    task, device = job.plan.task(number), jax.local_devices()[0]
    with jax.enable_x64(job.x64):
        if job.path is None:
            results, facts = compute(job.program, task, device)
            return results, facts["statuses"]
        store = Store.open(job.path)
        if store.sha != job.sha:
            raise StoreError(f"{job.path}: a worker sees another sweep there than the client does.")
        known = store.record(number)
        if known is None:
            results, known = compute(job.program, task, device)
            store.commit(task, results, known)
        return None, known["statuses"]
