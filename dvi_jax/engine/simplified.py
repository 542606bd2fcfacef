"""Newton's method with one Jacobian per step."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Inexact

import lanewise

from .contraction import Contraction
from .newton import Vector, value_and_jacobian


class SimplifiedNewton(Contraction):
    """Simplified Newton iteration, x ← x − J⁻¹ F(x), J = ∂F/∂x at the guess.

    The Jacobian, for many unknowns the most expensive part of Newton's method, is computed once per
    step, and factorised once if there are more than 64 unknowns. Convergence is linear, with a
    factor of about the relative change of the Jacobian from the guess to the root, O(h²) for the
    type II map. Unlike `Picard` it may converge where h times the derivative of the rate is larger
    than one, unless that derivative changes strongly.

    The stopping rule, the arguments and the errors are those of `Picard`. Derivatives are those of
    `Newton`, by the Jacobian at the root.

    **Source** Hairer & Wanner 1996, *Solving ODEs II*, IV.8.
    """

    def correction(self, F, x0):
        solve = factorise(value_and_jacobian(F, x0)[1])
        return lambda x: solve(F(x))

    def solve_tangent(self, linear, rhs):
        _, matrix = value_and_jacobian(linear, jnp.zeros_like(rhs))
        return lanewise.solve(matrix, rhs)


def factorise(A: Inexact[Array, "n n"]) -> Callable[[Vector], Vector]:
    """b → the solution of A x = b. A large A is factorised once, here."""
    if A.shape[0] > _ELIMINATION_UP_TO:
        from jax.scipy.linalg import lu_factor, lu_solve  # few runs need it: a part of import time

        factors = lu_factor(A)
        return lambda b: lu_solve(factors, b)
    return lambda b: lanewise.solve(A, b)


# Smaller systems are eliminated again for each b: generated code needs fewer operations for that
# than for finding the inverse once.
_ELIMINATION_UP_TO = 64
