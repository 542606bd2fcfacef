"""A discrete map as a solver of diffrax, and the vector field that it discretises."""

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

import dvi_jax as dvi

from ..engine.quantities import refuse_unit_or_mask
from .extras import expect, needed, system_of

if TYPE_CHECKING:
    from .diffrax_classes import DiscreteMap, DiscreteTerm


def vector_field(system: Any, epsilon: Any = 0.0) -> Callable[[Any, Any, Any], Any]:
    r"""The continuous limit h → 0 of a system, as ``f(t, y, args)`` with ``y = (q, p)``.

        q̇ = ∂H/∂p,    ṗ = −∂H/∂q + ε W,      H(t, q, p) = H_D(t, t, q, p) + ε H1_D(t, t, q, p)

    with W taken at (t, t, q, p): what `GaussLegendre` and `RungeKutta4` integrate, and what the map
    of every H_D tends to that is continuous at t1 = t0. It is for comparisons,
    ``diffrax.ODETerm(interop.vector_field(system))``; the map itself comes from H_D, not from it.

    - `system`: a `System`, or a problem of the library. `epsilon`: strength of the disturbance.

    **Returns** a function of t [time], (q, p) and args, whose value (q̇, ṗ) has their shapes
    [unit of q / time, unit of p / time]. It can be compiled, batched and differentiated.

    **Raises** `TypeError` for what is no system, and when called with a y that is no pair.

    **Accuracy** round-off. ``dvi.from_lagrangian`` divides by t1 − t0 and has no H_D(t, t, …): its
    field is NaN everywhere. With ``slow_time=True`` t is the time itself, and H_D receives εt.
    """
    system = _checked(system, epsilon)

    def field(t, y, args):
        q, p = as_pair(y)
        t, strength = (jnp.asarray(x, q.dtype) for x in (t, epsilon))
        at = t, t, q, p, strength, args
        position, momentum = jax.grad(system.hamiltonian, argnums=(2, 3))(*at)
        rates = momentum, -position + jnp.asarray(system.disturbing_force(*at), q.dtype)
        return type(y)(rates) if isinstance(y, list) else rates

    return field


def as_pair(y: Any) -> tuple[Any, Any]:
    """A state (q, p) as two arrays of one shape.

    **Raises** `TypeError` for another structure, `ValueError` for two shapes.
    """
    if not (isinstance(y, tuple | list) and len(y) == 2):
        raise TypeError(
            f"the state must be a pair y0=(q0, p0), got {type(y).__name__}: the map has to know "
            "positions from momenta."
        )
    q, p = (jnp.asarray(x) for x in y)
    if q.shape != p.shape:
        raise ValueError(f"q and p must have one shape, got {q.shape} and {p.shape}.")
    return q, p


def _checked(system: Any, epsilon: Any) -> dvi.System:
    """The system; warns, as `integrate` does, where ε has no effect and its value is known."""
    system = system_of(system)
    refuse_unit_or_mask("epsilon", epsilon)
    try:
        value = float(epsilon)
    except (TypeError, jax.errors.ConcretizationTypeError):  # it stands for values to come
        value = 0.0
    used = system.force is not None or system.perturbation is not None or system.slow_time
    if value != 0 and not used:
        text = f"epsilon = {value:g} has no effect: the system has no force and no perturbation."
        warnings.warn(text, stacklevel=3)
    return system


def diffrax_term(system: Any, epsilon: Any = 0.0) -> "DiscreteTerm":
    """The term of diffrax that carries a system: what `diffrax_solver` steps.

    - `system`: a `System`, or a problem of the library, whose args go into ``diffeqsolve(args=)``.
    - `epsilon`: strength of the disturbance; traced, so that a gradient may be taken in it.

    Its vector field is `vector_field`, so that diffrax's own solvers take it too
    (``diffeqsolve(term, diffrax.Dopri8(), …)``) and solve the continuous limit.

    **Raises** `ImportError` without diffrax, `TypeError` for what is no system.
    """
    needed("diffrax", "interop.diffrax_term")
    from .diffrax_classes import DiscreteTerm

    return DiscreteTerm(_checked(system, epsilon), jnp.asarray(epsilon, float))


def diffrax_solver(
    method: dvi.Method = dvi.TypeII(), newton: dvi.RootSolver = dvi.PicardThenNewton()
) -> "DiscreteMap":
    r"""A discrete map as a solver of `diffrax.diffeqsolve`.

        diffrax.diffeqsolve(interop.diffrax_term(system, epsilon), interop.diffrax_solver(method),
                            t0, t1, dt0, y0=(q0, p0), args=args)

    Each step of diffrax is the step of `method`, one of ``dvi.integrate``'s, on (t0, t1): its
    states are those of `integrate` to round-off, of which diffrax's times t0 + h + h + … have some.

    - `method`: any `Method`. `newton`: how implicit steps are solved.

    **Terms**: `diffrax_term` alone; diffrax rejects a `diffrax.ODETerm`, which has no H_D.

    **Step sizes**: ``diffrax.ConstantStepSize()`` or ``diffrax.StepTo(ts)``. A step that depends on
    the state would break the structure (see ``dvi.TimeTransformed``): there is no error estimate,
    and diffrax rejects its adaptive controllers.

    **Dense output** (``SaveAt(ts=…)``, ``SaveAt(dense=True)``, events): the cubic with the values
    and slopes of the continuous limit at both ends of a step, of error O(h⁴) in addition to the
    method's, and not symplectic. ``dvi.Save(ts=...)`` has the method's own order.

    **Failures**: `not_converged` becomes diffrax's `nonlinear_max_steps_reached`, `not_finite` its
    `nonfinite`, any other its `nonlinear_divergence`; with ``throw=True`` diffrax raises.

    **Gradients**: by `RecursiveCheckpointAdjoint`, `DirectAdjoint` and `ForwardMode`, those of the
    discrete map. `BacksolveAdjoint` solves another equation and is rejected.

    **Raises** `ImportError` without diffrax; `TypeError` for what is no method or root solver.
    """
    expect("method", method, dvi.Method, "a method such as dvi.Strang()")
    expect("newton", newton, dvi.RootSolver, "a root solver such as dvi.Newton()")
    needed("diffrax", "interop.diffrax_solver")
    from .diffrax_classes import DiscreteMap

    return DiscreteMap(method, newton)
