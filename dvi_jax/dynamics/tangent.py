"""The derivative of an iterated map along an orbit."""

from typing import Any

from jaxtyping import Array

from ..base.keywords import INTEGRATOR, take, with_keywords_of
from ..integration.integrate import integrate
from ..integration.integrator import chosen
from ..lattices import Given
from ..observe import TangentMap
from ..observe.solution import Save
from ..problem.system import System


@with_keywords_of(integrate, f"h num_steps t0 epsilon args {INTEGRATOR} throw")
def tangent_map(system: System, q0: Any, p0: Any, **keywords: Any) -> Array:
    """M = ∂(q_K, p_K)/∂(q_0, p_0) of K steps, shape (2N, 2N), by the chain rule along the orbit.

    The perturbing force is included; with ε = 0, or a perturbation that derives from a Hamiltonian,
    MᵀJM = J. Rows and columns are (q, p) raveled. Over a period of a closed orbit its eigenvalues
    are the Floquet multipliers.

    **Arguments** as for `integrate`; num_steps is 1 by default, or that of a lattice `Given`.
    **Raises** as `integrate` does; with ``throw=False`` M of a run that failed is NaN.
    """
    integrator = chosen(**take(keywords, INTEGRATOR))
    if keywords["num_steps"] is None and not isinstance(integrator.lattice, Given):
        keywords["num_steps"] = 1
    keywords |= {"integrator": integrator, "observe": TangentMap(), "save": Save(final=True)}
    return integrate(system, q0, p0, **keywords).observed
