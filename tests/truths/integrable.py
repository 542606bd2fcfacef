"""Maps that are integrable at their step size: linear ones, QRT maps, and maps of Suris."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import Case
from .maps import additive, area, box, component, kicked, potential, separable, sized, turning

KIND = "integrable"
LINEAR = "a linear symplectic map M conserves ω(z, Mᵏz), since ω(Mz, Mᵏ⁺¹z) = ω(z, Mᵏz)"


def spring(*stiffness):
    """The system with H_D = (p·p + Σ kᵢ qᵢ²)/2."""
    k = np.array(stiffness)
    return separable(lambda q: q @ (k * q) / 2)


OSCILLATOR = spring(1.0)
ISOTROPIC = spring(1.0, 1.0)


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

    def value(q, p):
        (x, y), (u, v) = first(q, p, 0), second(q, p, 1)
        return x * u + y * v

    return value


def hexagon(q, p):
    """Re ζ⁶ for a = 1."""
    return amplitude(1.0, 6)(q, p)[0]


def energy(k, h, i=0):
    """p² + k q² − h k q p of one oscillator under symplectic Euler."""
    return lambda q, p: (p[i] ** 2 + k * q[i] ** 2 - h * k * q[i] * p[i]) / 2


# --- QRT maps -------------------------------------------------------------------------


def biquadratic(alpha, beta, gamma, epsilon, xi, h=1.0):
    """α x²y² + β xy(x + y) + γ(x² + y²) + ε xy + ξ(x + y) with x = q − h p, y = q."""

    def value(q, p):
        y = q[0]
        x = y - h * p[0]
        return (
            alpha * x**2 * y**2
            + beta * x * y * (x + y)
            + gamma * (x**2 + y**2)
            + epsilon * x * y
            + xi * (x + y)
        )

    return value


def qrt(alpha, beta, gamma, epsilon, xi):
    """q₊ + q₋ = −(β q² + ε q + ξ)/(α q² + β q + γ)."""
    return additive(lambda q: -(beta * q**2 + epsilon * q + xi) / (alpha * q**2 + beta * q + gamma))


QRT = (
    "Quispel, Roberts & Thompson 1988, Phys. Lett. A 126, 419: in α x²y² + β xy(x+y) + γ(x²+y²) + "
    "ε xy + ξ(x+y), quadratic in y, the two roots have the sum −(β x² + ε x + ξ)/(α x² + β x + γ)"
)

MCMILLAN = separable(lambda q: jnp.sum(q**2 - 0.7 * jnp.log(1 + q**2)))


def asymmetric(b, c, d, e, change=0.0):
    """x²y² + y² + d x² + b xy + c y + e x with x = q, y = p: first y is moved to the other root,
    p1 + p = −(b q + c)/(q² + 1), then x, q1 + q = −(b p1 + e)/(p1² + d).

    By H_D with h = 1: p1·q0 + H_D = −p1 q0 + ∫G(q0) + ∫F(p1)."""
    G = potential(lambda x: -(b * x + c) / (x**2 + 1))
    F = potential(lambda y: -(b * y + e) / (y**2 + d + change * y))
    return dvi.System(lambda t0, t1, q, p, args: jnp.sum(-2 * q * p + G(q) + F(p)))


def of_asymmetric(b, c, d, e):
    """Its biquadratic."""

    def value(q, p):
        x, y = q[0], p[0]
        return x**2 * y**2 + y**2 + d * x**2 + b * x * y + c * y + e * x

    return value


# --- Lyness, Suris, Toda -------------------------------------------------------------


def lyness(a, power=1.0):
    """x₊x₋ = a + x with x = e^q: q₊ + q₋ = log(a + e^q)."""
    return additive(lambda q: jnp.log(a + jnp.exp(power * q)))


def of_lyness(a):
    """(1 + x)(1 + y)(a + x + y)/(xy)."""

    def value(q, p):
        x, y = jnp.exp(q[0]), jnp.exp(q[0] - p[0])
        return (1 + x) * (1 + y) * (a + x + y) / (x * y)

    return value


def exponential(i, j):
    """e^{i q + j (q − p)}."""
    return lambda q, p: jnp.exp(i * q[0] + j * (q[0] - p[0]))


EXPONENTIALS = dvi.Basis(
    {f"x^{i} y^{j}": exponential(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)}
)


def suris(k, other=1.0):
    """V'(q) = 2 arg(1 + k e^{iq}), |k| < 1."""
    V = potential(lambda q: 2 * jnp.arctan(k * jnp.sin(q) / (1 + other * k * jnp.cos(q))))
    return separable(lambda q: jnp.sum(V(q)))


