"""Steps that are recorded during a run and evaluated at its end."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.checks import array, one_of, whole
from ..base.printing import printable
from ..base.signature import array_type, with_time
from ..base.types import Args, Scalar, State
from ._reductions import Reduction

_UNLESS_FIRST = 2
"""Row flag: keep this step unless it is the first of the run."""

_UNKNOWN = -(2**30)
"""The count after a row whose flag is NaN: whether that step belongs to the list is not known."""


class StepStart(NamedTuple):
    """Start of a step, its end t1, which is `until` by the clock, and its number."""

    t0: Scalar
    t1: Scalar
    until: Scalar
    q0: State
    p0: State
    k: Any = 0


class KeptSteps(Reduction):
    """Base of the reductions that record the starts of some steps, in the order of time.

    `function` returns a row, see `as_row`. The first `skip` of these steps are left out. The result
    is the rows, NaN where there are fewer than the capacity, how many there were: NaN if it is not
    known whether a step belongs to them; and the numbers of these steps.
    """

    function: ClassVar[Callable[..., Any]]
    has_running_value: ClassVar[bool] = False

    # For a type checker, abstract variables would be constructor arguments of every subclass.
    if TYPE_CHECKING:
        capacity: ClassVar[int]
        skip: ClassVar[int]
    else:
        capacity: eqx.AbstractVar[int]
        skip: eqx.AbstractVar[int]

    def start(self, value):
        rows = jnp.full((self.capacity, *value.shape), jnp.nan, value.dtype)
        # Step −1 does not exist: `combine` gives an empty row no derivative.
        return rows, jnp.full((self.capacity,), -1, jnp.int32), jnp.asarray(-self.skip, jnp.int32)

    def update(self, memory, k, t, value):
        rows, steps, count = memory
        hit = (value[0] == 1) | ((value[0] == _UNLESS_FIRST) & (k > 0))
        count = jnp.where(jnp.isnan(value[0]), _UNKNOWN, count)
        # The count begins at −skip. A place beyond the end is dropped, without a branch.
        place = jnp.where(hit & (count >= 0), count, self.capacity)
        rows = rows.at[place].set(value, mode="drop")
        return rows, steps.at[place].set(k, mode="drop"), count + jnp.where(hit, 1, 0)

    def finish(self, memory) -> Any:
        rows, steps, count = memory
        # The count is negative while the first hits are skipped.
        number = jnp.maximum(count, 0).astype(rows.dtype)
        return rows, jnp.where(count < _UNKNOWN // 2, jnp.nan, number), steps

    def combine(self, memory, k, t, value):
        rows, steps, count = memory
        return rows + self.change(value[None], (steps == k)[:, None]), steps, count


def as_row(hit: Array, start: StepStart) -> Float[Array, " width"]:
    """One step as a row of numbers, the first of which is `hit`: 0, 1, 2, or NaN if not known."""
    parts = (hit.astype(start.q0.dtype), start.t0, start.t1, start.until)
    return jnp.concatenate([jnp.stack(parts), start.q0.ravel(), start.p0.ravel()])


def from_rows(
    rows: Float[Array, "... width"], k: Array, shape: tuple[int, ...]
) -> tuple[Array, StepStart]:
    """Which rows hold a step, and the steps of the numbers k, for positions of this shape."""
    lead = rows.shape[:-1]
    q0, p0 = (x.reshape(*lead, *shape) for x in jnp.split(rows[..., 4:], 2, axis=-1))
    ends = rows[..., 1], rows[..., 2], rows[..., 3]
    return rows[..., 0] >= 1, StepStart(*ends, q0, p0, k)


@printable
class Crossings(eqx.Module):
    """The points where a trajectory crossed a section, in the order of time.

    - `ts`, `qs`, `ps`: shapes (max_crossings,), (max_crossings, *q0.shape); NaN after the last one.
    - `count`: number of crossings after the first `skip`. If it is above max_crossings, only the
      first of these are listed.
    """

    ts: Array
    qs: Array
    ps: Array
    count: Array


class Section(KeptSteps):
    r"""Observable: where the trajectory crosses the surface g(t, q, p, args) = 0 (Poincaré 1892).

    A step contains a crossing when g has different signs at its ends. The crossing is computed to
    round-off on the curve Φ_{θh}(q0, p0), 0 < θ ≤ 1, of the method inside of the step. So it has
    the order of the method. The run only records these steps, and computes the points at its end.

    **Arguments**

    - `g`: function ``(q, p)`` or ``(t, q, p, args)`` → scalar. For an angle use sin or cos, which
      do not jump.
    - `direction`: 1 (the default, as in `poincare_section` and `ReturnMap`) for crossings where g
      increases with time, −1 where it decreases, 0 for both; the same points for h > 0 and h < 0.
    - `max_crossings`: the largest number that is stored; static.
    - `skip`: number of crossings at the beginning that are left out (a transient); static.

    The observed value is a `Crossings`. It is differentiable, the times included, and may be
    batched. Two crossings within one step are not detected: the steps must resolve the extrema of
    g. A start on the surface up to rounding (1e-6 of a step in float64, 2e-3 in float32) is not a
    crossing; a grid point on it ends one. A crossing in the last step before a `Stop` is left out.

    **Raises** `TypeError` for another g, `ValueError` for another direction, a max_crossings below
    1, and in `integrate` for a g that is not a scalar.

    **Example**

    ```python
    kepler = systems.kepler()
    axis = dvi.Section(lambda q, p: q[0], direction=1, max_crossings=20)
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1, num_steps=600,
                        observe={"axis": axis}, method=dvi.Yoshida(4), save=dvi.Save(final=True))
    crossed = sol.observed["axis"]
    print(int(crossed.count), np.round(crossed.ts[:2], 2))
    # 2 [ 2.91 39.9 ]
    ```
    """

    g: Callable[..., Any]
    direction: int = eqx.field(static=True, default=1)
    capacity: int = eqx.field(static=True, default=1000)
    skip: int = eqx.field(static=True, default=0)

    def __init__(
        self, g: Callable[..., Any], direction: int = 1, max_crossings: int = 1000, skip: int = 0
    ):
        self.g = with_time("g of Section", g)
        self.direction = direction.item() if isinstance(direction, np.integer) else direction
        self.capacity = whole("max_crossings", max_crossings)
        self.skip = whole("skip", skip, 0, hint="It is a number of crossings.")

    def __check_init__(self):
        hint = "1 selects the crossings where g increases, -1 where it decreases, 0 both."
        one_of("direction", self.direction, (1, -1, 0), hint)

    def function(self, t0, t1, q0, p0, q1, p1, args):
        g0, g1 = event(self.g, t0, q0, p0, args), event(self.g, t1, q1, p1, args)
        # A zero belongs to the step that ends there: a crossing at a grid point is counted once.
        rises, falls = (g0 < 0) & (g1 >= 0), (g0 > 0) & (g1 <= 0)
        hit = rises | falls
        # `direction` refers to increasing time: for h < 0 a step passes the surface the other way.
        if self.direction != 0:
            with_time, against_time = (rises, falls)[:: self.direction]
            hit = jnp.where(t1 > t0, with_time, against_time)
        # A run that continues from a crossing starts on the surface only up to rounding.
        tolerance = jnp.finfo(g0.dtype).eps ** 0.4
        begins_on_it = jnp.abs(g0) <= tolerance * jnp.abs(g1 - g0)
        flag = jnp.where(hit & begins_on_it, _UNLESS_FIRST, hit.astype(g0.dtype))
        # After a failure the state is NaN, and there are no crossings, also of a g that depends on
        # the time only; those before are still known.
        is_state = jnp.all(jnp.isfinite(q1)) & jnp.all(jnp.isfinite(p1))
        flag = jnp.where(jnp.isnan(g0) | jnp.isnan(g1), jnp.nan, flag)
        flag = jnp.where(is_state, flag, 0)
        return as_row(flag, StepStart(t0, t1, t1, q0, p0))


class RequestedTimes(KeptSteps):
    """The steps that contain the times of ``Save(ts=...)``, by t or by a user-defined clock.

    `due` are the times minus their possible rounding error: the step in which one is due is the one
    that reaches it. `ordered` are these in ascending order, for bisection.
    """

    ts: Array
    due: Array
    ordered: Array
    clock: Callable[..., Any] | None
    skip: ClassVar[int] = 0

    @property
    def capacity(self) -> int:
        return self.ts.shape[0]

    def function(self, t0, t1, q0, p0, q1, p1, args):
        start = shown(self.clock, t0, q0, p0, args)
        end = shown(self.clock, t1, q1, p1, args)

        # Bisection: a comparison with every requested time would be made in each step.
        def count(x, side):
            return jnp.searchsorted(self.ordered, x, side=side)

        forwards = count(end, "right") > count(start, "right")  # (start, end]
        backwards = count(start, "left") > count(end, "left")  # [end, start)
        hit = jnp.where(end >= start, forwards, backwards)
        # A failed step has no curve on which a state could be computed.
        return as_row(hit & jnp.all(jnp.isfinite(q1)), StepStart(t0, t1, end, q0, p0))


def shown(clock: Callable[..., Any] | None, t: Scalar, q: State, p: State, args: Args) -> Scalar:
    """The value of a clock at a point; the time t without a clock."""
    return t if clock is None else event(clock, t, q, p, args, "the clock")


def event(
    g: Callable[..., Any], t: Scalar, q: State, p: State, args: Args, name: str = "g"
) -> Scalar:
    """g at a point, refused unless it is a real scalar that can pass through a value."""
    value = g(t, q, p, args)
    array_type(f"{name}(t, q, p, args)", value)
    value = jnp.asarray(value)
    hint = "For a condition such as |q| > 2 take the difference |q| − 2."
    array(f"{name}(t, q, p, args)", value, (), verb="return", hint=hint)
    return value.astype(q.dtype)
