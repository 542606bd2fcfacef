"""Vocabulary of the cases: samples, formulas as text, and quantities that a map conserves."""

import re
from collections.abc import Callable
from typing import Any

import exact_series
import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

poly, trig, Radial = dvi.Polynomials, dvi.Trigonometric, dvi.Radial

# --- samples -------------------------------------------------------------------------


def box(n, count, low=-1.0, high=1.0):
    """Uniform samples in a box of 2n dimensions; `n` may be the shape of a state."""
    shape = (count, *np.atleast_1d(n))
    return lambda rng: (rng.uniform(low, high, shape), rng.uniform(low, high, shape))


def sized(n, count, q, p):
    """Uniform samples, with |q_i| below `q` and |p_i| below `p`."""
    return lambda rng: (rng.uniform(-q, q, (count, n)), rng.uniform(-p, p, (count, n)))


def shell(n, count, inner=0.5, outer=2.0, speed=1.0):
    """Positions between two radii, uniform in the logarithm of the radius, and momenta in a box."""

    def draw(rng):
        way = rng.normal(size=(count, n))
        r = np.exp(rng.uniform(np.log(inner), np.log(outer), count))
        q = way * (r / np.linalg.norm(way, axis=1))[:, None]
        return q, rng.uniform(-speed, speed, (count, n))

    return draw


def timed(samples, low=0.0, high=10.0):
    """The samples, at uniform times."""

    def draw(rng):
        q, p = samples(rng)
        return q, p, rng.uniform(low, high, len(q))

    return draw


def moved(samples, q: Any = 0.0, p: Any = 0.0):
    """The samples about another origin."""

    def draw(rng):
        qs, ps = samples(rng)
        return qs + np.array(q), ps + np.array(p)

    return draw


def with_outliers(samples, factor, of_p=None):
    """The samples, one of twenty so many times as far from the origin."""

    def draw(rng):
        qs, ps = (np.array(x) for x in samples(rng))
        qs[::20] *= factor
        ps[::20] *= factor if of_p is None else of_p
        return qs, ps

    return draw


# --- formulas ------------------------------------------------------------------------

_KNOWN = {
    name: getattr(jnp, name) for name in ("array", "cosh", "cross", "exp", "maximum", "sqrt")
} | {
    # functions that exact_series evaluates too
    "cos": exact_series.cos,
    "log": exact_series.log,
    "sin": exact_series.sin,
    "vector": exact_series.vector,
    "sum": lambda x: x.sum(),
    "pi": np.pi,
}


def formula(text: str, arguments: str = "q, p, t") -> Callable[..., Any]:
    """The function of a formula, in which q1 is the first component of q."""
    code = re.sub(r"\b([qp])([1-9])\b", lambda m: f"{m[1]}[{int(m[2]) - 1}]", text)
    return eval(f"lambda {arguments}: {code}", dict(_KNOWN))


def functions(*texts: str, complexity: int = 1) -> dvi.Basis:
    """A basis of these functions of q, p and, where it occurs, t."""
    named = {x: formula(x, "q, p, t" if re.search(r"\bt\b", x) else "q, p") for x in texts}
    return dvi.Basis(named, complexity)


def system(H: str, force: str = "", perturbation: str = "", **options: Any) -> dvi.System:
    """The system of an H_D, a force and a perturbation of (t0, q0, p1), where t0 is called t."""
    parts = (formula(x, "t, t1, q, p, args") if x else None for x in (H, force, perturbation))
    return dvi.System(*parts, **options)


def separable(V: str) -> dvi.System:
    """The system with H_D = p1·p1/2 + V(q0)."""
    return system(f"p @ p / 2 + ({V})")


def potential(slope):
    """A function of one number that has this derivative. Only the derivative enters a map: its
    value is not computed (it is often a dilogarithm)."""

    @jax.custom_jvp
    def V(x):
        return jnp.zeros_like(x)

    @V.defjvp
    def _(primals, tangents):
        return jnp.zeros_like(primals[0]), slope(primals[0]) * tangents[0]

    return V