def of_suris(k):
    """cos(x − y) + k (cos x + cos y) with x = q, y = q − p."""
    return lambda q, p: jnp.cos(p[0]) + k * (jnp.cos(q[0]) + jnp.cos(q[0] - p[0]))


WAVES = dvi.Trigonometric(1, "q", constant=True) * dvi.Trigonometric(1, "p", constant=True)


def toda(h, periodic=False, steepness=1.0):
    """x₊ − 2x + x₋ = log(1 + h² e^{x_{k+1} − x_k}) − log(1 + h² e^{x_k − x_{k−1}})."""
    V = potential(lambda u: jnp.log(1 + h * h * jnp.exp(steepness * u)) / (h * h))

    def energy(t0, t1, q, p, args):
        ends = jnp.append(q, q[0]) if periodic else q
        return p @ p / 2 + jnp.sum(V(ends[1:] - ends[:-1]))

    return dvi.System(energy)


def of_toda(h, n, periodic=False):
    """Σ e^{hp_k} + h² Σ e^{q_{k+1} − q_k + hp_k}, and its image under reversal of time."""
    pairs = [(k, (k + 1) % n) for k in range(n if periodic else n - 1)]

    def forwards(q, p):
        terms = [jnp.exp(q[j] - q[i] + h * p[i]) for i, j in pairs]
        return jnp.sum(jnp.exp(h * p)) + h * h * sum(terms)

    def backwards(q, p):
        terms = [jnp.exp(q[j] - q[i] - h * p[j]) for i, j in pairs]
        return jnp.sum(jnp.exp(-h * p)) + h * h * sum(terms)

    return forwards, backwards


def toda_basis(h, n, periodic=False):
    """e^{±hp_k}, e^{q_{k+1} − q_k} and its products with e^{±hp_k}, e^{±hp_{k+1}}, and p_k."""
    functions: dict[str, Callable[..., Any]] = {
        f"p{k + 1}": lambda q, p, k=k: p[k] for k in range(n)
    }
    for s in (1, -1):
        for k in range(n):
            functions[f"e^{s}hp{k + 1}"] = lambda q, p, k=k, s=s: jnp.exp(s * h * p[k])
    pairs = [(k, (k + 1) % n) for k in range(n if periodic else n - 1)]
    for i, j in pairs:
        functions[f"e{i + 1}{j + 1}"] = lambda q, p, i=i, j=j: jnp.exp(q[j] - q[i])
        for s in (1, -1):
            for m in (i, j):
                functions[f"e{i + 1}{j + 1} e^{s}hp{m + 1}"] = lambda q, p, i=i, j=j, s=s, m=m: (
                    jnp.exp(q[j] - q[i] + s * h * p[m])
                )
    return dvi.Basis(functions)


TODA = (
    "Suris 1990, Phys. Lett. A 145, 113 (explicit Toda map, dTL); traces of its Lax matrix, "
    "checked in 60 digits"
)


# --- more degrees of freedom --------------------------------------------------------


def garnier(m, change=0.0):
    """x₊ + x₋ = 2Mx/(1 + x·Mx) with M = diag(m), h = 1."""
    m = np.array(m)
    return separable(lambda q: q @ q - jnp.log(1 + q @ (m * q) + change * (q @ q) ** 2))


