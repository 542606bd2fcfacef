"""Systems that depend on time: driven, damped in Caldirola's and Kanai's way, slowly varying.

Where no truth is given the changes of the basis have full rank but for functions of time: checked
in 60 digits.
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import case, named
from .maps import *


def orbit_of_force(omega, h, amplitude=1.0):
    """Coefficients of the periodic orbit z*(t) = Re(Z e^{iωt}) of
    p1 = p − h(q − F cos ωt), q1 = q + h p1: (e^{iωh} − M) Z = (h², h)·F."""
    M = np.array([[1 - h * h, h], [-h, 1.0]])
    return np.linalg.solve(np.exp(1j * omega * h) * np.eye(2) - M, amplitude * np.array([h * h, h]))


def about_orbit(omega, h):
    """The quadratic form of the oscillator about that orbit."""
    Z = orbit_of_force(omega, h)

    def value(q, p, t):
        c, s = jnp.cos(omega * t), jnp.sin(omega * t)
        x = q[0] - (Z[0].real * c - Z[0].imag * s)
        y = p[0] - (Z[1].real * c - Z[1].imag * s)
        return (y * y + x * x - h * x * y) / 2

    return value


def damped(V):
    """H_D = e^{−γt₀} p²/2 + e^{γt₀} V(q), γ = 0.3: Caldirola 1941, Kanai 1948."""
    return system(f"exp(-0.3 * t) * (p @ p) / 2 + exp(0.3 * t) * ({V})")


def damped_form(h, rate):
    """e^{γt}(n v² + (m − l) q v − k q²) with v = e^{−γt} p and the matrix [[m, n], [k, l]] of
    v1 = e^{−γh}(v − h q), q1 = q + h (v − h q), which has the determinant e^{−γh}."""
    m, n, k, low = 1 - h * h, h, -h * np.exp(-rate * h), np.exp(-rate * h)

    def value(q, p, t):
        v = jnp.exp(-rate * t) * p[0]
        return jnp.exp(rate * t) * (n * v * v + (m - low) * q[0] * v - k * q[0] ** 2)

    return value


def growing(*multiples, rate=0.3):
    """e^{kγt} for these k."""
    return functions(*(f"exp({k * rate} * t)" for k in multiples))


TURN = float(np.arccos(1 - 0.1**2 / 2) / 0.1)
"""Frequency of the oscillator's map at h = 0.1: cos θ = 1 − h²/2."""


def rotating(part):
    """Re or Im ζ e^{−iωt}, ζ = p + (λ − 1) q/h, λ = e^{iωh}."""
    c = (np.exp(1j * TURN * 0.1) - 1) / 0.1

    def value(q, p, t):
        x, y = p[0] + c.real * q[0], c.imag * q[0]
        cos, sin = jnp.cos(TURN * t), jnp.sin(TURN * t)
        return x * cos + y * sin if part == "real" else y * cos - x * sin

    return value


DRIVEN = system("(p @ p + q @ q) / 2 - sum(q) * cos(0.7 * t)")
FALLING, FALL = separable("9.81 * sum(q)"), "p1**2 / 2 + 9.81 * q1 - 0.05 * 9.81 * p1"
PERIODIC = system("(p @ p + (1 + 0.3 * cos(t)) * (q @ q)) / 2")
SLOW = system("(p @ p + (1 + 0.3 * t) * (q @ q)) / 2", slow_time=True)
SLOW_FORM = "p1**2 + (1 + 0.3 * t) * (q1**2 - 0.1 * q1*p1)"
SLOW_PENDULUM = system("p @ p / 2 - (1 + 0.3 * t) * sum(cos(q))", slow_time=True)
PAINLEVE = system("p @ p / 2 + sum(q**2 - (0.8 + 0.05 * t) * log(q) + 0.3 / q)")
POSITIVE = lambda rng: (rng.uniform(0.3, 2.0, (100, 1)), rng.uniform(-1.0, 1.0, (100, 1)))  # noqa: E731
HARMONICS = trig(2, "t", 2 * np.pi / 0.7)
TAU = {count: dvi.Chebyshev(count, "τ", (0.0, 3.0)) for count in (3, 4)}

