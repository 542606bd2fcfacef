"""Maps whose symmetries are known, in polynomials of low degree, and gauges.

The symmetries of a linear map among linear vector fields are the matrices that commute with it.
`exact_series.Symmetries` counts the symmetries of all cases and confirms `truth`. How many are
variational follows from their Hamiltonians, which it counts too, and for those that move time from
the weight of the action: a scaling is variational if it leaves p·dq and H dt as they are.
"""

import numpy as np
from exact_series import cos, vector

import dvi_jax as dvi
from dvi_jax.discover.generators import Generator
from dvi_jax.discover.library import (
    boost,
    hamiltonian_flow,
    rotation,
    scaling,
    space_translation,
    time_translation,
)

from . import GaugeCase, SymmetryCase
from .perturbed import (
    FREE,
    ONE,
    TWO,
    box,
    forced,
    form,
    kepler,
    mixed,
    oscillators,
    perturbed,
    shell,
    total,
)

H = 0.1
AFFINE = dvi.Polynomials(1, constant=True)
NO_TIME = {"time": False}
EXACT, BROKEN, FIRST = "symmetries", "broken symmetries", "perturbed symmetries"


def flow(function):
    """The Hamiltonian vector field of K(q, p)."""
    return hamiltonian_flow(lambda t, q, p, args: function(q, p))


def only(i, n):
    """A scaling of degree of freedom i of n."""
    weight = np.eye(n)[i]
    return scaling(weight, weight)


def affine(t, n):
    """Affine functions of (q, p, t)."""
    names = ("q", "p") if n == 1 else tuple(f"{v}{i + 1}" for v in "qp" for i in range(n))
    return dvi.Polynomials(1, (*names, "t") if t else names, constant=True)


def timed(draw, times=3.0):
    """The samples of `draw` at random times."""

    def drawn(rng):
        q, p = draw(rng)
        return q, p, rng.uniform(0.0, times, len(q))

    return drawn


def bodies(count, dim, samples):
    shape = (samples, count, dim)
    return lambda rng: (rng.uniform(-1, 1, shape), rng.uniform(-1, 1, shape))


def case(name, kind, system, samples, truth, variational, counts, basis=AFFINE, time=True, **more):
    """A case with `counts`, the numbers of symmetries of each order."""
    source = more.pop("source", "the group of the equations; counted by exact arithmetic")
    return SymmetryCase(name, kind, source, system, basis, samples, truth, variational,
                        survivors=counts, options={"time": time}, **more)  # fmt: skip


def central(k=0.0, offset=0.0, depth=0.25):
    """Motion about a centre, with one axis stiffer by k."""

    def H_D(t0, t1, q, p, args):
        r = q - offset
        return (p @ p + r @ r) / 2 + (r @ r) ** 2 * depth + r[0] * r[0] * k

    return H_D


def plane(function):
    return dvi.System(lambda t0, t1, q, p, args: function(q, p))


OSCILLATOR = dvi.System(ONE)
FREE_SYSTEM = dvi.System(FREE)
FALLING = plane(lambda q, p: p @ p / 2 + q[0])
HENON_HEILES = plane(lambda q, p: (p @ p + q @ q) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3)
CENTRAL = dvi.System(central())
KEPLER = dvi.System(kepler)
ROTATIONS = (rotation(0, 1), rotation(1, 2), rotation(0, 2))


def first_form(q, p):
    return form(q, p, 0)


def second_form(q, p):
    return form(q, p, 1)