def of_garnier(m):
    """|u|²|w|² + |u|² + |w|² − 2 u·Mw with u = √M x, w = √M y, y = q − p."""
    m = np.array(m)

    def value(q, p):
        u, w = np.sqrt(m) * q, np.sqrt(m) * (q - p)
        return (u @ u) * (w @ w) + u @ u + w @ w - 2 * u @ (m * w)

    return value


def of_garnier_too(m):
    """u₁² + w₁² − 2m₁u₁w₁ + u₁²w₁² + (m₁²(u₁²w₂² + u₂²w₁²) − 2m₁m₂ u₁w₁u₂w₂)/(m₁² − m₂²)."""

    def value(q, p):
        u, w = np.sqrt(m) * q, np.sqrt(m) * (q - p)
        one = u[0] ** 2 + w[0] ** 2 - 2 * m[0] * u[0] * w[0] + (u[0] * w[0]) ** 2
        both = (u[0] * w[1]) ** 2 + (u[1] * w[0]) ** 2
        both = m[0] ** 2 * both - 2 * m[0] * m[1] * u[0] * w[0] * u[1] * w[1]
        return one + both / (m[0] ** 2 - m[1] ** 2)

    return value


def duffing(a, b, h):
    """V' = (a q + 2b q³)/(1 + h² b q²)."""
    V = potential(lambda q: (a * q + 2 * b * q**3) / (1 + h * h * b * q**2))
    return separable(lambda q: jnp.sum(V(q)))


def of_duffing(a, b, h):
    """p² + a x y + b x² y² with x = q − h p, y = q."""

    def value(q, p):
        x, y = q[0] - h * p[0], q[0]
        return p[0] ** 2 + a * x * y + b * x**2 * y**2

    return value


DUFFING = (
    "McMillan's map with f = (2 − h²a) q/(1 + h²b q²): the biquadratic h²b x²y² + x² + y² − "
    "(2 − h²a) xy over h²"
)


def two_actions(q, p):
    """N₁² + N₁N₂ with Nᵢ = (qᵢ² + pᵢ²)/2."""
    N = (q**2 + p**2) / 2
    return N[0] ** 2 + N[0] * N[1]


