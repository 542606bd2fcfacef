"""Many steps on trust: in segments, looked at when they end, taken again with care if need be.

A step that keeps no books (no status, no test for NaN, a fixed number of Newton iterations) is
several times as fast in a batch. It can be checked afterwards: states only ever change by sums, so
that one that is not finite never becomes finite again, and the largest excess of the solves is
carried along. So a segment of steps is run on trust; lanes that fail the check take it again, with
more iterations while that helps, then with care, and their books say what became of them. No lane
depends on the others: they share the length of a loop, never a number.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ._arithmetic import FixedPoint
from ._results import RESULTS
from ._rollout import (
    Carry,
    Plan,
    Saved,
    StepTaken,
    Task,
    counted_scan,
    piece_length,
    run,
    take_step,
)
from .engine.dependence import fixed_point, reached_outputs
from .engine.lanes import in_arrays
from .engine.newton import RootSolver, Trusted
from .engine.together import least_over_lanes, on_any_lane
from .observe import Deviations, Pushed, Reduction

SEGMENT = 128
"""Steps between two looks, where nothing else says how many."""

FEWEST_ITERATIONS, MOST_ITERATIONS = 2, 6
"""Of Newton's method on trust; what needs more is solved with care."""


def can_trust(task: Task) -> bool:
    """Whether steps may be taken on trust: the check at the end must find what went wrong."""
    is_plain = not isinstance(task.arithmetic, FixedPoint)  # it may leave its range and come back
    return is_plain and not task.lattice.has_memory and task.stop is None


def run_in_segments(
    task: Task, plan: Plan, carry: Carry, every: int = SEGMENT
) -> tuple[Carry, Saved, Saved | None]:
    """`run`, on trust: all steps of `plan` in segments of about `every` steps.

    In `Saved.inner` are the states at the ends of the segments inside of a long block.
    """
    segment = _Segment(task, carry)
    iterations = jnp.asarray(FEWEST_ITERATIONS, jnp.int32)
    state = (carry, iterations)
    if plan.block > every:

        def block(state, k):
            return _long_block(task, segment, state, k, plan.block, every)

        state, saved = counted_scan(
            block, state, jnp.asarray(0, jnp.int32), plan.block, plan.num_blocks
        )
    else:
        group = largest_divisor(plan.num_blocks, max(every // plan.block, 1))

        def blocks(state, k):
            part = Plan(group, plan.block, 0, False)

            def steps(task, carry):
                carry, saved, _ = run(task, part, carry, counted_scan, first=k)
                return carry, saved

            return segment(steps, state, k)

        state, saved = counted_scan(
            blocks, state, jnp.asarray(0, jnp.int32), plan.block * group, plan.num_blocks // group
        )
        saved = jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), saved)
    if not plan.tail:
        return state[0], saved, None
    first = jnp.asarray(plan.num_blocks * plan.block, jnp.int32)
    state, tail = _long_block(task, segment, state, first, plan.tail, every)
    return state[0], saved, tail


