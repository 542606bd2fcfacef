"""The chain of Fermi, Pasta, Ulam and Tsingou, with fixed ends."""

import jax.numpy as jnp
import numpy as np

from ..base.checks import whole
from ._problem import Parameter, Problem, Start, finite, library_problem


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy of unit masses on springs that are not quite linear.

    H_D = Σ_i p1_i²/2 + Σ_{i=0}^{n} (d_i²/2 + α d_i³/3 + β d_i⁴/4)

    d_i = q0_{i+1} − q0_i,    q0_0 = q0_{n+1} = 0
    """
    d = jnp.diff(jnp.pad(q0, 1))
    kinetic = jnp.sum(p1**2) / 2
    return kinetic + jnp.sum(d**2 / 2 + args["alpha"] * d**3 / 3 + args["beta"] * d**4 / 4)


def frequencies(n):
    """ω_k = 2 sin(πk/(2(n + 1))), k = 1, …, n: those of the linear chain, shape (n,)."""
    return 2 * np.sin(np.pi * np.arange(1, n + 1) / (2 * (n + 1)))


def mode_energies(t0, t1, q0, p0, q1, p1, args):
    r"""Energies of the modes of the linear chain at t1: shape (n,).

        E_k = (Ȧ_k² + ω_k² A_k²)/2,    A_k = √(2/(n + 1)) Σ_i q_i sin(πik/(n + 1))

    With α = β = 0 each is conserved. Their sum is the energy without the terms in α and β.
    """
    w = jnp.asarray(frequencies(q1.shape[0]), q1.dtype)
    return (_sine_transform(p1) ** 2 + (w * _sine_transform(q1)) ** 2) / 2


def _sine_transform(x):
    """√(2/(n + 1)) Σ_i x_i sin(πik/(n + 1)), k = 1, …, n."""
    n = x.shape[0]
    if n > 256:  # the matrix of a long chain would be larger than all its other data
        odd = jnp.concatenate([jnp.zeros_like(x[:1]), x, jnp.zeros_like(x[:1]), -x[::-1]])
        return -jnp.imag(jnp.fft.rfft(odd)[1:-1]) * np.sqrt(0.5 / (n + 1))
    i = np.arange(1, n + 1)
    modes = np.sqrt(2 / (n + 1)) * np.sin(np.pi * np.outer(i, i) / (n + 1))
    return jnp.asarray(modes, x.dtype) @ x


def fput(n: int = 31, alpha: float = 0.25, beta: float = 0.0) -> Problem:
    """The Fermi–Pasta–Ulam–Tsingou chain with its energy in the longest mode; dimensionless.

    n = 31 moving particles (32 springs), α = 1/4 and a sine wave of amplitude 1 are those of the
    report's first figure; all but some per cent of the energy returns to the first mode at
    t ≈ 10 000. With α ≠ 0 = β the energy has no lower bound: waves that are too strong break the
    chain.

    **Raises** `ValueError` for fewer than one particle, and for α or β that is not finite.

    **Source** Fermi, Pasta & Ulam (and Tsingou) 1955, *Studies of nonlinear problems I*, Los
    Alamos report LA-1940.
    """
    n = whole("n", n, hint="The FPUT chain is a row of particles between two walls.")
    alpha, beta = finite("alpha", alpha), finite("beta", beta)
    return library_problem(
        hamiltonian,
        Start("the FPUT chain is a row of particles between two walls", (None,)),
        name="fput",
        q0_p0_h=(np.sin(np.pi * np.arange(1, n + 1) / (n + 1)), np.zeros(n), 0.2),
        parameters={
            "alpha": Parameter(alpha, "quadratic part of a spring's force [1]", finite),
            "beta": Parameter(beta, "cubic part of a spring's force [1]", finite),
        },
        observables=[mode_energies],
        source="Fermi, Pasta & Ulam 1955, Los Alamos report LA-1940",
    )
