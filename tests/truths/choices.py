"""The user's choices: which functions, how many samples, and where they lie."""

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import Case
from .chaotic import HENON, standard
from .driven import QUADRATICS
from .integrable import ISOTROPIC, MCMILLAN, OSCILLATOR, biquadratic, energy
from .maps import box, component, separable, shell, sized, turning

BASES, FEW, WHERE = "bases", "few samples", "samples"
NONE = "checked in 60 digits: the changes of the basis have full rank"

QUARTIC = separable(lambda q: jnp.sum(q**4) / 4)
CENTRAL = separable(lambda q: (q @ q) ** 2 / 4)
TWIST = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2)
KEPLER = separable(lambda q: -1 / jnp.sqrt(q @ q))
McM = biquadratic(1, 0, 1, -1.4, 0)


def functions(**named):
    """A basis of functions by name."""
    return dvi.Basis(named)


def half_precision(samples):
    """The samples rounded to float32, and given in it."""
    return lambda rng: tuple(np.asarray(x, np.float32) for x in samples(rng))


def grid(per_side, n=1):
    """A regular grid of 2n dimensions."""

    def draw(rng):
        side = np.linspace(-1, 1, per_side) + 0 * rng.uniform()
        points = np.stack(np.meshgrid(*[side] * (2 * n), indexing="ij"), -1).reshape(-1, 2 * n)
        return points[:, :n], points[:, n:]

    return draw


def repeated(samples, times):
    """The samples, each of them several times."""
    return lambda rng: tuple(np.repeat(x, times, axis=0) for x in samples(rng))


def curve(count):
    """p = sin 3q, and q between −1 and 1."""

    def draw(rng):
        q = rng.uniform(-1, 1, (count, 1))
        return q, np.sin(3 * q)

    return draw


def orbit(count, h=0.1):
    """One orbit of the oscillator's map."""

    def draw(rng):
        q, p = rng.uniform(0.5, 1.0, 2)
        out = []
        for _ in range(count):
            p = p - h * q
            q = q + h * p
            out.append((q, p))
        points = np.array(out)
        return points[:, :1], points[:, 1:]

    return draw


def orbits_of_mcmillan(count, length):
    """Several orbits of McMillan's map."""

    def draw(rng):
        q, p = rng.uniform(-1, 1, (2, count, 1))
        out = []
        for _ in range(length):
            p = p - (2 * q - 1.4 * q / (1 + q**2))
            q = q + p
            out.append((q, p))
        return tuple(np.concatenate([x[k] for x in out]) for k in (0, 1))

    return draw


def squares(q, p):
    """The oscillator's quadratic form at h = 0.1, squared."""
    return energy(1.0, 0.1)(q, p) ** 2


