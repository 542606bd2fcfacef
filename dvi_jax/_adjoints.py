"""How gradients flow back through a trajectory."""

import abc
import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ._arithmetic import FloatingPoint
from ._compat import is_traced
from ._rollout import (
    Carry,
    Loop,
    Plan,
    Saved,
    StepTaken,
    Task,
    counted_scan,
    piece_length,
    reduce,
    run,
    start,
    take_step,
    with_tail,
)
from ._segments import can_trust, largest_divisor, run_in_segments
from ._step import Equations
from ._types import State
from .engine.lanes import in_arrays
from .engine.newton import Known, RootSolver, Trusted
from .engine.tiles import Layout, lanewise
from .engine.together import on_any_lane
from .methods import TypeII

BACKWARD_ITERATIONS = 3
"""Of Newton's method in an inverse step, on trust."""

LOOKS = 16
"""Steps back between two looks at how large the components are."""


class Outcome(NamedTuple):
    """A trajectory as it leaves the scan: last carry, saved states, reduced observables."""

    carry: Carry
    saved: Saved
    reduced: list[Any]


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

    def outcome(task, ran):
        carry, saved, tail = ran
        return Outcome(carry, with_tail(plan, saved, tail), reduce(task, carry))

    def forward(arrays, q0, p0):
        task = eqx.combine(arrays, rest)
        return outcome(task, run(task, plan, start(task, q0, p0), loop))

    def on_trust(arrays, q0, p0):
        task = eqx.combine(arrays, rest)
        begin = start(task, q0, p0)
        return outcome(task, run_in_segments(task, plan, begin, one_row=layout.in_kernel))

    return lanewise(
        on_trust if can_trust(task) else forward, arrays, q0, p0,
        layout=layout, steps=plan.num_steps, entries=2 * q0.size, plain=forward,
    )  # fmt: skip


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


