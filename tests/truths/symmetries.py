"""Maps whose symmetries are known, in polynomials of low degree, and gauges.

The symmetries of a linear map among linear vector fields are the matrices that commute with it.
`exact_series.Symmetries` counts the symmetries of all cases and confirms `truth`. How many are
variational follows from their Hamiltonians, which it counts too, and for those that move time from
the weight of the action: a scaling is variational if it leaves p·dq and H dt as they are.
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import numpy as np
from exact_series import vector

from dvi_jax.discover.functions.generators import Generator
from dvi_jax.discover.symmetries.library import (
    boost,
    hamiltonian_flow,
    rotation,
    scaling,
    space_translation,
    time_translation,
)

from . import gauge, named, symmetry
from .maps import *
from .perturbed import (
    FREE,
    KEPLER,
    MIXED,
    ONE,
    OVER_THE_HILL,
    TOTAL,
    TWO,
    between,
    forced,
    form,
    oscillators,
    perturbed,
)


def flow(K):
    """The Hamiltonian vector field of K(q, p)."""
    return hamiltonian_flow(formula(K, "t, q, p, args"))


def only(i, n):
    """A scaling of degree of freedom i of n."""
    weight = np.eye(n)[i]
    return scaling(weight, weight)


AFFINE = poly(1, constant=True)
TIMED = [
    poly(1, names, constant=True) for names in (("q", "p", "t"), ("q1", "q2", "p1", "p2", "t"))
]
"""Affine functions of (q, p, t) for one and two degrees of freedom."""


def moving(system, samples, counts, *truth, variational=None, basis=AFFINE, **more):
    """A case with ξ0, whose symmetries are all variational unless it says otherwise."""
    variational = len(truth) if variational is None else variational
    return symmetry(
        (system, basis, samples),
        truth,
        variational=variational,
        survivors=counts,
        order=len(counts) - 1,
        **{"time": True, **more},
    )


def fixed(system, samples, counts, *truth, **more):
    """A case without ξ0."""
    return moving(system, samples, counts, *truth, time=False, **more)


def central(k=0.0, offset=0.0):
    """H_D of a motion about a centre, with one axis stiffer by k."""
    r, r1 = (f"(q - {offset})", f"(q1 - {offset})") if offset else ("q", "q1")
    return f"(p @ p + {r} @ {r}) / 2 + ({r} @ {r})**2 * 0.25 + {r1} * {r1} * {k}"


def springs(n, outer=0.0):
    """H_D of bodies of mass 1, 2, …, with central quartic forces between them, and an outer
    spring."""
    kinetic = " + ".join(f"sum(p[{i}] * p[{i}]) / {2 * (i + 1)}" for i in range(n))
    pairs = [f"sum((q[{i}] - q[{j}])**2)" for i in range(n) for j in range(i)]
    return (
        f"{kinetic} + {' + '.join(f'{r} + 0.25 * {r} * {r}' for r in pairs)} + {outer} * sum(q * q)"
    )


def of_centre(linear):
    """The generator that acts as a linear map on the centre of mass, and on it only."""

    def masses(q):
        return 1.0 + np.arange(len(q))[:, None]

    def xi(t, q, p, args):
        return linear((masses(q) * q).sum(0) / masses(q).sum())[None] + 0 * q

    def eta(t, q, p, args):
        return linear(p.sum(0))[None] * masses(q) / masses(q).sum()

    return Generator(xi=xi, eta=eta)


def around(centre):
    """The rotation about (centre, centre)."""
    return rotation(0, 1) + centre * space_translation([1.0, -1.0])


def near_and_far(rng):
    """Positions of which one in 20 is within 0.01 of the origin."""
    q, p = between(2, 150)(rng)
    return np.where(np.arange(150)[:, None] % 20 == 0, 3e-3, 1.0) * q, p


def orbits_in_km(rng):
    q, p = between(2, 120)(rng)
    return 7000 * q, 7 * p


FIRST, SECOND = flow(form(1)), flow(form(2))
TURN, TIME, DILATION = rotation(0, 1), time_translation(), scaling()
RIGHT, ALONG = space_translation([1.0, 0.0]), space_translation([1.0])
CENTRE = of_centre(lambda x: x)
CENTRE_TURNED = of_centre(lambda x: vector(-x[1], x[0]))
SWAPPED = Generator(xi=lambda t, q, p, args: q[::-1], eta=lambda t, q, p, args: p[::-1])
NONE = Generator()

OSCILLATOR, CENTRAL, FREE_SYSTEM = system(ONE), system(central()), system(FREE)
OSCILLATORS = [system(oscillators(*k)) for k in ((1, 2), (1, 1, 2), (1, 1.001))]
PAIR, TRIPLE = system(springs(2)), system(springs(3))
FALLING = system("p @ p / 2 + q1")
HENON_HEILES = system("(p @ p + q @ q) / 2 + q1**2 * q2 - q2**3 / 3")
KEPLER_SYSTEM = system(KEPLER)
EARTH = system("p @ p / 2 - 398600.4418 * (q @ q)**-0.5")
CYCLIC = system("p1**2 * (1 + q2**2) / 2 + p2**2 / 2 + q2**4 / 4")
INVERSE_SQUARE = system("p @ p / 2 + 0.5 / (q @ q)")
WELL = system("p @ p / 2 + q1**4 / 4")
DRIVEN = system("(p @ p + q @ q) / 2 + q1**4 / 4 - q1 * cos(t)")
LINE, PLANE, OUTLIERS = box(1, 60), box(2, 80), with_outliers(box(2, 100), 10.0)
IN_TIME = timed(LINE, 0.0, 3.0)

_EXACT = {
    "central force in the plane": fixed(CENTRAL, box(2, 200), (1,), TURN, basis=poly(1)),
    "linear map of one oscillator": fixed(OSCILLATOR, LINE, (2,), FIRST, DILATION, variational=1),
    "linear map of one oscillator, with time": moving(OSCILLATOR, LINE, (3,), TIME, FIRST, DILATION,
        variational=2),
    "linear map of one oscillator, quadratic vector fields": fixed(OSCILLATOR, LINE, (2,), FIRST,
        DILATION, variational=1, basis=poly(2)),
    "linear map of one oscillator, cubic vector fields": fixed(OSCILLATOR, box(1, 80), (4,), FIRST,
        DILATION, variational=1, basis=poly(3)),
    "linear map of two equal oscillators": fixed(system(TWO), PLANE, (8,), FIRST, SECOND, TURN,
        DILATION, variational=3),
    "linear map of frequencies 1 and √2": fixed(OSCILLATORS[0], PLANE, (4,), FIRST,
        flow(form(2, 2)), only(0, 2), only(1, 2), variational=2),
    "linear map of frequencies 1, 1 and √2": fixed(OSCILLATORS[1], box(3, 80), (10,),
        *(FIRST, SECOND, TURN, flow(form(3, 2)), only(2, 3), DILATION), variational=4),
    "linear map of frequencies 1 and 1.0005": fixed(OSCILLATORS[2], PLANE, (4,),
        *(FIRST, flow(form(2, 1.001)), only(0, 2), only(1, 2)), variational=2),
    "linear map over a hill": fixed(system("(p @ p - q @ q) / 2"), LINE, (2,), flow(OVER_THE_HILL),
        DILATION, variational=1),
    "free particle on a line": moving(FREE_SYSTEM, IN_TIME, (7,),
        *(TIME, ALONG, boost([1.0]), scaling(0.5, -0.5, 1.0)), basis=TIMED[0]),
    "free particle on a line, without time": fixed(FREE_SYSTEM, LINE, (3,), ALONG, DILATION,
        variational=1),
    "falling particle, without time": fixed(FALLING, IN_TIME, (3,), ALONG, boost([1.0]),
        basis=TIMED[0]),
    "central force, with time": moving(CENTRAL, PLANE, (2,), TIME, TURN),
    "rotations of a central force in space": fixed(CENTRAL, box(3, 100), (3,), TURN, rotation(1, 2),
        rotation(0, 2)),
    "central force, few samples": fixed(CENTRAL, box(2, 14), (1,), TURN),
    "central force, 5 % outliers": fixed(CENTRAL, OUTLIERS, (1,), TURN),
    **{f"central force about ({c:g}, {c:g})": fixed(system(central(offset=c)), moved(PLANE, q=c),
        (1,), around(c)) for c in (3.0, 1000.0)},
    "cyclic coordinate": fixed(CYCLIC, PLANE, (2,), RIGHT),
    "quartic well: scaling of the time": moving(WELL, timed(box(1, 80), 0.0, 3.0), (2,),
        *(TIME, scaling(1.0, 2.0, -1.0)), variational=1, basis=TIMED[0]),
    "Kepler's third law": moving(KEPLER_SYSTEM, timed(between(2, 120), 0.0, 3.0), (3,),
        *(TIME, TURN, scaling(1.0, -0.5, 1.5)), variational=2, basis=TIMED[1]),
    "Kepler, samples close to the centre": fixed(KEPLER_SYSTEM, near_and_far, (1,), TURN),
    "orbits of the Earth in km and s": fixed(EARTH, orbits_in_km, (1,), TURN, h=10.0),
    "inverse square potential: scaling is variational": moving(INVERSE_SQUARE,
        timed(between(2, 120), 0.0, 3.0), (3,), *(TIME, TURN, scaling(0.5, -0.5, 1.0)),
        basis=TIMED[1]),
    "two bodies in the plane": fixed(PAIR, box((2, 2), 80), (11,),
        *(RIGHT, space_translation([0.0, 1.0]), TURN, CENTRE_TURNED, CENTRE), variational=4),
    "two bodies on a line, with boosts": fixed(PAIR, timed(box((2, 1), 80), 0.0, 3.0), (4,),
        *(ALONG, boost([1.0], [1.0, 2.0])), basis=TIMED[1]),
    "three bodies on a line": fixed(TRIPLE, box((3, 1), 80), (3,), ALONG, CENTRE, variational=1),
    "Hénon–Heiles, with time": moving(HENON_HEILES, PLANE, (1,), TIME),
    "pendulum in affine vector fields": moving(system("p @ p / 2 - cos(q1)"), LINE, (1,), TIME),
}  # fmt: skip
_BROKEN = {
    "central force with an axis stiffer by 1e-3": fixed(system(central(1e-3)), PLANE, (0,)),
    "central force with an axis stiffer by 1e-6": fixed(system(central(1e-6)), PLANE, (0,)),
    "two bodies and an outer spring": fixed(system(springs(2, 0.5)), box((2, 2), 80), (1,), TURN),
    "two bodies and an outer spring of 1e-6": fixed(
        system(springs(2, 1e-6)), box((2, 2), 80), (1,), TURN
    ),
    "Hénon–Heiles, quadratic vector fields": fixed(HENON_HEILES, PLANE, (0,), basis=poly(2)),
    "Hénon–Heiles, 5 % outliers": fixed(HENON_HEILES, OUTLIERS, (0,)),
    "oscillator with a quartic term of 1e-6": fixed(
        system("(p @ p + q @ q) / 2 + 1e-6 * q1**4"), LINE, (0,)
    ),
    "quartic well, without scaling of the time": fixed(WELL, LINE, (0,)),
    "drive: no translation of the time": moving(DRIVEN, IN_TIME, (0,)),
}
_FIRST = {
    "central perturbation": fixed(perturbed("q @ q", central()), PLANE, (1, 1), TURN),
    "perturbation of one axis": fixed(perturbed("q1**2", central()), PLANE, (1, 0)),
    "perturbation of one axis by 1e-12": fixed(perturbed("1e-12 * q1**2", central()), PLANE,
        (1, 0)),
    "spring of one oscillator, order 2": fixed(forced("-q"), LINE, (2, 2, 2), FIRST, DILATION,
        variational=1),
    "friction of one oscillator": fixed(forced("-p"), LINE, (2, 2), FIRST, DILATION, variational=0),
    "cubic force on one oscillator, affine vector fields": fixed(forced("-q**3"), LINE, (2, 0)),
    "cubic force on one oscillator, cubic vector fields": fixed(forced("-q**3"), box(1, 100),
        (4, 1), FIRST, basis=poly(3)),
    "friction under a central force": fixed(forced("-p", central()), PLANE, (1, 1), TURN,
        variational=0),
    "friction and translations": fixed(forced("-p", springs(2)), box((2, 1), 80), (3, 3), ALONG,
        CENTRE, variational=0),
    "two equal oscillators, coupled by q1q2": fixed(perturbed("q1*q2"), PLANE, (8, 4), flow(TOTAL),
        flow(MIXED), DILATION, SWAPPED, variational=2),
}  # fmt: skip

STILL, TURNING = box(1, 40), (TURN, NONE)
TWO_OF = box(2, 60)
# On the solutions −ξ·p is a gauge of every generator with ξ0 = 0: "trivial" below.
_GAUGES = {
    # H_D is the same for rotated states: G = 0
    "rotation under a central force": gauge((CENTRAL, poly(1), TWO_OF), TURN, closes=(True,)),
    # the torque is a cubic polynomial
    "rotation, Hénon–Heiles, linear gauges": gauge((HENON_HEILES, poly(1), TWO_OF), TURN,
        closes=(False,)),
    # trivial
    "rotation, Hénon–Heiles, quadratic gauges": gauge((HENON_HEILES, poly(2), TWO_OF), TURN,
        closes=(True,)),
    # N = p·v/h (h − h) − …: G = −q; p is conserved, and N is −v·p
    **{f"boost of a free particle, gauge {v}": gauge((FREE_SYSTEM, poly(1, v),
        timed(STILL, 0.0, 3.0)), boost([1.0]), closes=(v == "q",)) for v in ("q", "p")},
    # H_D does not depend on the time: G = 0
    "time under Kepler's force": gauge((KEPLER_SYSTEM, poly(1), between(2, 60)), TIME,
        closes=(True,)),
    # the power of the drive depends on the time
    "time under a drive": gauge((DRIVEN, poly(2), IN_TIME), TIME, closes=(False,)),
    # the force is constant: G = t; q does not grow as t
    **{f"translation in a uniform field, gauge {v}": gauge((FALLING, poly(1, v),
        timed(STILL, 0.0, 3.0)), ALONG, closes=(v == "t",)) for v in ("t", "q")},
    # it doubles the action, which is quadratic
    "scaling of an oscillator, linear gauges": gauge((OSCILLATOR, poly(1), LINE), DILATION,
        closes=(False,)),
    # trivial
    "scaling of an oscillator, quadratic gauges": gauge((OSCILLATOR, poly(2), LINE), DILATION,
        closes=(True,)),
    # G = K − ξ·p
    "flow of the form of an oscillator": gauge((OSCILLATOR, poly(2), LINE), FIRST, closes=(True,)),
    # H1_D is the same for rotated states
    "rotation and a central perturbation": gauge((perturbed("(q @ q)**2", central()), poly(1),
        TWO_OF), TURNING, closes=(True, True)),
    # the torque is −2 q1q2, not a difference
    "rotation and a perturbation of one axis": gauge((perturbed("q1**2", central()), poly(1),
        TWO_OF), TURNING, closes=(True, False)),
    # the torque of friction is −L, which does not change at ε = 0
    "rotation and friction, linear gauges": gauge((forced("-p", central()), poly(1), TWO_OF),
        TURNING, closes=(True, False)),
    # trivial
    "rotation and friction, quadratic gauges": gauge((forced("-p", central()), poly(2), TWO_OF),
        TURNING, closes=(True, True)),
    # H_D + ε H1_D does not depend on the time
    "time and a perturbation of an oscillator": gauge((perturbed("q1**2 / 2", ONE), poly(2), LINE),
        (TIME, NONE), closes=(True, True)),
    # the work −q0 (q1 − q0) is a difference less (q1 − q0)²/2, whose mean is not zero; the form,
    # which may be added to G_0, is conserved at order 1
    "time and a spring as a force": gauge((forced("-q"), poly(2), LINE), (TIME, NONE),
        closes=(True, False)),
    # the mean power of friction is balanced by the decay of a multiple of the form in G_0
    "time and friction": gauge((forced("-p"), poly(2), LINE), (TIME, NONE), closes=(True, True)),
}  # fmt: skip
SYMMETRIES = (
    *named("symmetries", _EXACT),
    *named("broken symmetries", _BROKEN),
    *named("perturbed symmetries", _FIRST),
)
CASES = (*SYMMETRIES, *named("gauges", _GAUGES))
