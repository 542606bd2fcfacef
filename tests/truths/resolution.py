"""Steps and boxes so small that an expansion is conserved as well as an invariant, to rounding."""

import jax.numpy as jnp

import dvi_jax as dvi
from dvi_jax.discover.library import rotation

from . import Case, GaugeCase, SymmetryCase
from .chaotic import HENON
from .integrable import MCMILLAN, OSCILLATOR, biquadratic, energy
from .maps import box, separable
from .simple import CENTRAL

STEPS, BOXES = "expansions in small steps", "expansions in small boxes"
CHANGED = "the modified energy is a series in h that does not end; checked at h = 0.1"
ABOUT = "the normal form about the fixed point is a series that does not end"
DUFFING = separable(lambda q: q @ q / 2 + jnp.sum(q**4) / 4)
PENDULUM = separable(lambda q: -jnp.sum(jnp.cos(q)))
WITH_WAVES = dvi.Polynomials(2) + dvi.Basis(
    {"cos q": lambda q, p: jnp.cos(q[0]), "p sin q": lambda q, p: p[0] * jnp.sin(q[0])}
)
UNEQUAL = dvi.System(
    lambda t0, t1, q, p, args: p @ p / 2 + q @ q / 2 + (q @ q) ** 2 / 4 + 1e-6 * q[0] ** 2 * q[1]
)
LINEAR = dvi.Polynomials(1, constant=True)
FIXED = {"time": False}
NOTHING = lambda t, q, p, args: jnp.zeros(2)  # noqa: E731
TRANSLATION = dvi.Generator(None, lambda t, q, p, args: jnp.array([1.0, 0.0]), NOTHING)
TOGETHER = dvi.Generator(None, lambda t, q, p, args: jnp.ones(2), NOTHING)
SINGULAR = dvi.System(
    lambda t0, t1, q, p, args: p @ p / 2 + (q[0] - q[1]) ** -12 + 0.5 * (q[0] + q[1]) ** 2
)

CASES = (
    *(
        Case(
            f"oscillator at h = {h:g}, functions of degree 4",
            STEPS,
            "p² − h q p + q² is conserved",
            OSCILLATOR,
            dvi.Polynomials(4),
            box(1, 200),
            truth=(energy(1.0, h),),
            h=h,
        )
        for h in (1e-4, 1e-7, 1e-17)
    ),
    *(
        Case(
            f"quartic spring at h = {h:g}",
            STEPS,
            CHANGED,
            DUFFING,
            dvi.Polynomials(4),
            box(1, 200),
            h=h,
        )
        for h in (1e-3, 1e-4, 1e-6, 1e-9)
    ),
    *(
        Case(
            f"pendulum at h = {h:g}",
            STEPS,
            CHANGED,
            PENDULUM,
            WITH_WAVES,
            box(1, 200),
            h=h,
        )
        for h in (1e-3, 1e-5)
    ),
    *(
        Case(
            f"Hénon's map in a box of {size:g}, degree {degree}",
            BOXES,
            ABOUT,
            HENON,
            dvi.Polynomials(degree),
            box(1, 200, -size, size),
            h=1.0,
        )
        for size, degree in ((0.1, 4), (1e-3, 5), (1e-5, 3))
    ),
    Case(
        "McMillan's map in a box of 1e-3",
        BOXES,
        "McMillan 1971: a biquadratic form",
        MCMILLAN,
        dvi.Polynomials(4),
        box(1, 200, -1e-3, 1e-3),
        truth=(biquadratic(1.0, 0.0, 1.0, -1.4, 0.0),),
        h=1.0,
    ),
    *(
        SymmetryCase(
            f"rotations under a central force at h = {h:g}",
            STEPS,
            "rotations; a quartic force has no other linear symmetry",
            CENTRAL,
            LINEAR,
            box(2, 200),
            truth=(rotation(0, 1),),
            variational=1,
            h=h,
            options=FIXED,
        )
        for h in (1e-4, 1e-6, 1e-8)
    ),
    *(
        SymmetryCase(
            f"flow of a quartic spring at h = {h:g}",
            STEPS,
            CHANGED,
            DUFFING,
            dvi.Polynomials(3, constant=True),
            box(1, 200),
            h=h,
            options=FIXED,
        )
        for h in (1e-2, 1e-5, 1e-8)
    ),
    *(
        SymmetryCase(
            f"an axis stiffer by 1e-6 q1² q2 in a box of {size:g}",
            BOXES,
            "a quartic force has no linear symmetry but rotations, and these are broken",
            UNEQUAL,
            LINEAR,
            box(2, 200, -size, size),
            options=FIXED,
        )
        for size in (1e-2, 1e-6)
    ),
    SymmetryCase(
        "rotations under a central force in a box of 1e-4",
        BOXES,
        "rotations; a quartic force has no other linear symmetry",
        CENTRAL,
        LINEAR,
        box(2, 200, -1e-4, 1e-4),
        truth=(rotation(0, 1),),
        variational=1,
        options=FIXED,
    ),
    *(
        GaugeCase(
            f"gauge of a field that is no symmetry, h = {h:g}",
            STEPS,
            "without a symmetry only −ξ·p, of degree 3, closes the identity",
            CENTRAL,
            (dvi.Generator(None, lambda t, q, p, args: q * q[0], lambda t, q, p, args: p),),
            dvi.Polynomials(1),
            box(2, 60),
            closes=(False,),
            h=h,
        )
        for h in (1e-6, 1e-11, 1e-15)
    ),
    *(
        GaugeCase(
            f"gauge of a translation, h = {h:g}",
            STEPS,
            "−ξ·p closes the identity of any ξ without ξ0",
            CENTRAL,
            (TRANSLATION,),
            dvi.Polynomials(1),
            box(2, 60),
            closes=(True,),
            h=h,
        )
        for h in (1e-6, 1e-11)
    ),
    GaugeCase(
        "gauge of a translation, hidden by strong kicks of a pair",
        BOXES,
        "a spring to the origin breaks the translation of a pair; its total momentum is no gauge",
        SINGULAR,
        (TOGETHER,),
        dvi.Basis({"r": lambda q, p: (q[0] - q[1]) ** 2}),
        box(2, 60),
        closes=(False,),
        h=0.01,
    ),
)
