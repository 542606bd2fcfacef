"""Where the results of tasks go: into memory here, into a store in `store`."""

import abc
import contextlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .plan import Plan, Task
from .variables import Variable


class StoreError(Exception):
    """A store that cannot be used: the message says why, and what to do."""


@contextlib.contextmanager
def as_store_error(path: Path, what: str, then: str = "") -> Iterator[None]:
    """What the system says of a file or directory, as a `StoreError`: `what` failed, what `then`
    to do."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{path}: {what}: {error.strerror or error}.{then}") from error


class Sink(abc.ABC):
    """Takes the results of tasks, and knows which it has."""

    @abc.abstractmethod
    def done(self) -> Collection[int]:
        """The numbers of the tasks that are done."""

    @abc.abstractmethod
    def is_done(self, number: int) -> bool:
        """Whether one task is done, by whomever."""

    @abc.abstractmethod
    def claimed(self, task: Task) -> contextlib.AbstractContextManager[bool]:
        """Whether the task is this worker's to do; for as long as the context lasts."""

    @abc.abstractmethod
    def commit(self, task: Task, results: Mapping[str, np.ndarray], facts: Mapping[str, Any]):
        """Keep the results of a task; it is done once this returns."""


class Memory(Sink):
    """Arrays of the whole grid, where there is room for them."""

    def __init__(self, plan: Plan, variables: Mapping[str, Variable]):
        self.plan, self.variables = plan, dict(variables)
        self.arrays = {
            name: np.full((*plan.shape, *v.shape), v.fill, v.dtype) for name, v in variables.items()
        }
        self._done: set[int] = set()

    def done(self):
        return set(self._done)

    def is_done(self, number):
        return number in self._done

    def claimed(self, task):
        return contextlib.nullcontext(True)

    def commit(self, task, results, facts):
        for name, x in results.items():
            self.arrays[name][task.box] = x
        self._done.add(task.number)
