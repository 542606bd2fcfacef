"""Duffing's oscillator: a spring with a cubic term; friction and a periodic drive perturb it."""

import jax.numpy as jnp
import numpy as np

from ._elliptic import first_kind, jacobi
from ._problem import Parameter, Problem, Start, System, finite, library_problem, over_times


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = p1²/2 + α q0²/2 + β q0⁴/4."""
    return jnp.sum(p1**2 / 2 + args["alpha"] * q0**2 / 2 + args["beta"] * q0**4 / 4)


def friction_and_drive(t0, t1, q0, p1, args):
    """W = −δ p1 + γ cos(ω t0)."""
    return -args["delta"] * p1 + args["gamma"] * jnp.cos(args["omega"] * t0)


@over_times((1,))
def exact(t, q0, p0, args):
    r"""The state at times t without perturbation, for β > 0.

        E > 0:  q = A cn(λt + u | m),  λ² = α + βA²,  m = βA²/(2λ²)      (over the barrier, if any)
        E < 0:  q = ±A dn(λt + u | m),  λ² = βA²/2,    m = 2 + 2α/(βA²)   (in one of two wells)

    with A the largest distance, A² = (−α + s)/β, s² = α² + 4βE = (α + βq²)² + 2βp², and p = dq/dt.
    NaN at E = 0 with α < 0 (separatrix), and at rest at the origin. Differentiable elsewhere,
    except at the bottom of a well, where s = 0 has a cusp: NaN.
    **Source** Kovacic & Brennan (eds.) 2011, *The Duffing Equation*, Chapter 4.
    """
    alpha, beta = args["alpha"], args["beta"]
    E = hamiltonian(0.0, 0.0, q0, p0, args)
    E = jnp.where(E == 0, jnp.nan, E)
    # s² as a sum of squares: α² + 4βE cancels near the bottom of a well
    slope = alpha + beta * q0**2
    is_high, root = E > 0, jnp.sqrt(slope**2 + 2 * beta * p0**2) + 0 * E
    # 4E/(α + root) is (root − α)/β without its cancellation, for α > 0
    square = jnp.where(alpha > 0, 4 * E / (alpha + root), (root - alpha) / beta)
    A = jnp.sqrt(square)
    rate = jnp.sqrt(jnp.where(is_high, root, beta * square / 2))
    m = jnp.where(is_high, beta * square / (2 * root), 2 * root / (beta * square))
    # cn = q/A and sn dn = −p/(Aλ)
    c = q0 / A
    cn_phase = jnp.arctan2(-p0 / (A * rate * jnp.sqrt(1 - m + m * c**2)), c)
    # dn = |q|/A and sn cn = ∓p/(Aλm), whose sine and cosine of twice the phase, times s
    sign = jnp.where(q0 < 0, -1.0, 1.0)
    dn_phase = jnp.arctan2(-sign * p0 * jnp.sqrt(2 * beta), slope) / 2
    u = first_kind(jnp.where(is_high, cn_phase, dn_phase), m)
    sn, cn, dn, _ = jacobi(rate * t + u, m)
    q = A * jnp.where(is_high, cn, sign * dn)
    p = -A * rate * jnp.where(is_high, sn * dn, sign * m * sn * cn)
    return q, p


def duffing() -> Problem:
    """H = p²/2 + αq²/2 + βq⁴/4 with the force ε(−δp + γ cos ωt), in the left of two wells.

    Dimensionless. α = −1, β = 1, δ = 0.3, ω = 1.2: with ε = 1 the motion is chaotic for γ = 0.5 and
    stays in a well for γ = 0.2. Without perturbation it oscillates in one well.

    **Source** Guckenheimer & Holmes 1983, *Nonlinear Oscillations*, 2.2; Kovacic & Brennan 2011,
    *The Duffing Equation*.
    """
    return library_problem(
        System(hamiltonian, friction_and_drive),
        Start("Duffing's oscillator has one degree of freedom", (1,)),
        name="duffing",
        q0_p0_h=(np.array([-1.2]), np.array([0.2]), 0.1),
        parameters={  # with β ≤ 0 the motion is unbounded
            "alpha": Parameter(-1.0, "linear part, negative for two wells [1/time²]", finite),
            "beta": Parameter(1.0, "cubic part of the spring, positive [1/(length² time²)]"),
            "delta": Parameter(0.3, "friction at ε = 1 [1/time]", finite),
            "gamma": Parameter(0.5, "amplitude of the drive at ε = 1 [length/time²]", finite),
            "omega": Parameter(1.2, "frequency of the drive [1/time]", finite),
        },
        source="Guckenheimer & Holmes 1983, Nonlinear Oscillations, 2.2",
        exact=exact,
    )
