"""Adaptive steps of explicit methods, by a reversible controller."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from lanewise.rules.exact import two_sum

from ..base.results import RESULTS
from ..base.signature import with_time
from ..base.types import Interval, Scalar
from ..engine.rounding import one_by_one
from ..methods.step import Equations
from ._base import Place, StepSizes, check_rounding, check_speed

_LARGEST_RATIO = 4.0
"""Largest ratio between h and δ g. The controller deviates from δ g by half of the change of g in a
step, which is a factor below two for every h that resolves g."""


class ControllerState(NamedTuple):
    """State of the controller between steps."""

    t: Scalar  # where the next step begins
    error: Scalar  # rounding error of t
    h: Scalar  # size of the last step


class AdaptiveReversible(StepSizes):
    r"""Explicit adaptive steps h ≈ δ g(t, q, p): small steps where g is small.

    The steps follow from the change of g along the motion (δ is the `h` of `integrate`):

        1/h_{k+1/2} = 1/h_{k−1/2} + G_k,     G = −d ln g/dt  at (t_k, q_k, p_k),
        1/h_{1/2}   = 1/(δ g_0) + G_0/2,

    with ∂H/∂p and −∂H/∂q + εW as the derivatives of q and p. An explicit method stays explicit, and
    a step costs little more than one of constant size. A backward run takes the same steps. The map
    is therefore reversible if the system is reversible and g is even in the momenta; then
    invariants of nearly integrable motion do not drift. The map is not symplectic.

    **Arguments** `speed`: g, function ``(q, p)`` or ``(t, q, p, args)`` → positive scalar, as for
    `TimeTransformed`; |q|^{3/2} is a good choice for Kepler's problem. H is H_D at t1 = t0.

    The method must be symmetric, such as `Strang` or `KahanLi`. `integrate` interprets `h` as δ
    [time / unit of g]. ``solution.stats`` has ``last_h`` [time] and ``resume_h``, the δ with which
    a run from the final state continues this one, and −δ goes back (NaN after a failure or a
    `Stop`). Gradients are those of the map; `Reversible` works as `Checkpointed`, because a step
    depends on the one before it.

    The status `step_control_failed` reports a step size whose sign has changed, or that differs
    from δ g by more than a factor of four: δ is then too large for the change of g in one step.

    **Limits** The error of h is of second order in δ. It does not reduce the order of the method,
    since every h is a step of it, but with a large error of the state the steps differ from δ g.
    In dissipative motion, on a limit cycle for example, errors of h do not cancel: steps slowly
    depart from δ g, until the run ends with this status. `TimeTransformed` has no such errors.

    **Raises** `TypeError` for a speed that is not a function, and in `integrate` `ValueError` for
    one that is not a positive scalar at the start, and for a method that is not symmetric.

    **Source** Hairer & Söderlind 2005, *SIAM J. Sci. Comput.* 26, 1838 (ρ = δ/h is their step
    density); Hairer, Lubich & Wanner 2006, VIII.3.2.

    **Example**

    ```python
    kepler = systems.kepler()
    close = dvi.AdaptiveReversible(lambda q, p: jnp.sqrt(q @ q))
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1, num_steps=100,
                        lattice=close, method=dvi.Strang())
    print(round(float(sol.hs.min()), 3), round(float(sol.hs.max()), 3))
    # 0.083 0.569
    ```
    """

    speed: Callable[..., Any]

    has_memory: ClassVar[bool] = True

    def __init__(self, speed: Callable[..., Any]):
        self.speed = with_time("the speed of AdaptiveReversible", speed)

    def check(self, method, arithmetic):
        if not method.is_symmetric:
            raise ValueError(
                "lattice=dvi.AdaptiveReversible(...) requires a symmetric method, such as "
                f"dvi.Strang(), got {method!r}."
            )
        check_rounding(type(self).__name__, arithmetic)

    def transform(self, run):
        check_speed(type(self).__name__, self.speed, run)
        return super().transform(run)

    def interval(self, t0, h, k):
        return Interval(t0, t0 + h, h)

    def begin(self, t0, h):
        return ControllerState(t0, jnp.zeros_like(h), h)

    def next(self, memory, equations, place):
        g, slope = self._along_the_motion(equations, memory.t, place.q, place.p)
        first = place.k == 0
        # As one quotient: 1/h + G = (g − h dg/dt)/(h g), half of it for the first step.
        inverse_rate = jnp.where(first, place.h * g, memory.h)
        h = inverse_rate * g / (g - jnp.where(first, 0.5, 1.0) * inverse_rate * slope)
        ratio = h / (place.h * g)
        # NaN, from a g that is not finite, is outside as well; so is a g that is not positive.
        follows = (g > 0) & (ratio < _LARGEST_RATIO) & (ratio > 1 / _LARGEST_RATIO)
        # Times carry no accumulated round-off: over many steps it would exceed the smallest h.
        t1, error = two_sum(memory.t, h + memory.error)
        status = RESULTS.where(follows, RESULTS.successful, RESULTS.step_control_failed)
        return Interval(memory.t, t1, h), ControllerState(t1, lax.stop_gradient(error), h), status

    def report(self, memory, equations, place):
        resume = one_by_one(AdaptiveReversible._resume_step, self, memory, equations, place)
        return {"last_h": memory.h, "resume_h": resume}

    def _resume_step(self, memory: ControllerState, equations: Equations, place: Place) -> Scalar:
        """The δ for which δ g is half a change after the last step, as it is at the start."""
        g, slope = self._along_the_motion(equations, memory.t, place.q, place.p)
        return jnp.where(place.k == 0, place.h, 2 * memory.h / (2 * g - memory.h * slope))

    def _along_the_motion(self, equations, t, q, p) -> tuple[Scalar, Scalar]:
        """g and dg/dt."""
        rates = equations.rates(Interval(t, t, jnp.zeros_like(t)), q, p)

        def g(t, q, p):
            return jnp.asarray(self.speed(t, q, p, equations.args), q.dtype)

        return jax.jvp(g, (t, q, p), (jnp.ones_like(t), *rates))
