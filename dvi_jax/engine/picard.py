"""Fixed-point iteration for implicit steps with many unknowns, and the default solver."""

import functools

import equinox as eqx
import jax.numpy as jnp
from jax import lax

import lanewise

from ..base.checks import instance, whole
from .contraction import Contraction
from .newton import Function, Newton, RootInfo, RootSolver, Scales, Vector


class Picard(Contraction):
    r"""Fixed-point (Picard) iteration, x ← x − F(x): no Jacobian, no linear solve.

    For the type II map it is p1 ← p0 + h (−∂H_D/∂q0 + εW)(t0, t1, q0, p1), one evaluation each. It
    converges where h times the derivative of the rate in the unknown is less than one, linearly
    with that factor: in two iterations for weakly implicit systems, such as a small force that
    depends on the momenta of many bodies; not at all for strongly implicit ones.

    The iteration stops once the estimated error of each component is at most ``rtol * scale +
    atol``. With corrections δ_k and θ = δ_k / δ_{k−1} the estimate is δ_k θ / (1 − θ), at most δ_k;
    `scale` is the largest of the component's start, guess and root. A component whose corrections
    are round-off and no longer shrink has converged as well.

    Tangents and cotangents are computed by the same iteration on the linearised F: derivatives form
    no Jacobian either. Where it does not converge the derivative is NaN.

    **Arguments**

    - `rtol`: relative tolerance of the error; None means 1/16 of the unit of round-off.
    - `atol`: absolute tolerance [unit of the unknown].
    - `max_steps`: iterations after which the status becomes `not_converged`.

    **Raises** `ValueError` for tolerances that are negative or both zero, or fewer than one step.

    **Source** Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, VIII.6 (fixed-point
    iteration against Newton's); the error estimate: Hairer & Wanner 1996, *Solving ODEs II*, IV.8.
    """

    def correction(self, F, x0):
        return F  # F(x) = x − (right side): subtracting it is the fixed-point iteration

    def solve_tangent(self, linear, rhs):
        return _without_matrix(self, linear, rhs)


class PicardThenNewton(RootSolver):
    """The default: Newton's method for few unknowns; for many `Picard`, then Newton if it is slow.

    With many unknowns Picard's iteration comes first. It stops for a trajectory as soon as a
    correction is more than half of the one before; then Newton's method solves that trajectory from
    the beginning. Results of other trajectories in the batch do not change.

    **Arguments**

    - `newton_up_to`: number of unknowns up to which only Newton's method is used: the components of
      q for `TypeII` and its compositions, times stages and sides for `GaussLegendre` and
      `LobattoIIIAIIIB`. None means 16.
    - `picard`, `newton`: settings of the two.

    **Raises** `ValueError` for a number that is negative or not an integer, `TypeError` for
    settings of another type.
    """

    newton_up_to: int | None = eqx.field(static=True, default=None)
    picard: Picard = Picard(max_steps=12)
    newton: Newton = Newton()

    def __check_init__(self):
        if self.newton_up_to is not None:
            whole("newton_up_to", self.newton_up_to, low=0)
        instance("picard", self.picard, Picard, "a dvi.Picard(...)")
        instance("newton", self.newton, Newton, "a dvi.Newton(...)")

    def _is_few(self, n: int) -> bool:
        return n <= (_NEWTON_UP_TO if self.newton_up_to is None else self.newton_up_to)

    def solve(self, F, x0, scales):
        if self._is_few(x0.size):
            return self.newton.solve(F, x0, scales)
        first = self.picard.contract(F, x0, scales, slowest=0.5)

        # From x0, not from where Picard's iteration stopped: it may have diverged. The branch runs
        # for the whole batch, so that the trajectories that have converged keep their numbers.
        def with_newton(first: RootInfo) -> RootInfo:
            second = self.newton.solve(F, x0, scales)
            second = second._replace(iterations=first.iterations + second.iterations)
            return RootInfo(*map(functools.partial(jnp.where, first.converged), first, second))

        return lax.cond(lanewise.on_any(~first.converged), with_newton, lambda first: first, first)

    def solve_tangent(self, linear, rhs):
        if self._is_few(rhs.size):
            return self.newton.solve_tangent(linear, rhs)
        return _without_matrix(self, linear, rhs)


# Measured: up to here the elimination of a banded Jacobian is faster than Picard's iteration.
_NEWTON_UP_TO = 16


def _without_matrix(solver: RootSolver, linear: Function, rhs: Vector) -> Vector:
    """x with linear(x) = rhs by `solver` itself, and likewise for the transpose."""

    def solve(A, b):
        size = lax.stop_gradient(jnp.abs(b))
        x, _, _, converged = solver.solve(lambda x: A(x) - b, b, Scales(size, size))
        # A derivative has no status of its own: NaN is the only way to report a failure.
        return jnp.where(converged, x, jnp.nan)

    return lax.custom_linear_solve(linear, rhs, solve, solve)
