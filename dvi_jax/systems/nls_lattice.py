r"""The discrete nonlinear Schrödinger equation on a ring of sites.

    i dψ_n/dt = −κ (ψ_{n+1} − 2ψ_n + ψ_{n−1}) − γ |ψ_n|² ψ_n,    ψ = (q + i p)/√2

q and p, real and imaginary part, are canonical. (The integrable lattice of Ablowitz and Ladik is
canonical in another bracket only.)
"""

import jax.numpy as jnp
import numpy as np

from ..base.checks import whole
from ._fields import sech
from ._problem import Parameter, Problem, Start, finite, library_problem
from .oscillator import PHASE


def hamiltonian(t0, t1, q0, p1, args):
    r"""Energy Σ κ|ψ_{n+1} − ψ_n|² − γ|ψ_n|⁴/2 in real and imaginary parts; not separable.

    H_D = Σ_n κ/2 [(q_{n+1} − q_n)² + (p_{n+1} − p_n)²] − γ/8 (q_n² + p_n²)²
    """
    steps = (q0 - jnp.roll(q0, -1)) ** 2 + (p1 - jnp.roll(p1, -1)) ** 2
    return jnp.sum(args["kappa"] / 2 * steps - args["gamma"] / 8 * (q0**2 + p1**2) ** 2)


def norm(t0, t1, q0, p0, q1, p1, args):
    """Σ|ψ_n|² = Σ (q² + p²)/2 at t1: the number of particles, conserved by phase symmetry."""
    return jnp.sum(q1**2 + p1**2) / 2


def densities(t0, t1, q0, p0, q1, p1, args):
    """|ψ_n|² at t1, shape (n,)."""
    return (q1**2 + p1**2) / 2


def lattice_momentum(t0, t1, q0, p0, q1, p1, args):
    """Σ Im(ψ_n* ψ_{n+1}) at t1: conserved in the limit of slowly varying ψ."""
    return jnp.sum(q1 * jnp.roll(p1, -1) - p1 * jnp.roll(q1, -1)) / 2


def plane_wave(t, n, mode, amplitude, args):
    r"""ψ_j = a exp(i(kj − ωt)) of the mode-th wave on n sites as (q, p), an exact solution.

        k = 2π mode/n,    ω = 4κ sin²(k/2) − γ a²

    - `t`: times, any shape. Returns q, p of shape t.shape + (n,).

    A modulation with wave number Q ≠ 0, a multiple of 2π/n, grows as exp(σt),

        σ² = 4κ cos k sin²(Q/2) (2γa² − 4κ cos k sin²(Q/2)) ,

    where that is positive: for κγ cos k > 0 and |γ|a² > 2|κ cos k| sin²(Q/2).

    **Source** Kivshar and Peyrard 1992, Phys. Rev. A 46, 3198; Kevrekidis 2009, *The Discrete
    Nonlinear Schrödinger Equation*.
    """
    k = 2 * np.pi * mode / n
    omega = 4 * args["kappa"] * np.sin(k / 2) ** 2 - args["gamma"] * amplitude**2
    angle = k * np.arange(n) - omega * jnp.asarray(t)[..., None] * np.ones(n)
    return np.sqrt(2) * amplitude * jnp.cos(angle), np.sqrt(2) * amplitude * jnp.sin(angle)


def soliton(t, n, amplitude, velocity, args):
    r"""The soliton of the continuum limit at the sites of a ring, in its middle at t = 0: (q, p).

        ψ_j = a sech(s (x_j − vt)) exp(i (v x_j/2κ − ωt)),  s = a √(γ/2κ),  ω = v²/4κ − γa²/2

    with x_j = j − n/2. It solves the equation of the lattice up to terms of order s² and (v/κ)²,
    for κγ > 0. `t`: a number. `velocity` v in sites per time. Returns q, p of shape (n,).

    **Source** Zakharov & Shabat 1972, *Sov. Phys. JETP* 34, 62.
    """
    kappa, gamma, x = args["kappa"], args["gamma"], np.arange(n) - n / 2
    width = amplitude * np.sqrt(gamma / (2 * kappa))
    omega = velocity**2 / (4 * kappa) - gamma * amplitude**2 / 2
    size = np.sqrt(2) * amplitude * sech(width * (x - velocity * t))
    phase = velocity * x / (2 * kappa) - omega * t
    return size * np.cos(phase), size * np.sin(phase)


def nls_lattice(n: int = 8, kappa: float = 1.0, gamma: float = 1.0) -> Problem:
    """Discrete nonlinear Schrödinger equation on a ring: a moving localised excitation.

    Dimensionless, n sites; focusing for κγ > 0. With κ = 1/dx² and sites at a distance dx it is the
    equation i ∂ψ/∂t = −∂²ψ/∂x² − γ|ψ|²ψ up to terms of order dx²; `soliton` of the module has its
    soliton. Initial conditions and step are ours. The steps are implicit.

    **Raises** `ValueError` for fewer than three sites, and for κ or γ that is not finite.

    **Source** Kevrekidis 2009, *The Discrete Nonlinear Schrödinger Equation*.
    """
    n = whole("n", n, 3, hint="The lattice is a ring of at least three sites.")
    site = np.arange(n) - n / 2
    size, phase = sech(site / 1.5), 0.5 * site
    q0, p0 = size * np.cos(phase), size * np.sin(phase)
    return library_problem(
        hamiltonian,
        Start("the lattice is a ring of at least three sites", (None,), smallest=3),
        name="nls_lattice",
        q0_p0_h=(q0, p0, 0.02 / max(1.0, abs(finite("kappa", kappa)))),
        parameters={
            "kappa": Parameter(kappa, "coupling of neighbours [1/time]", finite),
            "gamma": Parameter(gamma, "attraction on a site; < 0: repulsion [1/time]", finite),
        },
        observables=[norm, densities, lattice_momentum],
        source="Kevrekidis 2009, The Discrete Nonlinear Schrödinger Equation",
        invariants=("norm",),
        flow_symmetries={"phase": PHASE},
    )