class Reversible(AbstractAdjoint):
    r"""Reverse mode that rebuilds the states by the inverse step instead of storing them.

    Going backwards from λ_{k+1}, the state before the step is Φ_h⁻¹(q_{k+1}, p_{k+1}) and

        λ_k = (∂Φ_h/∂(q_k, p_k))ᵀ λ_{k+1},     dL/dθ += (∂Φ_h/∂θ)ᵀ λ_{k+1}.

    Memory does not grow with num_steps but for one state about every `checkpoint_every` steps, from
    which the rebuilding starts afresh: it amplifies round-off on chaotic or dissipative arcs.
    Where a rebuilt component misses the stored one by more than `max_defect` of its own size
    (None means 1e-6 in float64 and 1e-3 in float32; a component below round-off of the largest
    one is not looked at), or an inverse step has no solution, the lane goes from that checkpoint
    once more, its states stored: slower, and right for any dynamics. The gradient of a trajectory
    that has failed is NaN.

    Forward mode (`jvp`) and higher derivatives go through the scan as with `Direct`. A method
    without an inverse (`RungeKutta4`), a `Variational` lattice, a run with a `Stop`, and a system
    or observable that *closes over* a value being differentiated (better: hand it over in args),
    are differentiated as by `Checkpointed`.

    **Raises** `ValueError` for settings that are not positive.

    **Source** our own combination; reversible backpropagation: Maclaurin, Duvenaud & Adams 2015.
    """

    checkpoint_every: int = eqx.field(static=True, default=100)
    max_defect: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        every = self.checkpoint_every
        if isinstance(every, bool) or not isinstance(every, int) or every < 1:
            raise ValueError(f"checkpoint_every must be a positive integer, got {every!r}.")
        if self.max_defect is not None and not self.max_defect > 0:
            raise ValueError(f"max_defect must be positive, got {self.max_defect!r}.")

    def rollout(self, task, plan, q0, p0, layout=Layout()):
        if not task.method.is_invertible or task.lattice.has_memory or task.stop is not None:
            return Checkpointed().rollout(task, plan, q0, p0, layout)
        if _closes_over_traced(task, q0, p0):
            return Checkpointed().rollout(task, plan, q0, p0, layout)
        theta, others = eqx.partition(task, eqx.is_inexact_array)
        # Whole numbers and truth values may be traced as well: inputs without a derivative.
        whole, fixed = eqx.partition(others, eqx.is_array)
        size, steps = 2 * q0.size, plan.num_steps

        @jax.jit  # so that its uses below share one trace, and one trace of its derivative
        def forward(inputs, whole):
            theta, q0, p0 = inputs
            task = eqx.combine(theta, whole, fixed)
            return finish(
                task, run(task, plan, start(task, q0, p0), counted_scan, self._inner_loop)
            )

        def on_trust(inputs, whole):
            theta, q0, p0 = inputs
            task = eqx.combine(theta, whole, fixed)
            begin = start(task, q0, p0)
            every, one_row = self.checkpoint_every, layout.in_kernel
            return finish(task, run_in_segments(task, plan, begin, every, one_row))

        def finish(task, ran):
            carry, saved, tail = ran
            kept, counts = eqx.partition(with_tail(plan, saved, tail), eqx.is_inexact_array)
            smooth = _Smooth(carry.q, carry.p, kept, reduce(task, carry))
            return smooth, (carry, saved, tail, counts)

        fast = on_trust if can_trust(task) else forward

        @jax.custom_jvp
        def trajectory(inputs, whole):
            return lanewise(
                fast, inputs, whole, layout=layout, steps=steps, entries=size, plain=forward
            )

        @trajectory.defjvp
        def _(primals, tangents):
            # The tangent is L·dx with L the derivative. Written as the solution (u, v) of the
            # linear system u = dx, v − L u = 0, it may be given a transpose of its own: forward
            # mode runs L along the scan, reverse mode runs Lᵀ on rebuilt states.
            (inputs, whole), (change, _) = primals, tangents
            smooth, trace = trajectory(inputs, whole)

            def derivative(inputs, whole, u):
                return jax.jvp(lambda x: forward(x, whole)[0], (inputs,), (u,))[1]

            def quick(inputs, whole, u):
                return jax.jvp(lambda x: fast(x, whole)[0], (inputs,), (u,))[1]

            def push(u):
                return lanewise(
                    quick, inputs, whole, u,
                    layout=layout, steps=steps, entries=2 * size, plain=derivative,
                )  # fmt: skip

            # As one vector: the transposition of a linear solve wants all parts of its right side
            # to be linear in the tangents, also those that are zero.
            rhs, unravel = ravel_pytree((change, jax.tree.map(jnp.zeros_like, smooth)))

            def flat(u, v):
                return ravel_pytree((u, v))[0]

            def matvec(x):
                u, v = unravel(x)
                return flat(u, jax.tree.map(jnp.subtract, v, derivative(inputs, whole, u)))

            def solve(_, b):
                u, v = unravel(b)
                return flat(u, jax.tree.map(jnp.add, v, push(u)))

            def transpose_solve(_, b):
                u, v = unravel(b)
                back = lanewise(
                    lambda whole, *x: _pull_back(
                        self, eqx.combine(whole, fixed), plan, not layout.in_kernel, *x
                    ),
                    whole, inputs, trace, v, layout=layout, steps=steps, entries=2 * size,
                )  # fmt: skip
                return flat(jax.tree.map(jnp.add, u, back), v)

            solver: Any = lax.custom_linear_solve  # its annotations differ between versions
            _, moved = unravel(solver(matvec, rhs, solve, transpose_solve))
            return (smooth, trace), (moved, jax.tree.map(_no_tangent, trace))

        smooth, (carry, _, _, counts) = trajectory((theta, q0, p0), whole)
        saved = eqx.combine(smooth.saved, counts)
        return Outcome(carry._replace(q=smooth.q, p=smooth.p), saved, smooth.reduced)

    def _inner_loop(self, body, state, first, stride, count):
        """A scan over the steps of a block that keeps the state every `checkpoint_every` steps."""
        size = piece_length(count, self.checkpoint_every)
        segments = (count - 1) // size  # the end of the block is kept anyway
        if segments == 0:
            return counted_scan(body, state, first, stride, count)

        def segment(state, k):
            state, _ = counted_scan(body, state, k, stride, size)
            return state, (state[0].q, state[0].p)

        state, ends = counted_scan(segment, state, first, stride * size, segments)
        whole = segments * size
        state, _ = counted_scan(body, state, first + stride * whole, stride, count - whole)
        return state, ends


class _Smooth(NamedTuple):
    """The outputs of a trajectory that have derivatives."""

    q: State
    p: State
    saved: Saved
    reduced: list[Any]


def _no_tangent(x):
    if jnp.issubdtype(x.dtype, jnp.inexact):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)


