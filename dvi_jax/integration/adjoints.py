"""Ways to differentiate a trajectory in reverse mode."""

import abc
import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

import lanewise
from lanewise import Layout

from ..base.checks import whole
from ..base.types import State
from .loop import Loop, outcome, run, start, with_start
from .task import Outcome, Plan, Task, adds_start_outside


class AbstractAdjoint(eqx.Module):
    """Base of the ways to differentiate a trajectory.

    All give the derivative of the discrete map, to round-off; they differ in memory and time.
    """

    @abc.abstractmethod
    def rollout(
        self, task: Task, plan: Plan, q0: State, p0: State, layout: Layout = Layout()
    ) -> Outcome:
        """The whole trajectory, differentiable in this way."""


def _direct_rollout(
    task: Task, plan: Plan, q0: State, p0: State, loop: Loop, layout: Layout
) -> Outcome:
    task = dataclasses.replace(task, is_transposed=True)
    # Only arrays may be arguments of a compiled function; other parts of a task are static.
    arrays, functions = eqx.partition(task, eqx.is_array)

    def forward(arrays, q0, p0):
        task = eqx.combine(arrays, functions)
        return outcome(task, plan, run(task, plan, start(task, q0, p0), loop), q0, p0)

    result = lanewise.call(forward, arrays, q0, p0, layout=layout)
    if adds_start_outside(plan):
        return result._replace(rows=with_start(result.rows, q0, p0))
    return result


class Direct(AbstractAdjoint):
    """Forward and reverse mode of `jax.lax.scan` itself; reverse mode stores every step.

    For short runs: reverse mode stores values of each step, so that memory grows with num_steps.
    """

    def rollout(self, task, plan, q0, p0, layout=Layout()):
        return _direct_rollout(task, plan, q0, p0, lax.scan, layout)


class Checkpointed(AbstractAdjoint):
    """Reverse mode with recomputation: memory grows as √num_steps, for one more forward pass.

    - `segments`: number of pieces of a scan; None means about √(number of steps).

    Forward mode costs the same as with `Direct`. Works for every method and any dynamics.
    """

    segments: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.segments is not None:
            whole("segments", self.segments)

    def rollout(self, task, plan, q0, p0, layout=Layout()):
        return _direct_rollout(task, plan, q0, p0, self._loop, layout)

    def _loop(self, body, carry, _, count):
        # √count segments of √count steps: the memory is that of the segment starts and of the
        # steps of one segment, whose sum is then smallest.
        segments = min(self.segments or math.isqrt(count), count)
        size = count // max(segments, 1)
        if size < 2:  # nothing would be recomputed
            return lax.scan(body, carry, None, count)

        def segment(length):
            return jax.checkpoint(lambda carry, _: lax.scan(body, carry, None, length))

        carry, ys = lax.scan(segment(size), carry, None, segments)
        ys = jax.tree.map(lambda y: lax.collapse(y, 0, 2), ys)
        # A shorter last segment, without padding: a step beyond the end could fail.
        left = count - size * segments
        if left:
            carry, tail = segment(left)(carry, None)
            ys = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), ys, tail)
        return carry, ys
