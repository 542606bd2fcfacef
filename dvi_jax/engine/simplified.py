"""Newton's method with one Jacobian a step."""

from collections.abc import Callable

import jax.numpy as jnp
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, Inexact

import lanewise

from .contraction import Contraction
from .newton import Vector, value_and_jacobian


class SimplifiedNewton(Contraction):
    """Simplified Newton iteration, x ← x − J⁻¹ F(x), J = ∂F/∂x at the guess.

    The Jacobian, for many unknowns the most expensive part of Newton's method, is computed once a
    step, and factorised once if there are more than 64 unknowns. Convergence is linear, with a
    factor of about the relative change of the Jacobian from the guess to the root, O(h²) for the
    type II map. Unlike Picard's it may converge where h times the derivative of the rate is larger
    than one, unless that derivative changes much.

    Stops as `Picard` does, by the error that the linear convergence leaves; same arguments. Its
    derivatives are Newton's: the Jacobian at the root.

    **Arguments**

    - `rtol`: relative tolerance of the error; None means 1/16 of the unit of round-off.
    - `atol`: absolute tolerance [unit of the unknown].
    - `max_steps`: iterations after which the status becomes `not_converged`.

    **Raises** `ValueError` for tolerances that are negative or both zero, or fewer than one step.

    **Source** Hairer & Wanner 1996, *Solving ODEs II*, IV.8.
    """

    def correction(self, F, x0):
        solve = factorised(value_and_jacobian(F, x0)[1])
        return lambda x: solve(F(x))

    def solve_tangent(self, linear, rhs):
        _, matrix = value_and_jacobian(linear, jnp.zeros_like(rhs))
        return lanewise.solve(matrix, rhs)


def factorised(A: Inexact[Array, "n n"]) -> Callable[[Vector], Vector]:
    """b → the solution of A x = b, all that depends on A alone computed now.

    Small systems are eliminated again for each b: generated code does that in fewer operations than
    it takes to find the inverse once.
    """
    if A.shape[0] > _ELIMINATED:
        factors = lu_factor(A)
        return lambda b: lu_solve(factors, b)
    return lambda b: lanewise.solve(A, b)


_ELIMINATED = 64
"""Unknowns up to which a system is eliminated again for each right-hand side."""