def _pull_back(
    settings: Reversible, fixed, plan: Plan, may_store: bool, inputs, trace, cotangent: _Smooth
):
    """Lᵀ·cotangent: the reverse pass of `Reversible`, from the end of a trajectory to its start.

    Unless it `may_store` the states of a piece, the gradient is NaN where rebuilding fails.
    """
    theta, q_start, p_start = inputs
    carry, saved, tail, _ = trace
    task: Task = eqx.combine(theta, fixed)
    _, reductions = task.observables()
    solves = not (
        task.method._inverse_needs_no_solve(
            task.equations, task.interval(jnp.asarray(0, jnp.int32)), q_start
        )
    )
    newton = task.equations.newton
    assert isinstance(newton, RootSolver)
    on_trust = Trusted(newton, jnp.asarray(BACKWARD_ITERATIONS, jnp.int32))

    def solved_by(task: Task, options) -> Equations:
        return dataclasses.replace(task.equations, newton=options)

    def local_step(theta, q0, p0, k, p1):
        task: Task = eqx.combine(theta, fixed)
        alone, reductions = task.observables()
        interval = task.interval(k)
        if isinstance(task.method, TypeII) and isinstance(task.arithmetic, FloatingPoint):
            # What (13) is to be solved for is where we come from.
            options = Known(p1.ravel(), newton)
        else:
            options = newton
        q1, p1, _ = task.method.step(solved_by(task, options), interval, q0, p0)
        taken = StepTaken(interval.t0, interval.t1, q0, p0, q1, p1)
        values = [taken.value(f, task.args) for f in alone]
        reduced = [taken.number(task.bound(r.function), task.args) for r in reductions]
        return (q1, p1, interval.t1), eqx.filter(values, eqx.is_inexact_array), reduced

    def pull_through(state, k, before, is_last, at_save):
        """The cotangents before step k, from the states before and after it."""
        _, p1, grad, (cq, cp) = state
        ((_, _, t1), _, values), pull = jax.vjp(
            lambda theta, q, p: local_step(theta, q, p, k, p1), theta, *before
        )
        at_end = jax.tree.map(lambda c: jnp.where(is_last, c, jnp.zeros_like(c)), at_save)
        ct, seeds = jnp.zeros_like(t1), []
        for r, memory, c, value in zip(
            reductions, carry.reductions, cotangent.reduced, values, strict=True
        ):
            of_t, of_value = r.pull(memory, c, k, t1, value)
            ct = ct + of_t
            seeds.append(of_value.astype(value.dtype))
        of_theta, cq, cp = pull(((cq, cp, ct), at_end, seeds))
        return *before, jax.tree.map(jnp.add, grad, of_theta), (cq, cp)

    def undo_steps(known_start, end, first, count, last, at_save, grad, cot):
        """`count` steps back from the exact state `end`, checked against `known_start`.

        By inverse steps on trust; for lanes that then miss the start, through the steps again from
        there, their states stored.
        """
        group = largest_divisor(count, LOOKS)

        def undo(state, k):
            state, excess = state
            q, p, info = task.method.inverse(
                solved_by(task, on_trust), task.interval(k), state[0], state[1]
            )
            state = pull_through(state, k, (q, p), k == last, at_save)
            return (state, jnp.maximum(excess, info.residual) if solves else None), None

        def undo_group(state, k):
            state, sizes = state
            state, _ = counted_scan(undo, state, k, 1, group, reverse=True)
            return (state, _largest(sizes, state[0][:2])), None

        worst = jnp.full((), -jnp.inf, end[0].dtype) if solves else None
        begin = (((*end, grad, cot), worst), _largest(end, end))
        (((q, p, *out), excess), sizes), _ = counted_scan(
            undo_group, begin, first, group, count // group, reverse=True
        )
        allowed = settings.max_defect or (1e-6 if q.dtype.itemsize >= 8 else 1e-3)
        fine = _is_near(q, known_start[0], sizes[0], allowed)
        fine = fine & _is_near(p, known_start[1], sizes[1], allowed)
        if solves:
            fine = fine & (excess <= 0)

        def stored(known_start, end, first, last, at_save, grad, cot):
            def forward(state, k):
                q, p, _ = task.method.step(task.equations, task.interval(k), *state)
                return (q, p), state

            _, states = counted_scan(forward, known_start, first, 1, count)

            def back(state, x):
                k, state = state
                return (k - 1, pull_through(state, k, x, k == last, at_save)), None

            start = (first + count - 1, (*end, grad, cot))
            (_, (_, _, grad, cot)), _ = lax.scan(back, start, states, reverse=True)
            return grad, cot

        def mend(out):
            again = in_arrays(stored)(known_start, end, first, last, at_save, grad, cot)
            return jax.tree.map(lambda a, b: jnp.where(missing, a, b), again, out)

        # Where the trajectory itself has failed there is nothing to mend: NaN, not a number.
        missing = ~fine & _all_finite(known_start) & _all_finite(end)
        if not may_store:
            return jax.tree.map(lambda x: jnp.where(missing, jnp.nan, x), tuple(out))
        return lax.cond(on_any_lane(missing), mend, lambda out: out, tuple(out))

    def undo_block(known_start, saved: Saved, first, count, at_save, grad, cot):
        last = first + count - 1
        end = (saved.q, saved.p)
        cot = (cot[0] + at_save.q, cot[1] + at_save.p)
        _, pull_times = jax.vjp(lambda theta: _end_of(eqx.combine(theta, fixed), last), theta)
        grad = jax.tree.map(jnp.add, grad, *pull_times((at_save.t, at_save.h)))
        at_save = at_save.observed
        segments = 0 if saved.inner is None else len(saved.inner[0])
        if segments == 0:
            return undo_steps(known_start, end, first, count, last, at_save, grad, cot)
        inner, size = saved.inner, piece_length(count, settings.checkpoint_every)
        rest = count - segments * size
        if rest == size:  # the last piece goes with the others: it need not be compiled twice
            ends = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), inner, end)
        else:
            ends, k = inner, first + segments * size
            newest = jax.tree.map(lambda x: x[-1], inner)
            grad, cot = undo_steps(newest, end, k, rest, last, at_save, grad, cot)

        def segment(state, x):
            k, grad, cot = state
            start, end = x
            return (k - size, *undo_steps(start, end, k, size, last, at_save, grad, cot)), None

        starts = jax.tree.map(
            lambda a, b: jnp.concatenate([a[None], b])[: len(ends[0])], known_start, inner
        )
        k = first + (len(ends[0]) - 1) * size
        (_, grad, cot), _ = lax.scan(segment, (k, grad, cot), (starts, ends), reverse=True)
        return grad, cot

    start_state = (q_start, p_start)
    ends = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start_state, (saved.q, saved.p))
    grad = jax.tree.map(jnp.zeros_like, theta)
    cot = (cotangent.q, cotangent.p)
    rows = cotangent.saved
    if tail is not None:
        at_save = jax.tree.map(lambda x: _last_row(x, plan.save_tail), rows)
        newest = jax.tree.map(lambda x: x[-1], ends)
        k = jnp.asarray(plan.num_blocks * plan.block, jnp.int32)
        grad, cot = undo_block(newest, tail, k, plan.tail, at_save, grad, cot)

    def block(state, x):
        k, grad, cot = state
        known_start, saved, at_save = x
        k = k - plan.block
        return (k, *undo_block(known_start, saved, k, plan.block, at_save, grad, cot)), None

    starts = jax.tree.map(lambda x: x[:-1], ends)
    rows = jax.tree.map(lambda x: x[: plan.num_blocks], rows)
    k = jnp.asarray(plan.num_blocks * plan.block, jnp.int32)
    (_, grad, cot), _ = lax.scan(block, (k, grad, cot), (starts, saved, rows), reverse=True)
    return grad, *cot


