"""Maps that are integrable at their step size: linear ones, QRT maps, and maps of Suris.

A linear symplectic map M conserves ω(z, Mᵏz). The invariants of Suris' maps, and of the Toda
lattices, are checked in 60 digits too.
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import case, named
from .maps import *


def amplitude(a, power):
    """Re and Im of ζⁿ, ζ = p + c q, of the map with h = 1: p1 = p − a q, q1 = q + p1 give
    ζ1 = λζ with λ = 1 + c, λ² − (2 − a)λ + 1 = 0 (|λ| = 1 for 0 < a < 4)."""
    re, im = -a / 2, np.sqrt(a - a * a / 4)

    def zeta(q, p, i=0):
        x, y = p[i] + re * q[i], im * q[i]
        out = (x, y)
        for _ in range(power - 1):
            out = (out[0] * x - out[1] * y, out[0] * y + out[1] * x)
        return out

    return zeta


def resonant(a, m, b, n):
    """Re ζ₁ᵐ conj(ζ₂)ⁿ, conserved where λ₁ᵐ = λ₂ⁿ."""
    first, second = amplitude(a, m), amplitude(b, n)

    def value(q, p, t):
        (x, y), (u, v) = first(q, p, 0), second(q, p, 1)
        return x * u + y * v

    return value


def hexagon(q, p, t):
    """Re ζ⁶ for a = 1."""
    return amplitude(1.0, 6)(q, p)[0]


# --- QRT maps ------------------------------------------------------------------------
# Quispel, Roberts & Thompson 1988, Phys. Lett. A 126, 419: in α x²y² + β xy(x+y) + γ(x²+y²) +
# ε xy + ξ(x+y), quadratic in y, the two roots have the sum −(β x² + ε x + ξ)/(α x² + β x + γ).


def qrt(alpha, beta, gamma, epsilon, xi):
    """q₊ + q₋ = −(β q² + ε q + ξ)/(α q² + β q + γ)."""
    return additive(lambda q: -(beta * q**2 + epsilon * q + xi) / (alpha * q**2 + beta * q + gamma))


def asymmetric(b, c, d, e, change=0.0):
    """x²y² + y² + d x² + b xy + c y + e x with x = q, y = p: first y is moved to the other root,
    p1 + p = −(b q + c)/(q² + 1), then x, q1 + q = −(b p1 + e)/(p1² + d).

    By H_D with h = 1: p1·q0 + H_D = −p1 q0 + ∫G(q0) + ∫F(p1)."""
    G = potential(lambda x: -(b * x + c) / (x**2 + 1))
    F = potential(lambda y: -(b * y + e) / (y**2 + d + change * y))
    return dvi.System(lambda t0, t1, q, p, args: jnp.sum(-2 * q * p + G(q) + F(p)))


# --- Lyness, Suris, Toda -------------------------------------------------------------


def lyness(a, power=1.0):
    """x₊x₋ = a + x with x = e^q: q₊ + q₋ = log(a + e^q)."""
    return additive(lambda q: jnp.log(a + jnp.exp(power * q)))


def of_lyness(a):
    """(1 + x)(1 + y)(a + x + y)/(xy)."""

    def value(q, p, t):
        x, y = jnp.exp(q[0]), jnp.exp(q[0] - p[0])
        return (1 + x) * (1 + y) * (a + x + y) / (x * y)

    return value


EXPONENTIALS = functions(
    *(
        f"exp({i} * q1 + {j} * (q1 - p1))"
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
        if (i, j) != (0, 0)
    )
)


def suris(k, other=1.0):
    """V'(q) = 2 arg(1 + k e^{iq}), |k| < 1."""
    return with_slope(lambda q: 2 * jnp.arctan(k * jnp.sin(q) / (1 + other * k * jnp.cos(q))))


WAVES = trig(1, "q", constant=True) * trig(1, "p", constant=True)


def toda(h, periodic=False, steepness=1.0):
    """x₊ − 2x + x₋ = log(1 + h² e^{x_{k+1} − x_k}) − log(1 + h² e^{x_k − x_{k−1}}): Suris 1990,
    Phys. Lett. A 145, 113 (explicit Toda map, dTL)."""
    V = potential(lambda u: jnp.log(1 + h * h * jnp.exp(steepness * u)) / (h * h))

    def H_D(t0, t1, q, p, args):
        ends = jnp.append(q, q[0]) if periodic else q
        return p @ p / 2 + jnp.sum(V(ends[1:] - ends[:-1]))

    return dvi.System(H_D)


