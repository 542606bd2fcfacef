"""Events that change the state of a trajectory: bounces, kicks, mergers, changes of parameters."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array

from ..base.checks import instance, whole
from ..base.printing import printable
from ..base.signature import with_time


class Jump(eqx.Module):
    r"""A change of the state where g(t, q, p, args) reaches zero from below: a bounce, a kick.

    Where g rises through 0 inside of a step, the point with g = 0 is computed to round-off on the
    curve of the method, as for `Section`. There ``map`` replaces the state, and a shorter step of
    the method leads to the end of the step. So the time grid does not change, and the states have
    the order of the method. Several jumps in one step, of one or of several `Jump`, happen in the
    order of time; those at one time one after the other.

    **Arguments**

    - `g`: function ``(q, p)`` or ``(t, q, p, args)`` → scalar.
    - `map`: function of the same arguments → (q, p), the state after the jump; or (q, p, args),
      with other values of the parameters from then on.
    - `returns`: True (default) if the map sends the trajectory back to g < 0, as a wall does. The
      status is `not_returned` where it does not, so that no trajectory passes a wall. False for
      surfaces that may be passed: a kick at a time t_k, g = t − t_k; a change of a stage. The next
      jump then requires g < 0 in between.
    - `max_jumps`: the largest number of jumps that is stored in ``solution.jumps``, see `Jumps`;
      of a list of `Jump` the sum. It is static. With 0 the jumps are only counted.

    Derivatives contain the change of the time of the jump (saltation), also those of `Lyapunov`
    exponents and other deviation vectors. `Reversible` works as `Checkpointed`.

    **Limits** The steps must resolve g. If it is positive within a step, but negative at its ends,
    the jump is made where g is concave in time: dg/dt at the ends shows it. Else it is missed. The
    surface of a `Section` must be another than that of the jump, where it is zero up to rounding.
    After a jump its g is ignored for a fraction of a step, 5.5e-7 in float64 and
    1.7e-3 in float32, in which it is zero up to rounding; so it is at the start of a run. More than
    8 jumps in one step end the run with the status `too_many_jumps`, for instance where the bounces
    of a ball accumulate. At a point where two surfaces meet, the derivative is that of the order in
    which the jumps were made.

    **Raises** `TypeError` for other functions, and in `integrate` `ValueError` for noise,
    constraints, observables of a step, other arithmetic than `FloatingPoint`, and lattices whose
    steps depend on the ones before.

    **Source** Saltation: Aizerman & Gantmacher 1958, *Q. J. Mech. Appl. Math.* 11, 464.

    **Example**

    ```python
    ball = dvi.System(lambda t0, t1, q, p, args: p[0] ** 2 / 2 + q[0])
    floor = dvi.Jump(lambda q, p: -q[0], lambda q, p: (q, -0.8 * p))
    sol = dvi.integrate(ball, [1.0], [0.0], h=0.1, num_steps=40, method="strang", jump=floor)
    print(sol.status, int(sol.jumps.count), np.round(sol.jumps.ts[:2], 4))
    # successful 2 [1.4142 3.677 ]
    ```
    """

    g: Callable[..., Any]
    map: Callable[..., Any]
    returns: bool = eqx.field(static=True, default=True)
    capacity: int = eqx.field(static=True, default=100)

    def __init__(
        self,
        g: Callable[..., Any],
        map: Callable[..., Any],
        returns: bool = True,
        max_jumps: int = 100,
    ):
        self.g = with_time("g of Jump", g)
        self.map = with_time("map of Jump", map)
        self.returns = instance("returns", returns, bool, "True or False")
        self.capacity = whole("max_jumps", max_jumps, 0, hint="With 0 jumps are only counted.")


@printable
class Jumps(eqx.Module):
    """The jumps of a trajectory, in the order of time; NaN and index −1 after the last one.

    - `ts`: times, shape (max_jumps,). `index`: which `Jump` of the list, likewise.
    - `qs_before`, `ps_before`, `qs_after`, `ps_after`: states, shape (max_jumps, *q0.shape).
    - `count`: number of jumps. If it is above max_jumps, only the first of these are listed.
    """

    ts: Array
    index: Array
    qs_before: Array
    ps_before: Array
    qs_after: Array
    ps_after: Array
    count: Array
