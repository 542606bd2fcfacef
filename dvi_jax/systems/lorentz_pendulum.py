"""A pendulum of slowly changing length: Lorentz's question at the Solvay congress, 1911."""

import jax.numpy as jnp
import numpy as np

from ..problem.system import System
from ._elliptic import swing
from ._problem import Adiabatic, Parameter, Problem, Start, at_end, interval, library_problem
from .pendulum import exact as of_pendulum


def length(tau, args):
    """l(τ) = l0 (1 + d sin τ), |d| < 1, of the slow time τ = εt."""
    return args["length"] * (1 + args["depth"] * jnp.sin(tau))


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = p1²/(2 m l²) − m g l cos q0 with l = l(τ0); the times are slow ones, τ = εt.

    The radial energy of the bob, m l̇²/2, depends on time only and is omitted.
    """
    m, g, string = args["mass"], args["g"], length(t0, args)
    return jnp.sum(p1**2) / (2 * m * string**2) - m * g * string * jnp.sum(jnp.cos(q0))


energy = at_end(hamiltonian)


def action(t0, t1, q0, p0, q1, p1, args):
    r"""The adiabatic invariant at the end of the step, for librations of any amplitude (m < 1).

        J = ∮ p dq/2π = (8/π) M l √(gl) (E(m) − (1 − m) K(m)),
        m = sin²(q/2) + p²/(4 M² g l³)

    with M the mass and l = l(τ1). For small amplitudes J = (E + M g l)/√(g/l), Lorentz's and
    Einstein's E/ν.
    """
    mass, g, string = args["mass"], args["g"], length(t1, args)
    m = jnp.sum(jnp.sin(q1 / 2) ** 2 + p1**2 / (4 * mass**2 * g * string**3))
    return 8 / jnp.pi * mass * string * jnp.sqrt(g * string) * swing(m)


def small_swing_action(t0, t1, q0, p0, q1, p1, args):
    """(E + M g l)/√(g/l) at the end of the step: adiabatic for small amplitudes only."""
    string = length(t1, args)
    excess = energy(t0, t1, q0, p0, q1, p1, args) + args["mass"] * args["g"] * string
    return excess * jnp.sqrt(string / args["g"])


def exact(t, q0, p0, args):
    """The state at times t at ε = 0, where l = l0: see `pendulum.exact`."""
    m, g, string = args["mass"], args["g"], args["length"]
    inertia = m * string**2
    q, rate = of_pendulum(t, q0, jnp.asarray(p0) / inertia, {"omega": jnp.sqrt(g / string)})
    return q, inertia * rate


def lorentz_pendulum() -> Problem:
    """A pendulum of 1 m and 1 kg with slowly varying length, from rest at 1 rad.

    The length is l0 (1 + d sin εt) with d = 0.3 (`depth` in args); ε [1/s] is the angular frequency
    of the change. Initial conditions and step are ours.

    **Source** Solvay congress 1911 (Langevin & de Broglie 1912, *La théorie du rayonnement et les
    quanta*, p. 450); action: Landau & Lifshitz 1976, *Mechanics*, §49.
    """
    return library_problem(
        System(hamiltonian, slow_time=True),
        Start("Lorentz's pendulum has one angle", (1,)),
        name="lorentz_pendulum",
        q0_p0_h=(np.array([1.0]), np.array([0.0]), 0.02),
        parameters={
            "mass": Parameter(1.0, "of the bob [kg]"),
            "g": Parameter(9.81, "gravity [m/s²]"),
            "length": Parameter(1.0, "mean length of the string [m]"),
            "depth": Parameter(0.3, "relative change of the length [1]", interval(-1, 1)),
        },
        observables=[action, small_swing_action],
        units={"q": "rad", "p": "kg m²/s", "t": "s", "energy": "J"},
        source="Langevin & de Broglie 1912, La théorie du rayonnement et les quanta, p. 450",
        invariants=("action", "small_swing_action"),
        adiabatic={"action": Adiabatic("rate of the change over the frequency", 1)},
        exact=exact,
    )
