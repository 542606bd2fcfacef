"""The grid of a sweep, and how it is cut into tasks."""

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .._checks import whole

WORK = 2**28
"""Trajectory steps that one task should have: some tenths of a second."""

SMALLEST_WORK = 2**22
"""Trajectory steps below which a task is not cut further to have many of them."""

FEWEST, MOST = 256, 2**17
"""Trajectories of one task."""

MANY = 32
"""Tasks that a sweep should have at least, if they are worth it."""

BYTES = 2**26
"""Results of one task, at most (one trajectory may have more)."""


class Task(NamedTuple):
    """A box of the grid: its number and, for each dimension, where it begins and how long it is."""

    number: int
    start: tuple[int, ...]
    size: tuple[int, ...]

    @property
    def box(self) -> tuple[slice, ...]:
        return tuple(slice(a, a + n) for a, n in zip(self.start, self.size, strict=True))

    @property
    def lanes(self) -> int:
        return math.prod(self.size)


@dataclass(frozen=True)
class Plan:
    """A grid with named dimensions in boxes of one shape, `chunk`; each is one task.

    The last box along a dimension may be smaller. Programs are compiled for a whole one, whatever
    runs them: results do not depend on how many devices there are.
    """

    dims: Mapping[str, int]
    chunk: tuple[int, ...]

    def __post_init__(self):
        lengths = (*self.dims.values(), *self.chunk)
        is_whole = all(isinstance(n, int | np.integer) and n >= 1 for n in lengths)
        if not is_whole or len(self.dims) != len(self.chunk):
            raise ValueError(f"no grid of lengths {self.dims} can have tasks of {self.chunk}.")

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.dims.values())

    @property
    def lanes(self) -> int:
        """Trajectories in all."""
        return math.prod(self.shape)

    @property
    def lanes_per_task(self) -> int:
        return math.prod(self.chunk)

    @property
    def counts(self) -> tuple[int, ...]:
        """Boxes along each dimension."""
        return tuple(-(-n // c) for n, c in zip(self.shape, self.chunk, strict=True))

    @property
    def num_tasks(self) -> int:
        return math.prod(self.counts)

    def task(self, number: int) -> Task:
        if not 0 <= number < self.num_tasks:
            raise IndexError(f"there is no task {number}: the sweep has {self.num_tasks}.")
        start = tuple(k * c for k, c in zip(self.place(number), self.chunk, strict=True))
        size = tuple(min(c, n - a) for c, n, a in zip(self.chunk, self.shape, start, strict=True))
        return Task(number, start, size)

    def place(self, number: int) -> tuple[int, ...]:
        """The box of a task, counted along each dimension."""
        return tuple(int(k) for k in np.unravel_index(number, self.counts))

    def number(self, place: Sequence[int]) -> int:
        """The task in a box, the inverse of `place`."""
        return int(np.ravel_multi_index(tuple(place), self.counts))

    def todo(self, done: Container[int]) -> Iterator[int]:
        """The numbers of the other tasks, made when they are needed: there may be 10⁹ of them."""
        return (i for i in range(self.num_tasks) if i not in done)

    def tasks(self) -> Iterator[Task]:
        return (self.task(i) for i in range(self.num_tasks))


def make_plan(
    dims: Mapping[str, int],
    compiled: int,
    steps: int,
    bytes_per_lane: int,
    lanes: int | None = None,
) -> Plan:
    """A plan for a grid.

    - `compiled`: how many dimensions in front are compiled one value at a time.
    - `steps`: of one trajectory. `bytes_per_lane`: of its results.
    - `lanes`: trajectories of one task at most; None: chosen from the two.

    **Raises** `ValueError` for `lanes` that is not a positive whole number.
    """
    total = math.prod(list(dims.values())[compiled:])
    if lanes is None:
        lanes = min(max(_power_of_two(WORK // max(steps, 1)), FEWEST), MOST)
        fewest = max(FEWEST, SMALLEST_WORK // max(steps, 1))
        many = -(-MANY // max(math.prod(list(dims.values())[:compiled]), 1))
        lanes = min(lanes, max(fewest, -(-total // many)))
        lanes = max(1, min(lanes, BYTES // max(bytes_per_lane, 1)))
    room = whole("lanes_per_task", lanes)
    chunk: list[int] = []
    for n in reversed(list(dims.values())[compiled:]):
        boxes = -(-n // min(n, max(room, 1)))
        size = -(-n // boxes)  # boxes as equal as can be
        if boxes > 1 and size > 64:
            size = min(-(-size // 64) * 64, n, room)  # of whole vectors
        chunk.append(size)
        room = room // size if boxes == 1 else 1
    return Plan(dict(dims), (*(1 for _ in range(compiled)), *reversed(chunk)))


def _power_of_two(n: int) -> int:
    return 1 << max(n.bit_length() - 1, 0)
