"""Van der Pol's oscillator: amplified at small and damped at large amplitudes."""

import jax.numpy as jnp
import numpy as np

from ..discover.symmetries.library import scaling
from ._problem import Problem, Start, System, library_problem
from .oscillator import PHASE, exact, hamiltonian


def feedback(t0, t1, q0, p1, args):
    """W = (1 − q0²) p1: nonlinear and dependent on p, so that the step is implicit."""
    return (1 - q0**2) * p1


def amplitude(t0, t1, q0, p0, q1, p1, args):
    """√(q² + p²) at t1: constant at ε = 0, and approaches 2 for small ε > 0.

    The gradient at the origin, where it does not exist, is set to zero.
    """
    square = jnp.sum(q1**2) + jnp.sum(p1**2)
    is_away = square > 0
    return jnp.where(is_away, jnp.sqrt(jnp.where(is_away, square, 1.0)), 0.0 * square)


def averaged_amplitude(t, epsilon, start):
    r"""Amplitude at times t by the averaged equation, with error O(ε) for times of order 1/ε.

        da/dt = (ε/2) a (1 − a²/4),    a(t) = 2/√(1 + (4/a0² − 1) exp(−εt))

    - `start`: a0 > 0, the amplitude at t = 0.

    **Source** Guckenheimer & Holmes 1983, *Nonlinear Oscillations*, 4.1.
    """
    return 2 / jnp.sqrt(1 + (4 / start**2 - 1) * jnp.exp(-epsilon * jnp.asarray(t)))


def van_der_pol() -> Problem:
    """H = (p² + q²)/2 with the force ε(1 − q²)p; dimensionless.

    For ε > 0 every trajectory except the origin approaches one limit cycle, of amplitude 2 for
    small ε. The unperturbed system is the `oscillator`. Initial conditions and step are ours.

    **Source** van der Pol 1926, *Phil. Mag.* 2, 978.
    """
    return library_problem(
        System(hamiltonian, feedback),
        Start("Van der Pol's oscillator has one degree of freedom", (1,)),
        name="van_der_pol",
        q0_p0_h=(np.array([0.5]), np.array([0.0]), 0.1),
        observables=[amplitude],
        source="van der Pol 1926, Phil. Mag. 2, 978",
        invariants=("amplitude",),
        symmetries={"scaling": scaling()},
        flow_symmetries={"phase": PHASE},
        exact=exact,
    )
