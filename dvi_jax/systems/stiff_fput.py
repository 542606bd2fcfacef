"""Stiff linear springs in a chain with soft ones: the modified Fermi–Pasta–Ulam problem."""

import jax.numpy as jnp
import numpy as np

from ..base.checks import whole
from ._problem import Adiabatic, Parameter, Problem, Start, bound, library_problem, positive


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy of m stiff springs of frequency ω, joined by soft springs with a fourth power.

        H_D = |p1|²/2 + ω²/2 Σ_i y_i² + Σ_{i=0}^{m} (x_{i+1} − y_{i+1} − x_i − y_i)⁴/4

    q0 = (x, y), shape (2, m): scaled centres x_i of the stiff springs and their scaled lengths
    y_i, with x = y = 0 at the walls i = 0 and i = m + 1.
    """
    x, y = q0
    soft = jnp.pad(x - y, (0, 1)) - jnp.pad(x + y, (1, 0))
    return jnp.sum(p1**2) / 2 + args["omega"] ** 2 * jnp.sum(y**2) / 2 + jnp.sum(soft**4) / 4


def stiff_energies(t0, t1, q0, p0, q1, p1, args):
    """I_i = (ẏ_i² + ω² y_i²)/2 at t1, shape (m,): they exchange energy on times of order ω."""
    return (p1[1] ** 2 + (args["omega"] * q1[1]) ** 2) / 2


def oscillatory_energy(t0, t1, q0, p0, q1, p1, args):
    """I = Σ_i I_i at t1: an adiabatic invariant, constant to O(1/ω) over very long times."""
    return jnp.sum(stiff_energies(t0, t1, q0, p0, q1, p1, args))


def stiff_fput(m: int = 3, omega: float = 50.0) -> Problem:
    """The FPUT chain of stiff and soft springs: x_1 = ẋ_1 = ẏ_1 = 1, y_1 = 1/ω, all else zero.

    **Raises** `ValueError` for fewer than one spring, and for an ω that is not positive.

    **Source** Galgani, Giorgilli, Martinoli & Vanzini 1992, *Physica D* 59, 334; Hairer, Lubich
    & Wanner 2006, *Geometric Numerical Integration*, I.5.1 and XIII.2.1, whose start this is.
    """
    m = whole("m", m, hint="The stiff FPUT chain has centres and lengths of m springs.")
    omega = positive("omega", omega)
    q0, p0 = np.zeros((2, 2, m))
    q0[:, 0], p0[:, 0] = (1.0, 1 / omega), (1.0, 1.0)
    return library_problem(
        hamiltonian,
        Start("the stiff FPUT chain has centres and lengths of m springs", (2, None)),
        name="stiff_fput",
        q0_p0_h=(q0, p0, 0.5 / omega),
        parameters={"omega": Parameter(omega, "frequency of the stiff springs [1/time]")},
        observables=[stiff_energies, oscillatory_energy],
        source="Hairer, Lubich & Wanner 2006, Geometric Numerical Integration, I.5.1",
        adiabatic={"oscillatory_energy": Adiabatic("1/ω", 1, bound(_smaller, m, omega))},
    )


def _smaller(m, omega, factor):
    return stiff_fput(m, omega / factor)