def with_slope(slope):
    """The system with H_D = p1·p1/2 + Σ V(q0_i), V' = slope."""
    V = potential(slope)
    return dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + jnp.sum(V(q)))


def additive(f, h=1.0):
    """The system with the map q₊ + q₋ = f(q) of one coordinate, and p = (q − q₋)/h."""
    return with_slope(lambda q: (2 * q - f(q)) / h**2)


def spring(*stiffness):
    """The system with H_D = (p·p + Σ kᵢ qᵢ²)/2."""
    k = np.array(stiffness)
    return dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ (k * q) / 2)


# --- systems of several modules ------------------------------------------------------

OSCILLATOR, ISOTROPIC = spring(1.0), spring(1.0, 1.0)
CENTRAL = separable("(q @ q)**2 / 4")
FREE = separable("0.0 * sum(q)")
HENON = separable("sum(0.4 * q**2 + q**3 / 3)")
KEPLER = separable("-1 / sqrt(q @ q)")
MCMILLAN = separable("sum(q**2 - 0.7 * log(1 + q**2))")
PENDULUM = separable("-sum(cos(q))")
QUARTIC = separable("sum(q**4) / 4")
VARYING = system("p @ p / 2 + (1 + 0.3 * cos(t)) * (q @ q)**2 / 4")
TWO_VECTORS = system("sum(cross(q, p)**2 / array([1.0, 2.0, 3.0])) / 2")
"""A free top: L = q × p turns q and p together."""

MOMENTA = ["p1", "p2"]
QUADRATICS = functions("q1**2", "q1*p1", "p1**2")
ENERGIES = poly(2) + Radial()
"""Functions of Kepler's problem with the energy p²/2 − 1/r in their span."""

# --- what a map conserves ------------------------------------------------------------

L, L13, L23 = ANGULAR = ("q1*p2 - q2*p1", "q1*p3 - q3*p1", "q2*p3 - q3*p2")


def energy(k, h, i=1):
    """p² + k q² − h k q p, over 2, of one oscillator under symplectic Euler."""
    return f"(p{i}**2 + {k!r}*q{i}**2 - {h * k!r}*q{i}*p{i}) / 2"


def energies(h, *stiffness):
    """The same of each of several oscillators."""
    return tuple(energy(k, h, i + 1) for i, k in enumerate(stiffness))


E = energy(1.0, 0.1)


def kicked(K, h):
    """The step p1 = p − h K q, q1 = q + h p1."""
    K = jnp.asarray(K, float)

    def step(q, p):
        p = p - h * (K @ q)
        return q + h * p, p

    return step


def area(step, times=1):
    """ω(z, Mᵏz) = q·p' − p·q' of a linear step M; M conserves it since M is symplectic:
    ω(Mz, Mᵏ⁺¹z) = ω(z, Mᵏz)."""

    def form(q, p, t):
        q1, p1 = q, p
        for _ in range(times):
            q1, p1 = step(q1, p1)
        return q @ p1 - p @ q1

    return form


def biquadratic(alpha, beta, gamma, epsilon, xi, h=1.0, size=1.0):
    """α x²y² + β xy(x + y) + γ(x² + y²) + ε xy + ξ(x + y) with x = q − h p, y = q, each over the
    size."""

    def value(q, p, t):
        y = q[0] / size
        x = y - h * p[0] / size
        return (
            alpha * x**2 * y**2
            + beta * x * y * (x + y)
            + gamma * (x**2 + y**2)
            + epsilon * x * y
            + xi * (x + y)
        )

    return value


BIQUADRATIC = biquadratic(1, 0, 1, -1.4, 0)
"""Of McMillan's map (1971), x²y² + x² + y² − 2μxy with μ = 0.7."""
