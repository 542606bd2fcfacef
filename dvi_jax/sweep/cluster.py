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
from typing import Any

import jax

from lanewise.jaxprs.jaxapi import backends_are_initialized, x64_enabled

from .plan import SweepPlan
from .program import Sweep, SweepProgram
from .store import MemorySink, Store, StoreError
from .workers import Counter, Report, compute

_AHEAD = 4  # Tasks for each thread of the cluster that are submitted at a time
_LARGE = 2**20  # Bytes of a pickled sweep above which it is not sent with each task
_ATTEMPTS = 10  # Losses of a task with its worker before it is taken to be the cause


class ClusterError(RuntimeError):
    """Raised if the cluster is lost or a task kills its workers. With a store the finished tasks
    are in it, and the same call continues from there."""


def run_on(
    client: Any, sweep: Sweep, plan: SweepPlan, sink: MemorySink | Store, report: Report
) -> bool:
    """Compute the tasks that `sink` lacks on the workers of a `distributed.Client`. False: it was
    interrupted. **Raises** `ClusterError`, `StoreError`, and errors of a task."""
    import cloudpickle
    from distributed import CancelledError, KilledWorker, as_completed

    done_tasks = set(sink.done_tasks())
    todo, retries = plan.todo(done_tasks), deque[int]()
    counter = Counter(SweepProgram(sweep, plan), done_tasks, report)
    location = (str(sink.path.resolve()), sink.sha) if isinstance(sink, Store) else (None, None)
    job: Any = cloudpickle.dumps((sweep, plan, *location, x64_enabled()))
    losses, running, run = Counts(), {}, uuid.uuid4().hex[:12]
    completions = as_completed()
    if len(job) > _LARGE:  # an axis of many values: once to each worker
        job = client.scatter(job, broadcast=True, hash=False)

    def submit() -> None:
        threads = max(sum(client.nthreads().values()), 1)
        while len(running) < _AHEAD * threads:
            number = retries.popleft() if retries else next(todo, None)
            if number is None:
                return
            key = f"dvi-task-{run}-{number}-{uuid.uuid4().hex[:12]}"
            future = client.submit(_task, job, number, pure=False, key=key)
            running[key] = number, future
            completions.add(future)

    try:
        submit()
        while running:
            number, future = running.pop(next(completions).key)
            try:
                results, statuses = future.result()
            except KilledWorker as error:
                losses[number] += 1
                if losses[number] >= _ATTEMPTS:
                    raise ClusterError(
                        f"task {number} lost its workers {_ATTEMPTS} times, probably for lack of "
                        "memory: use a smaller lanes_per_task and a new store. The last error was: "
                        f"{error}"
                    ) from error
                retries.append(number)
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
            f"the connection to the Dask cluster was lost ({error!r}): start a new one. With "
            "store=... the same call continues."
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
def _job(job: bytes) -> tuple[SweepProgram, str | None, str | None, bool]:
    """The last sweep of a worker: its program, the path and hash of its store, and x64."""
    _start_jax()
    sweep, plan, *store_and_precision = pickle.loads(job)
    return SweepProgram(sweep, plan), *store_and_precision


_lock = threading.Lock()


def _task(job: bytes, number: int) -> tuple[Any, dict[str, int]]:
    """On a worker: compute a task, and commit it if there is a store. Its results, if there is no
    store, and its statuses."""
    with _lock:  # threads of a worker share one job
        program, path, sha, x64 = _job(job)
    task, device = program.plan.task(number), program.devices[number % len(program.devices)]
    with jax.enable_x64(x64):
        if path is None:
            results, facts = compute(program, task, device)
            return results, facts["statuses"]
        store = Store.open(path)
        if store.sha != sha:
            raise StoreError(
                f"store={path!r} must be one directory, shared by all workers, but on one of them "
                "it contains another sweep."
            )
        record = store.record(number)
        if record is None:
            results, record = compute(program, task, device)
            store.commit(task, results, record)
        return None, record["statuses"]