CASES = (
    Case(
        "oscillator with the constant 1 in the basis",
        BASES,
        "its quadratic form; a constant does not count as an invariant",
        OSCILLATOR,
        dvi.Polynomials(4, constant=True),
        box(1, 80),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "quartic oscillator with the constant 1 in the basis",
        BASES,
        NONE,
        QUARTIC,
        dvi.Polynomials(4, constant=True),
        box(1, 80),
    ),
    Case(
        "oscillator, a constant hidden in sin² + cos²",
        BASES,
        "its quadratic form; sin² q + cos² q is the constant 1",
        OSCILLATOR,
        QUADRATICS
        + functions(s=lambda q, p: jnp.sin(q[0]) ** 2, c=lambda q, p: jnp.cos(q[0]) ** 2),
        box(1, 80),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "oscillator, polynomials of degree 10",
        BASES,
        "its quadratic form",
        OSCILLATOR,
        dvi.Polynomials(10),
        box(1, 200),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "McMillan's map, polynomials of degree 9",
        BASES,
        "McMillan 1971, and its square",
        MCMILLAN,
        dvi.Polynomials(9),
        box(1, 200),
        truth=(McM,),
        h=1.0,
    ),
    Case(
        "quartic oscillator, polynomials of degree 10",
        BASES,
        NONE,
        QUARTIC,
        dvi.Polynomials(10),
        box(1, 200),
        h=0.5,
    ),
    Case(
        "McMillan's map in products of Chebyshev polynomials",
        BASES,
        "McMillan 1971",
        MCMILLAN,
        dvi.Chebyshev(5, "q", (-2.0, 2.0)) * dvi.Chebyshev(5, "p", (-2.0, 2.0)),
        box(1, 100, -2.0, 2.0),
        truth=(McM,),
        h=1.0,
    ),
    Case(
        "functions of momentum alone on a twist map",
        BASES,
        "p is conserved, and each of the four is a function of it",
        TWIST,
        functions(
            sin=lambda q, p: jnp.sin(p[0]),
            exp=lambda q, p: jnp.exp(p[0]),
            cube=lambda q, p: p[0] ** 3,
            q=lambda q, p: q[0],
        ),
        box(1, 60),
        truth=(lambda q, p: jnp.sin(p[0]),),
    ),
    Case(
        "squares of sums in place of squares",
        BASES,
        "its quadratic form",
        OSCILLATOR,
        functions(
            a=lambda q, p: (q[0] + p[0]) ** 2,
            b=lambda q, p: (q[0] - p[0]) ** 2,
            c=lambda q, p: (q[0] + 2 * p[0]) ** 2,
        ),
        box(1, 60),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "functions that differ by 1e-5 of them",
        BASES,
        "its quadratic form; the condition number is 1e5",
        OSCILLATOR,
        functions(
            a=lambda q, p: q[0] ** 2,
            b=lambda q, p: q[0] ** 2 + 1e-5 * q[0] * p[0],
            c=lambda q, p: p[0] ** 2,
        ),
        box(1, 60),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "the invariant alone",
        BASES,
        "its quadratic form",
        OSCILLATOR,
        functions(I=energy(1.0, 0.1)),
        box(1, 40),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "angular momenta alone",
        BASES,
        "each of the three functions is conserved",
        CENTRAL,
        functions(x=turning(1, 2), y=turning(2, 0), z=turning(0, 1)),
        box(3, 60),
        truth=(turning(1, 2), turning(2, 0), turning(0, 1)),
    ),
    Case(
        "two invariants of three functions",
        BASES,
        "total momentum, and the quadratic form of the difference of the positions",
        separable(lambda q: (q[0] - q[1]) ** 2 / 2),
        functions(
            P=lambda q, p: p[0] + p[1],
            I=lambda q, p: (
                (p[0] - p[1]) ** 2 + 2 * (q[0] - q[1]) ** 2 - 0.2 * (q[0] - q[1]) * (p[0] - p[1])
            ),
            q=lambda q, p: q[0],
        ),
        box(2, 60),
        truth=(
            lambda q, p: p[0] + p[1],
            lambda q, p: (
                (p[0] - p[1]) ** 2 + 2 * (q[0] - q[1]) ** 2 - 0.2 * (q[0] - q[1]) * (p[0] - p[1])
            ),
        ),
    ),
    Case(
        "the square of the invariant, but not the invariant",
        BASES,
        "its quadratic form squared",
        OSCILLATOR,
        functions(
            I2=squares,
            q4=lambda q, p: q[0] ** 4,
            p4=lambda q, p: p[0] ** 4,
            q2=lambda q, p: q[0] ** 2,
        ),
        box(1, 60),
        truth=(squares,),
    ),
    Case(
        "exponential and logarithm of the invariant",
        BASES,
        "its quadratic form: both are functions of it",
        OSCILLATOR,
        functions(
            exp=lambda q, p: jnp.exp(energy(1.0, 0.1)(q, p)),
            log=lambda q, p: jnp.log(1 + energy(1.0, 0.1)(q, p)),
            q=lambda q, p: q[0],
        ),
        box(1, 60),
        truth=(lambda q, p: jnp.exp(energy(1.0, 0.1)(q, p)),),
    ),
    Case(
        "a basis that is too small",
        BASES,
        "no linear function is conserved",
        OSCILLATOR,
        dvi.Polynomials(1),
        box(1, 40),
    ),
    Case(
        "positions alone",
        BASES,
        "no function of q is conserved",
        OSCILLATOR,
        dvi.Polynomials(5, ["q"]),
        box(1, 60),
    ),
    Case(
        "the energy of the flow alone",
        BASES,
        "the map conserves p² + q² − h q p, and the basis has no q p",
        OSCILLATOR,
        functions(E=lambda q, p: q @ q + p @ p, q=lambda q, p: q[0], p=lambda q, p: p[0]),
        box(1, 40),
        h=1e-4,
    ),
    Case(
        "the energy of the flow alone, in one function",
        BASES,
        "as above",
        OSCILLATOR,
        functions(E=lambda q, p: q @ q + p @ p),
        box(1, 40),
        h=1e-4,
    ),
    Case(
        "powers of the radius for Kepler's problem",
        BASES,
        "angular momentum",
        KEPLER,
        dvi.Polynomials(2) + dvi.Radial((-3, -2, -1, 1, 3)),
        shell(2, 100),
        truth=(turning(0, 1),),
    ),
    Case(
        "radial functions times polynomials for Kepler's problem",
        BASES,
        "angular momentum",
        KEPLER,
        dvi.Polynomials(2) + dvi.Polynomials(2) * dvi.Radial((-1,)),
        shell(2, 120),
        truth=(turning(0, 1),),
    ),
    Case(
        "a steep function among tame ones",
        BASES,
        "its quadratic form; e^{20 q} is of size 1e8 on the samples",
        OSCILLATOR,
        QUADRATICS + functions(steep=lambda q, p: jnp.exp(20 * q[0])),
        box(1, 80),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "functions with coefficients of 1e40 and 1e-40",
        BASES,
        "its quadratic form",
        OSCILLATOR,
        functions(
            a=lambda q, p: 1e40 * q[0] ** 2,
            b=lambda q, p: 1e-40 * p[0] ** 2,
            c=lambda q, p: q[0] * p[0],
        ),
        box(1, 60),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "localised functions",
        BASES,
        "Gaussians of width 0.1 around five points; " + NONE,
        OSCILLATOR,
        dvi.Basis(
            {
                f"g{k}": lambda q, p, a=a: jnp.exp(-((q[0] - a) ** 2 + p[0] ** 2) / 0.02)
                for k, a in enumerate((-0.8, -0.4, 0.1, 0.4, 0.8))
            }
        ),
        box(1, 300),
    ),
    Case(
        "a function that vanishes on most samples",
        BASES,
        "its quadratic form; max(q − 0.9, 0)² is not conserved",
        OSCILLATOR,
        QUADRATICS + functions(late=lambda q, p: jnp.maximum(q[0] - 0.9, 0.0) ** 2),
        box(1, 200),
        truth=(energy(1.0, 0.1),),
    ),
    *(
        Case(
            f"{name}, as few samples as are allowed",
            FEW,
            source,
            system,
            basis,
            samples,
            truth=truth,
            h=h,
            points=points,
        )
        for name, source, system, basis, samples, points, truth, h in (
            (
                "oscillator",
                "its quadratic form",
                OSCILLATOR,
                dvi.Polynomials(4),
                box(1, 28),
                box(1, 60),
                (energy(1.0, 0.1),),
                0.1,
            ),
            (
                "McMillan's map",
                "McMillan 1971",
                MCMILLAN,
                dvi.Polynomials(4),
                box(1, 28),
                box(1, 60),
                (McM,),
                1.0,
            ),
            (
                "Hénon's map",
                NONE,
                HENON,
                dvi.Polynomials(4),
                box(1, 28),
                box(1, 60),
                (),
                1.0,
            ),
            (
                "standard map",
                NONE,
                standard(0.5),
                dvi.Trigonometric(2, "q", constant=True) * dvi.Trigonometric(2, "p", constant=True),
                sized(1, 50, 3.1, 3.1),
                sized(1, 80, 3.1, 3.1),
                (),
                1.0,
            ),
            (
                "isotropic oscillator",
                "three of the four quadratic invariants are independent",
                ISOTROPIC,
                dvi.Polynomials(2),
                box(2, 28),
                box(2, 60),
                (energy(1.0, 0.1, 0), energy(1.0, 0.1, 1), turning(0, 1)),
                0.1,
            ),
            (
                "central force in the plane",
                "angular momentum",
                CENTRAL,
                dvi.Polynomials(3),
                box(2, 68),
                box(2, 100),
                (turning(0, 1),),
                0.1,
            ),
            (
                "one function",
                "p₁ is not conserved by the oscillator",
                OSCILLATOR,
                functions(p=component(0)),
                box(1, 2),
                box(1, 20),
                (),
                0.1,
            ),
        )
    ),
    Case(
        "oscillator, 5000 samples",
        WHERE,
        "its quadratic form",
        OSCILLATOR,
        dvi.Polynomials(4),
        box(1, 5000),
        truth=(energy(1.0, 0.1),),
        points=box(1, 100),
    ),
    Case(
        "McMillan's map, samples in float32",
        WHERE,
        "McMillan 1971; samples are points, and rounded ones are points too",
        MCMILLAN,
        dvi.Polynomials(4),
        half_precision(box(1, 100)),
        truth=(McM,),
        h=1.0,
    ),
    Case(
        "Kepler, samples in float32",
        WHERE,
        "angular momentum",
        KEPLER,
        dvi.Polynomials(2) + dvi.Radial(),
        half_precision(shell(2, 100)),
        truth=(turning(0, 1),),
    ),
    Case(
        "oscillator, samples on a grid",
        WHERE,
        "its quadratic form",
        OSCILLATOR,
        dvi.Polynomials(6),
        grid(12),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "Hénon's map, samples on a grid",
        WHERE,
        NONE,
        HENON,
        dvi.Polynomials(6),
        grid(12),
        h=1.0,
    ),
    Case(
        "central force, samples on a coarse grid",
        WHERE,
        "angular momentum",
        CENTRAL,
        dvi.Polynomials(2),
        grid(4, 2),
        truth=(turning(0, 1),),
    ),
    Case(
        "oscillator, samples on a curve",
        WHERE,
        "its quadratic form: what one step conserves from a generic curve",
        OSCILLATOR,
        dvi.Polynomials(2),
        curve(60),
        truth=(energy(1.0, 0.1),),
        points=box(1, 60),
    ),
    Case(
        "quartic oscillator, samples on a curve",
        WHERE,
        NONE,
        QUARTIC,
        dvi.Polynomials(2),
        curve(60),
        points=box(1, 60),
    ),
    Case(
        "oscillator, samples on one orbit",
        WHERE,
        "its quadratic form, which is constant on all of them",
        OSCILLATOR,
        dvi.Polynomials(2),
        orbit(80),
        truth=(energy(1.0, 0.1),),
        points=box(1, 60),
    ),
    Case(
        "McMillan's map, samples on ten orbits",
        WHERE,
        "McMillan 1971; the form and its products with others are constant on each orbit",
        MCMILLAN,
        dvi.Polynomials(4),
        orbits_of_mcmillan(10, 20),
        truth=(McM,),
        h=1.0,
    ),
    Case(
        "oscillator, each sample four times",
        WHERE,
        "its quadratic form",
        OSCILLATOR,
        dvi.Polynomials(4),
        repeated(box(1, 40), 4),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "McMillan's map, samples in one quadrant",
        WHERE,
        "McMillan 1971",
        MCMILLAN,
        dvi.Polynomials(4),
        box(1, 100, 0.2, 2.0),
        truth=(McM,),
        h=1.0,
    ),
    Case(
        "McMillan's map, samples of a Cauchy distribution",
        WHERE,
        "McMillan 1971",
        MCMILLAN,
        dvi.Polynomials(4),
        lambda rng: tuple(rng.standard_cauchy((2, 150, 1))),
        truth=(McM,),
        h=1.0,
        points=box(1, 100),
    ),
    Case(
        "oscillator, some samples at rest in the equilibrium",
        WHERE,
        "its quadratic form; a quarter of the samples does not move",
        OSCILLATOR,
        dvi.Polynomials(4),
        lambda rng: tuple(
            np.where(np.arange(120)[:, None] % 4, rng.uniform(-1, 1, (120, 1)), 0.0) for _ in "qp"
        ),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "oscillator, a box of 1e-8 about the equilibrium",
        WHERE,
        "its quadratic form",
        OSCILLATOR,
        dvi.Polynomials(2),
        box(1, 60, -1e-8, 1e-8),
        truth=(energy(1.0, 0.1),),
    ),
    Case(
        "quartic oscillator, a box of 1e-4",
        WHERE,
        "the map is nearly a shear there; p changes by 1e-12 h, which is 1e-8 of p; " + NONE + "",
        QUARTIC,
        dvi.Polynomials(2),
        box(1, 60, -1e-4, 1e-4),
        h=1.0,
    ),
)
