"""Gradients that flow back along states which are rebuilt, not stored."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

import lanewise
from lanewise import Layout
from lanewise.jaxapi import is_traced, linear_map, manual_axes

from ._adjoints import AbstractAdjoint, Checkpointed, Outcome
from ._arithmetic import FloatingPoint
from ._results import RESULTS
from ._rollout import (
    Plan,
    Saved,
    StepTaken,
    Task,
    adds_start_outside,
    counted_scan,
    piece_length,
    reduce,
    run,
    start,
    with_start,
    with_tail,
)
from ._step import Equations
from ._types import State
from .engine.newton import Known, RootSolver
from .methods import TypeII

LOOKS = 16
"""Steps back between two looks at how large the components are."""


class Reversible(AbstractAdjoint):
    r"""Reverse mode that rebuilds the states by the inverse step instead of storing them.

    Going backwards from λ_{k+1}, the state before the step is Φ_h⁻¹(q_{k+1}, p_{k+1}) and

        λ_k = (∂Φ_h/∂(q_k, p_k))ᵀ λ_{k+1},     dL/dθ += (∂Φ_h/∂θ)ᵀ λ_{k+1}.

    Memory does not grow with num_steps but for one state about every `checkpoint_every` steps, from
    which the rebuilding starts afresh: it amplifies round-off on chaotic or dissipative arcs.
    Where a rebuilt component misses the stored one by more than `max_defect` of its own size
    (None means 1e-6 in float64 and 1e-3 in float32; where that is round-off of the largest
    component, by more than this), or an inverse step has no solution, the lane goes from that
    checkpoint once more, its states stored: slower, and right for any dynamics. With
    `report_defect` the solution gives the largest of these misses, in
    ``stats["round_trip_defect"]`` (relative, ∞ where an inverse step has no solution), for as much
    time as the states take to be rebuilt.

    The gradient of a trajectory that has failed is NaN. That of one that a loss does not look at is
    0, failed or not, so that it spoils no parameter that lanes share: a loss takes
    ``jnp.where(ok, q, 0.0)``, ok of ``sol.result == dvi.RESULTS.successful``, before it computes.

    Forward mode (`jvp`) and higher derivatives go through the scan as with `Direct`. A method
    without an inverse (`RungeKutta4`), a `Variational` lattice, a run with a `Stop`, with deviation
    vectors (`LyapunovSpectrum` and its like) or with `Running` values, and a system or observable
    that *closes over* a value being differentiated (better: hand it over in args), are
    differentiated as by `Checkpointed`.

    **Raises** `ValueError` for settings that are not positive, and for `report_defect` where no
    states are rebuilt.

    **Source** our own combination; reversible backpropagation: Maclaurin, Duvenaud & Adams 2015.
    """

    checkpoint_every: int = eqx.field(static=True, default=100)
    max_defect: float | None = eqx.field(static=True, default=None)
    report_defect: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        every = self.checkpoint_every
        if isinstance(every, bool) or not isinstance(every, int) or every < 1:
            raise ValueError(f"checkpoint_every must be a positive integer, got {every!r}.")
        if self.max_defect is not None and not self.max_defect > 0:
            raise ValueError(f"max_defect must be positive, got {self.max_defect!r}.")
        if not isinstance(self.report_defect, bool):
            raise TypeError(f"report_defect must be True or False, got {self.report_defect!r}.")

    def allowed(self, dtype) -> float:
        """The largest miss that is let pass."""
        return self.max_defect or (1e-6 if jnp.dtype(dtype).itemsize >= 8 else 1e-3)

    def rollout(self, task, plan, q0, p0, layout=Layout()):
        why = _why_not(task)
        if why:
            return self._otherwise(why, task, plan, q0, p0, layout)
        outside = adds_start_outside(plan)
        theta, others = eqx.partition(task, eqx.is_inexact_array)
        # Whole numbers and truth values may be traced as well: inputs without a derivative.
        whole, fixed = eqx.partition(others, eqx.is_array)

        @jax.jit  # so that its uses below share one trace, and one trace of its derivative
        def forward(inputs, whole):
            theta, q0, p0 = inputs
            task = eqx.combine(theta, whole, fixed)
            ran = run(task, plan, start(task, q0, p0), counted_scan, self._inner_loop)
            return finish(task, ran, q0, p0)

        def finish(task, ran, *of):
            carry, saved, tail = ran
            rows = with_tail(plan, saved, tail)
            if not outside:
                rows = with_start(rows, *of)
            kept, counts = eqx.partition(rows, eqx.is_inexact_array)
            smooth = _Smooth(carry.q, carry.p, kept, reduce(task, carry))
            return smooth, (carry, saved, tail, counts)

        if manual_axes(*jax.tree.leaves((theta, whole, q0, p0))):
            why = "the run is inside of jax.shard_map with check_vma=True"
            return self._otherwise(why, task, plan, q0, p0, layout)

        # A value that is being differentiated or batched and that a function closes over is no
        # input of the trajectory: a derivative written for its inputs would miss it.
        if any(is_traced(c) for c in jax.make_jaxpr(forward)((theta, q0, p0), whole).consts):
            why = "a function of the run closes over a traced value (hand it over in args)"
            return self._otherwise(why, task, plan, q0, p0, layout)

        @jax.custom_jvp
        def trajectory(inputs, whole):
            return lanewise.call(forward, inputs, whole, layout=layout)

        @functools.partial(trajectory.defjvp, symbolic_zeros=True)
        def _(primals, tangents):
            # The tangent is L·dx with L the derivative: forward mode runs L along the scan, reverse
            # mode runs Lᵀ on rebuilt states.
            (inputs, whole), (change, _) = primals, tangents
            smooth, trace = trajectory(inputs, whole)
            # By inputs that do not move nothing is differentiated.
            moves = jax.tree.map(lambda x: not isinstance(x, SymbolicZero), change)
            moving, still = eqx.partition(inputs, moves)
            change = eqx.filter(change, moves)
            # No more than that: what nothing reads need not be computed on the way.
            carry, saved, tail, _ = trace
            known = carry.reductions, _states_of(saved), None if tail is None else _states_of(tail)

            def along(moving, still, whole, u):
                def of(moving):
                    return forward(eqx.combine(moving, still), whole)[0]

                return jax.jvp(of, (moving,), (u,))[1]

            def definition(residuals, u):
                moving, still, whole, _ = residuals
                return along(moving, still, whole, u)

            def push(residuals, u):
                moving, still, whole, _ = residuals
                return lanewise.call(along, moving, still, whole, u, layout=layout)

            def back(moving, still, whole, known, v):
                theta, q0, p0 = eqx.combine(moving, still)
                theta, others = eqx.partition(theta, moves[0])
                rest = eqx.combine(others, whole, fixed)
                return eqx.filter(_pull_back(self, rest, plan, (theta, q0, p0), known, v), moves)

            def pull(residuals, v):
                out = lanewise.call(back, *residuals, v, layout=layout)
                # From a lane that nothing asks for nothing flows back, though it has failed.
                asked = jnp.any(jnp.stack([jnp.any(x != 0) for x in jax.tree.leaves(v)]))
                return jax.tree.map(lambda x: jnp.where(asked, x, 0), out)

            residuals = moving, still, whole, known
            moved = linear_map(push, pull, definition, residuals, change)
            return (smooth, trace), (moved, jax.tree.map(_no_tangent, trace))

        smooth, (carry, saved, tail, counts) = trajectory((theta, q0, p0), whole)
        rebuilt = None
        if self.report_defect:

            def defect(theta, whole, *of):
                task = eqx.combine(theta, whole, fixed)
                return _round_trip_defect(self, task, plan, *of)

            rebuilt = lanewise.call(
                defect, *lax.stop_gradient((theta, whole, (q0, p0), saved, tail)), layout=layout
            )
        kept = eqx.combine(smooth.saved, counts)
        if outside:
            kept = with_start(kept, q0, p0)
        return Outcome(carry._replace(q=smooth.q, p=smooth.p), kept, smooth.reduced, rebuilt)

    def _otherwise(self, why: str, task, plan, q0, p0, layout) -> Outcome:
        """The run without states that are rebuilt, for the reason given."""
        if self.report_defect:
            raise ValueError(
                f"report_defect=True asks how well states are rebuilt, but none are: {why}. "
                "Leave it out: gradients go by dvi.Checkpointed() here."
            )
        return Checkpointed().rollout(task, plan, q0, p0, layout)

    def _inner_loop(self, body, state, first, stride, count):
        """A scan over the steps of a block that keeps the state every `checkpoint_every` steps."""
        size = piece_length(count, self.checkpoint_every)
        segments = (count - 1) // size  # the end of the block is kept anyway
        if segments == 0:
            return counted_scan(body, state, first, stride, count)

        def segment(state, k):
            state, _ = counted_scan(body, state, k, stride, size)
            return state, (state[0].q, state[0].p)

        if count % size == 0:  # one loop to compile instead of two
            state, ends = counted_scan(segment, state, first, stride * size, segments + 1)
            return state, jax.tree.map(lambda x: x[:-1], ends)
        state, ends = counted_scan(segment, state, first, stride * size, segments)
        whole = segments * size
        state, _ = counted_scan(body, state, first + stride * whole, stride, count - whole)
        return state, ends


def _states_of(saved: Saved) -> Saved:
    """What the reverse pass reads of what was saved."""
    return saved._replace(t=None, h=None, observed=[])


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


class _Pieces(NamedTuple):
    """Pieces of `size` steps each between two states that are known, in order from step `first`."""

    starts: tuple[State, State]
    ends: tuple[State, State]
    first: Array
    size: int

    def over(self, step: Callable, state: Any, reverse: bool = False) -> Any:
        """``state = step(state, k, start, end)`` for each piece, from step number k."""
        count = len(self.starts[0])
        if count == 1:
            return step(state, self.first, _row(self.starts, 0), _row(self.ends, 0))
        k, stride = self.first, self.size
        if reverse:
            k, stride = k + (count - 1) * stride, -stride

        def one(carry, x):
            k, state = carry
            return (k + stride, step(state, k, *x)), None

        (_, state), _ = lax.scan(one, (k, state), (self.starts, self.ends), reverse=reverse)
        return state


def _row(states: tuple[State, State], i: int) -> tuple[State, State]:
    return states[0][i], states[1][i]


def _pieces(known_start, saved: Saved, first, count: int, every: int) -> list[_Pieces]:
    """The `count` steps to a save point, cut at the states kept on the way, the last piece with the
    others where it is as long: what is done to a piece is compiled for each length."""
    inner = saved.inner
    kept = 0 if inner is None else len(inner[0])
    size = piece_length(count, every) if kept else count
    parts = [known_start[0][None], known_start[1][None]], inner, [saved.q[None], saved.p[None]]
    known = [jnp.concatenate(x) for x in zip(*(p for p in parts if p is not None), strict=True)]
    starts, ends = (known[0][:-1], known[1][:-1]), (known[0][1:], known[1][1:])
    rest = count - kept * size
    if rest == size:
        return [_Pieces(starts, ends, first, size)]

    def some(which: slice, first, size):
        start, end = ((q[which], p[which]) for q, p in (starts, ends))
        return _Pieces(start, end, first, size)

    return [some(slice(-1), first, size), some(slice(-1, None), first + kept * size, rest)]


def _solved_by(task: Task, options) -> Equations:
    return dataclasses.replace(task.equations, newton=options)


def _rebuilt(
    task: Task,
    end,
    first,
    count: int,
    known_start,
    allowed: float,
    along: Callable | None = None,
    sums: Any = None,
):
    """The states from `end` back over `count` steps, by inverse steps.

    Given are the `sums` that ``along(k, after, before, sums)`` has made of each step on the way, by
    how much of its size each component misses `known_start`, and whether all solves went well.
    """
    group = largest_divisor(count, LOOKS)

    def undo(state, k):
        after, sums, solved = state
        q, p, info = task.method.inverse(task.equations, task.interval(k), *after)
        if along is not None:
            sums = along(k, after, (q, p), sums)
        return ((q, p), sums, solved & (info.result == RESULTS.successful)), None

    def undo_group(state, k):
        state, sizes = state
        state, _ = counted_scan(undo, state, k, 1, group, reverse=True)
        return (state, _largest(sizes, state[0])), None

    begin = ((end, sums, jnp.asarray(True)), _largest(end, end))
    ((state, sums, solved), sizes), _ = counted_scan(
        undo_group, begin, first, group, count // group, reverse=True
    )
    misses = [
        _miss(a, b, size, allowed).ravel()
        for a, b, size in zip(state, known_start, sizes, strict=True)
    ]
    return sums, jnp.concatenate(misses), solved


def _round_trip_defect(
    settings: Reversible, task: Task, plan: Plan, start_state, saved: Saved, tail
) -> Array:
    """The largest miss of a rebuilt state at a checkpoint; ∞ where an inverse step went wrong."""
    allowed = settings.allowed(start_state[0].dtype)

    def of_piece(size):
        def of(worst, k, start, end):
            _, misses, solved = _rebuilt(task, end, k, size, start, allowed)
            return jnp.maximum(worst, jnp.where(solved, jnp.max(misses, initial=0.0), jnp.inf))

        return of

    def of_block(worst, start, saved, first, count):
        for pieces in _pieces(start, saved, first, count, settings.checkpoint_every):
            worst = pieces.over(of_piece(pieces.size), worst)
        return worst

    def block(carry, saved):
        k, start, worst = carry
        worst = of_block(worst, start, saved, k, plan.block)
        return (k + plan.block, (saved.q, saved.p), worst), None

    begin = (jnp.asarray(0, jnp.int32), start_state, jnp.zeros((), start_state[0].dtype))
    (k, start, worst), _ = lax.scan(block, begin, saved)
    return worst if tail is None else of_block(worst, start, tail, k, plan.tail)


def _pull_back(settings: Reversible, fixed, plan: Plan, inputs, known, cotangent: _Smooth):
    """Lᵀ·cotangent: the reverse pass of `Reversible`, from the end of a trajectory to its start."""
    theta, q_start, p_start = inputs
    memories, saved, tail = known
    task: Task = eqx.combine(theta, fixed)
    _, reductions = task.observables()
    newton = task.equations.newton
    assert isinstance(newton, RootSolver)

    def local_step(theta, q0, p0, k, p1):
        task: Task = eqx.combine(theta, fixed)
        alone, reductions = task.observables()
        interval = task.interval(k)
        if isinstance(task.method, TypeII) and isinstance(task.arithmetic, FloatingPoint):
            # What (13) is to be solved for is where we come from.
            options = Known(p1.ravel(), newton)
        else:
            options = newton
        q1, p1, _ = task.method.step(_solved_by(task, options), interval, q0, p0)
        taken = StepTaken(interval.t0, interval.t1, q0, p0, q1, p1)
        values = [taken.value(f, task.args) for f in alone]
        reduced = [taken.number(task.bound(r.function), task.args) for r in reductions]
        return (q1, p1, interval.t1), eqx.filter(values, eqx.is_inexact_array), reduced

    def pull_through(k, after, before, sums, is_last, at_save):
        """The cotangents before step k, from the states before and after it."""
        p1, (grad, (cq, cp)) = after[1], sums
        ((_, _, t1), _, values), pull = jax.vjp(
            lambda theta, q, p: local_step(theta, q, p, k, p1), theta, *before
        )
        at_end = jax.tree.map(lambda c: jnp.where(is_last, c, jnp.zeros_like(c)), at_save)
        ct, seeds = jnp.zeros_like(t1), []
        for r, memory, c, value in zip(
            reductions, memories, cotangent.reduced, values, strict=True
        ):
            of_t, of_value = r.pull(memory, c, k, t1, value)
            ct = ct + of_t
            seeds.append(of_value.astype(value.dtype))
        of_theta, cq, cp = pull(((cq, cp, ct), at_end, seeds))
        return jax.tree.map(jnp.add, grad, of_theta), (cq, cp)

    def undo_steps(known_start, end, first, count, last, at_save, grad, cot):
        """`count` steps back from the exact state `end`, checked against `known_start`.

        By inverse steps; where a trajectory then misses the start, through the steps again from
        there, their states stored.
        """

        def along(k, after, before, sums):
            return pull_through(k, after, before, sums, k == last, at_save)

        allowed = settings.allowed(end[0].dtype)
        out, misses, solved = _rebuilt(
            task, end, first, count, known_start, allowed, along, (grad, cot)
        )
        fine = solved & jnp.all(misses <= allowed)

        def stored(known_start, end, first, last, at_save, grad, cot):
            def forward(state, k):
                q, p, _ = task.method.step(task.equations, task.interval(k), *state)
                return (q, p), state

            _, states = counted_scan(forward, known_start, first, 1, count)

            def back(state, before):
                k, after, sums = state
                sums = pull_through(k, after, before, sums, k == last, at_save)
                return (k - 1, before, sums), None

            begin = (first + count - 1, end, (grad, cot))
            (_, _, sums), _ = lax.scan(back, begin, states, reverse=True)
            return sums

        def mend(out):
            again = stored(known_start, end, first, last, at_save, grad, cot)
            return jax.tree.map(lambda a, b: jnp.where(missing, a, b), again, out)

        # Where the trajectory itself has failed there is nothing to mend: NaN, not a number.
        missing = ~fine & _all_finite(known_start) & _all_finite(end)
        return lax.cond(lanewise.on_any(missing), mend, lambda out: out, tuple(out))

    def undo_block(known_start, saved: Saved, first, count, at_save, grad, cot):
        last = first + count - 1
        cot = (cot[0] + at_save.q, cot[1] + at_save.p)
        _, pull_times = jax.vjp(lambda theta: _end_of(eqx.combine(theta, fixed), last), theta)
        grad = jax.tree.map(jnp.add, grad, *pull_times((at_save.t, at_save.h)))
        at_save = at_save.observed
        every = settings.checkpoint_every
        sums = grad, cot
        for pieces in reversed(_pieces(known_start, saved, first, count, every)):

            def undo(sums, k, start, end, size=pieces.size):
                return undo_steps(start, end, k, size, last, at_save, *sums)

            sums = pieces.over(undo, sums, reverse=True)
        return sums

    start_state = (q_start, p_start)
    ends = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start_state, (saved.q, saved.p))
    grad = jax.tree.map(jnp.zeros_like, theta)
    cot = (cotangent.q, cotangent.p)
    rows = cotangent.saved
    of_start = None
    if not adds_start_outside(plan):
        of_start, rows = (rows.q[0], rows.p[0]), rows._replace(q=rows.q[1:], p=rows.p[1:])
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
    return grad, *(cot if of_start is None else map(jnp.add, cot, of_start))


def largest_divisor(n: int, most: int) -> int:
    return next(d for d in range(min(n, most), 0, -1) if n % d == 0) if n else 1


def _end_of(task: Task, k: Array) -> tuple[Array, Array]:
    """Time and step size at the end of step k."""
    interval = task.interval(k)
    return interval.t1, interval.h


def _last_row(x, is_there: bool):
    return x[-1] if is_there else jnp.zeros(x.shape[1:], x.dtype)


def _largest(sizes, state):
    return jax.tree.map(lambda s, x: jnp.maximum(jnp.abs(s), jnp.abs(x)), sizes, state)


def _miss(a, b, size, allowed):
    """By how much of its size each component of a misses b. To the size is added that of which
    `allowed` is round-off of the largest component."""
    round_off = 64 * jnp.finfo(a.dtype).eps * jnp.max(size, initial=0.0)
    return jnp.abs(a - b) / (size + (round_off / allowed + jnp.finfo(a.dtype).tiny))


def _why_not(task: Task) -> str | None:
    """Why no states of this run can be rebuilt, None if they can."""
    if not task.method.is_invertible:
        return f"{type(task.method).__name__} has no inverse step"
    if task.lattice.has_memory:
        return f"the steps of {type(task.lattice).__name__} depend on those before"
    if task.stop is not None:
        return "a run with a Stop ends in the midst"
    if task.has_deviations:
        return "deviation vectors cannot be followed backwards"
    if task.has_running_values:
        return "running values of reductions are not rebuilt"
    return None


def _all_finite(state) -> Array:
    return jnp.all(jnp.isfinite(state[0])) & jnp.all(jnp.isfinite(state[1]))