def _end_of(task: Task, k: Array) -> tuple[Array, Array]:
    """Time and step size at the end of step k."""
    interval = task.interval(k)
    return interval.t1, interval.h


def _last_row(x, is_there: bool):
    return x[-1] if is_there else jnp.zeros(x.shape[1:], x.dtype)


def _largest(sizes, state):
    return jax.tree.map(lambda s, x: jnp.maximum(jnp.abs(s), jnp.abs(x)), sizes, state)


def _is_near(a, b, size, allowed):
    """Whether a is b to `allowed` of each component's size, or to round-off of the largest."""
    round_off = 64 * jnp.finfo(a.dtype).eps * jnp.max(size, initial=0.0)
    return jnp.all(jnp.abs(a - b) <= allowed * size + round_off)


def _closes_over_traced(task: Task, q0: State, p0: State) -> bool:
    """Whether a function of the task holds a value that is being differentiated or batched.

    Such a value is no input of the trajectory, so that a derivative written for its inputs would
    miss it.
    """
    arrays, rest = eqx.partition(task, eqx.is_array)

    def one_step(arrays, q0, p0):
        task = eqx.combine(arrays, rest)
        alone, _ = task.observables()
        carry, _, taken = take_step(task, start(task, q0, p0), jnp.asarray(0, jnp.int32))
        return carry, [taken.value(f, task.args) for f in alone]

    return any(is_traced(c) for c in jax.make_jaxpr(one_step)(arrays, q0, p0).consts)


def _all_finite(state) -> Array:
    return jnp.all(jnp.isfinite(state[0])) & jnp.all(jnp.isfinite(state[1]))
