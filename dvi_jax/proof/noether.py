"""Noether's identities as exact statements: proved for all states, all ε, all times and steps."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..base.inputs import start_state
from ..base.types import Args, Interval
from ..discover.functions.generators import Generator, LatticePoint
from ..discover.symmetries.noether import AdiabaticInvariant, Gauge, gauge_value, noether_identity
from ..methods.step import Equations
from ..problem.energies import disturbing_work, outgoing_energy
from ..problem.system import check_system, of_problem
from .comparison import POINTS, compare, random_points
from .components import NotAnalytic, program_of
from .result import tools


class NoetherProof(eqx.Module):
    """Result of `prove_noether`: which statements hold for all (t0, h, q0, p1, ε).

    - `identities`: for each order m, whether N_m = 0.
    - `work`: whether W·(ξ_z − Dq ξ0_z) = 0. `fixed_time`: whether all ξ0_m = 0, so that the time
      grid has no effect.
    - `balance`: whether the balance law holds. It is a theorem: False means that the two sides are
      equal only by relations between elementary functions, which are not used here.
    - `conserved`: whether I_z is conserved exactly, with `TypeII` on every time grid.
    """

    identities: tuple[bool, ...]
    work: bool
    fixed_time: bool
    balance: bool

    @property
    def conserved(self) -> bool:
        """All identities hold, the perturbing force does no work, and no ξ0_m is nonzero."""
        return self.balance and all(self.identities) and self.work and self.fixed_time

    def __repr__(self) -> str:
        z = len(self.identities) - 1
        rows = [
            f"N_{m} = 0: {'proved' if zero else 'not an identity'}"
            for m, zero in enumerate(self.identities)
        ]
        rows.append(f"W·(ξ_{z} − Dq ξ0_{z}) = 0: {'proved' if self.work else 'not an identity'}")
        rows.append(f"balance law: {'proved' if self.balance else 'not shown'}")
        if self.conserved:
            rows.append(f"I_{z} is conserved exactly by the map, on every time grid")
        elif self.balance and all(self.identities):
            change = "0" if self.work else f"ε^{z + 1} W·(ξ_{z} − Dq ξ0_{z})"
            grid = "on every time grid" if self.fixed_time else "on the variational time grid"
            rows.append(f"D(I_{z}) = {change} {grid}")
        return "\n".join(rows)


def prove_noether(
    system: Any,
    generators: Sequence[Generator],
    gauges: Sequence[Gauge | None],
    q0: Any = None,
    *,
    args: Args = None,
) -> NoetherProof:
    r"""Prove Noether's identities and the balance law of an adiabatic invariant of `TypeII`.

        N_m = 0  for m = 0 … z,        W·(ξ_z − Dq ξ0_z) = 0,
        D(I_z) = Σ_m ε^m N_m + ε^{z+1} W·(ξ_z − Dq ξ0_z) − Σ_m ε^m ξ0_m r

    as identities in (t0, h, q0, p1, ε), with p0 and q1 from the map. Both sides are written as
    quotients of polynomials with rational coefficients, in which each value of an elementary
    function is a variable; a statement is proved if the difference is the polynomial 0. So they
    hold for every state, step and ε, and not only at the points where they were evaluated.

    **Arguments** `system`: a `System` or a problem of the library. `generators`, `gauges`: as for
    `AdiabaticInvariant`. `q0`: an array with the shape of q; by default that of the problem.
    `args`: of the system.

    **Returns** a `NoetherProof`; ``print`` shows the statements.

    **Raises** `ValueError` for a function that is not analytic; `ImportError` without python-flint.

    **Source** the identities: (25), (28) and (31) of the paper. The balance law is ours.

    **Example**

    ```python
    kepler = systems.kepler()
    turn = dvi.generators.rotation()
    print(dvi.prove_noether(kepler, [turn, turn], [None, None]))
    # N_0 = 0: proved
    # N_1 = 0: proved
    # W·(ξ_1 − Dq ξ0_1) = 0: proved
    # balance law: proved
    # I_1 is conserved exactly by the map, on every time grid
    ```
    """
    exact, _ = tools()
    q0 = getattr(system, "q0", None) if q0 is None else q0
    if q0 is None:
        raise TypeError("q0 is missing: give an array with the shape of q.")
    system, *_, args = of_problem(system, None, None, None, args, has_start=True)
    check_system(system, "prove_noether")
    series = AdiabaticInvariant(generators, gauges)
    z, shape = series.order, start_state(q0, q0)[0].shape

    def statements(t0, h, q0, p1, epsilon, energy):
        """The differences that have to be zero; `energy`: E⁻ at the first point, any number."""
        t1 = t0 + h
        moves = Equations(system, epsilon, args)
        interval = Interval(t0, t1, h)
        p0 = p1 - h * moves.momentum_rate(interval, q0, p1)
        q1 = q0 + h * moves.position_rate(interval, q0, p1)
        first, second = LatticePoint(t0, q0, p0), LatticePoint(t1, q1, p1)
        noether = [
            noether_identity(system, generators, gauges, m, first, second, epsilon, args)
            for m in range(z + 1)
        ]
        points_of_generators = [generator(first, args) for generator in generators]
        work = jnp.zeros(())
        if system.force is not None:
            W = system.force(*system.times(t0, t1, epsilon), q0, p1, args)
            work = jnp.sum(
                W * (points_of_generators[-1].q - (q1 - q0) / h * points_of_generators[-1].t)
            )
        end_value = series.bind(system, epsilon)(t0, t1, q0, p0, q1, p1, args)
        start_value, clock = jnp.zeros(()), jnp.zeros(())
        for m, (x, gauge) in enumerate(zip(points_of_generators, gauges, strict=True)):
            term = jnp.sum(x.q * p0) - x.t * energy
            if gauge is not None:
                term = term + gauge_value(gauge, first, args)
            start_value += epsilon**m * term
            clock += epsilon**m * x.t
        work_done = disturbing_work(system, t0, t1, q0, q1, p1, epsilon, args)
        residual = outgoing_energy(system, t0, t1, q0, p1, epsilon, args) - energy - work_done
        right = h * sum(epsilon**m * N for m, N in enumerate(noether))
        right += h * epsilon ** (z + 1) * work - clock * residual
        return (
            *noether,
            work,
            end_value - start_value - right,
            jnp.stack([x.t for x in points_of_generators]),
        )

    program = program_of(statements, (), (), shape, shape, (), ())
    q, p_range = np.asarray(q0, float), np.ones(shape)
    width = 0.2 * (1 + np.abs(q))
    points = random_points(
        [(-1, 1), (0.01, 0.2), (q - width, q + width), (-p_range, p_range), (-0.2, 0.2), (-1, 1)]
    )
    if compare("Noether's identity", statements, program, points) < POINTS / 4:
        raise NotAnalytic(
            f"Noether's identity is singular at most of the {POINTS} random points near q0, so "
            "that its list of operations cannot be compared with it. Give another q0."
        )
    algebra = exact.Identities(2 * int(np.prod(shape)) + 4, [program])
    values = exact.run(program, [(x, algebra.unit) for x in algebra.x], algebra)
    zero = [bool(numerator == 0 and denominator != 0) for numerator, denominator in values]
    return NoetherProof(tuple(zero[: z + 1]), zero[z + 1], all(zero[z + 3 :]), zero[z + 2])
