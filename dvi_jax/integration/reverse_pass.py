"""The reverse pass of `Reversible`: states by inverse steps, and cotangents along them."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

import lanewise

from ..base.results import RESULTS
from ..base.types import State
from ..engine.newton import KnownRoot, RootSolver
from ..observe import has_initial_value
from .loop import number_of
from .plan import Plan, adds_start_outside, piece_length
from .task import Saved, StepTaken, Task

# Steps back between two updates of the sizes of the components, relative to which differences are
# measured. An update in every step would take a noticeable part of the time of an explicit one.
LOOKS = 16


class Smooth(NamedTuple):
    """The differentiable outputs of a trajectory."""

    q: State
    p: State
    saved: Saved
    reduced: list[Any]


def states_of(saved: Saved) -> Saved:
    """The saved values that the reverse pass reads."""
    return saved._replace(t=None, h=None, observed=[])


class _Pieces(NamedTuple):
    """Pieces of `size` steps each between two known states, in order from step `first`."""

    starts: tuple[State, State]
    ends: tuple[State, State]
    first: Array
    size: int

    def over(self, step: Callable, state: Any, reverse: bool = False) -> Any:
        """``state = step(state, k, start, end)`` for each piece, from step number k."""
        count = len(self.starts[0])
        if count == 1:  # without a loop around one piece, which would be compiled
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
    """The `count` steps to a save point, divided at the checkpoints in between."""
    inner = saved.inner
    kept = 0 if inner is None else len(inner[0])
    size = piece_length(count, every) if kept else count
    parts = [known_start[0][None], known_start[1][None]], inner, [saved.q[None], saved.p[None]]
    known = [jnp.concatenate(x) for x in zip(*(p for p in parts if p is not None), strict=True)]
    starts, ends = (known[0][:-1], known[1][:-1]), (known[0][1:], known[1][1:])
    rest = count - kept * size
    # The code for a piece is compiled for each length: the last piece joins the others if it can.
    if rest == size:
        return [_Pieces(starts, ends, first, size)]

    def some(which: slice, first, size):
        start, end = ((q[which], p[which]) for q, p in (starts, ends))
        return _Pieces(start, end, first, size)

    return [some(slice(-1), first, size), some(slice(-1, None), first + kept * size, rest)]


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
    """The states from `end` back over `count` steps, by inverse steps: the `sums` that
    ``along(k, after, before, sums)`` accumulates, the relative difference of each component from
    `known_start`, and whether all solves succeeded."""
    # A divisor of `count`, so that one loop serves all groups.
    group = next((d for d in range(min(count, LOOKS), 1, -1) if count % d == 0), 1)

    # Cotangents go along in the same loop: states are needed once, and none is stored.
    def undo(state, _):
        k, after, sums, solved = state
        # Without the memory of the arithmetic, whose effect is below the accepted difference.
        interval = task.interval(k)
        q, p, info = task.method.inverse(task.equations_at(k, interval), interval, *after)
        if along is not None:
            sums = along(k, after, (q, p), sums)
        return (k - 1, (q, p), sums, solved & (info.result == RESULTS.successful)), None

    def undo_group(state, _):
        state, sizes = state
        state, _ = lax.scan(undo, state, None, group)
        return (state, _largest(sizes, state[1])), None

    begin = ((first + (count - 1), end, sums, jnp.asarray(True)), _largest(end, end))
    ((_, state, sums, solved), sizes), _ = lax.scan(undo_group, begin, None, count // group)
    misses = [
        _miss(a, b, size, allowed).ravel()
        for a, b, size in zip(state, known_start, sizes, strict=True)
    ]
    return sums, jnp.concatenate(misses), solved


def round_trip_defect(
    task: Task, plan: Plan, every: int, allowed: float, start_state, saved: Saved, tail
) -> Array:
    """The largest difference of a reconstructed state at a checkpoint; ∞ where an inverse step
    failed."""

    def of_piece(size):
        def of(worst, k, start, end):
            _, misses, solved = _rebuilt(task, end, k, size, start, allowed)
            return jnp.maximum(worst, jnp.where(solved, jnp.max(misses, initial=0.0), jnp.inf))

        return of

    def of_block(worst, start, saved, first, count):
        for pieces in _pieces(start, saved, first, count, every):
            worst = pieces.over(of_piece(pieces.size), worst)
        return worst

    def block(carry, saved):
        k, start, worst = carry
        worst = of_block(worst, start, saved, k, plan.block)
        return (k + plan.block, (saved.q, saved.p), worst), None

    begin = (jnp.asarray(0, jnp.int32), start_state, jnp.zeros((), start_state[0].dtype))
    (k, start, worst), _ = lax.scan(block, begin, saved)
    return worst if tail is None else of_block(worst, start, tail, k, plan.tail)


def pull_back(
    fixed, plan: Plan, every: int, allowed: float, inputs, known, cotangent: Smooth
) -> tuple[Any, Array, Array]:
    """Lᵀ·cotangent: the reverse pass of `Reversible`, from the end of a trajectory to its start.

    `every`: steps between checkpoints. `allowed`: the largest relative difference there.
    """
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
        # The unknown of (13) is the state after the step, which is known here: no solve.
        known_root = task.method.is_the_map and task.arithmetic.is_plain
        solver = KnownRoot(p1.ravel(), newton) if known_root else newton
        equations = dataclasses.replace(task.equations_at(k, interval), newton=solver)
        q1, p1, _ = task.method.step(equations, interval, q0, p0)
        taken = StepTaken(interval.t0, interval.t1, q0, p0, q1, p1)
        values = [taken.value(f, task.args) for f in alone]
        reduced = [taken.number(task.bound(r.function), task.args) for r in reductions]
        return (q1, p1, interval.t1), eqx.filter(values, eqx.is_inexact_array), reduced

    def pull_through(k, after, before, sums, is_last, at_save):
        """The cotangents before step k, from the states before and after it."""
        p1, (grad, (cq, cp)) = after[1], sums
        # The step is linearised at the reconstructed state: one more forward evaluation per step
        # takes the place of stored intermediate values.
        ((_, _, t1), _, values), pull = jax.vjp(
            lambda theta, q, p: local_step(theta, q, p, k, p1), theta, *before
        )
        # Functions are observed at save points only, which the last step of a block ends at.
        at_end = jax.tree.map(lambda c: jnp.where(is_last, c, jnp.zeros_like(c)), at_save)
        ct, seeds = jnp.zeros_like(t1), []
        for r, memory, c, value in zip(
            reductions, memories, cotangent.reduced, values, strict=True
        ):
            of_t, of_value = r.pull(memory, c, number_of(r, k), t1, value)
            ct = ct + of_t
            seeds.append(of_value.astype(value.dtype))
        of_theta, cq, cp = pull(((cq, cp, ct), at_end, seeds))
        return jax.tree.map(jnp.add, grad, of_theta), (cq, cp)

    def undo_steps(known_start, end, first, count, last, at_save, grad, cot):
        """`count` steps back from the exact state `end`, by inverse steps. Where these miss
        `known_start`, by the steps from there, computed again and stored."""

        def along(k, after, before, sums):
            return pull_through(k, after, before, sums, k == last, at_save)

        out, misses, solved = _rebuilt(
            task, end, first, count, known_start, allowed, along, (grad, cot)
        )
        fine = solved & jnp.all(misses <= allowed)

        def stored(known_start, end, first, last, at_save, grad, cot):
            def forward(state, _):
                k, before = state
                interval = task.interval(k)
                q, p, _ = task.method.step(task.equations_at(k, interval), interval, *before)
                return (k + 1, (q, p)), before

            _, states = lax.scan(forward, (first, known_start), None, count)

            def back(state, before):
                k, after, sums = state
                sums = pull_through(k, after, before, sums, k == last, at_save)
                return (k - 1, before, sums), None

            begin = (first + count - 1, end, (grad, cot))
            (_, _, sums), _ = lax.scan(back, begin, states, reverse=True)
            return sums

        def corrected(out):
            again = stored(known_start, end, first, last, at_save, grad, cot)
            return jax.tree.map(lambda a, b: jnp.where(missing, a, b), again, out)

        # Not for a trajectory that has failed itself: its gradient is NaN, and a batch must not
        # wait for the steps of one whose result is known.
        missing = ~fine & _all_finite(known_start) & _all_finite(end)
        return lax.cond(lanewise.on_any(missing), corrected, lambda out: out, tuple(out))

    def undo_block(known_start, saved: Saved, first, count, at_save, grad, cot):
        last = first + count - 1
        cot = (cot[0] + at_save.q, cot[1] + at_save.p)
        # Saved times and steps depend on h and t0 directly, not through the state.
        _, pull_times = jax.vjp(lambda theta: eqx.combine(theta, fixed).interval(last)[1:], theta)
        grad = jax.tree.map(jnp.add, grad, *pull_times((at_save.t, at_save.h)))
        at_save = at_save.observed
        sums = grad, cot
        for pieces in reversed(_pieces(known_start, saved, first, count, every)):

            def undo(sums, k, start, end, size=pieces.size):
                return undo_steps(start, end, k, size, last, at_save, *sums)

            sums = pieces.over(undo, sums, reverse=True)
        return sums

    # Each block begins where the one before ended; saved states are exact, not reconstructed.
    start_state = (q_start, p_start)
    ends = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start_state, (saved.q, saved.p))
    grad = jax.tree.map(jnp.zeros_like, theta)
    cot = (cotangent.q, cotangent.p)
    rows = cotangent.saved
    of_start = None
    if not adds_start_outside(plan):
        of_start, rows = (rows.q[0], rows.p[0]), rows._replace(q=rows.q[1:], p=rows.p[1:])
    if tail is not None:
        # Without a saved tail nothing is observed at the end of the run: cotangents of zero.
        at_save = jax.tree.map(
            lambda x: x[-1] if plan.save_tail else jnp.zeros(x.shape[1:], x.dtype), rows
        )
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
    of_q, of_p = cot if of_start is None else map(jnp.add, cot, of_start)
    return _through_initial(fixed, inputs, memories, cotangent.reduced, (grad, of_q, of_p))


def _through_initial(fixed, inputs, memories, cotangents, sums) -> tuple[Any, Array, Array]:
    """The cotangents, with those of the values of reductions at the initial state."""

    def initial(theta, q0, p0):
        task: Task = eqx.combine(theta, fixed)
        t0 = task.first_interval().t0
        taken = StepTaken(t0, t0, q0, p0, q0, p0)
        _, reductions = task.observables()
        known = [r for r in reductions if has_initial_value(r.function)]
        return t0, [taken.number(task.bound(r.function), task.args) for r in known]

    _, reductions = eqx.combine(inputs[0], fixed).observables()
    of_state = [
        (r, memory, c)
        for r, memory, c in zip(reductions, memories, cotangents, strict=True)
        if has_initial_value(r.function)
    ]
    if not of_state:
        return sums
    (t0, values), pull = jax.vjp(initial, *inputs)
    ct, seeds = jnp.zeros_like(t0), []
    for (r, memory, c), value in zip(of_state, values, strict=True):
        of_t, of_value = r.pull(memory, c, jnp.asarray(0, jnp.int32), t0, value)
        ct = ct + of_t
        seeds.append(of_value.astype(value.dtype))
    return jax.tree.map(jnp.add, sums, pull((ct, seeds)))


def _largest(sizes, state):
    return jax.tree.map(lambda s, x: jnp.maximum(jnp.abs(s), jnp.abs(x)), sizes, state)


def _miss(a, b, size, allowed):
    """The difference of each component of a from b, relative to its size."""
    # A small component inherits round-off of the largest one, which is no fault of the inverse
    # steps. The size is increased so that this round-off is just accepted.
    round_off = 64 * jnp.finfo(a.dtype).eps * jnp.max(size, initial=0.0)
    return jnp.abs(a - b) / (size + (round_off / allowed + jnp.finfo(a.dtype).tiny))


def _all_finite(state) -> Array:
    return jnp.all(jnp.isfinite(state[0])) & jnp.all(jnp.isfinite(state[1]))
