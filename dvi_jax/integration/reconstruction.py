"""States of a trajectory, reconstructed backwards by inverse steps from those that are stored."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..base.results import RESULTS
from ..base.types import State
from ..lattices import Uniform
from ..methods import Method
from ..methods._base import Coordinates
from .task import Plan, Rows, Task, piece_length

# Steps back between two updates of the sizes of the components, relative to which differences are
# measured. An update in every step would take a noticeable part of the time of an explicit one.
GROUP = 16

Point = tuple[State, State]
"""(q, p)."""


def fold_blocks(block: Callable, state: Any, count: int, size: int, rows: Any) -> Any:
    """``state = block(state, k, *row)`` for each of `count` blocks of `size` steps, from the last
    block to the first. k: the number of its first step; row: its row of the arrays `rows`."""

    def one_block(carry, row):
        k, state = carry
        return (k - size, block(state, k - size, *row)), None

    begin = (jnp.asarray(count * size, jnp.int32), state)
    (_, state), _ = lax.scan(one_block, begin, rows, reverse=True)
    return state


class Arc(NamedTuple):
    """`size` steps, the first of which has the number `first`, and the states at their ends."""

    first: Array
    size: int
    start: Point
    end: Point


class Pieces(NamedTuple):
    """Arcs of `size` steps each between stored states, in order from step `first`."""

    first: Array
    size: int
    starts: Point
    ends: Point

    def fold(self, function: Callable, state: Any, reverse: bool = False) -> Any:
        """``state = function(state, arc)`` for each arc."""
        count = len(self.starts[0])
        if count == 1:  # without a loop around one piece, which would be compiled
            start, end = row_of(self.starts, 0), row_of(self.ends, 0)
            return function(state, Arc(self.first, self.size, start, end))
        k, stride = self.first, self.size
        if reverse:
            k, stride = k + (count - 1) * stride, -stride

        def one_piece(carry, ends):
            k, state = carry
            return (k + stride, function(state, Arc(k, self.size, *ends))), None

        (_, state), _ = lax.scan(one_piece, (k, state), (self.starts, self.ends), reverse=reverse)
        return state


def row_of(points: Point, i: int | slice) -> Point:
    return points[0][i], points[1][i]


class Reconstruction(eqx.Module):
    """The states of a run between those that it stores: at save points, and at checkpoints about
    `spacing` steps apart. `tolerance`: the largest relative difference that is accepted there."""

    task: Task
    plan: Plan = eqx.field(static=True)
    spacing: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def coordinates(self, task: Task, k: Any, q: State) -> Coordinates | None:
        """Those of the method in step k; None: (q, p), also where functions read all states."""
        # A function of the user receives (q, p), which would be a conversion in each step.
        is_read = any(task.observables()) or type(task.lattice) is not Uniform
        if is_read or not task.arithmetic.is_plain:
            return None
        return task.method.in_equal_steps(task.equations, task.interval(k), q)

    def method(self, task: Task, k: Any, q: State) -> Method:
        """The method of the steps between the ends of an arc."""
        coordinates = self.coordinates(task, k, q)
        return task.method if coordinates is None else coordinates.method

    def conversion(self, direction: str, task: Task, k: Any, point: Point) -> Point:
        """A state in the coordinates of the method ("enter"), or one there in (q, p) ("leave")."""
        coordinates = self.coordinates(task, k, point[0])
        if coordinates is None:
            return point
        # These maps are undone by the next arc: what they report is known from the run.
        return getattr(coordinates, direction)(task.equations, task.interval(k), *point)[:2]

    def ends(self, arc: Arc) -> tuple[Any, Any]:
        """The steps in which the ends of an arc are converted, as the loop does at save points."""
        return jnp.maximum(arc.first - 1, 0), arc.first + (arc.size - 1)

    def inner_arc(self, arc: Arc) -> Arc:
        """The arc with its ends in the coordinates of the method."""
        points = zip(self.ends(arc), (arc.start, arc.end), strict=True)
        start, end = (self.conversion("enter", self.task, k, point) for k, point in points)
        return arc._replace(start=start, end=end)

    def starts(self, start: Point, rows: Rows) -> Point:
        """The states at the beginning of each block and of the tail: saved ones, thus exact."""
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, (rows.q, rows.p))

    def pieces(self, start: Point, rows: Rows, first: Any, count: int) -> list[Pieces]:
        """The `count` steps to a save point, divided at the checkpoints in between."""
        checkpoints = 0 if rows.inner is None else len(rows.inner[0])
        size = piece_length(count, self.spacing) if checkpoints else count
        parts = [[x[None] for x in start], rows.inner, [rows.q[None], rows.p[None]]]
        points = [jnp.concatenate(x) for x in zip(*filter(None, parts), strict=True)]
        starts, ends = (points[0][:-1], points[1][:-1]), (points[0][1:], points[1][1:])
        remainder = count - checkpoints * size
        # The code for a piece is compiled for each length: the last one joins the others if it can.
        if remainder == size:
            return [Pieces(first, size, starts, ends)]
        parts = slice(-1), slice(-1, None)
        front, last = ([row_of(points, part) for points in (starts, ends)] for part in parts)
        return [Pieces(first, size, *front), Pieces(first + checkpoints * size, remainder, *last)]

    def steps_by_inverse(
        self, arc: Arc, visit: Callable = lambda sums, k, start, end: sums, sums: Any = None
    ) -> tuple[Any, Array, Array]:
        """The arc backwards, by inverse steps: the `sums` of ``visit(sums, k, start, end)``, the
        relative difference of each component at the start, and whether all solves succeeded."""
        task, (first, count, start, end) = self.task, arc
        # A divisor of `count`, so that one loop serves all groups.
        group = next((d for d in range(min(count, GROUP), 1, -1) if count % d == 0), 1)

        # Cotangents go along in the same loop: states are needed once, and none is stored.
        def one_step(carry, _):
            k, state, sums, is_solved = carry
            # Without the memory of the arithmetic, whose effect is below the accepted difference.
            interval = task.interval(k)
            method = self.method(task, k, state[0])
            q, p, info = method.inverse(task.equations_at(k, interval), interval, *state)
            sums = visit(sums, k, (q, p), state)
            return (k - 1, (q, p), sums, is_solved & (info.result == RESULTS.successful)), None

        def one_group(carry, _):
            carry, sizes = carry
            carry, _ = lax.scan(one_step, carry, None, group)
            return (carry, _largest(sizes, carry[1])), None

        begin = ((first + (count - 1), end, sums, jnp.asarray(True)), _largest(end, end))
        ((_, point, sums, is_solved), sizes), _ = lax.scan(one_group, begin, None, count // group)
        defects = [
            self.difference(a, b, size).ravel()
            for a, b, size in zip(point, start, sizes, strict=True)
        ]
        return sums, jnp.concatenate(defects), is_solved

    def difference(self, a: State, b: State, size: State) -> Array:
        """The difference of each component of a from b, relative to its size."""
        # A small component inherits round-off of the largest one, which is no fault of the inverse
        # steps. The size is increased so that this round-off is just accepted.
        eps, tiny = jnp.finfo(a.dtype).eps, jnp.finfo(a.dtype).tiny
        round_off = 64 * eps * jnp.max(size, initial=0.0)
        return jnp.abs(a - b) / (size + (round_off / self.tolerance + tiny))

    def defect(self, start: Point, rows: Rows, tail: Rows | None) -> Array:
        """The largest difference from a stored state; ∞ where an inverse step failed."""
        plan, starts = self.plan, self.starts(start, rows)

        def of_arc(worst, arc):
            _, defects, is_solved = self.steps_by_inverse(self.inner_arc(arc))
            defect = jnp.max(defects, initial=0.0)
            return jnp.maximum(worst, jnp.where(is_solved, defect, jnp.inf))

        def of_block(worst, first, start, rows, count=plan.block):
            for pieces in self.pieces(start, rows, first, count):
                worst = pieces.fold(of_arc, worst)
            return worst

        worst = jnp.zeros((), start[0].dtype)
        if tail is not None:
            first = jnp.asarray(plan.num_blocks * plan.block, jnp.int32)
            worst = of_block(worst, first, row_of(starts, -1), tail, plan.tail)
        blocks = row_of(starts, slice(-1)), rows
        return fold_blocks(of_block, worst, plan.num_blocks, plan.block, blocks)


def _largest(sizes: Point, point: Point) -> Point:
    return jax.tree.map(lambda size, x: jnp.maximum(jnp.abs(size), jnp.abs(x)), sizes, point)
