"""Momentum maps: what symmetries conserve, in any method that has them."""

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import Case
from .maps import box, component, separable, shell, timed, total, turning

KIND = "momentum maps"
NOETHER = "Noether's theorem for H_D with the same symmetry (Marsden & West 2001, 1.3.3)"

MASSES = np.array([1.0, 2.0, 3.0])


def bodies(soft=0.1):
    """Three bodies in the plane that attract each other, positions of shape (3, 2)."""

    def energy(t0, t1, q, p, args):
        pairs = [(0, 1), (0, 2), (1, 2)]
        V = sum(
            -MASSES[i] * MASSES[j] / jnp.sqrt(jnp.sum((q[i] - q[j]) ** 2) + soft**2)
            for i, j in pairs
        )
        return jnp.sum(p**2 / MASSES[:, None]) / 2 + V

    return dvi.System(energy)


def plane_samples(count, n=3):
    """Positions and momenta of n bodies in the plane."""
    return lambda rng: (rng.uniform(-1, 1, (count, n, 2)), rng.uniform(-1, 1, (count, n, 2)))


def spin(q, p):
    """Σ x p_y − y p_x."""
    return jnp.sum(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0])


def of_centre(*masses):
    """Angular momentum of the centre of mass, (Σ m q) ∧ P: it moves at the constant P/Σm."""
    m = np.array(masses)[:, None]

    def value(q, p):
        centre, momentum = jnp.sum(m * q, axis=0), jnp.sum(p, axis=0)
        return centre[0] * momentum[1] - centre[1] * momentum[0]

    return value


def bilinear(n, d=2):
    """The momenta, and every product of a position and a momentum."""
    names = [f"q{i + 1}" for i in range(n * d)]
    momenta = [f"p{i + 1}" for i in range(n * d)]
    return dvi.Polynomials(1, momenta) + (dvi.Polynomials(1, names) * dvi.Polynomials(1, momenta))


BODIES = bodies()
CENTRAL3 = separable(lambda q: (q @ q) ** 2 / 4)
KEPLER3 = separable(lambda q: -1 / jnp.sqrt(q @ q))
SPHERE = dvi.System(
    lambda t0, t1, q, p, args: p[0] ** 2 / 2 + p[1] ** 2 / (2 * jnp.sin(q[0]) ** 2) + jnp.cos(q[0])
)


def around(q, samples):
    """The samples with q₁ moved by a constant."""

    def draw(rng):
        qs, ps = samples(rng)
        return qs + np.array([q, 0.0]), ps

    return draw


def magnetic(t0, t1, q, p, args):
    """|p − A|²/2 with A = (−q₂, q₁)/2."""
    return (p[0] + q[1] / 2) ** 2 / 2 + (p[1] - q[0] / 2) ** 2 / 2