LINEAR_MAPS = (
    case("linear map of one oscillator", EXACT, OSCILLATOR, box(1, 60),
        (flow(first_form), scaling()), 1, (2,), time=False),
    case("linear map of one oscillator, with time", EXACT, OSCILLATOR, box(1, 60),
        (time_translation(), flow(first_form), scaling()), 2, (3,)),
    case("linear map of one oscillator, quadratic vector fields", EXACT, OSCILLATOR, box(1, 60),
        (flow(first_form), scaling()), 1, (2,), dvi.Polynomials(2), time=False),
    case("linear map of one oscillator, cubic vector fields", EXACT, OSCILLATOR, box(1, 80),
        (flow(first_form), scaling()), 1, (4,), dvi.Polynomials(3), time=False),
    case("linear map of two equal oscillators", EXACT, dvi.System(TWO), box(2, 80),
        (flow(first_form), flow(second_form), rotation(0, 1), scaling()), 3, (8,),
        time=False),
    case("linear map of frequencies 1 and √2", EXACT, dvi.System(oscillators(1, 2)), box(2, 80),
        (flow(first_form), flow(lambda q, p: form(q, p, 1, 2)), only(0, 2), only(1, 2)), 2, (4,),
        time=False),
    case("linear map of frequencies 1, 1 and √2", EXACT, dvi.System(oscillators(1, 1, 2)),
        box(3, 80), (flow(first_form), flow(second_form), rotation(0, 1),
                     flow(lambda q, p: form(q, p, 2, 2)), only(2, 3), scaling()), 4, (10,),
        time=False),
    case("linear map of frequencies 1 and 1.0005", EXACT, dvi.System(oscillators(1, 1.001)),
        box(2, 80), (flow(first_form), flow(lambda q, p: form(q, p, 1, 1.001)), only(0, 2),
                     only(1, 2)), 2, (4,), time=False),
    case("linear map over a hill", EXACT, plane(lambda q, p: (p @ p - q @ q) / 2), box(1, 60),
        (flow(lambda q, p: p[0] * p[0] - q[0] * q[0] + H * q[0] * p[0]), scaling()), 1, (2,),
        time=False),
    case("free particle on a line", EXACT, FREE_SYSTEM, timed(box(1, 60)),
        (time_translation(), space_translation([1.0]), boost([1.0]), scaling(0.5, -0.5, 1.0)), 4,
        (7,), affine(True, 1)),
    case("free particle on a line, without time", EXACT, FREE_SYSTEM, box(1, 60),
        (space_translation([1.0]), scaling()), 1, (3,), time=False),
    case("falling particle, without time", EXACT, FALLING, timed(box(1, 60)),
        (space_translation([1.0]), boost([1.0])), 2, (3,), affine(True, 1), time=False),
)  # fmt: skip


def springs(n, quartic=0.25, outer=0.0):
    """Bodies of mass 1, 2, …, with central quartic forces between them, and an outer spring."""

    def H_D(t0, t1, q, p, args):
        kinetic = sum((p[i] * p[i]).sum() / (2 * (i + 1)) for i in range(n))
        pairs = [((q[i] - q[j]) ** 2).sum() for i in range(n) for j in range(i)]
        return kinetic + sum(r + quartic * r * r for r in pairs) + outer * (q * q).sum()

    return dvi.System(H_D)


def of_centre(linear):
    """The generator that acts as a linear map on the centre of mass, and on it only."""

    def masses(q):
        return 1.0 + np.arange(len(q))[:, None]

    def xi(t, q, p, args):
        return linear((masses(q) * q).sum(0) / masses(q).sum())[None] + 0 * q

    def eta(t, q, p, args):
        return linear(p.sum(0))[None] * masses(q) / masses(q).sum()

    return Generator(xi=xi, eta=eta)


def turned(x):
    return vector(-x[1], x[0])


PAIR = springs(2)
TRIPLE = springs(3)
CYCLIC = plane(lambda q, p: p[0] ** 2 * (1 + q[1] ** 2) / 2 + p[1] ** 2 / 2 + q[1] ** 4 / 4)
PENDULUM = plane(lambda q, p: p @ p / 2 - cos(q[0]))
INVERSE_SQUARE = plane(lambda q, p: p @ p / 2 + 0.5 / (q @ q))
QUARTIC_WELL = plane(lambda q, p: p @ p / 2 + q[0] ** 4 / 4)


def near_and_far(rng):
    """Positions of which one in 20 is within 0.01 of the origin."""
    q, p = shell(2, 150)(rng)
    return np.where(np.arange(150)[:, None] % 20 == 0, 3e-3, 1.0) * q, p


def with_outliers(rng):
    q, p = box(2, 100)(rng)
    size = np.where(np.arange(100)[:, None] % 20 == 0, 10.0, 1.0)
    return q * size, p * size


