"""The grid of a sweep and its division into tasks."""

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lanewise.jaxprs.extent import largest_bytes, operation_count

from ..base.checks import whole

FEWEST_TASKS = 32  # of a sweep


class Limits(NamedTuple):
    """Limits of one task: `work`, trajectory steps at most, and `least_work`, for which it is made
    smaller so that there are more; trajectories; bytes of results (one trajectory may have more).
    """

    work: int
    least_work: int
    fewest_lanes: int
    most_lanes: int
    bytes: int


ON_CPU = Limits(2**28, 2**22, 2**8, 2**17, 2**26)  # some tenths of a second of a core
# By prediction: fewer trajectories leave a part of a GPU idle, and so many steps of 256 operations
# take at most a second. Ctrl-C and the progress wait for the end of a task.
ON_GPU = Limits(2**32, 2**30, 2**16, 2**20, 2**28)
_STEP = 256
_MEMORY = 2**31  # Bytes of a GPU that does not report them
_COPIES = 16  # Arrays of a trajectory, as large as the largest, in two tasks of a GPU


class SweepTask(NamedTuple):
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
class SweepPlan:
    """A grid with named dimensions in boxes of one shape, `chunk`; each is one task.

    The last box along a dimension may be smaller. Programs are nevertheless compiled for a full
    box, so that results do not depend on the number of devices.
    """

    dims: Mapping[str, int]
    chunk: tuple[int, ...]

    def __post_init__(self):
        for name, size in (*self.dims.items(), *(("chunk", size) for size in self.chunk)):
            whole(name, size)
        if len(self.dims) != len(self.chunk):
            raise ValueError(f"chunk must have one size for each of {[*self.dims]}: {self.chunk}.")

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.dims.values())

    @property
    def lanes(self) -> int:
        """Number of trajectories."""
        return math.prod(self.shape)

    @property
    def lanes_per_task(self) -> int:
        return math.prod(self.chunk)

    @property
    def counts(self) -> tuple[int, ...]:
        """Boxes along each dimension."""
        return tuple(-(-size // c) for size, c in zip(self.shape, self.chunk, strict=True))

    @property
    def num_tasks(self) -> int:
        return math.prod(self.counts)

    def task(self, number: int) -> SweepTask:
        start = tuple(k * c for k, c in zip(self.place(number), self.chunk, strict=True))
        size = tuple(min(c, n - a) for c, n, a in zip(self.chunk, self.shape, start, strict=True))
        return SweepTask(number, start, size)

    def place(self, number: int) -> tuple[int, ...]:
        """The box of a task, counted along each dimension."""
        return tuple(int(k) for k in np.unravel_index(number, self.counts))

    def number(self, place: Sequence[int]) -> int:
        """The task in a box, the inverse of `place`."""
        return int(np.ravel_multi_index(tuple(place), self.counts))

    def todo(self, done_tasks: Container[int]) -> Iterator[int]:
        """The numbers of the other tasks, as an iterator: there may be 10⁹ of them."""
        return (i for i in range(self.num_tasks) if i not in done_tasks)

    def tasks(self) -> Iterator[SweepTask]:
        return (self.task(i) for i in range(self.num_tasks))


def on_devices(devices: Sequence[Any], program: Any) -> tuple[Limits, int]:
    """The limits of a task on these devices, and what a step counts for `work`; `program` is the
    jaxpr of a trajectory."""
    if devices[0].platform == "cpu":
        return ON_CPU, 1
    memory = min((d.memory_stats() or {}).get("bytes_limit", _MEMORY) for d in devices)
    lanes = max(memory // (_COPIES * largest_bytes(program)), 1)
    # A power of two: another share of the memory mostly gives the same tasks, which a store needs.
    most = min(ON_GPU.most_lanes, 1 << (lanes.bit_length() - 1))
    return ON_GPU._replace(most_lanes=most), -(-operation_count(program) // _STEP)


def make_plan(
    dims: Mapping[str, int],
    compiled_dims: int,
    steps: int,
    bytes_per_lane: int,
    lanes: int | None = None,
    limits: Limits = ON_CPU,
) -> SweepPlan:
    """A plan for a grid.

    - `compiled_dims`: number of leading dimensions of which each value is compiled separately.
    - `steps`: of one trajectory. `bytes_per_lane`: of its results.
    - `lanes`: trajectories of one task at most; None: chosen from the others and `limits`.
    """
    lengths = list(dims.values())
    separate, grid = lengths[:compiled_dims], lengths[compiled_dims:]
    if lanes is None:
        steps = max(steps, 1)
        power_of_two = 1 << max((limits.work // steps).bit_length() - 1, 0)
        tasks_per_value = -(-FEWEST_TASKS // math.prod(separate))
        fewest = max(limits.fewest_lanes, limits.least_work // steps)
        share = -(-math.prod(grid) // tasks_per_value)
        lanes = min(max(power_of_two, limits.fewest_lanes), limits.most_lanes, max(fewest, share))
        lanes = max(1, min(lanes, limits.bytes // max(bytes_per_lane, 1)))
    free = whole("lanes_per_task", lanes)
    chunk: list[int] = []
    for n in reversed(grid):
        boxes = -(-n // min(n, free))
        size = -(-n // boxes)  # boxes as equal as possible
        if boxes > 1 and size > 64:
            size = min(-(-size // 64) * 64, n, free)  # whole vectors of the processor
        chunk.append(size)
        free = free // size if boxes == 1 else 1
    return SweepPlan(dict(dims), (*(1 for _ in separate), *reversed(chunk)))
