"""Tasks on the workers of a Dask cluster: each worker commits its own, the scheduler distributes.

If a worker dies, a task runs twice, or the scheduler is lost, at most the tasks that were being
computed are lost: the tasks in the store remain, and are not computed again.
"""

import contextlib
import functools
import os
import pickle
import threading
import uuid
from collections import Counter as Counts, deque
from collections.abc import Callable
from typing import Any

import jax

from lanewise.jaxprs.jaxapi import backends_are_initialized, x64_enabled

from .plan import Plan
from .program import Program, Sweep
from .store import Memory, Store, StoreError
from .workers import Counter, SweepProgress, compute

_AHEAD = 4
"""Tasks for each thread of the cluster that are submitted at a time."""

_LARGE = 2**20
"""Bytes of a pickled sweep above which it is not sent with each task."""

_ATTEMPTS = 10
"""Number of times that a task may be lost with its worker before it is taken to be the cause."""


class ClusterError(RuntimeError):
    """Raised if the cluster is lost or a task kills its workers. With a store the finished tasks
    are in it, and the same call continues from there."""


def run_on(
    client: Any,
    sweep: Sweep,
    plan: Plan,
    sink: Memory | Store,
    report: Callable[[SweepProgress], None] | None,
) -> bool:
    """Compute the tasks that `sink` lacks on the workers of a `distributed.Client`. False: it was
    interrupted. **Raises** `ClusterError`, `StoreError`, and errors of a task."""
    import cloudpickle
    from distributed import CancelledError, KilledWorker, as_completed

    before = set(sink.done())
    todo, again = plan.todo(before), deque[int]()
    counter = Counter(Program(sweep, plan), before, report)
    where = (str(sink.path.resolve()), sink.sha) if isinstance(sink, Store) else (None, None)
    job: Any = cloudpickle.dumps((sweep, plan, *where, x64_enabled()))
    lost, running, run = Counts(), {}, uuid.uuid4().hex[:12]
    done = as_completed()
    if len(job) > _LARGE:  # an axis of many values: once to each worker
        job = client.scatter(job, broadcast=True, hash=False)

    def submit() -> None:
        threads = max(sum(client.nthreads().values()), 1)
        while len(running) < _AHEAD * threads:
            number = again.popleft() if again else next(todo, None)
            if number is None:
                return
            key = f"dvi-task-{run}-{number}-{uuid.uuid4().hex[:12]}"
            future = client.submit(_task, job, number, pure=False, key=key)
            running[key] = number, future
            done.add(future)

    try:
        submit()
        while running:
            number, future = running.pop(next(done).key)
            try:
                results, statuses = future.result()
            except KilledWorker as error:
                lost[number] += 1
                if lost[number] >= _ATTEMPTS:
                    raise ClusterError(
                        f"the workers of task {number} stopped in all of {_ATTEMPTS} attempts, "
                        "probably for lack of memory. Give the workers more memory, or use a "
                        "smaller lanes_per_task (with store=..., this needs a new path for the "
                        f"store). The last error was: {error}"
                    ) from error
                again.append(number)
            except CancelledError as error:
                raise OSError(f"task {number} was cancelled") from error
            except (OSError, TimeoutError) as error:
                if future.status != "error":
                    raise
                raise _TaskError(error) from error
            else:
                task = plan.task(number)
                if results is not None:
                    sink.commit(task, results, {})
                counter.add(task, statuses)
            submit()
    except KeyboardInterrupt:
        return False
    except _TaskError as error:
        raise error.args[0] from None
    except (OSError, TimeoutError) as error:
        raise ClusterError(
            f"the connection to the Dask cluster was lost ({error!r}). Start a new cluster and "
            "repeat the call with its client. With store=..., the same call continues after the "
            "finished tasks; otherwise all tasks are computed again."
        ) from error
    finally:
        with contextlib.suppress(OSError, TimeoutError):
            client.cancel([future for _, future in running.values()])
    return True


class _TaskError(Exception):
    """An error that a task raised, to distinguish it from those of the cluster."""


def _start_jax() -> None:
    """Start JAX in a worker with as many threads as the worker has.

    Threads of XLA wait actively. Those of a worker with one core would otherwise take the cores of
    its neighbours. XLA reads their number from NPROC, once.
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


@functools.lru_cache(maxsize=1)
def _job(pickled: bytes) -> tuple[Program, str | None, str | None, bool]:
    """The last sweep of a worker: its program, the path and hash of its store, and x64."""
    _start_jax()
    sweep, plan, *others = pickle.loads(pickled)
    return Program(sweep, plan), *others


_lock = threading.Lock()


def _task(pickled: bytes, number: int) -> tuple[Any, dict[str, int]]:
    """On a worker: compute a task and commit it if there is a store. Its results, if there is no
    store, and its statuses."""
    with _lock:  # threads of a worker share one job
        program, path, sha, x64 = _job(pickled)
    task, device = program.plan.task(number), jax.local_devices()[0]
    with jax.enable_x64(x64):
        if path is None:
            results, facts = compute(program, task, device)
            return results, facts["statuses"]
        store = Store.open(path)
        if store.sha != sha:
            raise StoreError(
                f"store must be the same directory on every worker, but on one worker {path!r} "
                "contains another sweep. Use a directory that all workers share."
            )
        known = store.record(number)
        if known is None:
            results, known = compute(program, task, device)
            store.commit(task, results, known)
        return None, known["statuses"]