CASES = (
    *(
        Case(
            f"three bodies in the plane, {name}",
            KIND,
            NOETHER
            + ": translations and rotations of the plane; the angular momentum of the centre of "
            "mass, which moves uniformly",
            BODIES,
            bilinear(3),
            plane_samples(110),
            truth=(total(0), total(1), spin, of_centre(*MASSES)),
            h=0.05,
            options={"method": method},
        )
        for name, method in (
            ("type II", dvi.TypeII()),
            ("Strang", dvi.Strang()),
            ("Yoshida", dvi.Yoshida(4)),
            ("adjoint", dvi.Adjoint()),
        )
    ),
    Case(
        "two bodies in the plane, Gauss–Legendre",
        KIND,
        "linear and quadratic invariants: Hairer, Lubich & Wanner 2006, IV.2.1",
        dvi.System(
            lambda t0, t1, q, p, args: (
                jnp.sum(p**2) / 2 - 1 / jnp.sqrt(jnp.sum((q[0] - q[1]) ** 2) + 0.1)
            )
        ),
        bilinear(2),
        plane_samples(60, 2),
        truth=(total(0), total(1), spin, of_centre(1, 1)),
        h=0.05,
        options={"method": dvi.GaussLegendre(2)},
    ),
    Case(
        "centre of mass of two bodies on a line",
        KIND,
        "Galilei boosts: m₁q₁ + m₂q₂ − t (p₁ + p₂), since q1 = q + h p1/m and the total momentum "
        "is constant",
        dvi.System(
            lambda t0, t1, q, p, args: p[0] ** 2 / 2 + p[1] ** 2 / 4 + jnp.cosh(q[0] - q[1])
        ),
        dvi.Polynomials(2, ["q1", "q2", "p1", "p2", "t"]),
        timed(box(2, 80)),
        truth=(
            lambda q, p: p[0] + p[1],
            lambda q, p, t: q[0] + 2 * q[1] - t * (p[0] + p[1]),
        ),
    ),
    Case(
        "central force in the plane, quartic",
        KIND,
        NOETHER,
        separable(lambda q: (q @ q) ** 2 / 4),
        dvi.Polynomials(4),
        box(2, 150),
        truth=(turning(0, 1),),
        h=0.3,
    ),
    Case(
        "central force in space",
        KIND,
        NOETHER + "; three components, which do not depend on one another",
        CENTRAL3,
        dvi.Polynomials(2),
        box(3, 80),
        truth=(turning(0, 1), turning(0, 2), turning(1, 2)),
        h=0.3,
    ),
    Case(
        "central force in space, Gauss–Legendre",
        KIND,
        "quadratic invariants: Hairer, Lubich & Wanner 2006, IV.2.1",
        CENTRAL3,
        dvi.Polynomials(2),
        box(3, 80),
        truth=(turning(0, 1), turning(0, 2), turning(1, 2)),
        h=0.2,
        options={"method": dvi.GaussLegendre(2)},
    ),
    Case(
        "Kepler in space, adjoint",
        KIND,
        NOETHER,
        KEPLER3,
        dvi.Polynomials(2) + dvi.Radial(),
        shell(3, 80),
        truth=(turning(0, 1), turning(0, 2), turning(1, 2)),
        options={"method": dvi.Adjoint()},
    ),
    Case(
        "Kepler in space, Yoshida",
        KIND,
        NOETHER,
        KEPLER3,
        dvi.Polynomials(2) + dvi.Radial(),
        shell(3, 80),
        truth=(turning(0, 1), turning(0, 2), turning(1, 2)),
        h=0.3,
        options={"method": dvi.Yoshida(4)},
    ),
    Case(
        "cyclic coordinate with a mass that varies",
        KIND,
        "H does not depend on q₂, so that p₂ is conserved",
        dvi.System(
            lambda t0, t1, q, p, args: p[0] ** 2 / 2 + p[1] ** 2 / (2 * (1 + q[0] ** 2)) + q[0] ** 4
        ),
        dvi.Polynomials(3),
        box(2, 100),
        truth=(component(1),),
    ),
    Case(
        "spherical pendulum in angles",
        KIND,
        "the azimuth is cyclic; type II solves for p_θ alone",
        SPHERE,
        dvi.Polynomials(3, ["p1", "p2"])
        + dvi.Trigonometric(2, "q1")
        + (dvi.Polynomials(1, ["p1", "p2"]) * dvi.Trigonometric(1, "q1")),
        around(1.5, box(2, 80)),
        truth=(component(1),),
        h=0.05,
    ),
    Case(
        "spherical pendulum in angles, Strang",
        KIND,
        "the azimuth is cyclic",
        SPHERE,
        dvi.Polynomials(3, ["p1", "p2"]) + dvi.Trigonometric(2, "q1"),
        around(1.5, box(2, 80)),
        truth=(component(1),),
        h=0.05,
        options={"method": dvi.Strang()},
    ),
    Case(
        "double pendulum without gravity",
        KIND,
        "turning both arms: p₁ + p₂, for the kinetic energy depends on q₁ − q₂",
        dvi.System(
            lambda t0, t1, q, p, args: (
                (p[0] ** 2 + 2 * p[1] ** 2 - 2 * p[0] * p[1] * jnp.cos(q[0] - q[1]))
                / (2 * (1 + jnp.sin(q[0] - q[1]) ** 2))
            )
        ),
        dvi.Polynomials(3, ["p1", "p2"]) + dvi.Trigonometric(1, "q1") + dvi.Trigonometric(1, "q2"),
        box(2, 80),
        truth=(lambda q, p: p[0] + p[1],),
        h=0.05,
        options={"method": dvi.Strang()},
    ),
    Case(
        "periodic chain of four masses",
        KIND,
        NOETHER + ": translations; Fermi, Pasta, Ulam & Tsingou 1955",
        separable(
            lambda q: jnp.sum((q - jnp.roll(q, 1)) ** 2 / 2 + 0.25 * (q - jnp.roll(q, 1)) ** 3 / 3)
        ),
        dvi.Polynomials(2),
        box(4, 110),
        truth=(lambda q, p: jnp.sum(p),),
        options={"method": dvi.Strang()},
    ),
    Case(
        "screw symmetry",
        KIND,
        "x cos z + y sin z is invariant under turns about z by α with shifts of z by α: L₃ + p₃",
        separable(lambda q: q[0] * jnp.cos(q[2]) + q[1] * jnp.sin(q[2])),
        dvi.Polynomials(2),
        box(3, 80),
        truth=(lambda q, p: q[0] * p[1] - q[1] * p[0] + p[2],),
        h=0.3,
    ),
    Case(
        "magnetic field, symmetric gauge",
        KIND,
        "linear map: p₁ − q₂/2, p₂ + q₁/2 (translations) and the kinetic energy; L depends on them",
        dvi.System(magnetic),
        dvi.Polynomials(2),
        box(2, 80),
        truth=(
            lambda q, p: p[0] - q[1] / 2,
            lambda q, p: p[1] + q[0] / 2,
            lambda q, p: (p[0] + q[1] / 2) ** 2 + (p[1] - q[0] / 2) ** 2,
        ),
    ),
    Case(
        "coupled standard maps with one sum of angles",
        KIND,
        "Froeschlé's map with the coupling cos(q₁ + q₂) alone: p₁ − p₂",
        separable(lambda q: -0.8 * jnp.cos(q[0] + q[1])),
        dvi.Polynomials(3, ["p1", "p2"]) + dvi.Trigonometric(1, "q1") + dvi.Trigonometric(1, "q2"),
        box(2, 80, -3.0, 3.0),
        truth=(lambda q, p: p[0] - p[1],),
        h=1.0,
    ),
    Case(
        "two springs with equal constants, and a third axis",
        KIND,
        "potential of q₁² + q₂² and q₃: L₃ only, in space",
        separable(lambda q: (q[0] ** 2 + q[1] ** 2) ** 2 / 4 + q[2] ** 4 / 4 + q[2] * (q @ q)),
        dvi.Polynomials(2),
        box(3, 80),
        truth=(turning(0, 1),),
    ),
)
