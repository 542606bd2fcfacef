"""Equations of first order x' = f(t, x, args) as Hamiltonian systems."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.signature import check_takes
from ..base.types import Args, Scalar, State
from ..problem.discretise import discretise
from ..problem.system import System
from .observations import Observations
from .uncertainty import inverse_or

# Singular values, relative to the largest, below which the regression has noise.
_TRUNCATION = 1e-3


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


def by_regression(model: Any, library: Any, arcs: list[Observations], params: Any) -> dict:
    r"""Coefficients to start from, by linear least squares of the integrated equation,

        x(t) = c0 + ∫ f dt + Σ c_i ∫ f_i dt,

    along the observed x, by the trapezoidal rule. Zero where x itself is not observed.
    """
    rows, values = [], []
    for i, arc in enumerate(arcs):
        spec = model.base_specification(params, i)
        field, args, shape = field_of(spec["system"]), spec.get("args"), np.shape(spec["q0"])
        good = np.isfinite(arc.values.reshape(len(arc.ts), -1)).all(axis=1)
        if field is None or arc.observe != "positions" or not good.any():
            continue

        def slopes(t, x, field=field, args=args):
            known = sum((part(t, x, args) for part in field.parts), jnp.zeros_like(x))
            zero = jnp.zeros_like(x)
            return jnp.stack([known, *(term(t, t, x, zero, args) for term in library.functions)])

        ts, xs = arc.ts[good], arc.values[good].reshape(-1, *shape)
        rates = np.asarray(jax.jit(jax.vmap(slopes))(jnp.asarray(ts), jnp.asarray(xs)))
        rates = rates.reshape(*rates.shape[:2], -1)
        areas = np.diff(ts)[:, None, None] * (rates[1:] + rates[:-1]) / 2
        integral = np.concatenate([0 * rates[:1], np.cumsum(areas, axis=0)])
        integral = integral - integral.mean(axis=0)
        states = xs.reshape(len(xs), -1)
        rows.append(integral[:, 1:].swapaxes(1, 2).reshape(-1, len(library)))
        values.append((states - states.mean(axis=0) - integral[:, 0]).ravel())
    if not rows or not np.isfinite(A := np.concatenate(rows)).all():
        return dict.fromkeys(library.names, 0.0)
    scale = inverse_or(np.linalg.norm(A, axis=0), 0.0)
    solution = np.linalg.lstsq(A * scale, np.concatenate(values), rcond=_TRUNCATION)[0]
    return dict(zip(library.names, (solution * scale).tolist(), strict=True))