def _pairs(n, periodic):
    return [(k, (k + 1) % n) for k in range(n if periodic else n - 1)]


def of_toda(h, n, periodic=False):
    """Σ e^{hp_k} + h² Σ e^{q_{k+1} − q_k + hp_k}, and its image under reversal of time: traces of
    the Lax matrix."""
    pairs = _pairs(n, periodic)

    def forwards(q, p, t):
        terms = [jnp.exp(q[j] - q[i] + h * p[i]) for i, j in pairs]
        return jnp.sum(jnp.exp(h * p)) + h * h * sum(terms)

    def backwards(q, p, t):
        terms = [jnp.exp(q[j] - q[i] - h * p[j]) for i, j in pairs]
        return jnp.sum(jnp.exp(-h * p)) + h * h * sum(terms)

    return forwards, backwards


def toda_basis(h, n, periodic=False):
    """e^{±hp_k}, e^{q_{k+1} − q_k} and its products with e^{±hp_k}, e^{±hp_{k+1}}, and p_k."""
    texts = [f"p{k + 1}" for k in range(n)]
    texts += [f"exp({s * h} * p{k + 1})" for s in (1, -1) for k in range(n)]
    for i, j in _pairs(n, periodic):
        texts.append(f"exp(q{j + 1} - q{i + 1})")
        texts += [f"exp(q{j + 1} - q{i + 1} + {s * h} * p{m + 1})" for s in (1, -1) for m in (i, j)]
    return functions(*texts)


# --- more degrees of freedom ---------------------------------------------------------


def garnier(*m, change=0.0):
    """x₊ + x₋ = 2Mx/(1 + x·Mx) with M = diag(m), h = 1: Suris 1994, Phys. Lett. A 189, 281."""
    m = np.array(m)
    return dvi.System(
        lambda t0, t1, q, p, args: (
            p @ p / 2 + q @ q - jnp.log(1 + q @ (m * q) + change * (q @ q) ** 2)
        )
    )


def of_garnier(*m):
    """|u|²|w|² + |u|² + |w|² − 2 u·Mw with u = √M x, w = √M y, y = q − p."""
    m = np.array(m)

    def value(q, p, t):
        u, w = np.sqrt(m) * q, np.sqrt(m) * (q - p)
        return (u @ u) * (w @ w) + u @ u + w @ w - 2 * u @ (m * w)

    return value


def of_garnier_too(*m):
    """u₁² + w₁² − 2m₁u₁w₁ + u₁²w₁² + (m₁²(u₁²w₂² + u₂²w₁²) − 2m₁m₂ u₁w₁u₂w₂)/(m₁² − m₂²)."""
    m = np.array(m)

    def value(q, p, t):
        u, w = np.sqrt(m) * q, np.sqrt(m) * (q - p)
        one = u[0] ** 2 + w[0] ** 2 - 2 * m[0] * u[0] * w[0] + (u[0] * w[0]) ** 2
        both = (u[0] * w[1]) ** 2 + (u[1] * w[0]) ** 2
        both = m[0] ** 2 * both - 2 * m[0] * m[1] * u[0] * w[0] * u[1] * w[1]
        return one + both / (m[0] ** 2 - m[1] ** 2)

    return value


def duffing(a, b, h):
    """V' = (a q + 2b q³)/(1 + h² b q²): McMillan's map with f = (2 − h²a) q/(1 + h²b q²)."""
    return with_slope(lambda q: (a * q + 2 * b * q**3) / (1 + h * h * b * q**2))


def of_duffing(a, b, h):
    """p² + a x y + b x² y² with x = q − h p, y = q: the biquadratic over h²."""
    return f"p1**2 + {a} * (q1 - {h} * p1) * q1 + {b} * (q1 - {h} * p1)**2 * q1**2"


POSITIVE = lambda rng: (rng.uniform(0.3, 2.0, (100, 1)), rng.uniform(-1.0, 1.0, (100, 1)))  # noqa: E731
STRANG, ADJOINT, GAUSS = dvi.Strang(), dvi.Adjoint(), dvi.GaussLegendre(2)
MIDPOINT = dvi.GaussLegendre(1)
COUPLED_CATS = kicked([[-1, -0.5], [-0.5, -1]], 1.0)
THREE = kicked([[2, -1, 0], [-1, 2.7, -0.7], [0, -0.7, 1.7]], 0.4)
SPACE = (0.7, 0.7, 0.7)
SCALAR_PRODUCTS = functions(
    "(q @ q)**2", "(q @ q) * (q @ p)", "(q @ q) * (p @ p)", "(q @ p)**2", "(q @ p) * (p @ p)"
)

