"""Systems that depend on time: driven, damped in Caldirola's and Kanai's way, slowly varying."""

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import Case
from .integrable import OSCILLATOR, energy
from .maps import box, separable, timed, turning

KIND = "time dependent"
NONE = "checked in 60 digits: the changes of the basis have full rank, but for functions of time"

QUADRATICS = dvi.Basis(
    {"q²": lambda q, p: q[0] ** 2, "q p": lambda q, p: q[0] * p[0], "p²": lambda q, p: p[0] ** 2}
)


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


def driven(omega):
    """H_D = p²/2 + q²/2 − q cos ωt₀."""
    return dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 - jnp.sum(q) * jnp.cos(omega * t0)
    )


def damped(V, rate=0.3):
    """H_D = e^{−γt₀} p²/2 + e^{γt₀} V(q): Caldirola 1941, Kanai 1948."""
    return dvi.System(
        lambda t0, t1, q, p, args: jnp.exp(-rate * t0) * (p @ p) / 2 + jnp.exp(rate * t0) * V(q)
    )


def damped_form(h, rate):
    """e^{γt}(n v² + (m − l) q v − k q²) with v = e^{−γt} p and the matrix [[m, n], [k, l]] of
    v1 = e^{−γh}(v − h q), q1 = q + h (v − h q), which has the determinant e^{−γh}."""
    m, n, k, low = 1 - h * h, h, -h * np.exp(-rate * h), np.exp(-rate * h)

    def value(q, p, t):
        v = jnp.exp(-rate * t) * p[0]
        return jnp.exp(rate * t) * (n * v * v + (m - low) * q[0] * v - k * q[0] ** 2)

    return value


def grown(k, name, rate=0.3):
    """e^{kγt}."""
    return dvi.Basis({name: lambda q, p, t: jnp.exp(k * rate * t)})


TURN = float(np.arccos(1 - 0.1**2 / 2) / 0.1)
"""Frequency of the oscillator's map at h = 0.1: cos θ = 1 − h²/2."""


def rotating(q, p, t):
    """Re ζ e^{−iωt}, ζ = p + (λ − 1) q/h, λ = e^{iωh}."""
    c = (np.exp(1j * TURN * 0.1) - 1) / 0.1
    x, y = p[0] + c.real * q[0], c.imag * q[0]
    return x * jnp.cos(TURN * t) + y * jnp.sin(TURN * t)


def rotating_too(q, p, t):
    """Im ζ e^{−iωt}."""
    c = (np.exp(1j * TURN * 0.1) - 1) / 0.1
    x, y = p[0] + c.real * q[0], c.imag * q[0]
    return y * jnp.cos(TURN * t) - x * jnp.sin(TURN * t)


CENTRAL = dvi.System(
    lambda t0, t1, q, p, args: p @ p / 2 + (1 + 0.3 * jnp.cos(t0)) * (q @ q) ** 2 / 4
)
PERIODIC = dvi.System(lambda t0, t1, q, p, args: (p @ p + (1 + 0.3 * jnp.cos(t0)) * (q @ q)) / 2)

