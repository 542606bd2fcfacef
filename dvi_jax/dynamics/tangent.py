"""The derivative of an iterated map along an orbit."""

from typing import Any, Unpack

from jaxtyping import Array

from ..base.keywords import checked_keywords
from ..integration.integrate import integrate
from ..integration.keywords import TangentSettings, integrator_of
from ..lattices import Given
from ..observe import TangentMap
from ..observe.solution import Save
from ..problem.system import System


@checked_keywords
def tangent_map(system: System, q0: Any, p0: Any, **settings: Unpack[TangentSettings]) -> Array:
    """M = ∂(q_K, p_K)/∂(q_0, p_0) of K steps, shape (2N, 2N), by the chain rule along the orbit.

    The perturbing force is included; with ε = 0, or a perturbation that derives from a Hamiltonian,
    MᵀJM = J. Rows and columns are (q, p) raveled. Over a period of a closed orbit its eigenvalues
    are the Floquet multipliers.

    **Arguments** as for `integrate`; num_steps is 1 by default, or that of a lattice `Given`.
    **Raises** as `integrate` does; with ``throw=False`` M of a run that failed is NaN.
    """
    integrator, options = integrator_of(settings)
    if options.get("num_steps") is None and not isinstance(integrator.lattice, Given):
        options["num_steps"] = 1
    options |= {"integrator": integrator, "observe": TangentMap(), "save": Save(final=True)}
    return integrate(system, q0, p0, **options).observed
