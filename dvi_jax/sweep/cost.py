"""Estimates of tasks, bytes and seconds of a sweep, from one task that is computed."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

from ..base.printing import printable
from .program import SweepProgram
from .variables import Variable
from .workers import cores

# Time to write a task, at least: files are forced to the disk one after the other. The directory of
# a cluster may take longer.
SECONDS_TO_COMMIT = 0.02
LONG = 2.0  # Seconds of a task above which it is not measured a third time


@printable
@dataclasses.dataclass(frozen=True)
class SweepCost:
    """Estimated cost of a sweep.

    - `dims`: of the grid. `lanes`: trajectories. `steps`: of all trajectories together.
    - `tasks`, `lanes_per_task`: units of work, whose trajectories are computed and stored together.
    - `bytes`: of the results, before compression. `files`: of a store.
    - `seconds_per_step`: of one trajectory, on one core or GPU, measured (the mean over methods).
    - `compilation`: seconds until the first task was done, less the time of computing it.
    - `seconds_per_task`: of the one measured. `cores`: that this process would use.
    """

    dims: Mapping[str, int]
    lanes: int
    steps: int
    tasks: int
    lanes_per_task: int
    bytes: int
    files: int
    variables: int
    seconds_per_step: float
    seconds_per_task: float
    compilation: float
    cores: int

    def seconds(self, workers: int | None = None) -> float:
        """Estimated time on this number of cores or GPUs; None: those of this machine.

        The time of ⌈tasks/workers⌉ tasks, one after the other, and of one compilation.
        """
        workers = workers or self.cores
        task_seconds = max(self.steps * self.seconds_per_step / self.tasks, SECONDS_TO_COMMIT)
        return self.compilation + -(-self.tasks // workers) * task_seconds

    def scaled(self, lanes: float) -> "SweepCost":
        """The cost of another number of trajectories, in tasks of the same size."""
        factor = lanes / self.lanes
        tasks = max(1, -(-int(lanes) // self.lanes_per_task))
        numbers = {"steps": int(self.steps * factor), "bytes": int(self.bytes * factor)}
        numbers |= {"lanes": int(lanes), "tasks": tasks, "files": tasks * (self.variables + 1)}
        return dataclasses.replace(self, dims={}, **numbers)

    def table(
        self, lanes: Sequence[float] = (1e6, 1e9, 1e12), workers: Sequence[int] = (1, 64, 4096)
    ) -> str:
        """Time and disk space for other numbers of trajectories and workers, as Markdown."""
        cores = ["1 worker" if n == 1 else f"{n} workers" for n in workers]
        lines = [["trajectories", "tasks", "results", *cores], ["---"] * (3 + len(cores))]
        for cost in (self, *(self.scaled(n) for n in lanes if n != self.lanes)):
            times = (span(cost.seconds(n)) for n in workers)
            lines.append([f"{cost.lanes:.3g}", f"{cost.tasks:.3g}", size(cost.bytes), *times])
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)

    def __str__(self) -> str:
        grid = " × ".join(f"{name} {n}" for name, n in self.dims.items())
        return (
            f"{grid or 'trajectories'}: {self.lanes:.6g} trajectories, {self.steps:.3g} steps\n"
            f"{self.tasks} tasks of {self.lanes_per_task} trajectories, "
            f"{span(self.seconds_per_task)} each\n"
            f"{size(self.bytes)} of results in {self.files} files\n"
            f"{self.seconds_per_step * 1e9:.3g} ns a step; compilation "
            f"{span(self.compilation)}; in all {span(self.seconds())} on {self.cores} cores"
        )


def cost(program: SweepProgram, variables: Mapping[str, Variable]) -> SweepCost:
    """Compute the first task of each method and number of steps twice or more, and extrapolate."""
    plan = program.plan
    per_value = plan.num_tasks // math.prod(plan.counts[: program.sweep.compiled_dims])
    firsts, repeats, steps = [], [], 0
    for number in range(0, plan.num_tasks, per_value):
        task = plan.task(number)
        firsts.append(_seconds(program, task))
        repeats.append(_seconds(program, task))
        if repeats[-1] < LONG:
            repeats[-1] = min(repeats[-1], _seconds(program, task))
        steps += program.steps(task)
    return SweepCost(
        dims=dict(plan.dims),
        lanes=plan.lanes,
        steps=plan.lanes // len(repeats) * steps,
        tasks=plan.num_tasks,
        lanes_per_task=plan.lanes_per_task,
        bytes=plan.lanes * sum(v.bytes for v in variables.values()),
        files=plan.num_tasks * (len(variables) + 1),
        variables=len(variables),
        seconds_per_step=sum(repeats) / (plan.lanes_per_task * steps),
        seconds_per_task=sum(repeats) / len(repeats),
        compilation=max(0.0, sum(firsts) - sum(repeats)),
        cores=cores(program.devices),
    )


def _seconds(program: SweepProgram, task: Any) -> float:
    start = time.perf_counter()
    program(task, program.devices[0])
    return time.perf_counter() - start


def size(number: float) -> str:
    """A number of bytes in words."""
    for unit in ("B", "KiB", "MiB", "GiB", "TiB"):
        if number < 1024:
            return f"{number:.3g} {unit}"
        number /= 1024
    return f"{number:.3g} PiB"


# Units of time: name, seconds, and the least number of them that is written in this unit.
_UNITS = (("years", 365.25 * 86400, 2), ("days", 86400, 2), ("h", 3600, 1.5), ("min", 60, 1.5))


def span(seconds: float) -> str:
    """A time in words."""
    for unit, length, fewest in _UNITS:
        if seconds >= fewest * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.2g} s"
