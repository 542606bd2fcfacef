"""The periodic Toda lattice, a chain of particles that is integrable."""

import jax.numpy as jnp
import numpy as np

from ..base.checks import whole
from ..discover.symmetries.library import space_translation
from ._problem import Problem, Start, library_problem


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = Σ_i p1_i²/2 + Σ_i exp(q0_i − q0_{i+1}), with q_{n+1} = q_1."""
    return jnp.sum(p1**2) / 2 + jnp.sum(jnp.exp(q0 - jnp.roll(q0, -1)))


def lax_matrix(q, p):
    r"""Flaschka's symmetric matrix L, whose eigenvalues are conserved.

        L_ii = b_i,    L_{i,i+1} = L_{i+1,i} = a_i,    L_{1n} = L_{n1} = a_n

        a_i = exp((q_i − q_{i+1})/2)/2,    b_i = −p_i/2

    q, p: shape (n,), n ≥ 3. Returns shape (n, n). tr L = −Σ p_i/2 and tr L² = H/2.

    **Source** Flaschka 1974, *Phys. Rev. B* 9, 1924; Hairer, Lubich & Wanner 2006, X.1.3.
    """
    n = q.shape[0]
    a, neighbour = jnp.exp((q - jnp.roll(q, -1)) / 2) / 2, (np.arange(n) + 1) % n
    upper = jnp.zeros((n, n), q.dtype).at[np.arange(n), neighbour].set(a)
    return upper + upper.T - jnp.diag(p) / 2


def total_momentum(t0, t1, q0, p0, q1, p1, args):
    """Σ p_i at t1."""
    return jnp.sum(p1)


def cubic_integral(t0, t1, q0, p0, q1, p1, args):
    r"""Σ_i p_i³/3 + (p_i + p_{i+1}) exp(q_i − q_{i+1}) = −8/3 tr L³ at t1, for n ≥ 4.

    A sum of terms of neighbours, so that it costs no more than the energy. With three particles
    tr L³ has one more term, 6 a_1 a_2 a_3 = 3/4.
    """
    bond = jnp.exp(q1 - jnp.roll(q1, -1))
    return jnp.sum(p1**3 / 3 + (p1 + jnp.roll(p1, -1)) * bond)


def lax_traces(t0, t1, q0, p0, q1, p1, args):
    """tr L^k, k = 1, …, n, at t1: shape (n,). They are in involution."""
    L = lax_matrix(q1, p1)
    power, traces = L, [jnp.trace(L)]
    for _ in range(q1.shape[0] - 1):
        power = power @ L
        traces.append(jnp.trace(power))
    return jnp.stack(traces)


def lax_eigenvalues(t0, t1, q0, p0, q1, p1, args):
    """Eigenvalues of L at t1, ascending: shape (n,)."""
    return jnp.linalg.eigvalsh(lax_matrix(q1, p1))


def toda(n: int = 5) -> Problem:
    """The Toda lattice of n particles at equal distances, with two waves; dimensionless.

    The mean velocity is 0.1. Initial conditions and step are ours.

    `lax_traces` and `lax_eigenvalues` take a time of order n⁴ and n³; they are observables for
    n ≤ 32. `total_momentum` and `cubic_integral` are sums over the chain, for any n.

    **Raises** `ValueError` for fewer than three particles.

    **Source** Toda 1967, *J. Phys. Soc. Japan* 22, 431; integrals: Hénon 1974, *Phys. Rev. B* 9,
    1921, and Flaschka 1974, 1924.
    """
    n = whole("n", n, 3, hint="The periodic Toda lattice needs at least three particles.")
    lax = (lax_traces, lax_eigenvalues) if n <= 32 else ()
    angle = 2 * np.pi * np.arange(n) / n
    q0, p0 = np.zeros(n), 0.1 + np.cos(angle) + np.sin(2 * angle) / 2
    return library_problem(
        hamiltonian,
        Start("the periodic Toda lattice needs at least three particles", (None,), smallest=3),
        name="toda",
        q0_p0_h=(q0, p0, 0.1),
        observables=[total_momentum, cubic_integral, *lax],
        source="Toda 1967, J. Phys. Soc. Japan 22, 431; Flaschka 1974, Phys. Rev. B 9, 1924",
        invariants=("total_momentum", "cubic_integral", *(f.__name__ for f in lax)),
        symmetries={"translation": space_translation(np.ones(n))},
    )
