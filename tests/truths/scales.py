"""Units from 1e-35 to 1e30, origins far away, outliers, and step sizes from 1e-9 to 100."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import Case
from .chaotic import HENON
from .integrable import MCMILLAN, OSCILLATOR, biquadratic, duffing, energy, of_duffing, qrt, spring
from .maps import additive, box, component, separable, shell, sized, timed, turning

UNITS, OFFSETS, OUTLIERS, STEPS = "units", "offsets", "outliers", "small and large steps"
NONE = "checked in 60 digits: the changes of the basis have full rank"


def mechanical(m, V):
    """H_D = p1·p1/2m + V(q0)."""
    return dvi.System(lambda t0, t1, q, p, args: p @ p / (2 * m) + V(q))


def moved(samples, q: Any = 0.0, p: Any = 0.0):
    """The samples about another origin."""

    def draw(rng):
        qs, ps = samples(rng)
        return qs + np.array(q), ps + np.array(p)

    return draw


def with_outliers(samples, factor, every=20):
    """The samples, one of `every` so many times as far from the origin."""

    def draw(rng):
        qs, ps = samples(rng)
        qs, ps = np.array(qs), np.array(ps)
        qs[::every] *= factor
        ps[::every] *= factor
        return qs, ps

    return draw


def wild(samples, every=20):
    """The samples, one of `every` replaced by normal numbers times 10 to a power from −8 to 8."""

    def draw(rng):
        qs, ps = samples(rng)
        qs, ps = np.array(qs), np.array(ps)
        for x in (qs, ps):
            part = x[::every]
            part[:] = rng.normal(size=part.shape) * 10.0 ** rng.uniform(-8, 8, part.shape)
        return qs, ps

    return draw


SUN = 1.327e20
"""GM of the sun [m³/s²]."""
EARTH = 5.97e24
"""Mass [kg]."""
AU = 1.496e11
"""[m]."""


def scaled_mcmillan(size):
    """q₊ + q₋ = 1.4 q/(1 + (q/s)²)."""
    return additive(lambda q: 1.4 * q / (1 + (q / size) ** 2))


def of_scaled(size):
    """x²y²/s² + x² + y² − 1.4 xy."""
    return lambda q, p: biquadratic(1.0, 0.0, 1.0, -1.4, 0.0)(q / size, p / size)


def linear_form(m, k, h):
    """p² + m k q² − h k q p of H = p²/2m + k q²/2."""
    return lambda q, p: p[0] ** 2 / m + k * q[0] ** 2 - h * k / m * q[0] * p[0]


ATOM = (1.67e-27, 5e2)
"""Mass [kg] and stiffness [N/m] of a molecule of hydrogen, about."""

KEPLER = separable(lambda q: -1 / jnp.sqrt(q @ q))
QUARTIC = separable(lambda q: (q @ q) ** 2 / 4)
FAR = np.array([300.0, -200.0])
PAIR = separable(lambda q: jnp.cosh(q[0] - q[1]))

CASES = (
    Case(
        "molecule in SI units",
        UNITS,
        "p²/m + k q² − (hk/m) q p; p about 1e-23 kg m/s",
        mechanical(ATOM[0], lambda q: ATOM[1] * (q @ q) / 2),
        dvi.Polynomials(4),
        sized(1, 100, 1e-11, 1e-23),
        truth=(lambda q, p: 1e46 * ATOM[0] * linear_form(*ATOM, 1e-15)(q, p),),
        h=1e-15,
    ),
    Case(
        "planet in SI units",
        UNITS,
        "angular momentum; p about 1e29 kg m/s",
        mechanical(EARTH, lambda q: -SUN * EARTH / jnp.sqrt(q @ q)),
        dvi.Polynomials(2) + dvi.Radial(),
        lambda rng: (rng.uniform(-2, 2, (100, 2)) * AU, rng.uniform(-2e29, 2e29, (100, 2))),
        truth=(lambda q, p: 1e-40 * (q[0] * p[1] - q[1] * p[0]),),
        h=86400.0,
    ),
    Case(
        "planet in SI units, Strang, in space",
        UNITS,
        "angular momentum",
        mechanical(EARTH, lambda q: -SUN * EARTH / jnp.sqrt(q @ q)),
        dvi.Polynomials(2),
        lambda rng: (rng.uniform(-2, 2, (80, 3)) * AU, rng.uniform(-2e29, 2e29, (80, 3))),
        truth=tuple(
            lambda q, p, i=i, j=j: 1e-40 * (q[i] * p[j] - q[j] * p[i])
            for i, j in ((0, 1), (0, 2), (1, 2))
        ),
        h=1e6,
        options={"method": dvi.Strang()},
    ),
    *(
        Case(
            f"McMillan's map of size {size:g}",
            UNITS,
            "x²y²/s² + x² + y² − 2μxy",
            scaled_mcmillan(size),
            dvi.Polynomials(4),
            box(1, 100, -size, size),
            truth=(of_scaled(size),),
            h=1.0,
        )
        for size in (1e-30, 1e-6, 1e8, 1e30)
    ),
    Case(
        "McMillan's map of size 1e-12 with a cubic force",
        UNITS,
        NONE,
        additive(lambda q: 1.4 * q / (1 + (1e12 * q) ** 2) + 0.01 * 1e24 * q**3),
        dvi.Polynomials(4),
        box(1, 100, -1e-12, 1e-12),
        h=1.0,
    ),
    Case(
        "oscillators of very different sizes",
        UNITS,
        "a quadratic form each; q₁ about 1e-10, q₂ about 1e10",
        spring(1.0, 0.5),
        dvi.Polynomials(2),
        lambda rng: tuple(rng.uniform(-1, 1, (80, 2)) * np.array([1e-10, 1e10]) for _ in "qp"),
        truth=(
            lambda q, p: 1e20 * energy(1.0, 0.3, 0)(q, p),
            lambda q, p: 1e-20 * energy(0.5, 0.3, 1)(q, p),
        ),
        h=0.3,
    ),
    Case(
        "momentum of 1e30 beside a position of 1e-30",
        UNITS,
        "H = 1e-60 p²/2 + 1e60 q²/2: p²/m + k q² − (hk/m) q p, h = 0.1",
        mechanical(1e60, lambda q: 1e60 * (q @ q) / 2),
        dvi.Polynomials(4),
        sized(1, 100, 1e-30, 1e30),
        truth=(lambda q, p: linear_form(1.0, 1.0, 0.1)(1e30 * q, 1e-30 * p),),
    ),
    Case(
        "chain of atoms in SI units",
        UNITS,
        "total momentum",
        mechanical(
            1e-26,
            lambda q: jnp.sum(10 * (q[1:] - q[:-1]) ** 2 / 2 + 1e21 * (q[1:] - q[:-1]) ** 4 / 4),
        ),
        dvi.Polynomials(2),
        sized(3, 80, 1e-10, 1e-23),
        truth=(lambda q, p: 1e23 * jnp.sum(p),),
        h=1e-14,
        options={"method": dvi.Strang()},
    ),
    Case(
        "Hénon's map in units of 1e-20",
        UNITS,
        NONE,
        separable(lambda q: jnp.sum(0.4 * q**2 + 1e20 * q**3 / 3)),
        dvi.Polynomials(4),
        box(1, 100, -1e-20, 1e-20),
        h=1.0,
    ),
    Case(
        "frequency of 1e15 and steps of 1e-16",
        UNITS,
        "p² + ω²q² − hω² q p",
        separable(lambda q: 1e30 * (q @ q) / 2),
        dvi.Polynomials(2),
        sized(1, 80, 1e-10, 1e5),
        truth=(lambda q, p: (p[0] ** 2 + 1e30 * q[0] ** 2 - 1e14 * q[0] * p[0]) / 1e10,),
        h=1e-16,
    ),
    *(
        Case(
            f"oscillator about {offset:g}",
            OFFSETS,
            "the form about the equilibrium, expanded; digits are lost as the square of the offset",
            separable(lambda q, c=offset: (q - c) @ (q - c) / 2),
            dvi.Polynomials(2),
            moved(box(1, 80), q=offset),
            truth=(lambda q, p, c=offset: energy(1.0, 0.1)(q - c, p),),
        )
        for offset in (3.0, 100.0)
    ),
    Case(
        "oscillator about 1e6, with functions of the distance from there",
        OFFSETS,
        "the form about the equilibrium",
        separable(lambda q: (q - 1e6) @ (q - 1e6) / 2),
        dvi.Basis(
            {
                f"x^{i} p^{j}": lambda q, p, i=i, j=j: (q[0] - 1e6) ** i * p[0] ** j
                for i in range(3)
                for j in range(3 - i)
                if i + j
            }
        ),
        moved(box(1, 80), q=1e6),
        truth=(lambda q, p: energy(1.0, 0.1)(q - 1e6, p),),
    ),
    Case(
        "pair at 1e8",
        OFFSETS,
        "total momentum: the force depends on the difference of the positions",
        PAIR,
        dvi.Polynomials(1) + dvi.Polynomials(2, ["p1", "p2"]) * dvi.Polynomials(1, ["p1"]),
        moved(box(2, 60), q=1e8),
        truth=(lambda q, p: p[0] + p[1],),
    ),
    Case(
        "pair at 1e4, momenta alone",
        OFFSETS,
        "total momentum and its powers",
        PAIR,
        dvi.Polynomials(4, ["p1", "p2"]),
        moved(box(2, 60), q=1e4),
        truth=(lambda q, p: p[0] + p[1],),
    ),
    Case(
        "free particle at 1e8",
        OFFSETS,
        "p",
        separable(lambda q: 0.0 * jnp.sum(q)),
        dvi.Polynomials(1),
        moved(box(1, 40), q=1e8),
        truth=(component(0),),
    ),
    Case(
        "Kepler about another centre",
        OFFSETS,
        "angular momentum about the centre, (q − c) ∧ p",
        separable(lambda q: -1 / jnp.sqrt((q - FAR) @ (q - FAR))),
        dvi.Polynomials(2),
        moved(shell(2, 100), q=FAR),
        truth=(lambda q, p: turning(0, 1)(q - FAR, p),),
    ),
    Case(
        "angles after a thousand turns",
        OFFSETS,
        "standard map at K = 0.5; " + NONE,
        separable(lambda q: -0.5 * jnp.sum(jnp.cos(q))),
        dvi.Trigonometric(2, "q", constant=True) * dvi.Trigonometric(2, "p", constant=True),
        moved(box(1, 100, -3.0, 3.0), q=2000 * np.pi),
        h=1.0,
    ),
    Case(
        "momenta about 1000",
        OFFSETS,
        "free motion along the second axis: p₂; the first is an oscillator",
        spring(1.0, 0.0),
        dvi.Polynomials(2),
        moved(box(2, 80), p=[0.0, 1000.0]),
        truth=(energy(1.0, 0.1), component(1)),
    ),
    Case(
        "times about 1e9",
        OFFSETS,
        "central force that varies with time: L",
        dvi.System(
            lambda t0, t1, q, p, args: p @ p / 2 + (1 + 0.3 * jnp.cos(t0)) * (q @ q) ** 2 / 4
        ),
        dvi.Polynomials(2),
        timed(box(2, 80), 1e9, 1e9 + 10),
        truth=(turning(0, 1),),
    ),
    *(
        Case(
            f"{name}, one sample of twenty {factor:g} times as far",
            OUTLIERS,
            source,
            system,
            basis,
            with_outliers(samples, factor),
            truth=truth,
            h=h,
            points=samples,
        )
        for name, source, system, basis, samples, truth, h in (
            (
                "oscillator",
                "its quadratic form",
                OSCILLATOR,
                dvi.Polynomials(4),
                box(1, 120),
                (energy(1.0, 0.1),),
                0.1,
            ),
            (
                "McMillan's map",
                "McMillan 1971",
                MCMILLAN,
                dvi.Polynomials(4),
                box(1, 120),
                (biquadratic(1, 0, 1, -1.4, 0),),
                1.0,
            ),
            (
                "central quartic force",
                "angular momentum",
                QUARTIC,
                dvi.Polynomials(2),
                box(2, 100),
                (turning(0, 1),),
                0.1,
            ),
        )
        for factor in (30.0, 1e6)
    ),
    Case(
        "oscillator, one sample of twenty anywhere",
        OUTLIERS,
        "its quadratic form",
        OSCILLATOR,
        dvi.Polynomials(4),
        wild(box(1, 200)),
        truth=(energy(1.0, 0.1),),
        points=box(1, 200),
    ),
    Case(
        "Kepler, one sample of twenty anywhere",
        OUTLIERS,
        "angular momentum",
        KEPLER,
        dvi.Polynomials(2) + dvi.Radial(),
        wild(shell(2, 200)),
        truth=(turning(0, 1),),
        points=shell(2, 200),
    ),
    Case(
        "Hénon's map, one sample of twenty anywhere",
        OUTLIERS,
        NONE,
        HENON,
        dvi.Polynomials(4),
        wild(box(1, 200)),
        h=1.0,
        points=box(1, 200),
    ),
    Case(
        "Hénon's map, one sample of twenty 100 times as far",
        OUTLIERS,
        NONE,
        HENON,
        dvi.Polynomials(4),
        with_outliers(box(1, 120), 100.0),
        h=1.0,
        points=box(1, 120),
    ),
    *(
        Case(
            f"oscillator at h = {h:g}",
            STEPS,
            "its quadratic form at this step size",
            OSCILLATOR,
            dvi.Polynomials(4),
            box(1, 80),
            truth=(energy(1.0, h),),
            h=h,
        )
        for h in (1e-9, 1e-5, 30.0)
    ),
    *(
        Case(
            f"integrable discrete Duffing oscillator at h = {h:g}",
            STEPS,
            "McMillan's map",
            duffing(1.0, 0.5, h),
            dvi.Polynomials(4),
            box(1, 100),
            truth=(of_duffing(1.0, 0.5, h),),
            h=h,
        )
        for h in (0.01, 3.0)
    ),
    Case(
        "Kepler at h = 100",
        STEPS,
        "angular momentum",
        KEPLER,
        dvi.Polynomials(2) + dvi.Radial(),
        shell(2, 100),
        truth=(turning(0, 1),),
        h=100.0,
    ),
    Case(
        "Kepler at h = 1e-8, without the energy in the basis",
        STEPS,
        "angular momentum",
        KEPLER,
        dvi.Polynomials(2),
        shell(2, 100),
        truth=(turning(0, 1),),
        h=1e-8,
    ),
    Case(
        "quartic oscillator at h = 1e-3 with its energy in the basis",
        STEPS,
        "the energy changes in a step by O(h²); " + NONE,
        separable(lambda q: jnp.sum(q**4) / 4),
        dvi.Polynomials(4),
        box(1, 100),
        h=1e-3,
    ),
    Case(
        "quartic oscillator at h = 3",
        STEPS,
        NONE,
        separable(lambda q: jnp.sum(q**4) / 4),
        dvi.Polynomials(4),
        box(1, 100),
        h=3.0,
    ),
    Case(
        "backwards in time",
        STEPS,
        "the quadratic form at h = −0.3",
        OSCILLATOR,
        dvi.Polynomials(4),
        box(1, 80),
        truth=(energy(1.0, -0.3),),
        h=-0.3,
    ),
    Case(
        "hyperbolic map with multipliers of 1e4",
        STEPS,
        "a linear map with λ + 1/λ = 2 + 1e4",
        spring(-1e4),
        dvi.Polynomials(4),
        box(1, 100),
        truth=(lambda q, p: p[0] ** 2 - 1e4 * q[0] ** 2 + 1e4 * q[0] * p[0],),
        h=1.0,
    ),
    Case(
        "QRT map in a small box about its fixed point",
        STEPS,
        "the biquadratic, whose quartic term is 1e-6 of the quadratic ones there",
        qrt(1.0, 0.0, 1.0, -1.4, 0.0),
        dvi.Polynomials(4),
        box(1, 100, -1e-3, 1e-3),
        truth=(biquadratic(1, 0, 1, -1.4, 0),),
        h=1.0,
    ),
    Case(
        "QRT map in a large box",
        STEPS,
        "the biquadratic, whose quadratic terms are 1e-6 of the quartic one there",
        qrt(1.0, 0.0, 1.0, -1.4, 0.0),
        dvi.Polynomials(4),
        box(1, 100, -1e3, 1e3),
        truth=(biquadratic(1, 0, 1, -1.4, 0),),
        h=1.0,
    ),
    Case(
        "frequencies of 1 and 1e4",
        STEPS,
        "a quadratic form each",
        spring(1.0, 1e8),
        dvi.Polynomials(2),
        box(2, 80),
        truth=(
            energy(1.0, 1e-4, 0),
            lambda q, p: energy(1e8, 1e-4, 1)(q, p) / 1e8,
        ),
        h=1e-4,
    ),
)
