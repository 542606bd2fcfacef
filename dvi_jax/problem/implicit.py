"""Hamiltonians of quantities that are defined by an equation."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import lanewise

from ..base.signature import check_takes, with_time
from ..base.types import Args, Scalar, State
from ..engine.newton import Newton, RootSolver, Vector, find_root


class Implicit(eqx.Module):
    r"""The Hamiltonian H(t, q, p, args) = E(t, q, p, y, args) at the y where R(…, y, args) = 0.

    For energies that are known in other variables than (q, p): the flux label of a guiding centre,
    the velocity of a Lagrangian, a constraint that defines an inner state. Give it to `discretise`.

    **Arguments**

    - `energy`: E, function ``(t, q, p, y, args)`` → scalar [energy].
    - `relation`: R, function of the same arguments → array like y, which is zero at the
      solution y. ∂R/∂y must be regular there.
    - `guess`: function ``(q, p)`` or ``(t, q, p, args)`` → y of shape (k,), near that root.
    - `root_finder`: of the inner solve, where there is one.

    `GaussLegendre` needs no inner solve: it takes the y of each stage among its unknowns, and
    solves for all of them together. Other methods find y in each evaluation, to round-off. The
    results agree to round-off.

    **Raises** `TypeError` for functions of other arguments. Where no y is found H is NaN, and the
    status of the step reports it.

    **Source** Hairer & Wanner 1996, *Solving ODEs II*, VI.1 (differential-algebraic equations of
    index 1: the state-space form, and both solved together).
    """

    energy: Callable[..., Any]
    relation: Callable[..., Any]
    guess: Callable[..., Any] = eqx.field(converter=lambda guess: with_time("guess", guess))
    root_finder: RootSolver = Newton()

    def __check_init__(self):
        check_takes("energy", self.energy, "(t, q, p, y, args)")
        check_takes("relation", self.relation, "(t, q, p, y, args)")

    def solved(self, t: Scalar, q: State, p: State, args: Args) -> Vector:
        """y at (t, q, p); NaN where it is not found. Differentiable to any order."""
        guess = self.guess(t, q, p, args)
        y, info = find_root(
            lambda y: self.relation(t, q, p, y, args), guess, guess, self.root_finder
        )
        # A factor and not jnp.where(…, y, nan), of which the derivative would be 0 and not NaN.
        return y * jnp.where(info.converged, 1.0, jnp.nan).astype(y.dtype)

    def __call__(self, t: Scalar, q: State, p: State, args: Args) -> Scalar:
        return self.energy(t, q, p, self.solved(t, q, p, args), args)

    def rates(self, t: Scalar, q: State, p: State, y: Vector, args: Args) -> tuple[State, State]:
        """∂H/∂q and ∂H/∂p as functions of (q, p, y), which are those of H where R = 0:

        ∂H/∂z = ∂E/∂z − (∂R/∂z)ᵀ λ,    (∂R/∂y)ᵀ λ = ∂E/∂y
        """
        # E and R are differentiated at y as an independent variable: no root is differentiated.
        of_q, of_p, of_y = jax.grad(self.energy, argnums=(1, 2, 3))(t, q, p, y, args)
        _, pull = jax.vjp(lambda q, p, y: self.relation(t, q, p, y, args), q, p, y)
        slope = jax.jacfwd(lambda y: self.relation(t, q, p, y, args))(y)
        # One small linear solve, in place of a derivative of y for each component of (q, p).
        back_q, back_p, _ = pull(lanewise.solve(slope.T, of_y))
        return of_q - back_q, of_p - back_p
