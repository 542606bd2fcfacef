"""How gradients flow back through a trajectory."""

import abc
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

import lanewise
from lanewise import Layout

from ._rollout import (
    Carry,
    Loop,
    Plan,
    Saved,
    Task,
    adds_start_outside,
    counted_scan,
    reduce,
    run,
    start,
    with_start,
    with_tail,
)
from ._types import State


class Outcome(NamedTuple):
    """A trajectory as it leaves the scan: last carry, saved states with the start in front, reduced
    observables, and the largest miss of a state that was rebuilt, if it was asked for."""

    carry: Carry
    saved: Saved
    reduced: list[Any]
    round_trip_defect: jax.Array | None = None


class AbstractAdjoint(eqx.Module):
    """Base of the ways to differentiate a trajectory.

    All of them give the same derivative, that of the discrete map, to round-off; they
    differ in memory and time.
    """

    @abc.abstractmethod
    def rollout(
        self, task: Task, plan: Plan, q0: State, p0: State, layout: Layout = Layout()
    ) -> Outcome:
        """The whole trajectory, differentiable in this adjoint's way."""


def _direct_rollout(
    task: Task, plan: Plan, q0: State, p0: State, loop: Loop, layout: Layout
) -> Outcome:
    arrays, rest = eqx.partition(task, eqx.is_array)
    outside = adds_start_outside(plan)

    def outcome(task, ran, *of):
        carry, saved, tail = ran
        kept = with_tail(plan, saved, tail)
        if not outside:
            kept = with_start(kept, *of)
        return Outcome(carry, kept, reduce(task, carry))

    def forward(arrays, q0, p0):
        task = eqx.combine(arrays, rest)
        return outcome(task, run(task, plan, start(task, q0, p0), loop), q0, p0)

    result = lanewise.call(forward, arrays, q0, p0, layout=layout)
    return result._replace(saved=with_start(result.saved, q0, p0)) if outside else result


class Direct(AbstractAdjoint):
    """Forward and reverse mode straight through the scan.

    Reverse mode stores what each step needs: memory grows with num_steps; good for short runs.
    """

    def rollout(self, task, plan, q0, p0, layout=Layout()):
        return _direct_rollout(task, plan, q0, p0, counted_scan, layout)


class Checkpointed(AbstractAdjoint):
    """Reverse mode with recomputation: memory grows as √num_steps, for one more forward pass.

    - `segments`: pieces that a scan is cut into; None means about √(number of steps).

    Forward mode costs what it costs with `Direct`. Works for every method and any
    dynamics, chaotic or dissipative.
    """

    segments: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.segments is not None and (
            isinstance(self.segments, bool)
            or not isinstance(self.segments, int)
            or self.segments < 1
        ):
            raise ValueError(f"segments must be a positive integer, got {self.segments!r}.")

    def rollout(self, task, plan, q0, p0, layout=Layout()):
        return _direct_rollout(task, plan, q0, p0, self._loop, layout)

    def _loop(self, body, carry, first, stride, count):
        segments = min(self.segments or math.isqrt(count), count)
        size = count // max(segments, 1)
        if size < 2:
            return counted_scan(body, carry, first, stride, count)
        whole = size * segments

        def segment(length):
            @jax.checkpoint
            def scan(carry, k):
                return counted_scan(body, carry, k, stride, length)

            return scan

        carry, ys = counted_scan(segment(size), carry, first, stride * size, segments)
        ys = jax.tree.map(lambda y: y.reshape(whole, *y.shape[2:]), ys)
        if whole < count:
            carry, rest = segment(count - whole)(carry, first + stride * whole)
            ys = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), ys, rest)
        return carry, ys