def about(centre, count):
    return lambda rng: (centre + rng.uniform(-1, 1, (count, 2)), rng.uniform(-1, 1, (count, 2)))


def around(centre):
    """The rotation about (centre, centre)."""
    return rotation(0, 1) + centre * space_translation([1.0, -1.0])


EARTH = plane(lambda q, p: p @ p / 2 - 398600.4418 * (q @ q) ** -0.5)


def orbits_in_km(rng):
    q, p = shell(2, 120)(rng)
    return 7000 * q, 7 * p


NONLINEAR = (
    case("central force, with time", EXACT, CENTRAL, box(2, 80),
        (time_translation(), rotation(0, 1)), 2, (2,)),
    case("rotations of a central force in space", EXACT, CENTRAL, box(3, 100), ROTATIONS, 3, (3,),
        time=False),
    case("central force, few samples", EXACT, CENTRAL, box(2, 14), (rotation(0, 1),), 1, (1,),
        time=False),
    case("central force, 5 % outliers", EXACT, CENTRAL, with_outliers, (rotation(0, 1),), 1, (1,),
        time=False),
    case("central force about (3, 3)", EXACT, dvi.System(central(offset=3.0)), about(3.0, 80),
        (around(3.0),), 1, (1,), time=False),
    case("central force about (1000, 1000)", EXACT, dvi.System(central(offset=1000.0)),
        about(1000.0, 80), (around(1000.0),), 1, (1,), time=False),
    case("cyclic coordinate", EXACT, CYCLIC, box(2, 80), (space_translation([1.0, 0.0]),), 1,
        (2,), time=False),
    case("quartic well: scaling of the time", EXACT, QUARTIC_WELL, timed(box(1, 80)),
        (time_translation(), scaling(1.0, 2.0, -1.0)), 1, (2,), affine(True, 1)),
    case("Kepler's third law", EXACT, KEPLER, timed(shell(2, 120)),
        (time_translation(), rotation(0, 1), scaling(1.0, -0.5, 1.5)), 2, (3,), affine(True, 2)),
    case("Kepler, samples close to the centre", EXACT, KEPLER, near_and_far, (rotation(0, 1),), 1,
        (1,), time=False),
    case("orbits of the Earth in km and s", EXACT, EARTH, orbits_in_km, (rotation(0, 1),), 1,
        (1,), time=False, h=10.0),
    case("inverse square potential: scaling is variational", EXACT, INVERSE_SQUARE,
        timed(shell(2, 120)), (time_translation(), rotation(0, 1), scaling(0.5, -0.5, 1.0)), 3,
        (3,), affine(True, 2)),
    case("two bodies in the plane", EXACT, PAIR, bodies(2, 2, 80),
        (space_translation([1.0, 0.0]), space_translation([0.0, 1.0]), rotation(0, 1),
         of_centre(turned), of_centre(lambda x: x)), 4, (11,), time=False),
    case("two bodies on a line, with boosts", EXACT, PAIR, timed(bodies(2, 1, 80)),
        (space_translation([1.0]), boost([1.0], [1.0, 2.0])), 2, (4,), affine(True, 2),
        time=False),
    case("three bodies on a line", EXACT, TRIPLE, bodies(3, 1, 80),
        (space_translation([1.0]), of_centre(lambda x: x)), 1, (3,), time=False),
    case("Hénon–Heiles, with time", EXACT, HENON_HEILES, box(2, 80), (time_translation(),), 1,
        (1,)),
    case("pendulum in affine vector fields", EXACT, PENDULUM, box(1, 60), (time_translation(),),
        1, (1,)),
)  # fmt: skip

DRIVEN = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + q[0] ** 4 / 4 - q[0] * cos(t0))