_CASES = {
    "oscillator, symplectic Euler": case((OSCILLATOR, poly(4), box(1, 200)), E),
    "oscillator at h = 1.9, close to the limit of stability": case((OSCILLATOR, poly(4),
        box(1, 120), 1.9), energy(1.0, 1.9)),
    # kick–drift–kick has equal diagonal elements and conserves p² + (1 − h²/4) q²
    "oscillator, Strang": case((OSCILLATOR, poly(4), box(1, 120), 0.5),
        "p1**2 + (1 - 0.5**2/4) * q1**2", method=STRANG),
    # Gauss methods conserve quadratic invariants: Hairer, Lubich & Wanner 2006, IV.2.1
    "oscillator, Gauss–Legendre": case((OSCILLATOR, poly(4), box(1, 120), 0.5), "p1**2 + q1**2",
        method=GAUSS),
    # drift–kick is kick–drift backwards: p² + q² + h q p
    "oscillator, adjoint": case((OSCILLATOR, poly(4), box(1, 120), 0.5),
        "p1**2 + q1**2 + 0.5*q1*p1", method=ADJOINT),
    # resonance 1:1: the same 2×2 map A on each (qᵢ, pᵢ) conserves the polar forms of its
    # quadratic form and of ω; three of the four are independent
    "isotropic oscillator in the plane": case((ISOTROPIC, poly(2), box(2, 120)),
        (*energies(0.1, 1.0, 1.0), L)),
    # as in the plane: 2n − 1 = 5 of the nine quadratic invariants are independent
    "isotropic oscillator in space": case((spring(1.0, 1.0, 1.0), poly(2), box(3, 120), 0.3),
        (*energies(0.3, 1.0, 1.0, 1.0), L, L23)),
    # cos θ₁ = 3/4 and cos θ₂ = 2 cos² θ₁ − 1 = 1/8, so that ζ₁² conj ζ₂ is conserved
    "resonance 1:2 of the map": case((spring(0.5, 1.75), poly(3), box(2, 150), 1.0),
        (*energies(1.0, 0.5, 1.75), resonant(0.5, 2, 1.75, 1))),
    # H = (p₁² + q₁²)/2 − (p₂² + q₂²)/2: λ₂ = 1/λ₁, so that ζ₁ζ₂ is conserved; three of four
    # quadratic forms are independent
    "resonance 1:−1 of the map": case((system("(p1**2 + q1**2 - p2**2 - q2**2) / 2"), poly(2),
        box(2, 100), 0.25), (energy(1.0, 0.25), "p2**2 + q2**2 + 0.25*q2*p2", "q1*p2 + p1*q2")),
    # q1 = 2q + p, p1 = q + p conserves q² − qp − p²
    "cat map on the plane": case((separable("-q @ q / 2"), poly(4), box(1, 120), 1.0),
        "q1**2 - q1*p1 - p1**2"),
    "two coupled cat maps": case((separable("-(q @ q + q1*q2) / 2"), poly(3), box(2, 120), 1.0),
        (area(COUPLED_CATS, k) for k in (1, 2))),
    "three coupled oscillators": case((separable("(q @ q + (q1 - q2)**2 + 0.7 * (q2 - q3)**2) / 2"),
        poly(2), box(3, 120), 0.4), (area(THREE, k) for k in (1, 2, 3))),
    # each degree of freedom has its quadratic form
    "saddle and centre": case((spring(1.0, -1.0), poly(3), box(2, 120), 0.3),
        energies(0.3, 1.0, -1.0)),
    # q1 = B q, p1 = B⁻ᵀ p with B = 1 + h(a + bJ) conserves p·Cq for every C that commutes with
    # B: 1 and J
    "spiral in and out": case((system("0.3 * (q @ p) + 0.7 * (q1*p2 - q2*p1)"), poly(2),
        box(2, 100), 0.5), ("q @ p", L)),
    # M from p1 = p − h(a q + b p1), q1 = q + h(b q + c p1); M = [[m, n], [k, l]] conserves
    # n p² + (m − l) q p − k q²
    "general quadratic H_D, implicit": case((system(
        "sum(0.8 * q**2 / 2 + 0.3 * q * p + 1.1 * p**2 / 2)"), poly(4), box(1, 120), 0.2),
        "0.22/1.06 * p1**2 + (1.06 - (0.22*0.16 + 1)/1.06) * q1*p1 + 0.16/1.06 * q1**2"),
    # h = 1: λ = e^{iπ/3}, λ⁶ = 1, so that Re ζ⁶ is conserved besides |ζ|²; the map moves and has
    # as many independent invariants as coordinates, since its sixth iterate is the identity
    "sixth of a turn in each step": case((OSCILLATOR, poly(6), box(1, 120), 1.0),
        (energy(1.0, 1.0), hexagon)),
    # as above, and the quadratic form of an oscillator that turns by another angle
    "sixth of a turn and another oscillator": case((spring(1.0, 0.3),
        poly(6, ["q1", "p1"]) + poly(2, ["q2", "p2"]), box(2, 150), 1.0),
        (*energies(1.0, 1.0, 0.3), hexagon)),
    # H_D = p: q1 = q + h, p1 = p conserves p and functions of q with the period h
    "translation by a period of the basis": case((system("sum(p)"),
        poly(2) + trig(1, "q", period=0.5), sized(1, 80, 3.0, 1.0), 0.5),
        ("p1", "cos(4 * pi * q1)")),
    # momenta, and angular momentum: 2n − 1
    "free particle in the plane": case((FREE, poly(2), box(2, 100)), ("p1", "p2", L)),
    # momenta and angular momenta, of which p·L = 0
    "free particle in space": case((FREE, poly(2), box(3, 120)), (*MOMENTA, "p3", L, L23)),
    # p1 = p, q1 = q + h p³
    "twist map": case((system("sum(p**4) / 4"), poly(4), box(1, 120), 1.0), "p1"),
    "a degree of freedom at rest": case((system("p1**2 / 2"), poly(3), box(2, 120)),
        ("p1", "q2", "p2")),
    "McMillan's map": case((MCMILLAN, poly(4), box(1, 120), 1.0), BIQUADRATIC),
    # μ = 1.5
    "McMillan's map, unstable at the origin": case((qrt(1, 0, 1, -3.0, 0), poly(4),
        box(1, 120, -2.0, 2.0), 1.0), biquadratic(1, 0, 1, -3.0, 0)),
    **{f"symmetric QRT map with {name}": case((qrt(*c), poly(degree), box(1, 120), 1.0),
        biquadratic(*c)) for name, degree, c in (("all coefficients", 5,
        (1.0, 0.5, 2.0, -1.2, 0.3)), ("a cubic invariant", 4, (0.0, 1.0, 3.0, -1.5, 0.2)))},
    # different curves for x and y
    "asymmetric QRT map": case((asymmetric(0.8, 0.3, 1.5, -0.4), poly(4), box(1, 120), 1.0),
        "q1**2*p1**2 + p1**2 + 1.5*q1**2 + 0.8*q1*p1 + 0.3*p1 - 0.4*q1"),
    # Lyness 1945, x₊x₋ = a + x: (1 + x)(1 + y)(a + x + y)/(xy)
    "Lyness' map in logarithms": case((lyness(2.0), EXPONENTIALS, box(1, 80), 1.0), of_lyness(2.0)),
    # Suris 1989, Funct. Anal. Appl. 23, 74: for given x = q the two roots y = q − p of
    # cos(x − y) + k (cos x + cos y) have the sum 2 arg(e^{ix} + k)
    "Suris' trigonometric map": case((suris(0.4), WAVES + poly(2), box(1, 100, -3.0, 3.0), 1.0),
        "cos(p1) + 0.4 * (cos(q1) + cos(q1 - p1))"),
    "discrete Toda lattice of two particles, open": case((toda(0.5), toda_basis(0.5, 2), box(2, 80),
        0.5), ("p1 + p2", of_toda(0.5, 2)[0])),
    "discrete Toda lattice of three particles, open": case((toda(0.5), toda_basis(0.5, 3),
        box(3, 100), 0.5), ("sum(p)", *of_toda(0.5, 3))),
    "discrete Toda lattice of three particles, periodic": case((toda(0.5, True),
        toda_basis(0.5, 3, True), box(3, 120), 0.5), ("sum(p)", *of_toda(0.5, 3, True))),
    # x₊ + x₋ = 2μx/(1 + |x|²) conserves |x|²|y|² + |x|² + |y|² − 2μ x·y and x ∧ y: the isotropic
    # case of Garnier's system
    "radial McMillan map in the plane": case((garnier(0.7, 0.7), poly(4), box(2, 150), 1.0),
        (L, of_garnier(0.7, 0.7))),
    "discrete Garnier system": case((garnier(0.9, 0.5), poly(4), box(2, 150), 1.0),
        (of_garnier(0.9, 0.5), of_garnier_too(0.9, 0.5))),
    # separable: one invariant each
    "McMillan's map and an oscillator": case((separable(
        "q1**2 - 0.7 * log(1 + q1**2) + 0.3 * q2**2 / 2"),
        poly(4, ["q1", "p1"]) + poly(4, ["q2", "p2"]), box(2, 120), 1.0),
        (BIQUADRATIC, energy(0.3, 1.0, 2))),
    "integrable discrete Duffing oscillator": case((duffing(1.0, 0.5, 0.25), poly(4), box(1, 120),
        0.25), of_duffing(1.0, 0.5, 0.25)),
    # H = N², N = (q² + p²)/2 is a quadratic invariant of the equations: HLW IV.2.1
    "function of an action, Gauss–Legendre": case((system("sum((q**2 + p**2)**2) / 4"), poly(4),
        box(1, 120), 0.3), "q1**2 + p1**2", method=GAUSS),
    # H = N₁² + N₁N₂: both actions are quadratic invariants of the equations: HLW IV.2.1
    "function of two actions, midpoint rule": case(
        (system("((q1**2 + p1**2) / 2)**2 + (q1**2 + p1**2) * (q2**2 + p2**2) / 4"), poly(3),
        box(2, 120), 0.3), ("q1**2 + p1**2", "q2**2 + p2**2"), method=MIDPOINT),
    # q1 = q/(1 − hq), p1 = p(1 − hq)², contracting in q, conserves p q²
    "flow of a projective vector field": case((system("sum(p * q**2 / (1 - 0.25 * q))"), poly(4),
        box(1, 120), 0.25), "p1 * q1**2"),
    # q1 = (1 + h) q, p1 = p/(1 + h) conserves q p
    "dilation": case((system("sum(q * p)"), poly(4), box(1, 120), 0.5), "q1 * p1"),
    # cos θ₁ = 3/4 and cos θ₂ = 4 cos³ θ₁ − 3 cos θ₁ = −9/16, so that ζ₁³ conj ζ₂ is conserved
    "resonance 1:3 of the map": case((spring(0.5, 3.125), poly(4), box(2, 150), 1.0),
        (*energies(1.0, 0.5, 3.125), resonant(0.5, 3, 3.125, 1))),
    # q₊ = p + f(q)/2 with f = 1.4 q/(1 + q²): the biquadratic and a constant
    "McMillan's map by Strang's method": case((MCMILLAN, poly(4) + functions("1 / (1 + q1**2)"),
        box(1, 100), 1.0), "(1 + q1**2) * p1**2 + q1**2 + 0.49 / (1 + q1**2)", method=STRANG),
    # drift–kick: q₊ = q + p, the biquadratic of q and q + p
    "McMillan's map by the adjoint method": case((MCMILLAN, poly(4), box(1, 100), 1.0), lambda q, p,
        t: BIQUADRATIC(q, -p, t), method=ADJOINT),
    # q₊ + q₋ = a/q + b/q²: x²y² − a xy − b (x + y)
    "autonomous discrete Painlevé I with poles of order 2": case(
        (separable("sum(q**2 - 0.8 * log(q) + 0.3 / q)"), poly(4), POSITIVE, 1.0),
        biquadratic(1.0, 0.0, 0.0, -0.8, -0.3)),
    # q₊ + q + q₋ = a/q + b: xy(x + y) − b xy − a (x + y)
    "autonomous discrete Painlevé I with poles of order 1": case(
        (separable("sum(1.5 * q**2 - 0.5 * q - 0.8 * log(q))"), poly(4), POSITIVE, 1.0),
        biquadratic(0.0, 1.0, 0.0, -0.5, -0.8)),
    # q₊ + q₋ = (a q + b)/(1 − q²): −x²y² + x² + y² − a xy − b (x + y)
    "autonomous discrete Painlevé II": case((qrt(-1.0, 0.0, 1.0, -0.8, -0.2), poly(4),
        box(1, 100, -0.9, 0.9), 1.0), biquadratic(-1.0, 0.0, 1.0, -0.8, -0.2)),
    # q·q, q·p and p·p are quadratic invariants of the equations: HLW IV.2.1
    "free top by two vectors, midpoint rule": case((TWO_VECTORS, poly(2), box(3, 70), 0.2),
        ("q @ q", "q @ p", "p @ p"), method=MIDPOINT),
    # as in the plane, with three components of x ∧ y, and functions of scalar products
    "radial McMillan map in space": case((garnier(*SPACE), poly(2) + SCALAR_PRODUCTS, box(3, 90),
        1.0), (*ANGULAR, of_garnier(*SPACE))),
}  # fmt: skip
CASES = named("integrable", _CASES)