_CASES = {
    # the quadratic form about the periodic orbit of the map
    "oscillator with a periodic force": case((DRIVEN,
        poly(2, constant=True) * trig(2, "t", 2 * np.pi / 0.7, True),
        timed(box(1, 100), 0.0, 50.0)), about_orbit(0.7, 0.1)),
    # the form about the periodic orbit has products of q and cos ωt, which this basis lacks
    "oscillator with a periodic force, too few harmonics": case((DRIVEN, poly(2) + HARMONICS,
        timed(box(1, 80), 0.0, 50.0))),
    # ζ e^{−iωt} with the frequency ω of the map itself
    "oscillator in the frame that rotates with it": case((OSCILLATOR,
        poly(1) * trig(1, "t", 2 * np.pi / TURN), timed(box(1, 60), 0.0, 50.0)),
        (rotating("real"), rotating("imaginary"))),
    # with the frequency 1 of the flow nothing is conserved: the map is faster by h²/24
    "oscillator in the frame that rotates with the flow": case((OSCILLATOR, poly(1) * trig(1, "t"),
        timed(box(1, 60), 0.0, 50.0))),
    # p + g t, and p²/2 + g q − (h/2) g p; g = 9.81
    "free fall": case((FALLING, poly(2, ["q", "p", "t"]), timed(box(1, 60))),
        ("p1 + 9.81 * t", FALL)),
    "free fall without functions of time": case((FALLING, poly(3), box(1, 60)), FALL),
    "free particle with functions of time": case((FREE, poly(3, ["q", "p", "t"]),
        timed(box(1, 80), -5.0, 5.0)), ("p1", "q1 - t * p1")),
    # the linear map of (q, e^{−γt} p) has the determinant e^{−γh}: its quadratic form times e^{γt}
    "damped oscillator of Caldirola and Kanai": case((damped("q @ q / 2"),
        QUADRATICS * growing(0, 1, -1), timed(box(1, 60), 0.0, 5.0)), damped_form(0.1, 0.3)),
    # p, and q + h e^{−γt} p/(1 − e^{−γh})
    "damped free particle": case((damped("0.0 * sum(q)"), poly(1, constant=True) * growing(0, -1),
        timed(box(1, 60), 0.0, 5.0)), ("p1", "q1 + 0.1 / (1 - exp(-0.03)) * exp(-0.3 * t) * p1")),
    # the rate of the basis is 1 % too large
    "damped oscillator with another rate in the basis": case((damped("q @ q / 2"),
        QUADRATICS * growing(1, 0, -1, rate=0.303), timed(box(1, 60), 0.0, 5.0))),
    "damped pendulum": case((damped("-sum(cos(q))"),
        (QUADRATICS + trig(1, "q")) * growing(0, 1, -1), timed(box(1, 80, -2.0, 2.0), 0.0, 5.0))),
    # Noether's theorem: rotations, at any time
    "central force that varies with time": case((VARYING, poly(3), timed(box(2, 80))), L),
    # linear with periodic coefficients whose period is no multiple of h: the form of Ermakov and
    # Lewis is no trigonometric polynomial
    "parametric oscillator with harmonics": case((PERIODIC,
        QUADRATICS * trig(3, "t", constant=True), timed(box(1, 100), 0.0, 20.0))),
    # at ε = 0 the slow time is constant: p² + ω² q² − h ω² q p with ω² = 1 + 0.3 τ, and its
    # products with functions of τ, which alone have no differential in q and p
    "slow oscillator at order 0": case((SLOW, QUADRATICS * TAU[4], timed(box(1, 60), 0.0, 3.0)),
        SLOW_FORM),
    "slow oscillator at order 0 with functions of τ alone": case((SLOW,
        poly(2, constant=True) * TAU[3], timed(box(1, 80), 0.0, 3.0)), SLOW_FORM),
    "slow pendulum at order 0": case((SLOW_PENDULUM, (QUADRATICS + trig(1, "q")) * TAU[3],
        timed(box(1, 80), 0.0, 3.0))),
    "oscillator, samples at many times": case((OSCILLATOR, poly(4), timed(box(1, 80), -1e6, 1e6)),
        E),
    # q₊ + q₋ = (a + δt)/q + b/q²: integrable, and without an invariant
    "discrete Painlevé I": case((PAINLEVE, poly(4), timed(POSITIVE), 1.0)),
}  # fmt: skip
CASES = named("time dependent", _CASES)
