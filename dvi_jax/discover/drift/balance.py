"""The three causes of the drift of an invariant, step by step."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lanewise.jaxprs.jaxapi import is_traced

from ...base.printing import printable
from ...base.types import Args
from ...observe.solution import Solution
from ...problem.system import System, check_system
from ..functions.generators import Generator, LatticePoint
from ..symmetries.noether import AdiabaticInvariant, Gauge, lattice_defect, noether_identity


@printable
class Balance(NamedTuple):
    """The drift of I_z over each step and its causes, shape (steps − 1,), [unit of I / time].

    - `ts`: start of each step (the first step has no incoming energy and is left out).
    - `drift`: (I_{k+1} − I_k)/h, the sum of the other three to round-off.
    - `symmetry`: Σ ε^m N_m, the residuals of Noether's identities.
    - `work`: ε^{z+1} W·(ξ_z − Dq ξ0_z), the work of the perturbing force.
    - `lattice`: −Σ ε^m ξ0_m r, from a time grid that violates the energy equation.
    """

    ts: Float[Array, " steps"]
    drift: Float[Array, " steps"]
    symmetry: Float[Array, " steps"]
    work: Float[Array, " steps"]
    lattice: Float[Array, " steps"]

    @property
    def defect(self) -> Float[Array, " steps"]:
        """drift − (symmetry + work + lattice): round-off, if the solution is one of the map."""
        return self.drift - (self.symmetry + self.work + self.lattice)


def noether_balance(
    system: System,
    generators: Sequence[Generator],
    gauges: Sequence[Gauge | None],
    solution: Solution,
    *,
    epsilon: Any = None,
    args: Args = None,
) -> Balance:
    r"""The balance law of an adiabatic invariant along a solution of `TypeII`.

        D(I_z) = Σ_m ε^m N_m + ε^{z+1} W·(ξ_z − Dq ξ0_z) − Σ_m ε^m ξ0_m r

    It holds on every time grid, for any generators and gauges: every drift is the sum of the
    violation of the symmetry, the work of the perturbing force and the lattice defect.

    **Arguments**

    - `generators`, `gauges`: as for `AdiabaticInvariant`.
    - `solution`: of `integrate` with ``method=TypeII()``, every state saved.
    - `epsilon`, `args`: those of the run.

    **Returns** a `Balance`.

    **Raises** `ValueError` for a solution without every state, or with fewer than two steps.

    **Source** our own; (31) of the paper is the case where the identities hold on the lattice
    of (14).

    **Example**

    ```python
    kepler = systems.kepler()
    wind = dvi.System(kepler.system.H_D, force=lambda t0, t1, q0, p1, args: jnp.array([1.0, 0.0]))
    sol = dvi.integrate(wind, kepler.q0, kepler.p0, args=kepler.args, h=0.1, num_steps=50,
                        epsilon=0.01)
    b = dvi.noether_balance(wind, [dvi.generators.rotation()], [None], sol, epsilon=0.01,
                            args=kepler.args)
    sides = b.drift, b.symmetry + b.work + b.lattice
    print(bool(np.allclose(*sides, atol=1e-13)), f"{float(np.abs(b.drift).max()):.2f}")
    # True 0.03
    ```
    """
    check_system(system, "noether_balance")
    steps = int(jnp.size(solution.ts)) - 1
    if jnp.ndim(solution.ts) != 1 or steps < 2:
        raise ValueError(
            "solution must be one trajectory with at least three states, got solution.ts of shape "
            f"{jnp.shape(solution.ts)}: of a batch take jax.tree.map(lambda x: x[i], solution)."
        )
    num_steps = solution.stats["num_steps"]
    if steps != jnp.size(solution.hs) or not (is_traced(num_steps) or steps == num_steps):
        raise ValueError(
            f"solution must have the state at every lattice point, got {steps + 1} states, at some "
            f"or at requested times, for num_steps={num_steps}: integrate with save=dvi.Save()."
        )
    strength = jnp.asarray(system.strength(epsilon))
    invariant = AdiabaticInvariant(generators, gauges, system, strength)
    return _balance(system, invariant, LatticePoint(solution.ts, solution.qs, solution.ps), args)


@eqx.filter_jit
def _balance(system, invariant: AdiabaticInvariant, points: LatticePoint, args) -> Balance:
    generators, gauges, epsilon = invariant.generators, invariant.gauges, invariant.epsilon

    def at_points(first, second, third):
        h = third.t - second.t

        def value(start, end):
            return invariant(start.t, end.t, start.q, start.p, end.q, end.p, args)

        drift = (value(second, third) - value(first, second)) / h
        r = lattice_defect(system, (first, second, third), epsilon, args)
        symmetry = lattice = jnp.zeros_like(drift)
        for m, generator in enumerate(generators):
            N = noether_identity(system, generators, gauges, m, second, third, epsilon, args)
            symmetry += epsilon**m * N
            lattice -= epsilon**m * generator(second, args).t * r
        last = generators[-1](second, args)
        # The system gives ε W; the other factor is ε^z.
        force = system.disturbing_force(second.t, third.t, second.q, third.p, epsilon, args)
        virtual = last.q - (third.q - second.q) / h * last.t
        work = epsilon ** (len(generators) - 1) * jnp.sum(force * virtual)
        return Balance(second.t, drift, symmetry, work, lattice)

    windows = [jax.tree.map(lambda x, i=i: x[i : len(x) - 2 + i], points) for i in range(3)]
    return jax.vmap(at_points)(*windows)