CASES = (
    Case(
        "oscillator at h = 1.9, close to the limit of stability",
        KIND,
        LINEAR,
        OSCILLATOR,
        dvi.Polynomials(4),
        box(1, 120),
        truth=(energy(1.0, 1.9),),
        h=1.9,
    ),
    Case(
        "oscillator, Strang",
        KIND,
        "kick–drift–kick has equal diagonal elements and conserves p² + (1 − h²/4) q²",
        OSCILLATOR,
        dvi.Polynomials(4),
        box(1, 120),
        truth=(lambda q, p: p[0] ** 2 + (1 - 0.5**2 / 4) * q[0] ** 2,),
        h=0.5,
        options={"method": dvi.Strang()},
    ),
    Case(
        "oscillator, Gauss–Legendre",
        KIND,
        "Gauss methods conserve quadratic invariants: Hairer, Lubich & Wanner 2006, IV.2.1",
        OSCILLATOR,
        dvi.Polynomials(4),
        box(1, 120),
        truth=(lambda q, p: p[0] ** 2 + q[0] ** 2,),
        h=0.5,
        options={"method": dvi.GaussLegendre(2)},
    ),
    Case(
        "oscillator, adjoint",
        KIND,
        "drift–kick is kick–drift backwards: p² + q² + h q p",
        OSCILLATOR,
        dvi.Polynomials(4),
        box(1, 120),
        truth=(lambda q, p: p[0] ** 2 + q[0] ** 2 + 0.5 * q[0] * p[0],),
        h=0.5,
        options={"method": dvi.Adjoint()},
    ),
    Case(
        "isotropic oscillator in the plane",
        KIND,
        "resonance 1:1: the same 2×2 map A on each (qᵢ, pᵢ) conserves the polar forms of its "
        "quadratic form and of ω; three of the four are independent",
        ISOTROPIC,
        dvi.Polynomials(2),
        box(2, 120),
        truth=(energy(1.0, 0.1, 0), energy(1.0, 0.1, 1), turning(0, 1)),
    ),
    Case(
        "isotropic oscillator in space",
        KIND,
        "as in the plane: 2n − 1 = 5 of the nine quadratic invariants are independent",
        spring(1.0, 1.0, 1.0),
        dvi.Polynomials(2),
        box(3, 120),
        truth=(
            *(energy(1.0, 0.3, i) for i in range(3)),
            turning(0, 1),
            turning(1, 2),
        ),
        h=0.3,
    ),
    Case(
        "resonance 1:2 of the map",
        KIND,
        "cos θ₁ = 3/4 and cos θ₂ = 2 cos² θ₁ − 1 = 1/8, so that ζ₁² conj ζ₂ is conserved",
        spring(0.5, 1.75),
        dvi.Polynomials(3),
        box(2, 150),
        truth=(energy(0.5, 1.0, 0), energy(1.75, 1.0, 1), resonant(0.5, 2, 1.75, 1)),
        h=1.0,
    ),
    Case(
        "resonance 1:−1 of the map",
        KIND,
        "H = (p₁² + q₁²)/2 − (p₂² + q₂²)/2: λ₂ = 1/λ₁, so that ζ₁ζ₂ is conserved; three of "
        "four quadratic forms are independent",
        dvi.System(lambda t0, t1, q, p, args: (p[0] ** 2 + q[0] ** 2 - p[1] ** 2 - q[1] ** 2) / 2),
        dvi.Polynomials(2),
        box(2, 100),
        truth=(
            energy(1.0, 0.25, 0),
            lambda q, p: p[1] ** 2 + q[1] ** 2 + 0.25 * q[1] * p[1],
            lambda q, p: q[0] * p[1] + p[0] * q[1],
        ),
        h=0.25,
    ),
    Case(
        "cat map on the plane",
        KIND,
        "q1 = 2q + p, p1 = q + p conserves q² − qp − p²",
        separable(lambda q: -q @ q / 2),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(lambda q, p: q[0] ** 2 - q[0] * p[0] - p[0] ** 2,),
        h=1.0,
    ),
    Case(
        "two coupled cat maps",
        KIND,
        LINEAR,
        separable(lambda q: -(q @ q + q[0] * q[1]) / 2),
        dvi.Polynomials(3),
        box(2, 120),
        truth=tuple(area(kicked([[-1, -0.5], [-0.5, -1]], 1.0), k) for k in (1, 2)),
        h=1.0,
    ),
    Case(
        "three coupled oscillators",
        KIND,
        LINEAR,
        separable(lambda q: (q @ q + (q[0] - q[1]) ** 2 + 0.7 * (q[1] - q[2]) ** 2) / 2),
        dvi.Polynomials(2),
        box(3, 120),
        truth=tuple(
            area(kicked([[2, -1, 0], [-1, 2.7, -0.7], [0, -0.7, 1.7]], 0.4), k) for k in (1, 2, 3)
        ),
        h=0.4,
    ),
    Case(
        "saddle and centre",
        KIND,
        "each degree of freedom has its quadratic form",
        spring(1.0, -1.0),
        dvi.Polynomials(3),
        box(2, 120),
        truth=(energy(1.0, 0.3, 0), energy(-1.0, 0.3, 1)),
        h=0.3,
    ),
    Case(
        "spiral in and out",
        KIND,
        "q1 = B q, p1 = B⁻ᵀ p with B = 1 + h(a + bJ) conserves p·Cq for every C that commutes "
        "with B: 1 and J",
        dvi.System(lambda t0, t1, q, p, args: 0.3 * (q @ p) + 0.7 * (q[0] * p[1] - q[1] * p[0])),
        dvi.Polynomials(2),
        box(2, 100),
        truth=(lambda q, p: q @ p, turning(0, 1)),
        h=0.5,
    ),
    Case(
        "general quadratic H_D, implicit",
        KIND,
        LINEAR + "; here M from p1 = p − h(a q + b p1), q1 = q + h(b q + c p1)",
        dvi.System(
            lambda t0, t1, q, p, args: jnp.sum(0.8 * q**2 / 2 + 0.3 * q * p + 1.1 * p**2 / 2)
        ),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(
            # M = [[m, n], [k, l]] conserves n p² + (m − l) q p − k q²
            lambda q, p: (
                0.2 * 1.1 / 1.06 * p[0] ** 2
                + (1.06 - (0.2 * 1.1 * 0.2 * 0.8 + 1) / 1.06) * q[0] * p[0]
                + 0.2 * 0.8 / 1.06 * q[0] ** 2
            ),
        ),
        h=0.2,
    ),
    Case(
        "sixth of a turn in each step",
        KIND,
        "h = 1: λ = e^{iπ/3}, λ⁶ = 1, so that Re ζ⁶ is conserved besides |ζ|²; the map "
        "moves and has as many independent invariants as coordinates, since its sixth iterate is "
        "the identity",
        OSCILLATOR,
        dvi.Polynomials(6),
        box(1, 120),
        truth=(energy(1.0, 1.0), hexagon),
        h=1.0,
    ),
    Case(
        "sixth of a turn beside another oscillator",
        KIND,
        "as above, and the quadratic form of an oscillator that turns by another angle",
        spring(1.0, 0.3),
        dvi.Polynomials(6, ["q1", "p1"]) + dvi.Polynomials(2, ["q2", "p2"]),
        box(2, 150),
        truth=(
            energy(1.0, 1.0),
            hexagon,
            energy(0.3, 1.0, 1),
        ),
        h=1.0,
    ),
    Case(
        "translation by a period of the basis",
        KIND,
        "H_D = p: q1 = q + h, p1 = p conserves p and functions of q with the period h",
        dvi.System(lambda t0, t1, q, p, args: jnp.sum(p)),
        dvi.Polynomials(2) + dvi.Trigonometric(1, "q", period=0.5),
        sized(1, 80, 3.0, 1.0),
        truth=(lambda q, p: p[0], lambda q, p: jnp.cos(4 * jnp.pi * q[0])),
        h=0.5,
    ),
    Case(
        "free particle in the plane",
        KIND,
        "momenta, and angular momentum: 2n − 1",
        separable(lambda q: 0.0 * jnp.sum(q)),
        dvi.Polynomials(2),
        box(2, 100),
        truth=(lambda q, p: p[0], lambda q, p: p[1], turning(0, 1)),
    ),
    Case(
        "free particle in space",
        KIND,
        "momenta and angular momenta, of which p·L = 0",
        separable(lambda q: 0.0 * jnp.sum(q)),
        dvi.Polynomials(2),
        box(3, 120),
        truth=(*map(component, range(3)), turning(0, 1), turning(1, 2)),
    ),
    Case(
        "twist map",
        KIND,
        "p1 = p, q1 = q + h p³",
        dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**4) / 4),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(lambda q, p: p[0],),
        h=1.0,
    ),
    Case(
        "a degree of freedom at rest",
        KIND,
        "H_D = p₁²/2: p₁, q₂ and p₂ are conserved",
        dvi.System(lambda t0, t1, q, p, args: p[0] ** 2 / 2),
        dvi.Polynomials(3),
        box(2, 120),
        truth=(lambda q, p: p[0], lambda q, p: q[1], lambda q, p: p[1]),
    ),
    Case(
        "McMillan's map",
        KIND,
        "McMillan 1971: x²y² + x² + y² − 2μxy with μ = 0.7; " + QRT,
        MCMILLAN,
        dvi.Polynomials(4),
        box(1, 120),
        truth=(biquadratic(1, 0, 1, -1.4, 0),),
        h=1.0,
    ),
    Case(
        "McMillan's map, unstable at the origin",
        KIND,
        "μ = 1.5; " + QRT,
        qrt(1, 0, 1, -3.0, 0),
        dvi.Polynomials(4),
        box(1, 120, -2.0, 2.0),
        truth=(biquadratic(1, 0, 1, -3.0, 0),),
        h=1.0,
    ),
    Case(
        "symmetric QRT map with all coefficients",
        KIND,
        QRT,
        qrt(1.0, 0.5, 2.0, -1.2, 0.3),
        dvi.Polynomials(5),
        box(1, 120),
        truth=(biquadratic(1.0, 0.5, 2.0, -1.2, 0.3),),
        h=1.0,
    ),
    Case(
        "symmetric QRT map with a cubic invariant",
        KIND,
        "α = 0; " + QRT,
        qrt(0.0, 1.0, 3.0, -1.5, 0.2),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(biquadratic(0.0, 1.0, 3.0, -1.5, 0.2),),
        h=1.0,
    ),
    Case(
        "asymmetric QRT map",
        KIND,
        QRT + "; here with different curves for x and y",
        asymmetric(0.8, 0.3, 1.5, -0.4),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(of_asymmetric(0.8, 0.3, 1.5, -0.4),),
        h=1.0,
    ),
    Case(
        "Lyness' map in logarithms",
        KIND,
        "Lyness 1945, x₊x₋ = a + x: (1 + x)(1 + y)(a + x + y)/(xy)",
        lyness(2.0),
        EXPONENTIALS,
        box(1, 80),
        truth=(of_lyness(2.0),),
        h=1.0,
    ),
    Case(
        "Suris' trigonometric map",
        KIND,
        "Suris 1989, Funct. Anal. Appl. 23, 74: for given x the two roots y of cos(x − y) + "
        "k (cos x + cos y) have the sum 2 arg(e^{ix} + k)",
        suris(0.4),
        WAVES + dvi.Polynomials(2),
        box(1, 100, -3.0, 3.0),
        truth=(of_suris(0.4),),
        h=1.0,
    ),
    Case(
        "discrete Toda lattice of two particles, open",
        KIND,
        TODA,
        toda(0.5),
        toda_basis(0.5, 2),
        box(2, 80),
        truth=(lambda q, p: p[0] + p[1], of_toda(0.5, 2)[0]),
        h=0.5,
    ),
    Case(
        "discrete Toda lattice of three particles, open",
        KIND,
        TODA,
        toda(0.5),
        toda_basis(0.5, 3),
        box(3, 100),
        truth=(lambda q, p: jnp.sum(p), *of_toda(0.5, 3)),
        h=0.5,
    ),
    Case(
        "discrete Toda lattice of three particles, periodic",
        KIND,
        TODA,
        toda(0.5, periodic=True),
        toda_basis(0.5, 3, periodic=True),
        box(3, 120),
        truth=(lambda q, p: jnp.sum(p), *of_toda(0.5, 3, periodic=True)),
        h=0.5,
    ),
    Case(
        "radial McMillan map in the plane",
        KIND,
        "x₊ + x₋ = 2μx/(1 + |x|²) conserves |x|²|y|² + |x|² + |y|² − 2μ x·y and x ∧ y (the "
        "isotropic case of Suris' discrete Garnier system, Phys. Lett. A 189 (1994) 281)",
        garnier([0.7, 0.7]),
        dvi.Polynomials(4),
        box(2, 150),
        truth=(turning(0, 1), of_garnier([0.7, 0.7])),
        h=1.0,
    ),
    Case(
        "discrete Garnier system",
        KIND,
        "Suris 1994, Phys. Lett. A 189, 281; both integrals checked in 60 digits",
        garnier([0.9, 0.5]),
        dvi.Polynomials(4),
        box(2, 150),
        truth=(of_garnier([0.9, 0.5]), of_garnier_too([0.9, 0.5])),
        h=1.0,
    ),
    Case(
        "McMillan's map beside an oscillator",
        KIND,
        "separable: one invariant each",
        separable(lambda q: q[0] ** 2 - 0.7 * jnp.log(1 + q[0] ** 2) + 0.3 * q[1] ** 2 / 2),
        dvi.Polynomials(4, ["q1", "p1"]) + dvi.Polynomials(4, ["q2", "p2"]),
        box(2, 120),
        truth=(biquadratic(1, 0, 1, -1.4, 0), energy(0.3, 1.0, 1)),
        h=1.0,
    ),
    Case(
        "integrable discrete Duffing oscillator",
        KIND,
        DUFFING,
        duffing(1.0, 0.5, 0.25),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(of_duffing(1.0, 0.5, 0.25),),
        h=0.25,
    ),
    Case(
        "function of an action, Gauss–Legendre",
        KIND,
        "H = N², N = (q² + p²)/2 is a quadratic invariant of the equations: HLW IV.2.1",
        dvi.System(lambda t0, t1, q, p, args: jnp.sum((q**2 + p**2) ** 2) / 4),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(lambda q, p: q[0] ** 2 + p[0] ** 2,),
        h=0.3,
        options={"method": dvi.GaussLegendre(2)},
    ),
    Case(
        "function of two actions, midpoint rule",
        KIND,
        "H = N₁² + N₁N₂: both actions are quadratic invariants of the equations: HLW IV.2.1",
        dvi.System(lambda t0, t1, q, p, args: two_actions(q, p)),
        dvi.Polynomials(3),
        box(2, 120),
        truth=(
            lambda q, p: q[0] ** 2 + p[0] ** 2,
            lambda q, p: q[1] ** 2 + p[1] ** 2,
        ),
        h=0.3,
        options={"method": dvi.GaussLegendre(1)},
    ),
    Case(
        "flow of a projective vector field",
        KIND,
        "H_D = p q²/(1 − h q): q1 = q/(1 − hq), p1 = p(1 − hq)², contracting in q, conserves p q²",
        dvi.System(lambda t0, t1, q, p, args: jnp.sum(p * q**2 / (1 - 0.25 * q))),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(lambda q, p: p[0] * q[0] ** 2,),
        h=0.25,
    ),
    Case(
        "dilation",
        KIND,
        "H_D = q p: q1 = (1 + h) q, p1 = p/(1 + h) conserves q p",
        dvi.System(lambda t0, t1, q, p, args: jnp.sum(q * p)),
        dvi.Polynomials(4),
        box(1, 120),
        truth=(lambda q, p: q[0] * p[0],),
        h=0.5,
    ),
    Case(
        "resonance 1:3 of the map",
        KIND,
        "cos θ₁ = 3/4 and cos θ₂ = 4 cos³ θ₁ − 3 cos θ₁ = −9/16, so that ζ₁³ conj ζ₂ is conserved",
        spring(0.5, 3.125),
        dvi.Polynomials(4),
        box(2, 150),
        truth=(energy(0.5, 1.0, 0), energy(3.125, 1.0, 1), resonant(0.5, 3, 3.125, 1)),
        h=1.0,
    ),
    Case(
        "McMillan's map by Strang's method",
        KIND,
        "q₊ = p + f(q)/2 with f = 1.4 q/(1 + q²): the biquadratic is (1 + q²)p² + q² + "
        "0.49/(1 + q²) and a constant",
        MCMILLAN,
        dvi.Polynomials(4) + dvi.Basis({"1/(1+q²)": lambda q, p: 1 / (1 + q[0] ** 2)}),
        box(1, 100),
        truth=(lambda q, p: (1 + q[0] ** 2) * p[0] ** 2 + q[0] ** 2 + 0.49 / (1 + q[0] ** 2),),
        h=1.0,
        options={"method": dvi.Strang()},
    ),
    Case(
        "McMillan's map by the adjoint method",
        KIND,
        "drift–kick: q₊ = q + p, the biquadratic of q and q + p",
        MCMILLAN,
        dvi.Polynomials(4),
        box(1, 100),
        truth=(lambda q, p: biquadratic(1, 0, 1, -1.4, 0)(q, -p),),
        h=1.0,
        options={"method": dvi.Adjoint()},
    ),
    Case(
        "autonomous discrete Painlevé I with poles of order 2",
        KIND,
        "q₊ + q₋ = a/q + b/q²: x²y² − a xy − b (x + y); " + QRT,
        separable(lambda q: jnp.sum(q**2 - 0.8 * jnp.log(q) + 0.3 / q)),
        dvi.Polynomials(4),
        lambda rng: (rng.uniform(0.3, 2.0, (100, 1)), rng.uniform(-1.0, 1.0, (100, 1))),
        truth=(biquadratic(1.0, 0.0, 0.0, -0.8, -0.3),),
        h=1.0,
    ),
    Case(
        "autonomous discrete Painlevé I with poles of order 1",
        KIND,
        "q₊ + q + q₋ = a/q + b: xy(x + y) − b xy − a (x + y); " + QRT,
        separable(lambda q: jnp.sum(1.5 * q**2 - 0.5 * q - 0.8 * jnp.log(q))),
        dvi.Polynomials(4),
        lambda rng: (rng.uniform(0.3, 2.0, (100, 1)), rng.uniform(-1.0, 1.0, (100, 1))),
        truth=(biquadratic(0.0, 1.0, 0.0, -0.5, -0.8),),
        h=1.0,
    ),
    Case(
        "autonomous discrete Painlevé II",
        KIND,
        "q₊ + q₋ = (a q + b)/(1 − q²): −x²y² + x² + y² − a xy − b (x + y); " + QRT,
        qrt(-1.0, 0.0, 1.0, -0.8, -0.2),
        dvi.Polynomials(4),
        box(1, 100, -0.9, 0.9),
        truth=(biquadratic(-1.0, 0.0, 1.0, -0.8, -0.2),),
        h=1.0,
    ),
    Case(
        "free top by two vectors, midpoint rule",
        KIND,
        "H = Σ Lᵢ²/2Iᵢ with L = q × p turns q and p together: q·q, q·p and p·p are quadratic "
        "invariants of the equations: HLW IV.2.1",
        dvi.System(
            lambda t0, t1, q, p, args: (
                jnp.sum(jnp.cross(q, p) ** 2 / jnp.array([1.0, 2.0, 3.0])) / 2
            )
        ),
        dvi.Polynomials(2),
        box(3, 70),
        truth=(lambda q, p: q @ q, lambda q, p: q @ p, lambda q, p: p @ p),
        h=0.2,
        options={"method": dvi.GaussLegendre(1)},
    ),
    Case(
        "radial McMillan map in space",
        KIND,
        "as in the plane, with three components of x ∧ y, and functions of scalar products",
        garnier([0.7, 0.7, 0.7]),
        dvi.Polynomials(2)
        + dvi.Basis(
            {
                "q²q²": lambda q, p: (q @ q) ** 2,
                "q²qp": lambda q, p: (q @ q) * (q @ p),
                "q²p²": lambda q, p: (q @ q) * (p @ p),
                "qp qp": lambda q, p: (q @ p) ** 2,
                "qp p²": lambda q, p: (q @ p) * (p @ p),
            }
        ),
        box(3, 90),
        truth=(
            turning(0, 1),
            turning(0, 2),
            turning(1, 2),
            of_garnier([0.7, 0.7, 0.7]),
        ),
        h=1.0,
    ),
)
