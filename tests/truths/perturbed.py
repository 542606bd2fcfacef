"""Perturbed systems with known normal forms: leading-order terms with an invariant of order z.

All maps are of type II with the step `H` = 0.1, unless a case says otherwise. Formulas have only
functions that `exact_series` evaluates too: its `Count` confirms `truth` and `survivors`.
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import numpy as np

from . import case, named
from .maps import *

H = 0.1


def form(i, square=1.0, h=H):
    """The quadratic form that the map of oscillator i conserves: p² + ω²q² − hω²qp."""
    return f"(p{i}*p{i} + {square}*q{i}*q{i} - {h * square}*q{i}*p{i})"


def oscillators(*squares):
    """H_D of oscillators with these squares of the frequencies."""
    terms = (f"{k}*q{i}*q{i}" for i, k in enumerate(squares, 1))
    return f"(p @ p + {' + '.join(terms)}) / 2"


ONE, TWO, UNEQUAL = oscillators(1), oscillators(1, 1), oscillators(1, 2)
"""H_D of one oscillator, of two of the same frequency, and of two of frequencies 1 and √2."""
FREE, HILL = "(p @ p) / 2", "(p @ p - q @ q) / 2"
TUNED, DETUNED = oscillators(1, 3.99), oscillators(1, 4)
"""H_D whose map has angles of rotation per step with the ratio 1:2 exactly, ω2² = 4 − h²; and that
with frequencies 1 and 2, whose map detunes them by O(h²)."""
KEPLER = "(p @ p) / 2 - (q @ q)**-0.5"
IN_A_FIELD = "((p1 + q2/2)**2 + (p2 - q1/2)**2) / 2"
"""H_D of a charge in a uniform magnetic field."""


def forced(force, H_D=ONE):
    """A system with the force W(q, p), by default on one oscillator."""
    return system(H_D, force)


def perturbed(perturbation, H_D=TWO):
    """A system with the perturbation H1_D(q, p), by default of two oscillators."""
    return system(H_D, perturbation=perturbation)


ACTION, SECOND, FAST = form(1), form(2), form(2, 2)
TOTAL = f"{form(1)} + {form(2)}"
MIXED = f"p1*p2 + q1*q2 - {H / 2}*(q1*p2 + q2*p1)"
"""The invariant of two equal oscillators that is bilinear in them."""
TUNED_ACTION = f"{form(1)} + {form(2, 3.99)} / 0.995"
"""I1 + 2 I2 of the map `TUNED`, whose actions are h form/(2 sin θ): sin 2θ = 2 sin θ cos θ,
cos θ = 1 − h²/2 = 0.995."""
OVER_THE_HILL = f"p1*p1 - q1*q1 + {H}*q1*p1"
IN_WELL = "p1**2"

CUBIC, SPRING, FRICTION = forced("-q**3"), forced("-q"), forced("-p")
VAN_DER_POL = forced("(1 - q**2) * p")
MCMILLAN = "p @ p / 2 + q @ q - 0.7 * log(1 + q @ q)"
OF_MCMILLAN = "(q1*(q1 - p1))**2 + q1*q1 + (q1 - p1)*(q1 - p1) - 1.4*q1*(q1 - p1)"
"""x²y² + x² + y² − 2(μ + ε)xy, x = q, y = q − p, is conserved at every ε."""
ATOMIC = system("(p @ p) / 2e-26 + (q @ q) / 2", "-1e20 * q**3")
ABOUT_3 = system("(p @ p + (q - 3) @ (q - 3)) / 2", "-(q - 3)**3")


def one(system, degree, order, survivors, *truth, samples=None, **more):
    """A case of one degree of freedom in polynomials, which conserves the action or `truth`."""
    truth = truth or (ACTION,) * (survivors[-1] > 0)
    samples = samples or box(1, 200)
    return case((system, poly(degree), samples), truth, order=order, survivors=survivors, **more)


def two(system, degree, order, survivors, *truth):
    """A case of two degrees of freedom in polynomials."""
    return one(
        system, degree, order, survivors, *truth, samples=box(2, {2: 60, 3: 100, 4: 200}[degree])
    )


ANGLE = float(np.arccos(1 - H**2 / 2))
"""Of rotation in a step of the map of the oscillator."""
EIGEN = float(np.sin(ANGLE) / H)
"""p − hq/2 + i EIGEN q turns by `ANGLE` in each step."""
RATE = ANGLE / H
FORMS = functions("q @ q", "q @ p", "p @ p", complexity=2)
LINES = poly(1, ("q", "p"), constant=True)


def driven(force):
    """One oscillator with the force W(t, q, p)."""
    return system(ONE, force)


def waves(rate, count=1):
    return trig(count, "t", period=2 * np.pi / rate, constant=True)


def turned(part, rate, power=1):
    """The real or imaginary part of ((p − hq/2 + i EIGEN q) e^{−i rate t})^power."""
    x, y = f"(p1 - {H / 2}*q1)", f"({EIGEN}*q1)"
    if power == 2:
        x, y = f"({x}*{x} - {y}*{y})", f"(2*{x}*{y})"
    c, s = f"cos({power * rate}*t)", f"sin({power * rate}*t)"
    return f"{x}*{c} + {y}*{s}" if part == "real" else f"{y}*{c} - {x}*{s}"


def at_times(system, basis, order, survivors, *truth, times=40.0, **more):
    """A case of one oscillator with samples at random times."""
    return case(
        (system, basis, timed(box(1, 200), 0.0, times)),
        truth,
        order=order,
        survivors=survivors,
        **more,
    )


SIGMA = "(1 + t/4)"
"""20 tan(θ/2), θ the angle of rotation in a step of the slow oscillator: 1 + τ/4."""
SQUARE = f"({SIGMA}**2 / (1 + {SIGMA}**2 / 400))"
"""ω², so that 2 − h²ω² = 2 cos θ."""
SLOW_H = f"(p @ p) / 2 + {SQUARE} * (q @ q) / 2"
SLOW_OSCILLATOR = system(SLOW_H, slow_time=True)
SLOW_ACTION = f"(1/{SIGMA} + {SIGMA}/400) * p1*p1 + {SIGMA} * (q1*q1 - {H}*q1*p1)"
"""The discrete action h form/(2 sin θ), up to a factor."""


def slowly(force):
    return system(ONE, force, slow_time=True)


def powers(*exponents):
    return functions(*(f"{SIGMA}**{k}" for k in exponents))


def taus(degree):
    return poly(degree, "τ", constant=True)


def angles(n):
    """Angles all around, momenta from 0.5 to 2.5."""
    return lambda rng: (rng.uniform(0, 2 * np.pi, (150, n)), rng.uniform(0.5, 2.5, (150, n)))


def between(n, count, inner=0.8, outer=2.0):
    """Positions at a distance between two radii from the origin."""

    def draw(rng):
        direction = rng.normal(size=(count, n))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return direction * rng.uniform(inner, outer, (count, 1)), rng.uniform(-1, 1, (count, n))

    return draw


def search(system, basis, samples, order, survivors, *truth, **more):
    return case((system, basis, samples), truth, order=order, survivors=survivors, **more)


PENDULUM = perturbed("cos(q1)", FREE)
SMALL_DENOMINATORS = functions("cos(q1 - p1/2) / sin(p1/2)", "sin(q1 - p1/2) / sin(p1/2)")
ROTORS = perturbed("cos(q1 - q2)", FREE)
ONE_WITH_FRICTION = system(FREE, "vector(-p1, 0 * p2)", "cos(q1 - q2)")
DIFFERENCE = functions("cos(q1 - q2)", "sin(q1 - q2)")
OBLATE = perturbed("(q @ q)**-1.5 * (3 * q3**2 / (q @ q) - 1) / 2", KEPLER)

_KEPT = {
    "cubic spring, order 1": one(CUBIC, 4, 1, (2, 1), exact=False),
    "cubic spring, order 2": one(CUBIC, 6, 2, (3, 2, 1), exact=False),
    "cubic spring, order 3": one(CUBIC, 8, 3, (4, 3, 2, 1), exact=False),
    "cubic spring, simplest corrections": one(CUBIC, 6, 2, (3, 2, 1), exact=False,
        representative="simplest"),
    "cubic spring with 5 % outliers": one(CUBIC, 4, 1, (2, 1), exact=False,
        samples=with_outliers(box(1, 200), 100.0)),
    "cubic spring, few samples": one(CUBIC, 4, 1, (2, 1), exact=False, samples=box(1, 30)),
    "cubic spring as a perturbation of H_D": one(perturbed("q1**4 / 4", ONE), 4, 1, (2, 1),
        exact=False),
    **{f"cubic spring of strength {s}": one(forced(f"-{s} * q**3"), 4, 1, (2, 1), exact=False)
        for s in ("1e-15", "1e15")},
    "quadratic force, order 2": one(forced("-(q**2)"), 4, 2, (2, 1, 1)),
    "force of fifth degree": one(forced("-(q**5)"), 6, 1, (3, 1)),
    "harmonic perturbation, order 3": one(SPRING, 4, 3, (2, 2, 2, 2), exact=True),
    **{f"harmonic perturbation of strength {s}": one(forced(f"-{s} * q"), 2, 1, (1, 1), exact=True,
        epsilon=epsilon) for s, epsilon in (("1e-15", 1e15), ("1e15", 1e-15))},
    "constant force": one(forced("q**0"), 4, 2, (2, 2, 2), exact=True),
    "quadratic drag, order 1": one(forced("p**2"), 3, 1, (1, 1)),
    "force q p, order 2": one(forced("q * p"), 4, 2, (2, 1, 1)),
    "cubic spring in atomic SI units": one(ATOMIC, 4, 1, (2, 1),
        "p @ p * 1e26 + q @ q - 1e12 * (q @ p)", samples=sized(1, 200, 1e-10, 1e-23), h=1e-14,
        exact=False),
    **{f"cubic spring, {name}": one(CUBIC, 4, 1, (2, 1), form(1, 1.0, h), h=h, exact=False)
        for name, h in (("h = 1", 1.0), ("h = 1e-4", 1e-4), ("backwards in time", -0.1))},
    "cubic spring, samples of size 1e-6": one(CUBIC, 4, 1, (2, 1), exact=False,
        samples=box(1, 200, -1e-6, 1e-6)),
    "cubic spring about q = 3": one(ABOUT_3, 4, 1, (2, 1),
        f"p1*p1 + (q1 - 3)*(q1 - 3) - {H}*(q1 - 3)*p1", samples=moved(box(1, 200), q=3.0),
        exact=False),
    "double well about its hill, order 2": one(forced("-q**3", HILL), 6, 2, (3, 2, 1),
        OVER_THE_HILL),
    "free particle in a weak harmonic well": one(forced("-q", FREE), 2, 2, (2, 1, 1), IN_WELL,
        exact=True),
    "free particle in a weak quartic well": one(forced("-q**3", FREE), 4, 1, (4, 1), IN_WELL),
    "free particle with friction, where p + εq is conserved": one(forced("-p", FREE), 3, 2,
        (3, 3, 3), "p1", exact=True),
    "falling particle in a weak harmonic well": one(forced("-q", "(p @ p) / 2 + sum(q)"), 4, 2,
        (2, 2, 2), f"p1**2 / 2 + q1 - {H / 2} * p1"),
    "McMillan's map with another μ": search(forced("2 * q / (1 + q**2)", MCMILLAN), poly(4),
        box(1, 150), 2, (1, 1, 1), OF_MCMILLAN, h=1.0, exact=True),
    "frequencies 1 and √2, coupling q1²q2": two(perturbed("q1**2 * q2", UNEQUAL), 3, 1, (2, 2),
        ACTION, FAST),
    "frequencies 1 and √2, coupling q1²q2²": two(perturbed("q1**2 * q2**2", UNEQUAL), 4, 1, (5, 2),
        ACTION, FAST),
    "frequencies 1 and √2, coupling q1q2": two(perturbed("q1*q2", UNEQUAL), 2, 2, (2, 2, 2), ACTION,
        FAST),
    "frequencies 1 and √2, coupling q1q2, with powers of the actions": two(perturbed("q1*q2",
        UNEQUAL), 4, 1, (5, 5), ACTION, FAST),
    "a spring and a friction": two(forced("vector(-q1, -p2)", UNEQUAL), 2, 2, (2, 1, 1), ACTION),
    "drive off resonance": at_times(driven("cos(2.3 * t) + 0 * q"), FORMS + LINES * waves(2.3, 2),
        2, (1, 1, 1), ACTION, exact=True),
    "drive off resonance, late times": at_times(driven("cos(2.3 * t) + 0 * q"),
        FORMS + LINES * waves(2.3), 1, (1, 1), ACTION, times=1e4),
    "frequency modulated off resonance": at_times(driven("-cos(2.7 * t) * q"), FORMS * waves(2.7),
        1, (1, 1), ACTION),
    "friction whose sign alternates": at_times(driven("sin(1.3 * t) * p"), FORMS * waves(1.3), 1,
        (1, 1), ACTION),
    "kicked rotor, basis with the small denominators": search(PENDULUM,
        poly(1, "p") + SMALL_DENOMINATORS, angles(1), 1, (1, 1), "p1", h=1.0, exact=False),
    "two coupled rotors": search(ROTORS, poly(2, MOMENTA) + DIFFERENCE * poly(1, MOMENTA,
        constant=True), angles(2), 2, (5, 2, 2), "p1 + p2", h=1.0, exact=True),
    "Kepler, perturbed by 1/r³": search(perturbed("(q @ q)**-1.5", KEPLER), ENERGIES,
        between(2, 150), 2, (1, 1, 1), L, exact=True),
    "Kepler in space, perturbed by r²": search(perturbed("q @ q", KEPLER), ENERGIES,
        between(3, 150), 1, (3, 3), *ANGULAR, exact=True),
    "oblate planet, order 1": search(OBLATE, ENERGIES, between(3, 150), 1, (3, 1), L, exact=True),
    "oblate planet, order 2": search(OBLATE, poly(2), between(3, 150), 2, (3, 1, 1), L, exact=True),
}  # fmt: skip
_LOST = {
    # where the map dissipates by O(h)
    "quadratic drag, order 2, where the map dissipates by O(h)": one(forced("p**2"), 4, 2,
        (2, 1, 0)),
    "linear friction": one(FRICTION, 4, 1, (2, 0)),
    "linear friction of strength 1e-12": one(forced("-1e-12 * p"), 4, 1, (2, 0)),
    "cubic friction": one(forced("-(p**3)"), 4, 1, (2, 0)),
    "force q² p": one(forced("q**2 * p"), 6, 1, (3, 0)),
    "van der Pol, order 1": one(VAN_DER_POL, 6, 1, (3, 0)),
    "van der Pol, order 2": one(VAN_DER_POL, 6, 2, (3, 0, 0)),
    "cubic spring with weak friction": one(forced("-(q**3) - 1e-3 * p"), 6, 1, (3, 0)),
    "force of sin 50 q, which no polynomial corrects": one(forced("-vector(sin(50 * q1))"), 6, 1,
        (3, 0)),
    "cubic spring with friction of 1e-7": one(forced("-(q**3) - 1e-7 * p"), 6, 1, (3, 0)),
    "cubic spring with noise of 1e-8": one(forced("-(q**3) + 1e-8 * vector(sin(1e4 * q1))"), 6, 1,
        (3, 0)),
    "hill with friction": one(forced("-p", HILL), 4, 1, (2, 0)),
    # friction contracts areas; a level curve shrinks
    "McMillan's map with friction": search(forced("-p", MCMILLAN), poly(4), box(1, 150), 1, (1, 0),
        h=1.0),
    "a spring, and friction of the difference": two(forced("vector(p2 - p1, p1 - p2)", UNEQUAL), 2,
        1, (2, 0)),
    "friction that is modulated": at_times(driven("-(1 + sin(1.3 * t)) * p"), FORMS * waves(1.3), 1,
        (1, 0)),
    "kicked rotor, basis of waves": search(PENDULUM,
        poly(3, "p") + trig(2, "q") * poly(2, "p", True), angles(1), 1, (3, 0), h=1.0),
    "rotor with friction, basis of waves": search(forced("-p", FREE),
        poly(2, "p") + trig(2, "q") * poly(1, "p", True), angles(1), 1, (2, 0), h=1.0),
    "two coupled rotors with friction of one": search(ONE_WITH_FRICTION,
        poly(2, MOMENTA) + DIFFERENCE, angles(2), 1, (5, 0), h=1.0),
    "Kepler with friction": search(forced("-p", KEPLER), ENERGIES, between(2, 150), 1, (1, 0)),
    "Kepler in a uniform field": search(perturbed("q1", KEPLER), ENERGIES, between(2, 150), 1,
        (1, 0)),
    "magnetic field with friction": search(forced("-p", IN_A_FIELD), poly(2), box(2, 100), 1,
        (6, 0)),
}  # fmt: skip
_RESONANT = {
    "equal frequencies, a coupling without reaction": two(forced("vector(-q1, q1)", TWO), 2, 1,
        (4, 2), ACTION, f"{SECOND} + 2 * ({MIXED})"),
    "equal frequencies, coupling q1q2": two(perturbed("q1*q2"), 2, 2, (4, 2, 2), TOTAL, MIXED),
    "equal frequencies, coupling by L": two(perturbed(L), 2, 1, (4, 2), TOTAL, L),
    "equal frequencies, coupling q1²q2²": two(perturbed("q1**2 * q2**2"), 4, 1, (13, 1), TOTAL),
    "equal frequencies, central quartic force": two(perturbed("(q @ q)**2"), 4, 1, (13, 3), TOTAL,
        L),
    "equal frequencies, force of a curl": two(forced("vector(-q2, q1)", TWO), 2, 1, (4, 2), MIXED,
        f"{ACTION} - {SECOND}"),
    **{f"frequencies that differ by {name}, coupling q1q2": two(perturbed("q1*q2",
        oscillators(1, k)), 2, 1, (2, 2), ACTION, form(2, k))
        for name, k in (("5e-4", 1.001), ("5e-7", 1.000001))},
    "Hénon–Heiles, order 1": two(perturbed("q1**2 * q2 - q2**3 / 3"), 3, 1, (4, 4), ACTION, SECOND,
        L),
    "Hénon–Heiles, order 2": two(perturbed("q1**2 * q2 - q2**3 / 3"), 4, 2, (13, 4, 2), TOTAL, L),
    "frequencies 1 and 2 of the flow, detuned by the step": two(perturbed("q1**2 * q2", DETUNED), 3,
        1, (2, 2), ACTION, form(2, 4)),
    "angles 1:2 of the map, coupling q1²q2": two(perturbed("q1**2 * q2", TUNED), 3, 1, (4, 1),
        TUNED_ACTION),
    "drive on the resonance of the map": at_times(driven(f"cos({RATE} * t) + 0 * q"),
        FORMS + LINES * waves(RATE, 2), 1, (3, 1), turned("imaginary", RATE)),
    "drive on the resonance of the map, with t in the basis": at_times(
        driven(f"cos({RATE} * t) + 0 * q"), functions("t") + LINES * waves(RATE, 2), 1, (2, 2),
        turned("imaginary", RATE), turned("real", RATE), times=20.0),
    **{f"drive on the resonance of the flow{name}": at_times(driven("cos(t) + 0 * q"),
        FORMS + LINES * waves(1.0), 1, (1, 1), ACTION, times=times)
        for name, times in ((", which the step detunes, late times", 400.0),
        (", early times", 40.0))},
    "frequency modulated at twice the frequency": at_times(driven(f"-cos({2 * RATE} * t) * q"),
        FORMS * waves(2 * RATE, 2), 1, (3, 1), turned("real", RATE, 2)),
    "magnetic field and a weak electric one": search(perturbed("q1", IN_A_FIELD), poly(2),
        box(2, 100), 1, (6, 3), "p2 + q1/2", IN_A_FIELD),
    "magnetic field and a weak harmonic well": search(perturbed("q @ q", IN_A_FIELD), poly(2),
        box(2, 100), 1, (6, 2), L, IN_A_FIELD),
}  # fmt: skip
_SLOW = {
    "slow frequency, order 1": at_times(SLOW_OSCILLATOR, FORMS * powers(*range(-3, 4)), 1, (5, 1),
        SLOW_ACTION, times=6.0),
    "slow frequency, order 2": at_times(SLOW_OSCILLATOR, FORMS * powers(*range(-5, 6)), 2,
        (9, 1, 1), SLOW_ACTION, times=6.0),
    "slow frequency, basis without odd powers": at_times(SLOW_OSCILLATOR, FORMS * powers(-2, 0, 2),
        1, (2, 0), times=6.0),
    "slow frequency and friction": at_times(system(SLOW_H, "-p", slow_time=True),
        FORMS * powers(*range(-3, 4)), 1, (5, 0), times=6.0),
    "weak spring that grows slowly, order 1": at_times(slowly("-t * q"), FORMS * taus(2), 1, (3, 1),
        ACTION, times=3.0),
    "weak spring that grows slowly, order 2": at_times(slowly("-t * q"), FORMS * taus(3), 2,
        (4, 1, 1), ACTION, times=3.0),
    "weak friction that grows slowly": at_times(slowly("-t * p"), FORMS * taus(2), 1, (3, 0),
        times=3.0),
}  # fmt: skip
CASES = (
    *named("perturbed, conserved", _KEPT),
    *named("perturbed, lost", _LOST),
    *named("resonant", _RESONANT),
    *named("slow time", _SLOW),
)
