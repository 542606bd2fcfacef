"""Steps and boxes so small that an expansion is conserved as well as an invariant, to rounding.

The modified energy of a nonlinear flow is a series in h that does not end (checked at h = 0.1), and
so is the normal form about a fixed point. A quartic central force has no linear symmetry but
rotations.
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import dvi_jax as dvi
from dvi_jax.discover.symmetries.library import rotation, space_translation

from . import case, gauge, named, symmetry
from .maps import *

DUFFING = separable("q @ q / 2 + sum(q**4) / 4")
WITH_WAVES = poly(2) + functions("cos(q1)", "p1 * sin(q1)")
WELL = separable("q @ q / 2 + (q @ q)**2 / 4")
UNEQUAL = separable("q @ q / 2 + (q @ q)**2 / 4 + 1e-6 * q1**2 * q2")
LINEAR = poly(1, constant=True)
BROKEN = dvi.Generator(None, lambda t, q, p, args: q * q[0], lambda t, q, p, args: p)
SINGULAR = separable("(q1 - q2)**-12 + 0.5 * (q1 + q2)**2")

_STEPS = {
    **{f"oscillator at h = {h:g}, functions of degree 4": case((OSCILLATOR, poly(4), box(1, 200),
        h), energy(1.0, h)) for h in (1e-4, 1e-7, 1e-17)},
    **{f"quartic spring at h = {h:g}": case((DUFFING, poly(4), box(1, 200), h))
        for h in (1e-3, 1e-4, 1e-6, 1e-9)},
    **{f"pendulum at h = {h:g}": case((PENDULUM, WITH_WAVES, box(1, 200), h))
        for h in (1e-3, 1e-5)},
    **{f"rotations under a central force at h = {h:g}": symmetry((WELL, LINEAR, box(2, 200), h),
        rotation(0, 1), variational=1, time=False) for h in (1e-4, 1e-6, 1e-8)},
    **{f"flow of a quartic spring at h = {h:g}": symmetry((DUFFING, poly(3, constant=True),
        box(1, 200), h), time=False) for h in (1e-2, 1e-5, 1e-8)},
    # without a symmetry only −ξ·p, of degree 3, closes the identity
    **{f"gauge of a field that is no symmetry, h = {h:g}": gauge((WELL, poly(1), box(2, 60), h),
        BROKEN, closes=(False,)) for h in (1e-6, 1e-11, 1e-15)},
    # −ξ·p closes the identity of any ξ without ξ0
    **{f"gauge of a translation, h = {h:g}": gauge((WELL, poly(1), box(2, 60), h),
        space_translation([1.0, 0.0]), closes=(True,)) for h in (1e-6, 1e-11)},
}  # fmt: skip
_BOXES = {
    **{f"Hénon's map in a box of {size:g}, degree {degree}": case((HENON, poly(degree),
        box(1, 200, -size, size), 1.0)) for size, degree in ((0.1, 4), (1e-3, 5), (1e-5, 3))},
    "McMillan's map in a box of 1e-3": case((MCMILLAN, poly(4), box(1, 200, -1e-3, 1e-3), 1.0),
        BIQUADRATIC),
    **{f"an axis stiffer by 1e-6 q1² q2 in a box of {size:g}": symmetry((UNEQUAL, LINEAR,
        box(2, 200, -size, size)), time=False) for size in (1e-2, 1e-6)},
    "rotations under a central force in a box of 1e-4": symmetry((WELL, LINEAR,
        box(2, 200, -1e-4, 1e-4)), rotation(0, 1), variational=1, time=False),
    # a spring to the origin breaks the translation of a pair; its total momentum is no gauge
    "gauge of a translation, hidden by strong kicks of a pair": gauge((SINGULAR,
        functions("(q1 - q2)**2"), box(2, 60), 0.01), space_translation([1.0, 1.0]),
        closes=(False,)),
}  # fmt: skip
CASES = (*named("expansions in small steps", _STEPS), *named("expansions in small boxes", _BOXES))
