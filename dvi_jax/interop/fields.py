"""The vector field that a discrete map discretises."""

import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import dvi_jax as dvi

from ..base.inputs import refuse_unit_or_mask
from ..base.keywords import user_level
from .extras import system_of


def vector_field(system: Any, epsilon: Any = None) -> Callable[[Any, Any, Any], Any]:
    r"""The continuous limit h → 0 of a system, as ``f(t, y, args)`` with ``y = (q, p)``.

        q̇ = ∂H/∂p,    ṗ = −∂H/∂q + ε W,      H(t, q, p) = H_D(t, t, q, p) + ε H1_D(t, t, q, p)

    with W taken at (t, t, q, p). `GaussLegendre` and `RungeKutta4` integrate it, and the map of
    every H_D that is continuous at t1 = t0 tends to it. It is for comparisons, such as
    ``diffrax.ODETerm(interop.vector_field(system))``; the map itself comes from H_D.

    - `system`: a `System`, or a problem of the library. `epsilon`: strength of the perturbation. A
      constraint adds its force (`dvi.ConstraintForce`); other solvers leave its manifold slowly.

    **Returns** a function of t [time], (q, p) and args, whose value (q̇, ṗ) has their shapes
    [unit of q / time, unit of p / time]. It can be compiled, batched and differentiated.

    **Raises** `TypeError` for another object than a system, and, when called, for another y than a
    pair.

    **Accuracy** round-off. ``dvi.from_lagrangian`` divides by t1 − t0 and has no H_D(t, t, …): its
    field is NaN everywhere. With ``slow_time=True`` t is the time itself, and H_D receives εt.
    """
    system, epsilon = system_and_strength(system, epsilon)
    push = dvi.ConstraintForce().bind(system, epsilon)

    def field(t, y, args):
        q, p = as_pair(y)
        t, strength = (jnp.asarray(x, q.dtype) for x in (t, epsilon))
        point = t, t, q, p, strength, args
        position, momentum = jax.grad(system.hamiltonian, argnums=(2, 3))(*point)
        rates = momentum, -position + jnp.asarray(system.disturbing_force(*point), q.dtype)
        if system.constraint is not None:
            rates = momentum, rates[1] + push(t, t, q, p, q, p, args)
        return type(y)(rates) if isinstance(y, list) else rates

    return field


def as_pair(y: Any) -> tuple[Any, Any]:
    """A state (q, p) as two arrays of one shape."""
    if not (isinstance(y, tuple | list) and len(y) == 2):
        size = f" of length {len(y)}" if isinstance(y, tuple | list) else ""
        raise TypeError(f"y or y0 must be a pair (q0, p0), got type {type(y).__name__}{size}.")
    q, p = (jnp.asarray(x) for x in y)
    if q.shape != p.shape:
        raise ValueError(f"q0 and p0 in y or y0 must have one shape, got {q.shape} and {p.shape}.")
    return q, p


def system_and_strength(system: Any, epsilon: Any) -> tuple[dvi.System, Any]:
    """The system and ε. Warns, as `integrate` does, if ε is known to have no effect."""
    system = system_of(system)
    epsilon = system.strength(epsilon)
    refuse_unit_or_mask("epsilon", epsilon)
    try:
        value = float(epsilon)
    except (TypeError, jax.errors.ConcretizationTypeError):  # traced: its value is not known
        value = 0.0
    if value != 0 and not system.depends_on_epsilon:
        text = f"epsilon = {value:g} has no effect without a force or a perturbation: leave it out."
        warnings.warn(text, stacklevel=user_level())
    return system, epsilon
