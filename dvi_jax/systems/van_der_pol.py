"""Van der Pol's oscillator: a harmonic oscillator that is fed when small and damped when large."""

import jax.numpy as jnp
import numpy as np

from .._system import System
from ..discover.library import scaling
from ._problem import Problem, library_problem
from ._start import Start
from .oscillator import PHASE, exact, hamiltonian


def feedback(t0, t1, q0, p1, args):
    """W = (1 − q0²) p1, which is not linear in the state and depends on p: an implicit step."""
    return (1 - q0**2) * p1


def amplitude(t0, t1, q0, p0, q1, p1, args):
    """√(q² + p²) at t1: kept at ε = 0, and nearing 2 for small ε > 0.

    Its gradient at the origin, a corner, is put down as zero.
    """
    square = jnp.sum(q1**2) + jnp.sum(p1**2)
    away = square > 0
    return jnp.where(away, jnp.sqrt(jnp.where(away, square, 1.0)), 0.0 * square)


def averaged_amplitude(t, epsilon, start):
    r"""Amplitude at times t by the averaged equation, right to O(ε) for times up to 1/ε and beyond.

        da/dt = (ε/2) a (1 − a²/4),    a(t) = 2/√(1 + (4/a0² − 1) exp(−εt))

    - `start`: a0 > 0, the amplitude at t = 0.

    **Source** Guckenheimer & Holmes 1983, *Nonlinear Oscillations*, 4.1.
    """
    return 2 / jnp.sqrt(1 + (4 / start**2 - 1) * jnp.exp(-epsilon * jnp.asarray(t)))


def van_der_pol() -> Problem:
    """H = (p² + q²)/2 with the force ε(1 − q²)p; dimensionless.

    For ε > 0 every start but the origin ends on one cycle, of amplitude 2 for small ε. It is the
    `oscillator` with another disturbance. Start and step are ours.

    **Source** van der Pol 1926, *Phil. Mag.* 2, 978.
    """
    return library_problem(
        System(hamiltonian, force=feedback),
        Start("Van der Pol's oscillator has one degree of freedom", (1,)),
        name="van_der_pol",
        q0=np.array([0.5]),
        p0=np.array([0.0]),
        h=0.1,
        observables=[amplitude],
        source="van der Pol 1926, Phil. Mag. 2, 978",
        invariants=("amplitude",),
        symmetries={"scaling": scaling()},
        flow_symmetries={"phase": PHASE},
        exact=exact,
    )
