"""A discrete map as a solver of diffrax."""

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

import dvi_jax as dvi

from ..base.checks import instance
from .extras import require
from .fields import system_and_strength

if TYPE_CHECKING:
    from .diffrax_classes import DiscreteMap, DiscreteTerm


def diffrax_term(system: Any, epsilon: Any = None) -> "DiscreteTerm":
    """A system as a term of diffrax, for `diffrax_solver`.

    - `system`: a `System`, or a problem of the library, whose args go into ``diffeqsolve(args=)``.
    - `epsilon`: strength of the perturbation; traced: derivatives with respect to it exist.

    Its vector field is `vector_field`: with diffrax's own solvers,
    ``diffeqsolve(term, diffrax.Dopri8(), …)``, it gives the continuous limit.

    **Raises** `ImportError` without diffrax, `TypeError` for another object than a system.
    """
    require("diffrax", "interop.diffrax_term")
    from .diffrax_classes import DiscreteTerm

    system, epsilon = system_and_strength(system, epsilon)
    return DiscreteTerm(system, jnp.asarray(epsilon, float))


def diffrax_solver(
    method: dvi.Method = dvi.TypeII(), root_finder: dvi.RootSolver = dvi.PicardThenNewton()
) -> "DiscreteMap":
    r"""A discrete map as a solver of `diffrax.diffeqsolve`.

        diffrax.diffeqsolve(interop.diffrax_term(system, epsilon), interop.diffrax_solver(method),
                            t0, t1, dt0, y0=(q0, p0), args=args)

    Each step is one step of `method` by ``dvi.integrate``. The states are those of `integrate` up
    to the round-off in diffrax's times t0 + h + h + ….

    - `method`: any `Method`. `root_finder`: how implicit steps are solved.

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

    **Raises** `ImportError` without diffrax; `TypeError` for another method or root solver.
    """
    instance("method", method, dvi.Method, "a method such as dvi.Strang()")
    instance("root_finder", root_finder, dvi.RootSolver, "a root solver such as dvi.Newton()")
    require("diffrax", "interop.diffrax_solver")
    from .diffrax_classes import DiscreteMap

    return DiscreteMap(method, root_finder)
