"""Fixed-point iteration for implicit steps with many unknowns, and the solver by default."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax

import lanewise

from .._checks import instance, whole
from .contraction import Contraction, contract
from .newton import Found, Function, Newton, RootSolver, Scales, Vector


class Picard(Contraction):
    r"""Fixed-point (Picard) iteration, x ← x − F(x): no Jacobian, no linear solve.

    For the type II map that is p1 ← p0 + h (−∂H_D/∂q0 + εW)(t0, t1, q0, p1), one evaluation each.
    It converges where h times the derivative of the rate in the unknown is less than one, linearly
    with that factor: for weakly implicit systems, a tiny force that depends on the momenta of many
    bodies, in two iterations; for strongly implicit ones not at all.

    The iteration stops once the error that is left in each component is at most ``rtol * scale +
    atol``. With corrections δ_k and θ = δ_k / δ_{k−1} that error is δ_k θ / (1 − θ), or less than
    δ_k, whatever is less; `scale` is the largest of the component's start, guess and root.
    A component whose corrections are round-off and shrink no more is good as well.

    Tangents and cotangents are solved for by the same iteration on the linearised F: no Jacobian is
    formed in derivatives either. Where that does not converge the derivative is NaN.

    **Arguments**

    - `rtol`: relative tolerance of the error; None means 1/16 of the unit of round-off.
    - `atol`: absolute tolerance [unit of the unknown].
    - `max_steps`: iterations after which the status becomes `not_converged`.

    **Raises** `ValueError` for tolerances that are negative or both zero, or fewer than one step.

    **Source** Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, VIII.6 (fixed-point
    iteration against Newton's); the error that is left: Hairer & Wanner 1996, *Solving ODEs II*,
    IV.8.
    """

    def correction(self, F, x0):
        return F

    def solve_tangent(self, linear, rhs):
        return _without_matrix(self, linear, rhs)


class PicardThenNewton(RootSolver):
    """The solver by default: Newton's method for few unknowns, for many `Picard` and, where it is
    not fast, Newton's.

    With more unknowns in a solve Picard's iteration goes first, and is given up for a lane as soon
    as a correction is more than half of the one before. That lane is solved by Newton's method
    from the start, and only if there is such a lane. Numbers of the others do not change.

    **Arguments**

    - `newton_up_to`: unknowns up to which Newton's method is taken at once: the components of q for
      `TypeII` and what is made of it, times stages and sides for `GaussLegendre` and
      `LobattoIIIAIIIB`. None means 16.
    - `picard`, `newton`: settings of the two.

    **Raises** `ValueError` for a number that is negative or no integer, `TypeError` for settings
    of another kind.
    """

    newton_up_to: int | None = eqx.field(static=True, default=None)
    picard: Picard = Picard(max_steps=12)
    newton: Newton = Newton()

    def __check_init__(self):
        if self.newton_up_to is not None:
            whole("newton_up_to", self.newton_up_to, least=0)
        instance("picard", self.picard, Picard, "a dvi.Picard(...)")
        instance("newton", self.newton, Newton, "a dvi.Newton(...)")

    def _is_few(self, n: int) -> bool:
        return n <= (_FEW if self.newton_up_to is None else self.newton_up_to)

    def solve(self, F, x0, scales):
        if self._is_few(x0.size):
            return self.newton.solve(F, x0, scales)
        of = self.picard
        first = contract(F, x0, scales, of.rtol, of.atol, of.max_steps, slowest=0.5)

        def mend(first: Found) -> Found:
            second = self.newton.solve(F, x0, scales)
            second = second._replace(iterations=first.iterations + second.iterations)
            return Found(
                *(jnp.where(first.converged, a, b) for a, b in zip(first, second, strict=True))
            )

        return lax.cond(lanewise.on_any(~first.converged), mend, lambda first: first, first)

    def solve_tangent(self, linear, rhs):
        if self._is_few(rhs.size):
            return self.newton.solve_tangent(linear, rhs)
        return _without_matrix(self, linear, rhs)


_FEW = 16
"""Unknowns up to which the elimination of a band is faster than Picard's iteration."""


def _without_matrix(solver: RootSolver, linear: Function, rhs: Vector) -> Vector:
    """x with linear(x) = rhs by `solver` itself, and likewise for the transpose."""

    def solve(A, b):
        size = lax.stop_gradient(jnp.abs(b))
        x, _, _, converged = solver.solve(lambda x: A(x) - b, b, Scales(size, size))
        return jnp.where(converged, x, jnp.nan)

    return lax.custom_linear_solve(linear, rhs, solve, solve)
