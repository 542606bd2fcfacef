"""The trajectory inside of its steps: crossings, requested times, the point where it stopped."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from lanewise import Layout

from ._rollout import Task
from ._solution import Save
from ._step import Equations
from ._types import Interval, Scalar, State
from .engine.bracket import bracketed_root
from .engine.rounding import each, one_by_one
from .methods import Method
from .observe import Crossings, Reduction, Section, Stop, Stopped, is_observable
from .observe._kept import RequestedTimes, Start, event, from_rows, shown

Point = tuple[Scalar, State, State]
"""(t, q, p)."""


class Curve(eqx.Module):
    """The curve that a method draws inside of a step, Φ_{θh}(q0, p0) for 0 ≤ θ ≤ 1.

    It is of the method's own order, and ends where the step ends.
    """

    method: Method
    equations: Equations
    layout: Layout = eqx.field(static=True)

    @classmethod
    def of(cls, method: Method, equations: Equations, layout: Layout) -> "Curve":
        # On a grid of its own the curve would be a staircase: between lattice points it is smooth.
        return cls(method, dataclasses.replace(equations, quantum=None), layout)

    def point(self, start: Start, theta: Scalar) -> Point:
        """(t, q, p) at the fraction θ of the step."""
        h = theta * (start.t1 - start.t0)
        t = start.t0 + h
        q, p, _ = self.method.step(self.equations, Interval(start.t0, t, h), start.q0, start.p0)
        return t, q, p

    def where(self, g: Callable[..., Any], start: Start, exists: Array) -> Point:
        """The point of the step where g(t, q, p, args) = 0, or its end if nothing `exists`."""

        args = self.equations.args

        def at(theta):
            return event(g, *self.point(start, theta), args)

        zero, one = jnp.zeros_like(start.t0), jnp.ones_like(start.t0)
        at_zero = event(g, start.t0, start.q0, start.p0, args)
        theta = bracketed_root(at, zero, at_zero, one, at(one), exists)
        return self.point(start, theta)


def requested_times(save: Save, task: Task, num_steps: int) -> tuple[RequestedTimes, PyTree]:
    """What is observed along the run when states are saved at requested times: no observables that
    stand alone, which are evaluated at those times afterwards."""
    if task.has_running_values:
        raise ValueError(
            "Running tells a reduction at lattice points, and Save(ts=...) asks for other times: "
            "take save=dvi.Save(every=m)."
        )
    kept = jax.tree.map(
        lambda f: f if isinstance(f, Reduction) else None, task.observe, is_leaf=is_observable
    )
    ts = jnp.asarray(save.ts, task.t0.dtype)
    due = lax.stop_gradient(ts)
    if save.clock is None and not task.lattice.has_memory and num_steps > 0:
        eps = jnp.finfo(ts.dtype).eps
        end = task.interval(jnp.asarray(num_steps - 1, jnp.int32)).t1
        for known in (task.t0, end):  # N·(T/N) need not be T to the last digit
            size = jnp.maximum(jnp.abs(task.t0), jnp.abs(known))
            near = jnp.abs(ts - known) <= 16 * eps * size
            ts = jnp.where(near, ts + lax.stop_gradient(known - ts), ts)
        # Nor is t0 + k h, compiled in a loop, the same to the last digit as it is here.
        slack = 4 * eps * (jnp.abs(task.t0) + jnp.abs(ts))
        due = lax.stop_gradient(ts - jnp.where(end >= task.t0, slack, -slack))
    return RequestedTimes(ts=ts, due=due, ordered=jnp.sort(due), clock=save.clock), kept


def crossings(curve: Curve, section: Section, kept: tuple[Array, Array], safe: Start) -> Crossings:
    """The crossings in the steps that a section has kept. `safe` is any step that can be taken."""
    rows, count = kept
    exists, starts = _steps(rows, safe)
    found = each(
        lambda given, *row: given[0].where(given[1].g, *row), (curve, section), starts, exists,
        layout=curve.layout,
    )  # fmt: skip
    ts, qs, ps = _or_nan(exists, found)
    return Crossings(ts, qs, ps, count.astype(jnp.int32))


def at_times(
    curve: Curve, requested: RequestedTimes, kept: tuple[Array, Array], safe: Start
) -> tuple[Array, Start, Point]:
    """For each requested time: if it was reached, the step that it lies in, and the point there."""
    exists, starts = _steps(kept[0], safe)
    given = (curve, requested.clock)
    began = each(_shown, given, starts, layout=curve.layout)
    first = one_by_one(_shown, given, safe, layout=curve.layout)
    sense = jnp.where(starts.until[0] >= began[0], 1, -1)  # −1: time runs backwards
    ends = jnp.where(exists, sense * starts.until, jnp.inf)

    def one(time, due):
        i = jnp.minimum(jnp.searchsorted(ends, sense * due), ends.size - 1)
        reached = exists[i] & (sense * began[i] < sense * due) & (sense * due <= ends[i])
        start = jax.tree.map(lambda x, y: jnp.where(reached, x[i], y), starts, safe)
        is_start = time == first
        if requested.clock is None:
            time = jnp.where(is_start, _just_after(time, start), time)
        point, is_shown = one_by_one(_within, given, start, time, reached, layout=curve.layout)
        known = (safe.t0, safe.q0, safe.p0)
        if requested.clock is None:  # the start to the bit, with the slope of the curve
            known = jax.tree.map(lambda a, b: a + lax.stop_gradient(b - a), point, known)
        point = jax.tree.map(lambda a, b: jnp.where(is_start, b, a), point, known)
        found = (reached & is_shown) | is_start
        return found, start, _or_nan(found, point)

    return jax.vmap(one)(requested.ts, requested.due)


def _shown(given, start: Start) -> Scalar:
    """What the clock shows where a step begins."""
    curve, clock = given
    return shown(clock, start.t0, start.q0, start.p0, curve.equations.args)


def _within(given, start: Start, time: Scalar, reached: Array) -> tuple[Point, Array]:
    """The point of the step at a requested time, and if the clock shows that time there."""
    curve, clock = given
    if clock is None:
        theta = (time - start.t0) / (start.t1 - start.t0)
        return curve.point(start, theta), jnp.asarray(True)
    args = curve.equations.args

    def late(t, q, p, args):
        return shown(clock, t, q, p, args) - time

    t, q, p = curve.where(late, start, reached)
    # A clock that jumps, or turns, has passed the value without showing it.
    missed = jnp.abs(shown(clock, t, q, p, args) - time)
    span = jnp.abs(start.until - _shown(given, start))
    close = jnp.sqrt(jnp.finfo(start.q0.dtype).eps)
    return (t, q, p), missed <= close * (span + jnp.abs(time))


def _just_after(time: Scalar, start: Start) -> Scalar:
    """A time a little inside of the step, moving as `time` does: an H_D may divide by its step."""
    part = jnp.finfo(start.q0.dtype).eps ** 0.4
    return time + lax.stop_gradient(part * (start.t1 - start.t0))


def stopped(curve: Curve, stop: Stop, row: Array, safe: Start) -> Stopped:
    """Where g = 0 in the step that a run stopped in; its start if g ≥ 0 already there."""
    exists, start = _steps(row, safe)
    began = (start.t0, start.q0, start.p0)
    args = curve.equations.args
    at_start = one_by_one(_event, stop, began, args, layout=curve.layout) >= 0
    point = one_by_one(
        lambda curve, stop, *row: curve.where(stop.g, *row), curve, stop, start, exists & ~at_start,
        layout=curve.layout,
    )  # fmt: skip
    point = jax.tree.map(lambda a, b: jnp.where(at_start, b, a), point, began)
    return Stopped(*_or_nan(exists, point))


def _event(stop: Stop, point: Point, args) -> Scalar:
    return event(stop.g, *point, args)


def _steps(rows: Array, safe: Start) -> tuple[Array, Start]:
    """The steps in the rows, the safe one where a row is empty."""
    exists, starts = from_rows(rows, safe.q0.shape)

    def filled(x, substitute):
        return jnp.where(_beside(exists, x), x, substitute)

    return exists, jax.tree.map(filled, starts, safe)


def _or_nan(exists: Array, points: Any) -> Any:
    return jax.tree.map(lambda x: jnp.where(_beside(exists, x), x, jnp.nan), points)


def _beside(exists: Array, x: Array) -> Array:
    return exists.reshape(exists.shape + (1,) * (x.ndim - exists.ndim))