def _long_block(task: Task, segment, state, first, count: int, every: int):
    """`count` steps in segments, and their end as it is saved."""
    alone, _ = task.observables()
    every = piece_length(count, every)
    pieces = -(-count // every)

    def piece(state, k):
        length = jnp.minimum(every, first + count - k) if count % every else every

        def steps(task, carry):
            def body(i, so_far):
                carry, _ = so_far
                after, _, taken = take_step(task, carry, k + i)
                return after, (taken.q0, taken.p0) if alone else None

            before = (carry.q, carry.p) if alone else None
            return lax.fori_loop(0, length, body, (carry, before))

        state, before = segment(steps, state, k)
        return state, (before, (state[0].q, state[0].p))

    state, (before, ends) = counted_scan(piece, state, first, every, pieces)
    carry, _ = state
    interval = task.interval(first + (count - 1))
    taken = None
    if alone:
        q0, p0 = (x[-1] for x in before)
        taken = StepTaken(interval.t0, interval.t1, q0, p0, carry.q, carry.p)
    observed = task.at_save(carry, taken)
    inner = jax.tree.map(lambda x: x[:-1], ends) if pieces > 1 else None
    return state, Saved(interval.t1, interval.h, carry.q, carry.p, observed, inner)


class _Segment:
    """A segment of steps: on trust, and with care for the lanes where that fails."""

    def __init__(self, task: Task, carry: Carry):
        self.task = task
        first = task.interval(jnp.asarray(0, jnp.int32))
        self.solves = not task.method.needs_no_solve(task.equations, first, carry.q)
        self.depends = _depend_on_the_state(task, carry)

    def __call__(self, steps: Callable, state: tuple[Carry, Array], first: Array):
        """`steps(task, carry)` → (carry, other), from step number `first`."""
        carry, iterations = state
        assert carry.result is not None
        good = carry.result == RESULTS.successful
        if self.solves:
            iterations, done, out = self._solved(steps, carry, iterations, good)
        else:
            out = self._on_trust(steps, carry, iterations)
            done = ~good | _is_fine(out[0])
        # Where the start was bad the books are kept from the first step on.
        missing = ~done | (~good & (first == 0))
        careful = in_arrays(lambda carry: steps(self.task, carry))

        def mend(state):
            return jnp.asarray(False), self._where(missing, careful(carry), state[1])

        # A loop of one turn or none, because a conditional copies what it passes on.
        trusted = self._in_the_books(carry, out[0], good), out[1]
        begin = on_any_lane(missing), trusted
        _, (after, other) = lax.while_loop(lambda state: state[0], mend, begin)
        return (after, iterations), other

    def _on_trust(self, steps: Callable, carry: Carry, iterations: Array):
        equations = self.task.equations
        newton = equations.newton
        assert isinstance(newton, RootSolver)
        trusting = dataclasses.replace(equations, newton=Trusted(newton, iterations))
        return steps(dataclasses.replace(self.task, equations=trusting), self._bare(carry))

    def _bare(self, carry: Carry) -> Carry:
        """The carry without its books."""
        return carry._replace(
            result=None,
            failed_step=None,
            failed_residual=None,
            iterations=jnp.asarray(0, jnp.int32),
            residual=jnp.full_like(carry.residual, -jnp.inf) if self.solves else None,
        )

    def _solved(self, steps: Callable, carry: Carry, iterations: Array, good: Array):
        """On trust, with as many iterations as a lane has needed so far, or more.

        A lane that has failed before goes along once, for the times that it gives.
        """
        newton = self.task.equations.newton
        assert isinstance(newton, RootSolver)
        most = max(min(newton.most_effort(), MOST_ITERATIONS), FEWEST_ITERATIONS)
        like = jax.eval_shape(lambda c: self._on_trust(steps, c, iterations), carry)
        other = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like[1])
        out = self._bare(carry), other

        def is_open(iterations, done):
            return ~done & (iterations <= most)

        def again(state):
            iterations, done, out = state
            mine = is_open(iterations, done)
            now = least_over_lanes(jnp.where(mine & good, iterations, most + 1))
            now = jnp.where(now > most, FEWEST_ITERATIONS, now)
            new = self._on_trust(steps, carry, now)
            mine = mine & (iterations == now)
            fine = (mine & _is_fine(new[0])) | (~good & ~done)
            out = self._where(fine, new, out)
            return jnp.where(mine & ~fine, iterations + 1, iterations), done | fine, out

        state = (jnp.where(good, iterations, FEWEST_ITERATIONS), jnp.asarray(False), out)
        return lax.while_loop(lambda s: on_any_lane(is_open(s[0], s[1])), again, state)

    def _where(self, which: Array, new: tuple[Carry, Saved], old: tuple[Carry, Saved]):
        """`new` where `which`, else `old`, from the same start; memories that do not depend on the
        state are alike."""

        def choose(new, old):
            return jax.tree.map(lambda a, b: jnp.where(which, a, b), new, old)

        leaves, tree = jax.tree.flatten(new[0].reductions)
        before = jax.tree.leaves(old[0].reductions)
        leaves = [
            choose(a, b) if depends else a
            for a, b, depends in zip(leaves, before, self.depends, strict=True)
        ]
        carry = choose(*(x[0]._replace(reductions=None) for x in (new, old)))
        return carry._replace(reductions=jax.tree.unflatten(tree, leaves)), choose(new[1], old[1])

    def _in_the_books(self, carry: Carry, after: Carry, good: Array) -> Carry:
        """The carry after a segment on trust that was found good."""
        residual = carry.residual
        if self.solves:
            bound = 64 * jnp.finfo(residual.dtype).eps
            residual = jnp.where(good, jnp.maximum(residual, bound), residual)
        return after._replace(
            result=carry.result,
            failed_step=carry.failed_step,
            failed_residual=carry.failed_residual,
            iterations=carry.iterations + jnp.where(good, after.iterations, 0),
            residual=residual,
        )


def _depend_on_the_state(task: Task, carry: Carry) -> list[bool]:
    """Which leaves of the reductions' memories do; the others count steps, or times."""
    found: list[bool] = []
    interval = task.interval(jnp.asarray(0, jnp.int32))
    taken = StepTaken(interval.t0, interval.t1, carry.q, carry.p, carry.q, carry.p)
    _, reductions = task.observables()
    for r, memory in zip(reductions, carry.reductions, strict=True):
        value = _like_a_value(task, r, memory, taken, interval.h)
        update = jax.make_jaxpr(r.update)(memory, jnp.asarray(0, jnp.int32), interval.t1, value)
        count, parts = (len(jax.tree.leaves(x)) for x in (memory, value))
        found += fixed_point(
            lambda marks, u=update, n=parts: reached_outputs(
                u.jaxpr, [*marks, False, False, *[True] * n]
            ),
            [False] * count,
        )
    return found


def _like_a_value(task: Task, r: Reduction, memory, taken: StepTaken, h: Array):
    """What a reduction is given after a step, as zeros."""
    if isinstance(r, Deviations):
        return Pushed(jnp.zeros_like(r.vectors(memory)), h)
    like = jax.eval_shape(lambda: taken.number(task.bound(r.function), task.args))
    return jnp.zeros(like.shape, like.dtype)


def _is_fine(after: Carry) -> Array:
    """Whether a segment on trust went well: finite to its end, and every solve good."""
    fine = jnp.all(jnp.isfinite(after.q)) & jnp.all(jnp.isfinite(after.p))
    return fine if after.residual is None else fine & (after.residual <= 0)


def largest_divisor(n: int, most: int) -> int:
    return next(d for d in range(min(n, most), 0, -1) if n % d == 0) if n else 1