NO_SYMMETRY = (
    case("central force with an axis stiffer by 1e-3", BROKEN, dvi.System(central(1e-3)),
        box(2, 80), (), 0, (0,), time=False),
    case("central force with an axis stiffer by 1e-6", BROKEN, dvi.System(central(1e-6)),
        box(2, 80), (), 0, (0,), time=False),
    case("two bodies and an outer spring", BROKEN, springs(2, outer=0.5), bodies(2, 2, 80),
        (rotation(0, 1),), 1, (1,), time=False),
    case("two bodies and an outer spring of 1e-6", BROKEN, springs(2, outer=1e-6),
        bodies(2, 2, 80), (rotation(0, 1),), 1, (1,), time=False),
    case("Hénon–Heiles, quadratic vector fields", BROKEN, HENON_HEILES, box(2, 80), (), 0, (0,),
        dvi.Polynomials(2), time=False),
    case("Hénon–Heiles, 5 % outliers", BROKEN, HENON_HEILES, with_outliers, (), 0, (0,),
        time=False),
    case("oscillator with a quartic term of 1e-6", BROKEN,
        plane(lambda q, p: (p @ p + q @ q) / 2 + 1e-6 * q[0] ** 4), box(1, 60), (), 0, (0,),
        time=False),
    case("quartic well, without scaling of the time", BROKEN, QUARTIC_WELL, box(1, 60), (), 0,
        (0,), time=False),
    case("drive: no translation of the time", BROKEN,
        DRIVEN, timed(box(1, 60)), (), 0, (0,)),
)  # fmt: skip

SWAPPED = Generator(xi=lambda t, q, p, args: q[::-1], eta=lambda t, q, p, args: p[::-1])

FIRST_ORDER = (
    case("central perturbation", FIRST, perturbed(lambda q, p: q @ q, central()), box(2, 80),
        (rotation(0, 1),), 1, (1, 1), order=1, time=False),
    case("perturbation of one axis", FIRST, perturbed(lambda q, p: q[0] ** 2, central()),
        box(2, 80), (), 0, (1, 0), order=1, time=False),
    case("perturbation of one axis by 1e-12", FIRST,
        perturbed(lambda q, p: 1e-12 * q[0] ** 2, central()), box(2, 80), (), 0, (1, 0), order=1,
        time=False),
    case("spring of one oscillator, order 2", FIRST, forced(lambda q, p: -q), box(1, 60),
        (flow(first_form), scaling()), 1, (2, 2, 2), order=2, time=False),
    case("friction of one oscillator", FIRST, forced(lambda q, p: -p), box(1, 60),
        (flow(first_form), scaling()), 0, (2, 2), order=1, time=False),
    case("cubic force on one oscillator, affine vector fields", FIRST,
        forced(lambda q, p: -(q**3)), box(1, 60), (), 0, (2, 0), order=1, time=False),
    case("cubic force on one oscillator, cubic vector fields", FIRST,
        forced(lambda q, p: -(q**3)), box(1, 100), (flow(first_form),), 1, (4, 1), order=1,
        basis=dvi.Polynomials(3), time=False),
    case("friction under a central force", FIRST, forced(lambda q, p: -p, central()), box(2, 80),
        (rotation(0, 1),), 0, (1, 1), order=1, time=False),
    case("friction and translations", FIRST, forced(lambda q, p: -p, PAIR.H_D),
        bodies(2, 1, 80), (space_translation([1.0]), of_centre(lambda x: x)), 0, (3, 3), order=1,
        time=False),
    case("two equal oscillators, coupled by q1q2", FIRST, perturbed(lambda q, p: q[0] * q[1]),
        box(2, 80), (flow(total), flow(mixed), scaling(), SWAPPED), 2, (8, 4), order=1, time=False),
)  # fmt: skip

SYMMETRIES = (*LINEAR_MAPS, *NONLINEAR, *NO_SYMMETRY, *FIRST_ORDER)


def gauge(name, system, generators, basis, samples, closes, source, **more):
    return GaugeCase(name, "gauges", source, system, generators, basis, samples, closes, **more)


TRIVIAL = "on the solutions −ξ·p is a gauge of every generator with ξ0 = 0"
NONE = Generator()

