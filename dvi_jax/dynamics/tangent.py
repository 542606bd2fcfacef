"""The derivative of the flow of the map along an orbit."""

from typing import Any

from jaxtyping import Array, PyTree

from .._arithmetic import Arithmetic
from .._integrate import integrate
from .._integrator import Integrator, chosen
from .._solution import Save
from .._system import System
from ..engine.names import both_names
from ..engine.newton import RootSolver
from ..lattices import Given, Lattice
from ..methods import Method
from ..observe import TangentMap


@both_names
def tangent_map(
    system: System,
    q0: Any,
    p0: Any,
    *,
    h: Any = None,
    num_steps: int | None = None,
    t0: Any = 0.0,
    epsilon: Any = 0.0,
    args: PyTree = None,
    method: Method | None = None,
    lattice: Lattice | None = None,
    newton: RootSolver | None = None,
    arithmetic: Arithmetic | None = None,
    integrator: Integrator | None = None,
    throw: bool = True,
) -> Array:
    """M = ∂(q_K, p_K)/∂(q_0, p_0) of K steps, shape (2N, 2N), by the chain rule along the orbit.

    The disturbance is included; with ε = 0, or a disturbance that derives from a Hamiltonian,
    MᵀJM = J. Rows and columns are (q, p) raveled. Over a period of a closed orbit its eigenvalues
    are the Floquet multipliers.

    **Arguments** as for `integrate`; num_steps is 1 if left out, or that of a lattice `Given`.
    **Raises** as `integrate` does; with ``throw=False`` M of a
    run that failed is NaN.
    """
    integrator = chosen(
        integrator, method=method, lattice=lattice, root_finder=newton, arithmetic=arithmetic
    )
    if num_steps is None and not isinstance(integrator.lattice, Given):
        num_steps = 1
    return integrate(
        system, q0, p0, h=h, num_steps=num_steps, t0=t0, epsilon=epsilon, args=args,
        integrator=integrator, observe=TangentMap(), save=Save(final=True), throw=throw,
    ).observed  # fmt: skip
