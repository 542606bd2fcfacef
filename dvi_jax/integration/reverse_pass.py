"""The adjoint equation of a trajectory: cotangents from its end to its start."""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

import lanewise

from ..base.types import State
from ..engine.guard import all_finite, constant_unless
from ..engine.newton import KnownRoot
from ..observe import Reduction, has_initial_value
from .loop import number_of
from .reconstruction import Arc, Point, Reconstruction, fold_blocks, row_of
from .task import Ends, Rows, Task, adds_start_outside


class Smooth(NamedTuple):
    """The differentiable outputs of a trajectory, or their cotangents."""

    q: State
    p: State
    rows: Rows
    results: list[Any]


class Cotangents(NamedTuple):
    """λ = (q, p), of the state between two steps, and the sum dL/dθ over the steps after it."""

    theta: Any
    q: State
    p: State


class SavePoint(NamedTuple):
    """The number of the step that ends at a save point, and the cotangents of the values of the
    functions that are observed there."""

    step: Array
    observed: list[Any]


class ReversePass(eqx.Module):
    r"""Lᵀ times the cotangent of a trajectory, L being its derivative.

    Backwards along reconstructed states, with the step Φ_k from (q_k, p_k) to (q_{k+1}, p_{k+1}),

        λ_k = (∂Φ_k/∂(q_k, p_k))ᵀ λ_{k+1},     dL/dθ += (∂Φ_k/∂θ)ᵀ λ_{k+1},

    and the cotangents of saved and observed values are added where they belong.

    - `theta`: the arrays of the task that are differentiated. `constants`: its other parts.
    - `memories`: of the reductions, after the run. `cotangent`: of its outputs.
    """

    theta: Any
    constants: Any
    states: Reconstruction
    memories: list[Any]
    cotangent: Smooth

    def task(self, theta: Any) -> Task:
        return eqx.combine(theta, self.constants)

    def transport(
        self, after_step: Cotangents, k: Array, start: Point, end: Point, save: SavePoint
    ) -> Cotangents:
        """The adjoint equation of step k, from the state `start` to `end`."""
        # The step is linearised at the reconstructed state: one more forward evaluation per step
        # takes the place of stored intermediate values.
        ((_, _, t1), _, values), pull = jax.vjp(
            lambda theta, q0, p0: self.local_step(theta, q0, p0, k, end[1]), self.theta, *start
        )
        # Functions are observed at save points only.
        is_saved = k == save.step
        observed = jax.tree.map(lambda c: jnp.where(is_saved, c, jnp.zeros_like(c)), save.observed)
        of_t1, of_values = _of_values(self.reductions(), k, t1, values)
        pullback = pull(((after_step.q, after_step.p, of_t1), observed, of_values))
        # A failed step is a constant, NaN: zero times its derivative would be NaN as well.
        good = all_finite(start) & all_finite(end)
        of_theta, q, p = lax.cond(
            lanewise.on_any(~good),
            lambda: jax.tree.map(lambda x: jnp.where(good, x, 0), pullback),
            lambda: pullback,
        )
        return Cotangents(jax.tree.map(jnp.add, after_step.theta, of_theta), q, p)

    def local_step(self, theta: Any, q0: State, p0: State, k: Array, p1: State) -> tuple:
        """((q1, p1, t1), observed values, arguments of the reductions) of step k, whose p1 is known
        from the reconstruction; all differentiable."""
        task = self.task(theta)
        functions, reductions = task.observables()
        newton = task.equations.newton
        interval = task.interval(k)
        # The unknown of (13) is the state after the step: no solve.
        is_root = task.method.is_the_map and task.arithmetic.is_plain
        solver = KnownRoot(p1.ravel(), newton) if is_root else newton
        equations = dataclasses.replace(task.equations_at(k, interval), newton=solver)
        q1, p1, _ = self.states.method(task, k, q0).step(equations, interval, q0, p0)
        step = Ends(interval.t0, interval.t1, q0, p0, q1, p1)
        # As in the loop, a value that is not finite is a constant.
        value_of = functools.partial(constant_unless, all_finite(step), succeeds=all_finite)
        values = [
            value_of(functools.partial(Ends.value, observable=function, args=task.args), step)
            for function in functions
        ]
        numbers = [
            value_of(lambda step, f=reduction: _real(task.number(f, step), q1), step)
            for reduction in reductions
        ]
        return (
            (q1, p1, interval.t1),
            eqx.filter([jnp.asarray(x) for x in values], eqx.is_inexact_array),
            numbers,
        )

    def reductions(self) -> list[tuple[Reduction, Any, Any]]:
        """Each reduction with its memory and the cotangent of its result."""
        _, reductions = self.task(self.theta).observables()
        return list(zip(reductions, self.memories, self.cotangent.results, strict=True))

    def steps(self, cotangents: Cotangents, arc: Arc, save: SavePoint) -> Cotangents:
        """The steps of an arc, backwards from its end by inverse steps. Where these miss its start,
        by the steps from there."""
        inner, (first, last) = self.states.inner_arc(arc), self.states.ends(arc)
        cotangents = self.conversion("leave", last, inner.end, cotangents)
        cotangents = self.steps_inside(cotangents, inner, save)
        return self.conversion("enter", first, arc.start, cotangents)

    def conversion(
        self, direction: str, k: Any, point: Point, cotangents: Cotangents
    ) -> Cotangents:
        """The cotangents before a conversion of the point, from those after it."""
        if self.states.coordinates(self.states.task, k, point[0]) is None:
            return cotangents
        _, pull = jax.vjp(
            lambda theta, *x: self.states.conversion(direction, self.task(theta), k, x),
            *(self.theta, *point),
        )
        of_theta, q, p = pull((cotangents.q, cotangents.p))
        # A state after a failure is a constant, NaN, as in `transport`.
        good = all_finite(point)
        of_theta, q, p = jax.tree.map(lambda x: jnp.where(good, x, 0), (of_theta, q, p))
        return Cotangents(jax.tree.map(jnp.add, cotangents.theta, of_theta), q, p)

    def steps_inside(self, cotangents: Cotangents, arc: Arc, save: SavePoint) -> Cotangents:
        """The same in the coordinates of the method."""

        def transport(cotangents, k, start, end):
            return self.transport(cotangents, k, start, end, save)

        cheap, defects, is_solved = self.states.steps_by_inverse(arc, transport, cotangents)
        is_exact = is_solved & jnp.all(defects <= self.states.tolerance)
        # A batch must not wait for the steps of a trajectory that fails in this arc, unless
        # reductions read those before.
        is_used = all_finite(arc.end) | _any_nonzero(self.cotangent.results)
        is_wrong = ~is_exact & all_finite(arc.start) & is_used

        def correct(cheap):
            exact = self.steps_again(cotangents, arc, save)
            return jax.tree.map(lambda a, b: jnp.where(is_wrong, a, b), exact, cheap)

        return lax.cond(lanewise.on_any(is_wrong), correct, lambda cheap: cheap, cheap)

    def steps_again(self, cotangents: Cotangents, arc: Arc, save: SavePoint) -> Cotangents:
        """The same from the states of these steps, which are computed again and stored."""
        task, (first, count, start, end) = self.states.task, arc

        def forward(carry, _):
            k, state = carry
            interval, method = task.interval(k), self.states.method(task, k, state[0])
            q, p, _ = method.step(task.equations_at(k, interval), interval, *state)
            return (k + 1, (q, p)), state

        def backward(carry, start):
            k, end, cotangents = carry
            return (k - 1, start, self.transport(cotangents, k, start, end, save)), None

        _, points = lax.scan(forward, (first, start), None, count)
        begin = (first + count - 1, end, cotangents)
        (_, _, cotangents), _ = lax.scan(backward, begin, points, reverse=True)
        return cotangents

    def block(
        self, cotangents: Cotangents, first: Any, start: Point, row: Rows, of_row: Rows, count: int
    ) -> Cotangents:
        """The steps between save points; `row`: values at the second one, `of_row`: cotangents."""
        step = first + count - 1
        # Rows times and steps depend on h and t0 directly, not through the state.
        _, pull = jax.vjp(lambda theta: self.task(theta).interval(step)[1:], self.theta)
        of_theta = jax.tree.map(jnp.add, cotangents.theta, *pull((of_row.t, of_row.h)))
        cotangents = Cotangents(of_theta, cotangents.q + of_row.q, cotangents.p + of_row.p)
        save = SavePoint(step, of_row.observed)
        steps = functools.partial(self.steps, save=save)
        for pieces in reversed(self.states.pieces(start, row, first, count)):
            cotangents = pieces.fold(steps, cotangents, reverse=True)
        return cotangents

    def run(self, start: Point, rows: Rows, tail: Rows | None) -> Cotangents:
        """The cotangents of θ and of the initial state, from the states that the run has stored."""
        plan, of_rows = self.states.plan, self.cotangent.rows
        zero = jax.tree.map(jnp.zeros_like, self.theta)
        cotangents = Cotangents(zero, self.cotangent.q, self.cotangent.p)
        of_start = None
        if not adds_start_outside(plan):
            of_start = of_rows.q[0], of_rows.p[0]
            of_rows = of_rows._replace(q=of_rows.q[1:], p=of_rows.p[1:])
        starts = self.states.starts(start, rows)
        if tail is not None:
            # Without a saved tail nothing is observed at the end of the run: cotangents of zero.
            of_tail = jax.tree.map(
                lambda x: x[-1] if plan.save_tail else jnp.zeros(x.shape[1:], x.dtype), of_rows
            )
            first = jnp.asarray(plan.num_blocks * plan.block, jnp.int32)
            start_of_tail = row_of(starts, -1)
            cotangents = self.block(cotangents, first, start_of_tail, tail, of_tail, plan.tail)
        of_rows = jax.tree.map(lambda x: x[: plan.num_blocks], of_rows)
        blocks = row_of(starts, slice(-1)), rows, of_rows
        one_block = functools.partial(self.block, count=plan.block)
        cotangents = fold_blocks(one_block, cotangents, plan.num_blocks, plan.block, blocks)
        if of_start is not None:
            q, p = map(jnp.add, (cotangents.q, cotangents.p), of_start)
            cotangents = cotangents._replace(q=q, p=p)
        return self.initial_values(cotangents, start)

    def initial_values(self, cotangents: Cotangents, start: Point) -> Cotangents:
        """The cotangents, with those of the values of reductions at the initial state."""
        reductions = [item for item in self.reductions() if has_initial_value(item[0].function)]
        if not reductions:
            return cotangents

        def values_of(theta, q0, p0):
            task = self.task(theta)
            t0 = task.first_interval().t0
            step = Ends(t0, t0, q0, p0, q0, p0)
            _, reductions = task.observables()
            initial = [item for item in reductions if has_initial_value(item.function)]
            return t0, [_real(task.number(reduction, step), q0) for reduction in initial]

        (t0, values), pull = jax.vjp(values_of, self.theta, *start)
        seeds = _of_values(reductions, jnp.asarray(-1, jnp.int32), t0, values)
        # NaN parameters make the value of a valid state NaN.
        good = all_finite(start) & (all_finite(values) | _any_nonzero(seeds))
        pullback = jax.tree.map(lambda x: jnp.where(good, x, 0), pull(seeds))
        return jax.tree.map(jnp.add, cotangents, Cotangents(*pullback))


def _of_values(
    reductions: list[tuple[Reduction, Any, Any]], k: Array, t1: Array, values: list[Array]
) -> tuple[Array, list[Array]]:
    """The cotangents of t1 and of the values that the reductions receive at the end of step k;
    k = −1: at the initial state."""
    of_t1, of_values = jnp.zeros_like(t1), []
    for (reduction, memory, cotangent), value in zip(reductions, values, strict=True):
        if not jax.tree.leaves(cotangent):  # its results are integers
            of_values.append(jnp.zeros_like(value))
            continue
        of_t, of_value = reduction.pull(memory, cotangent, number_of(reduction, k), t1, value)
        of_t1 = of_t1 + of_t
        of_values.append(of_value.astype(value.dtype))
    return of_t1, of_values


def _real(value: Array, like: Array) -> Array:
    """A value with a tangent: zero for an integer."""
    return value if jnp.issubdtype(value.dtype, jnp.inexact) else value.astype(like.dtype)


def _any_nonzero(cotangents: Any) -> Array:
    return jnp.any(jnp.asarray([jnp.any(x != 0) for x in jax.tree.leaves(cotangents)], bool))