GAUGES = (
    gauge("rotation under a central force", CENTRAL, (rotation(0, 1),), dvi.Polynomials(1),
        box(2, 60), (True,), "H_D is the same for rotated states: G = 0"),
    gauge("rotation, Hénon–Heiles, linear gauges", HENON_HEILES, (rotation(0, 1),),
        dvi.Polynomials(1), box(2, 60), (False,), "the torque is a cubic polynomial"),
    gauge("rotation, Hénon–Heiles, quadratic gauges", HENON_HEILES, (rotation(0, 1),),
        dvi.Polynomials(2), box(2, 60), (True,), TRIVIAL),
    gauge("boost of a free particle, gauge q", FREE_SYSTEM, (boost([1.0]),),
        dvi.Polynomials(1, "q"), timed(box(1, 40)), (True,), "N = p·v/h (h − h) − …: G = −q"),
    gauge("boost of a free particle, gauge p", FREE_SYSTEM, (boost([1.0]),),
        dvi.Polynomials(1, "p"), timed(box(1, 40)), (False,), "p is conserved, and N is −v·p"),
    gauge("time under Kepler's force", KEPLER, (time_translation(),), dvi.Polynomials(1),
        shell(2, 60), (True,), "H_D does not depend on the time: G = 0"),
    gauge("time under a drive", DRIVEN, (time_translation(),), dvi.Polynomials(2),
        timed(box(1, 60)), (False,), "the power of the drive depends on the time"),
    gauge("translation in a uniform field, gauge t", FALLING, (space_translation([1.0]),),
        dvi.Polynomials(1, "t"), timed(box(1, 40)), (True,), "the force is constant: G = t"),
    gauge("translation in a uniform field, gauge q", FALLING, (space_translation([1.0]),),
        dvi.Polynomials(1, "q"), timed(box(1, 40)), (False,), "q does not grow as t"),
    gauge("scaling of an oscillator, linear gauges", OSCILLATOR, (scaling(),), dvi.Polynomials(1),
        box(1, 60), (False,), "it doubles the action, which is quadratic"),
    gauge("scaling of an oscillator, quadratic gauges", OSCILLATOR, (scaling(),),
        dvi.Polynomials(2), box(1, 60), (True,), TRIVIAL),
    gauge("flow of the form of an oscillator", OSCILLATOR, (flow(first_form),),
        dvi.Polynomials(2), box(1, 60), (True,), "G = K − ξ·p"),
    gauge("rotation and a central perturbation",
        perturbed(lambda q, p: (q @ q) ** 2, central()), (rotation(0, 1), NONE),
        dvi.Polynomials(1), box(2, 60), (True, True), "H1_D is the same for rotated states"),
    gauge("rotation and a perturbation of one axis",
        perturbed(lambda q, p: q[0] ** 2, central()), (rotation(0, 1), NONE),
        dvi.Polynomials(1), box(2, 60), (True, False), "the torque is −2 q1q2, not a difference"),
    gauge("rotation and friction, linear gauges", forced(lambda q, p: -p, central()),
        (rotation(0, 1), NONE), dvi.Polynomials(1), box(2, 60), (True, False),
        "the torque of friction is −L, which does not change at ε = 0"),
    gauge("rotation and friction, quadratic gauges", forced(lambda q, p: -p, central()),
        (rotation(0, 1), NONE), dvi.Polynomials(2), box(2, 60), (True, True), TRIVIAL),
    gauge("time and a perturbation of an oscillator",
        perturbed(lambda q, p: q[0] ** 2 / 2, ONE), (time_translation(), NONE),
        dvi.Polynomials(2), box(1, 60), (True, True), "H_D + ε H1_D does not depend on the time"),
    gauge("time and a spring as a force", forced(lambda q, p: -q), (time_translation(), NONE),
        dvi.Polynomials(2), box(1, 60), (True, False),
        "the work −q0 (q1 − q0) is a difference less (q1 − q0)²/2, whose mean is not zero; the "
        "form, which may be added to G_0, is conserved at order 1"),
    gauge("time and friction", forced(lambda q, p: -p), (time_translation(), NONE),
        dvi.Polynomials(2), box(1, 60), (True, True),
        "the mean power of friction is balanced by the decay of a multiple of the form in G_0"),
)  # fmt: skip

CASES = (*SYMMETRIES, *GAUGES)
