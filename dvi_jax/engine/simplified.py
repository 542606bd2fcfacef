"""Newton's method with one Jacobian, factorised once."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, Inexact

from .contraction import contract, contract_on_trust, linear_iterations, most_linear_effort
from .linear import UNROLLED_UP_TO, solve_dense
from .newton import RootSolver, Vector, check_settings, value_and_jacobian


class SimplifiedNewton(RootSolver):
    """Simplified Newton iteration, x ← x − J⁻¹ F(x), J = ∂F/∂x at the guess, factorised once.

    The Jacobian and its factors, the dear parts of Newton's method for many unknowns, are made
    once a step; convergence is linear, with a factor of about the relative change of the Jacobian
    from the guess to the root, O(h²) for the type II map. Unlike Picard's it may converge where h
    times the derivative of the rate is larger than one, unless that derivative changes much.

    Stops as `Picard` does, by the error that the linear convergence leaves; same arguments. Its
    derivatives are Newton's: the Jacobian at the root.

    **Arguments**

    - `rtol`: relative tolerance of the error; None means 1/16 of the unit of round-off.
    - `atol`: absolute tolerance [unit of the unknown].
    - `max_steps`: iterations after which the status becomes `not_converged`.

    **Raises** `ValueError` for tolerances that are negative or both zero, or fewer than one step.

    **Source** Hairer & Wanner 1996, *Solving ODEs II*, IV.8.
    """

    rtol: float | None = eqx.field(static=True, default=None)
    atol: float = eqx.field(static=True, default=0.0)
    max_steps: int = eqx.field(static=True, default=50)

    def __check_init__(self):
        check_settings(self.rtol, self.atol, self.max_steps)

    def solve(self, F, x0, scales):
        return contract(_corrections(F, x0), x0, scales, self.rtol, self.atol, self.max_steps)

    def solve_on_trust(self, F, x0, scales, effort):
        count = self.iterations(effort, x0.size)
        return contract_on_trust(_corrections(F, x0), x0, scales, self.rtol, self.atol, count)

    def iterations(self, effort, n):
        return linear_iterations(effort)

    def most_effort(self):
        return most_linear_effort(self.max_steps)

    def solve_tangent(self, linear, rhs, on_trust):
        _, matrix = value_and_jacobian(linear, jnp.zeros_like(rhs))
        return solve_dense(matrix, rhs)


def _corrections(F, x0: Vector) -> Callable[[Vector], Vector]:
    """x → J⁻¹ F(x) with J at x0."""
    solve = factorised(value_and_jacobian(F, x0)[1])
    return lambda x: solve(F(x))


def factorised(A: Inexact[Array, "n n"]) -> Callable[[Vector], Vector]:
    """b → the solution of A x = b, all that depends on A alone computed now.

    For n ≤ `UNROLLED_UP_TO` by the inverse, whose errors an iteration corrects; else by factors.
    """
    n = A.shape[0]
    if n > UNROLLED_UP_TO:
        factors = lu_factor(A)
        return lambda b: lu_solve(factors, b)
    inverse = jax.vmap(solve_dense, (None, 1), 1)(A, jnp.eye(n, dtype=A.dtype))
    return lambda b: inverse @ b
