"""Equations of first order x' = f(t, x, args) as Hamiltonian systems."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ..base.signature import check_takes
from ..base.types import Args, Scalar, State
from ..problem.discretise import discretise
from ..problem.system import System


class VectorField(eqx.Module):
    r"""The Hamiltonian p·f(t, q, args), of which q̇ = f is the equation of q.

        q̇ = f,   ṗ = −(∂f/∂q)ᵀ p

    p has no effect on q, and stays zero if it is zero at the beginning. `parts`: functions
    (t, x, args) whose sum is f.
    """

    parts: tuple[Callable[..., Any], ...] = ()

    def __call__(self, t: Scalar, q: State, p: State, args: Args) -> Scalar:
        total = jnp.zeros((), p.dtype)
        for part in self.parts:
            total = total + jnp.sum(p * part(t, q, args))
        return total


class LibraryField(eqx.Module):
    """The sum of a library of candidates as a vector field; its momenta are zero."""

    library: Callable[..., Any]

    def __call__(self, t: Scalar, x: State, args: Args) -> State:
        return self.library(t, t, x, jnp.zeros_like(x), args)


def first_order_system(f: Callable[..., Any] | None) -> System:
    """The system with q̇ = f(t, q, args); without f, with q̇ = 0.

    **Raises** `TypeError` for an f that is not a function of (t, x, args).
    """
    if f is not None:
        check_takes("f", f, "(t, x, args)")
    return System(discretise(VectorField(() if f is None else (f,))))


def field_of(system: System) -> VectorField | None:
    """The vector field of a system of first order; None for another one."""
    hamiltonian = getattr(system.H_D, "H", None)
    return hamiltonian if isinstance(hamiltonian, VectorField) else None
