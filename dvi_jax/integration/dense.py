"""The trajectory between the points of its time grid: crossings, requested times, end points."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from lanewise import Layout

from ..base.results import RESULTS, first_of
from ..base.types import Interval, Scalar, State
from ..engine.bracket import bracketed_root
from ..engine.guard import constant_unless
from ..engine.rounding import each, one_by_one
from ..methods import Method
from ..methods.step import Equations, info_of
from ..observe import Crossings, Reduction, Section, Stop, Stopped, is_observable
from ..observe._kept import RequestedTimes, StepStart, event, from_rows, shown
from ..observe.solution import Save
from ..problem.paths import NoisePath
from .task import Task

Point = tuple[Scalar, State, State]
"""(t, q, p)."""

PointAndStatus = tuple[Point, RESULTS]
"""A point, and the status of the step from which it follows."""


class Curve(eqx.Module):
    """The curve Φ_{θh}(q0, p0), 0 ≤ θ ≤ 1, of a method between the ends of a step."""

    # A substep of the method itself, not an interpolation: it has the order of the method, and its
    # end is the end of the step.
    method: Method
    equations: Equations
    path: NoisePath | None
    layout: Layout = eqx.field(static=True)

    @classmethod
    def of_task(cls, task: Task, layout: Layout) -> "Curve":
        # In fixed point the curve would be a staircase, on which no root can be found.
        equations = dataclasses.replace(task.equations, quantum=None)
        return cls(task.method, equations, task.path, layout)

    def point(self, start: StepStart, theta: Scalar) -> PointAndStatus:
        """(t, q, p) at the fraction θ of the step."""
        h = theta * (start.t1 - start.t0)
        t, equations = start.t0 + h, self.equations
        if self.path is not None:
            step = Interval(start.t0, start.t1, start.t1 - start.t0)
            increments = self.path.increments_within(start.k, step, theta)
            equations = dataclasses.replace(equations, increments=increments)
        q, p, info = self.method.step(equations, Interval(start.t0, t, h), start.q0, start.p0)
        return (t, q, p), info_of(self.method, info, q, p).result

    def where(self, g: Callable[..., Any], start: StepStart, exists: Array) -> PointAndStatus:
        """The point of the step where g(t, q, p, args) = 0, or its end if none `exists`."""

        def value(theta, curve=self, start=start):
            point, _ = curve.point(start, theta)
            return event(g, *point, curve.equations.args)

        zero, unit = jnp.zeros_like(start.t0), jnp.ones_like(start.t0)
        at_zero = event(g, start.t0, start.q0, start.p0, self.equations.args)
        # The bracket has no derivative: that of a whole step would be compiled for nothing.
        arrays, rest = eqx.partition((self, start), eqx.is_array)
        at_unit = value(unit, *eqx.combine(lax.stop_gradient(arrays), rest))
        theta = bracketed_root(value, zero, at_zero, unit, at_unit, exists)
        return self.point(start, theta)


def requested_times(save: Save, task: Task, num_steps: int) -> tuple[RequestedTimes, PyTree]:
    """The observables of a run with requested times: the steps of those times, and reductions."""
    if task.has_running_values:
        raise ValueError(
            "dvi.Running, whose values exist at grid points only, cannot be combined with "
            "save=dvi.Save(ts=...): use dvi.Save(every=m)."
        )
    # Functions that are not reductions are evaluated at the requested times, after the run.
    reductions = jax.tree.map(
        lambda f: f if isinstance(f, Reduction) else None, task.observe, is_leaf=is_observable
    )
    ts = jnp.asarray(save.ts, task.t0.dtype)
    due = lax.stop_gradient(ts)
    if save.clock is None and not task.lattice.has_memory and num_steps > 0:
        eps = jnp.finfo(ts.dtype).eps
        end = task.interval(jnp.asarray(num_steps - 1, jnp.int32)).t1
        # N·(T/N) may differ from T in the last digit: a request at an end of the run is moved to
        # it, so that it is not outside. The derivative is that of the requested time.
        for edge in (task.t0, end):
            size = jnp.maximum(jnp.abs(task.t0), jnp.abs(edge))
            is_edge = jnp.abs(ts - edge) <= 16 * eps * size
            ts = jnp.where(is_edge, ts + lax.stop_gradient(edge - ts), ts)
        # Also t0 + k h, compiled in a loop, may differ in the last digit from its value here.
        slack = 4 * eps * (jnp.abs(task.t0) + jnp.abs(ts))
        due = lax.stop_gradient(ts - jnp.where(end >= task.t0, slack, -slack))
    return RequestedTimes(ts=ts, due=due, ordered=jnp.sort(due), clock=save.clock), reductions


def crossings(
    curve: Curve, section: Section, record: tuple[Array, Array, Array], safe: StepStart
) -> tuple[Crossings, RESULTS]:
    """The crossings in the steps that a section has recorded, and their status. `safe` is any step
    that exists."""
    rows, count, steps = record
    exists, starts = _steps(rows, steps, safe)
    point_of = guarded(_crossing, (curve, section.g), curve.layout, has_succeeded)
    points, statuses = jax.vmap(point_of)(exists, starts, exists)
    ts, qs, ps = _or_nan(exists, points)
    is_known = ~jnp.isnan(count)
    status = RESULTS.where(is_known, first_of(statuses, exists), RESULTS.event_not_finite)
    return Crossings(ts, qs, ps, jnp.where(is_known, count, 0).astype(jnp.int32)), status


def _crossing(surface: tuple[Curve, Callable], start: StepStart, exists: Array) -> PointAndStatus:
    curve, g = surface
    return curve.where(g, start, exists)


def at_times(
    curve: Curve, request: RequestedTimes, record: tuple[Array, Array, Array], safe: StepStart
) -> tuple[Array, StepStart, Point, RESULTS]:
    """For each requested time: is it reached, the step that contains it, and the point there; and
    the status of these points."""
    exists, starts = _steps(record[0], record[2], safe)
    clock = (curve, request.clock)
    readings = each(_reading, clock, starts, layout=curve.layout)
    first = one_by_one(_reading, clock, safe, layout=curve.layout)
    sense = jnp.where(starts.until[0] >= readings[0], 1, -1)  # −1: time runs backwards
    # In ascending order, as bisection requires: empty rows, which are last, are at infinity.
    ends = jnp.where(exists, sense * starts.until, jnp.inf)

    def at_time(time, due):
        i = jnp.minimum(jnp.searchsorted(ends, sense * due), ends.size - 1)
        is_reached = exists[i] & (sense * readings[i] < sense * due) & (sense * due <= ends[i])
        start = jax.tree.map(lambda x, y: jnp.where(is_reached, x[i], y), starts, safe)
        is_first = time == first
        if request.clock is None:
            time = jnp.where(is_first, _just_after(time, start), time)
        point_of = guarded(_point_at, clock, curve.layout, has_succeeded)
        point, status, is_shown = point_of(is_reached | is_first, start, time, is_reached)
        origin = (safe.t0, safe.q0, safe.p0)
        if request.clock is None:  # the value of the start to the bit, the slope of the curve
            origin = jax.tree.map(_with_slope, point, origin)
        point = jax.tree.map(lambda a, b: jnp.where(is_first, b, a), point, origin)
        has_point = (is_reached & is_shown) | is_first
        # The state at the start needs no step.
        status = RESULTS.where(is_reached & ~is_first, status, RESULTS.successful)
        return has_point, start, _or_nan(has_point, point), status

    has_point, start, points, statuses = jax.vmap(at_time)(request.ts, request.due)
    return has_point, start, points, first_of(statuses, jnp.asarray(True))


Clock = tuple[Curve, Any]
"""A curve, and the function whose value is the time (None: t itself)."""


def _reading(clock: Clock, start: StepStart) -> Scalar:
    """The value of the clock at the start of a step."""
    curve, function = clock
    return shown(function, start.t0, start.q0, start.p0, curve.equations.args)


def _point_at(
    clock: Clock, start: StepStart, time: Scalar, is_reached: Array
) -> tuple[Point, RESULTS, Array]:
    """The point of the step at a requested time, its status, and whether the clock shows that time
    there."""
    curve, function = clock
    if function is None:
        theta = (time - start.t0) / (start.t1 - start.t0)
        return *curve.point(start, theta), jnp.asarray(True)
    args = curve.equations.args

    def delay(t, q, p, args):
        return shown(function, t, q, p, args) - time

    (t, q, p), status = curve.where(delay, start, is_reached)
    # A clock that jumps has passed the value without showing it; so has one that is not monotonic.
    error = jnp.abs(shown(function, t, q, p, args) - time)
    span = jnp.abs(start.until - _reading(clock, start))
    tolerance = jnp.sqrt(jnp.finfo(start.q0.dtype).eps)
    return (t, q, p), status, error <= tolerance * (span + jnp.abs(time))


def _just_after(time: Scalar, start: StepStart) -> Scalar:
    """A time slightly later than `time`, with the same derivative."""
    # At the start of the run the substep would have h = 0, and an H_D may divide by t1 − t0.
    part = jnp.finfo(start.q0.dtype).eps ** 0.4
    return time + lax.stop_gradient(part * (start.t1 - start.t0))


def stop_point(
    curve: Curve, stop: Stop, record: tuple[Array, Array], safe: StepStart
) -> tuple[Stopped, RESULTS]:
    """The point g = 0 in the last step of a run, the start of that step if g ≥ 0 there already; and
    its status."""
    exists, start = _steps(*record, safe)
    origin = (start.t0, start.q0, start.p0)
    value = one_by_one(event, stop.g, *origin, curve.equations.args, layout=curve.layout)
    is_start = value >= 0
    surface = (curve, stop.g)
    has_root = exists & ~is_start
    point_of = guarded(_crossing, surface, curve.layout, has_succeeded)
    point, status = point_of(has_root, start, has_root)
    point = jax.tree.map(lambda a, b: jnp.where(is_start, b, a), point, origin)
    status = RESULTS.where(has_root, status, RESULTS.successful)
    return Stopped(*_or_nan(exists, point)), status


def guarded(
    function: Callable, constants: Any, layout: Layout, succeeds: Callable | None = None
) -> Callable:
    """``(exists, *row) → function(constants, *row)`` with the bits of a call for one row alone. Its
    derivative is zero where no such row `exists`, or ``succeeds(result)`` is False."""

    def value(*row):
        return one_by_one(function, constants, *row, layout=layout)

    def guarded_value(exists, *row):
        return constant_unless(exists, value, *row, succeeds=succeeds)

    return guarded_value


def has_succeeded(result: Any) -> Array:
    """Whether a point, whose status is the second entry, has been computed."""
    return result[1] == RESULTS.successful


def _with_slope(curve: Array, value: Array) -> Array:
    """`value` to the bit, with the derivative of `curve`, or its own where `curve` is NaN."""
    return jnp.where(jnp.isnan(curve), value, curve + lax.stop_gradient(value - curve))


def _steps(rows: Array, k: Array, safe: StepStart) -> tuple[Array, StepStart]:
    """The steps in the rows, of the numbers k, and the safe one for an empty row."""
    exists, starts = from_rows(rows, k, safe.q0.shape)

    def fill(x, substitute):
        return jnp.where(_flags_like(exists, x), x, substitute)

    return exists, jax.tree.map(fill, starts, safe)


def _or_nan(exists: Array, points: Any) -> Any:
    return jax.tree.map(lambda x: jnp.where(_flags_like(exists, x), x, jnp.nan), points)


def _flags_like(exists: Array, x: Array) -> Array:
    """Flags of rows, in a shape that broadcasts to that of x."""
    return exists.reshape(exists.shape + (1,) * (x.ndim - exists.ndim))
