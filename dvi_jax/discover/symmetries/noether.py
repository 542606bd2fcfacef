"""Noether's identity, and the adiabatic invariant it leads to."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ...base.checks import instance, whole
from ...base.printing import printable
from ...base.signature import with_time
from ...base.types import Args, Scalar
from ...problem.energies import disturbing_work, incoming_energy, outgoing_energy
from ...problem.system import System, check_system
from ..functions.generators import Generator, LatticePoint, prolong, require_bound

Gauge = Callable[..., Any]  # ``G(q, p)`` or ``G(t, q, p, args)`` → scalar [action]


def gauge_value(gauge: Gauge, point: Sequence[Any], args: Args) -> Scalar:
    """A gauge at a grid point."""
    return with_time("a gauge", gauge)(*point, args)


def lattice_defect(
    system: System, points: Sequence[LatticePoint], epsilon: Any = 0.0, args: Args = None
) -> Scalar:
    r"""The residual r of the lattice equation at the middle of three points [power].

        r = (E⁺_k − E⁻_k − εW_k·(q_{k+1} − q_k)) / h_k

    Zero when the lattice obeys (14); on a fixed mesh the energy changes by it. `points`: three
    (t, q, p) in the order of time.

    **Source** the paper's (11) and (14) with corrected signs: (14) prints −H_{D,k−1} and
    differentiates it in t_{k−1}; stationarity in t_k gives the form above.
    """
    check_system(system, "lattice_defect")
    instance("points", points, Sequence, "three dvi.LatticePoint in the order of time")
    whole("number of points", len(points), 3, 3, "They are those before, at and after the middle.")
    (t_, q_, _), (t0, q0, p0), (t1, q1, p1) = points
    work = disturbing_work(system, t0, t1, q0, q1, p1, epsilon, args)
    outgoing = outgoing_energy(system, t0, t1, q0, p1, epsilon, args)
    arriving = incoming_energy(system, t_, t0, q_, p0, epsilon, args)
    return (outgoing - arriving - work) / (t1 - t0)


def noether_identity(
    system: System,
    generators: Sequence[Generator],
    gauges: Sequence[Gauge | None],
    order: int,
    first: LatticePoint,
    second: LatticePoint,
    epsilon: Any = 0.0,
    args: Args = None,
) -> Scalar:
    r"""The left side N_m of Noether's identity of order m between two lattice points [energy].

        N_m = pr X_m(S)/h + W·(ξ_{m−1} − Dq ξ0_{m−1}) + D G_m,    S = p1·(q1 − q0) − h H_D

    with D f = (f_{k+1} − f_k)/h and no W term for m = 0. It has to vanish on the solutions of the
    *perturbed* map for `AdiabaticInvariant` to be invariant.

    **Arguments** `generators`, `gauges`: the series, order 0 first (a gauge None is zero);
    `order`: m; `first`, `second`: the points (t0, q0, p0) and (t1, q1, p1).

    **Source** the paper, (25) and (28).
    """
    check_system(system, "noether_identity")
    first = LatticePoint(*map(jnp.asarray, first))
    second = LatticePoint(*map(jnp.asarray, second))
    h = second.t - first.t

    def action(first, second):
        (t0, q0, _), (t1, q1, p1) = first, second
        H = system.hamiltonian(t0, t1, q0, p1, epsilon, args)
        return jnp.sum(p1 * (q1 - q0)) - (t1 - t0) * H

    identity = prolong(generators[order], action, (first, second), args=args) / h
    if order > 0 and system.force is not None:
        W = system.force(*system.times(first.t, second.t, epsilon), first.q, second.p, args)
        xi0, xi, _ = generators[order - 1](first, args)
        identity = identity + jnp.sum(W * (xi - (second.q - first.q) / h * xi0))
    gauge = gauges[order]
    if gauge is not None:
        change = gauge_value(gauge, second, args) - gauge_value(gauge, first, args)
        identity = identity + change / h
    return identity


@printable
class AdiabaticInvariant(eqx.Module):
    r"""The adiabatic invariant of order z of a series of generators and gauges.

        I_z = Σ_{m≤z} ε^m (ξ_m·p_k − ξ0_m E⁻_k + G_m)

    at the end of a step of the map `TypeII`, where E⁻ = H_D + h ∂H_D/∂t1. It is an observable:
    give it to `integrate` as it is, alone or in a reduction, and it is bound there to the
    system and ε of the run. To call it elsewhere bind it first:
    ``invariant.bind(system, epsilon)(t0, t1, q0, p0, q1, p1, args)``. (A composed step has no
    single H_D: there E⁻ is taken of the whole step and differs from the energy by O(h).)

    - `generators`, `gauges`: one for each order, order 0 first; z is their number less one. A
      gauge G is a function ``(q, p)`` or ``(t, q, p, args)`` → scalar [action], or None for zero.

    `noether_identity` shows whether it *is* invariant to that order.

    **Raises** `ValueError` for different numbers of generators and gauges, or none.

    **Source** the paper, (26) (with its η·p corrected to ξ·p) and (29).

    **Example**

    ```python
    kepler = systems.kepler()
    turn = dvi.generators.rotation()
    L = dvi.AdiabaticInvariant([turn], [None])               # order 0: here it is exact
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1,
                        num_steps=1000, epsilon=0.01, observe={"L": dvi.MaxDrift(L)})
    print(sol.observed["L"] < 1e-13)
    # True
    ```
    """

    generators: Sequence[Generator]
    gauges: Sequence[Gauge | None]
    system: System | None = None
    epsilon: Any = None

    def __check_init__(self):
        lists = self.generators, self.gauges
        sizes = [len(x) if isinstance(x, list | tuple) else 0 for x in lists]
        if sizes[0] != sizes[1] or 0 in sizes:
            raise ValueError(
                "generators and gauges must be lists of one entry for each order, got "
                f"{' and '.join(type(x).__name__ for x in lists)} of {sizes} entries."
            )

    @property
    def order(self) -> int:
        """z, the order up to which the series goes."""
        return len(self.gauges) - 1

    def bind(self, system: System, epsilon: Any) -> "AdiabaticInvariant":
        """The same invariant for this system and strength of the perturbation."""
        return AdiabaticInvariant(self.generators, self.gauges, system, epsilon)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        system = require_bound(self, "system", self.system)
        energy = incoming_energy(system, t0, t1, q0, p1, self.epsilon, args)
        end = LatticePoint(t1, q1, p1)
        total = jnp.zeros((), q1.dtype)
        for m, (generator, gauge) in enumerate(zip(self.generators, self.gauges, strict=True)):
            xi0, xi, _ = generator(end, args)
            term = jnp.sum(xi * p1) - xi0 * energy
            if gauge is not None:
                term = term + gauge_value(gauge, end, args)
            total = total + self.epsilon**m * term
        return total