CASES = (
    Case(
        "oscillator with a periodic force",
        KIND,
        "the quadratic form about the periodic orbit of the map",
        driven(0.7),
        dvi.Polynomials(2, constant=True) * dvi.Trigonometric(2, "t", 2 * np.pi / 0.7, True),
        timed(box(1, 100), 0.0, 50.0),
        truth=(about_orbit(0.7, 0.1),),
    ),
    Case(
        "oscillator with a periodic force, too few harmonics",
        KIND,
        "the form about the periodic orbit has products of q and cos ωt, which this basis lacks; "
        + NONE,
        driven(0.7),
        dvi.Polynomials(2) + dvi.Trigonometric(2, "t", 2 * np.pi / 0.7),
        timed(box(1, 80), 0.0, 50.0),
    ),
    Case(
        "oscillator in the frame that rotates with it",
        KIND,
        "ζ e^{−iωt} with the frequency ω of the map itself",
        OSCILLATOR,
        dvi.Polynomials(1) * dvi.Trigonometric(1, "t", 2 * np.pi / TURN),
        timed(box(1, 60), 0.0, 50.0),
        truth=(rotating, rotating_too),
    ),
    Case(
        "oscillator in the frame that rotates with the flow",
        KIND,
        "with the frequency 1 of the flow nothing is conserved: the map is faster by h²/24",
        OSCILLATOR,
        dvi.Polynomials(1) * dvi.Trigonometric(1, "t"),
        timed(box(1, 60), 0.0, 50.0),
    ),
    Case(
        "free fall",
        KIND,
        "p + g t, and p²/2 + g q − (h/2) g p; g = 9.81",
        separable(lambda q: 9.81 * jnp.sum(q)),
        dvi.Polynomials(2, ["q", "p", "t"]),
        timed(box(1, 60)),
        truth=(
            lambda q, p, t: p[0] + 9.81 * t,
            lambda q, p: p[0] ** 2 / 2 + 9.81 * q[0] - 0.05 * 9.81 * p[0],
        ),
    ),
    Case(
        "free fall without functions of time",
        KIND,
        "p²/2 + g q − (h/2) g p; g = 9.81",
        separable(lambda q: 9.81 * jnp.sum(q)),
        dvi.Polynomials(3),
        box(1, 60),
        truth=(lambda q, p: p[0] ** 2 / 2 + 9.81 * q[0] - 0.05 * 9.81 * p[0],),
    ),
    Case(
        "free particle with functions of time",
        KIND,
        "p and q − t p",
        separable(lambda q: 0.0 * jnp.sum(q)),
        dvi.Polynomials(3, ["q", "p", "t"]),
        timed(box(1, 80), -5.0, 5.0),
        truth=(lambda q, p: p[0], lambda q, p, t: q[0] - t * p[0]),
    ),
    Case(
        "damped oscillator of Caldirola and Kanai",
        KIND,
        "the linear map of (q, e^{−γt} p) has the determinant e^{−γh}: its quadratic form times "
        "e^{γt}",
        damped(lambda q: q @ q / 2),
        QUADRATICS * (grown(0, "1") + grown(1, "e^γt") + grown(-1, "e^-γt")),
        timed(box(1, 60), 0.0, 5.0),
        truth=(damped_form(0.1, 0.3),),
    ),
    Case(
        "damped free particle",
        KIND,
        "p, and q + h e^{−γt} p/(1 − e^{−γh})",
        damped(lambda q: 0.0 * jnp.sum(q)),
        dvi.Polynomials(1, constant=True) * (grown(0, "1") + grown(-1, "e^-γt")),
        timed(box(1, 60), 0.0, 5.0),
        truth=(
            lambda q, p: p[0],
            lambda q, p, t: q[0] + 0.1 / (1 - np.exp(-0.03)) * jnp.exp(-0.3 * t) * p[0],
        ),
    ),
    Case(
        "damped oscillator with another rate in the basis",
        KIND,
        "the rate of the basis is 1 % too large; " + NONE,
        damped(lambda q: q @ q / 2),
        QUADRATICS * (grown(1, "e^γt", 0.303) + grown(0, "1") + grown(-1, "e^-γt", 0.303)),
        timed(box(1, 60), 0.0, 5.0),
    ),
    Case(
        "damped pendulum",
        KIND,
        NONE,
        damped(lambda q: -jnp.sum(jnp.cos(q))),
        (QUADRATICS + dvi.Trigonometric(1, "q"))
        * (grown(0, "1") + grown(1, "e^γt") + grown(-1, "e^-γt")),
        timed(box(1, 80, -2.0, 2.0), 0.0, 5.0),
    ),
    Case(
        "central force that varies with time",
        KIND,
        "Noether's theorem: rotations, at any time",
        CENTRAL,
        dvi.Polynomials(3),
        timed(box(2, 80)),
        truth=(turning(0, 1),),
    ),
    Case(
        "parametric oscillator with harmonics",
        KIND,
        "linear with periodic coefficients whose period is no multiple of h: the form of Ermakov "
        "and Lewis is no trigonometric polynomial; " + NONE,
        PERIODIC,
        QUADRATICS * dvi.Trigonometric(3, "t", constant=True),
        timed(box(1, 100), 0.0, 20.0),
    ),
    Case(
        "slow oscillator at order 0",
        KIND,
        "at ε = 0 the slow time stands still: p² + ω² q² − h ω² q p with ω² = 1 + 0.3 τ, and its "
        "products with functions of τ",
        dvi.System(
            lambda t0, t1, q, p, args: (p @ p + (1 + 0.3 * t0) * (q @ q)) / 2, slow_time=True
        ),
        QUADRATICS * dvi.Chebyshev(4, "τ", (0.0, 3.0)),
        timed(box(1, 60), 0.0, 3.0),
        truth=(lambda q, p, t: p[0] ** 2 + (1 + 0.3 * t) * (q[0] ** 2 - 0.1 * q[0] * p[0]),),
    ),
    Case(
        "slow oscillator at order 0 with functions of τ alone",
        KIND,
        "as above; functions of τ have no differential in q and p",
        dvi.System(
            lambda t0, t1, q, p, args: (p @ p + (1 + 0.3 * t0) * (q @ q)) / 2, slow_time=True
        ),
        dvi.Polynomials(2, constant=True) * dvi.Chebyshev(3, "τ", (0.0, 3.0)),
        timed(box(1, 80), 0.0, 3.0),
        truth=(lambda q, p, t: p[0] ** 2 + (1 + 0.3 * t) * (q[0] ** 2 - 0.1 * q[0] * p[0]),),
    ),
    Case(
        "slow pendulum at order 0",
        KIND,
        NONE,
        dvi.System(
            lambda t0, t1, q, p, args: p @ p / 2 - (1 + 0.3 * t0) * jnp.sum(jnp.cos(q)),
            slow_time=True,
        ),
        (QUADRATICS + dvi.Trigonometric(1, "q")) * dvi.Chebyshev(3, "τ", (0.0, 3.0)),
        timed(box(1, 80), 0.0, 3.0),
    ),
    Case(
        "oscillator, samples at many times",
        KIND,
        "a map that does not depend on time",
        OSCILLATOR,
        dvi.Polynomials(4),
        timed(box(1, 80), -1e6, 1e6),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "discrete Painlevé I",
        KIND,
        "q₊ + q₋ = (a + δt)/q + b/q²: integrable, and without an invariant; " + NONE,
        dvi.System(
            lambda t0, t1, q, p, args: (
                p @ p / 2 + jnp.sum(q**2 - (0.8 + 0.05 * t0) * jnp.log(q) + 0.3 / q)
            )
        ),
        dvi.Polynomials(4),
        timed(
            lambda rng: (rng.uniform(0.3, 2.0, (100, 1)), rng.uniform(-1.0, 1.0, (100, 1))),
            0.0,
            10.0,
        ),
        h=1.0,
    ),
)
