"""Perturbed systems whose normal forms are known: which leading parts have an invariant of order z.

All maps are of type II with the step `H` = 0.1, unless a case says otherwise. Functions are written
so that `exact_series` can evaluate them too: its `Count` confirms `truth` and `survivors`.
"""

import numpy as np
from exact_series import cos, log, sin, vector

import dvi_jax as dvi

from . import Case

H = 0.1


def box(n, count, low=-1.0, high=1.0):
    """Uniform samples in a box of 2n dimensions."""
    return lambda rng: (rng.uniform(low, high, (count, n)), rng.uniform(low, high, (count, n)))


def timed(n, count, times):
    """Uniform samples in a box of 2n dimensions, at times between 0 and `times`."""
    return lambda rng: (*box(n, count)(rng), rng.uniform(0.0, times, count))


def outliers(n, count, factor=100.0):
    """Like `box`, but one sample in 20 is `factor` times as large."""

    def draw(rng):
        q, p = box(n, count)(rng)
        size = np.where(np.arange(count) % 20 == 0, factor, 1.0)[:, None]
        return q * size, p * size

    return draw


def oscillators(*squares):
    """H_D of oscillators with these squares of the frequencies."""
    k = np.array(squares)
    return lambda t0, t1, q, p, args: (p @ p + (k * q) @ q) / 2


def form(q, p, i, square=1.0, h=H):
    """The quadratic form that the map of oscillator i conserves: p² + ω²q² − hω²qp."""
    return p[i] * p[i] + square * q[i] * q[i] - h * square * q[i] * p[i]


ONE, TWO = oscillators(1), oscillators(1, 1)
"""H_D of one oscillator, and of two of the same frequency."""


def forced(function, H_D=ONE):
    """A System with the force W(q, p), by default on one oscillator."""
    return dvi.System(H_D, force=lambda t0, t1, q, p, args: function(q, p))


def perturbed(function, H_D=TWO):
    """A System with the perturbation H1_D(q, p), by default of two oscillators."""
    return dvi.System(H_D, perturbation=lambda t0, t1, q, p, args: function(q, p))


def action(q, p):
    return form(q, p, 0)


def second_action(q, p):
    return form(q, p, 1)


def total(q, p):
    return form(q, p, 0) + form(q, p, 1)


def angular_momentum(q, p):
    return q[0] * p[1] - q[1] * p[0]


def mixed(q, p):
    """The invariant of two equal oscillators that is bilinear in them."""
    return p[0] * p[1] + q[0] * q[1] - H / 2 * (q[0] * p[1] + q[1] * p[0])


CUBIC = forced(lambda q, p: -(q**3))
SPRING = forced(lambda q, p: -q)
FRICTION = forced(lambda q, p: -p)
HENON_HEILES = perturbed(lambda q, p: q[0] ** 2 * q[1] - q[1] ** 3 / 3)
NORMAL_FORM = "normal form theory; counted by exact arithmetic modulo a prime (exact_series)"
KEPT, LOST, RESONANT, SLOW = (
    "perturbed, conserved",
    "perturbed, lost",
    "resonant",
    "slow time",
)


def one(name, kind, system, degree, order, survivors, truth=(action,), **more):
    """A case of one degree of freedom in polynomials."""
    more = {"samples": box(1, 200), "source": NORMAL_FORM, "h": H} | more
    basis = dvi.Polynomials(degree)
    return Case(name, kind, system=system, basis=basis, order=order, truth=truth,
                survivors=survivors, **more)  # fmt: skip


def two(name, kind, system, degree, order, survivors, truth, **more):
    """A case of two degrees of freedom in polynomials."""
    more = {"samples": box(2, {2: 60, 3: 100, 4: 200}[degree])} | more
    return one(name, kind, system, degree, order, survivors, truth, **more)


OSCILLATORS = (
    one("cubic spring, order 1", KEPT, CUBIC, 4, 1, (2, 1), exact=False),
    one("cubic spring, order 2", KEPT, CUBIC, 6, 2, (3, 2, 1), exact=False),
    one("cubic spring, order 3", KEPT, CUBIC, 8, 3, (4, 3, 2, 1), exact=False),
    one("cubic spring, simplest corrections", KEPT, CUBIC, 6, 2, (3, 2, 1), exact=False,
        options={"representative": "simplest"}),
    one("cubic spring with 5 % outliers", KEPT, CUBIC, 4, 1, (2, 1), exact=False,
        samples=outliers(1, 200)),
    one("cubic spring, few samples", KEPT, CUBIC, 4, 1, (2, 1), exact=False, samples=box(1, 30)),
    one("cubic spring as a perturbation of H_D", KEPT, perturbed(lambda q, p: q[0] ** 4 / 4, ONE),
        4, 1, (2, 1), exact=False),
    one("cubic spring of strength 1e-15", KEPT, forced(lambda q, p: -1e-15 * q**3), 4, 1, (2, 1),
        exact=False),
    one("cubic spring of strength 1e15", KEPT, forced(lambda q, p: -1e15 * q**3), 4, 1, (2, 1),
        exact=False),
    one("quadratic force, order 2", KEPT, forced(lambda q, p: -(q**2)), 4, 2, (2, 1, 1)),
    one("force of fifth degree", KEPT, forced(lambda q, p: -(q**5)), 6, 1, (3, 1)),
    one("harmonic perturbation, order 3", KEPT, SPRING, 4, 3, (2, 2, 2, 2), exact=True),
    one("harmonic perturbation of strength 1e-15", KEPT, forced(lambda q, p: -1e-15 * q), 2, 1,
        (1, 1), exact=True, epsilon=1e15),
    one("harmonic perturbation of strength 1e15", KEPT, forced(lambda q, p: -1e15 * q), 2, 1,
        (1, 1), exact=True, epsilon=1e-15),
    one("constant force", KEPT, forced(lambda q, p: q**0), 4, 2, (2, 2, 2), exact=True),
    one("quadratic drag, order 1", KEPT, forced(lambda q, p: p**2), 3, 1, (1, 1)),
    one("quadratic drag, order 2, where the map dissipates by O(h)", LOST,
        forced(lambda q, p: p**2), 4, 2, (2, 1, 0), ()),
    one("force q p, order 2", KEPT, forced(lambda q, p: q * p), 4, 2, (2, 1, 1)),
    one("linear friction", LOST, FRICTION, 4, 1, (2, 0), ()),
    one("linear friction of strength 1e-12", LOST, forced(lambda q, p: -1e-12 * p), 4, 1, (2, 0),
        ()),
    one("cubic friction", LOST, forced(lambda q, p: -(p**3)), 4, 1, (2, 0), ()),
    one("force q² p", LOST, forced(lambda q, p: q**2 * p), 6, 1, (3, 0), ()),
    one("van der Pol, order 1", LOST, forced(lambda q, p: (1 - q**2) * p), 6, 1, (3, 0), ()),
    one("van der Pol, order 2", LOST, forced(lambda q, p: (1 - q**2) * p), 6, 2, (3, 0, 0), ()),
    one("cubic spring with weak friction", LOST, forced(lambda q, p: -(q**3) - 1e-3 * p), 6, 1,
        (3, 0), ()),
    one("force of sin 50 q, which no polynomial corrects", LOST,
        forced(lambda q, p: -vector(*(sin(50 * x) for x in q))), 6, 1, (3, 0), ()),
    one("cubic spring in atomic SI units", KEPT,
        dvi.System(lambda t0, t1, q, p, args: (p @ p) / 2e-26 + (q @ q) / 2,
                   force=lambda t0, t1, q, p, args: -1e20 * q**3),
        4, 1, (2, 1), (lambda q, p: p @ p * 1e26 + q @ q - 1e12 * (q @ p),), h=1e-14, exact=False,
        samples=lambda rng: (1e-10 * rng.uniform(-1, 1, (200, 1)),
                             1e-23 * rng.uniform(-1, 1, (200, 1)))),
    one("cubic spring, h = 1", KEPT, CUBIC, 4, 1, (2, 1), (lambda q, p: form(q, p, 0, 1, 1.0),),
        h=1.0, exact=False),
    one("cubic spring, h = 1e-4", KEPT, CUBIC, 4, 1, (2, 1),
        (lambda q, p: form(q, p, 0, 1, 1e-4),), h=1e-4, exact=False),
    one("cubic spring, backwards in time", KEPT, CUBIC, 4, 1, (2, 1),
        (lambda q, p: form(q, p, 0, 1, -0.1),), h=-0.1, exact=False),
    one("cubic spring, samples of size 1e-6", KEPT, CUBIC, 4, 1, (2, 1), exact=False,
        samples=box(1, 200, -1e-6, 1e-6)),
    one("cubic spring with friction of 1e-7", LOST, forced(lambda q, p: -(q**3) - 1e-7 * p), 6, 1,
        (3, 0), ()),
    one("cubic spring with noise of 1e-8", LOST,
        forced(lambda q, p: -(q**3) + 1e-8 * vector(*(sin(1e4 * x) for x in q))), 6, 1, (3, 0),
        ()),
    one("cubic spring about q = 3", KEPT,
        dvi.System(lambda t0, t1, q, p, args: (p @ p + (q - 3) @ (q - 3)) / 2,
                   force=lambda t0, t1, q, p, args: -((q - 3) ** 3)),
        4, 1, (2, 1), (lambda q, p: action(q - 3, p),), exact=False,
        samples=lambda rng: (rng.uniform(2, 4, (200, 1)), rng.uniform(-1, 1, (200, 1)))),
)  # fmt: skip

HILL = lambda t0, t1, q, p, args: (p @ p - q @ q) / 2  # noqa: E731
FREE = lambda t0, t1, q, p, args: (p @ p) / 2  # noqa: E731


def over_the_hill(q, p):
    """Conserved by the map of the inverted oscillator."""
    return p[0] * p[0] - q[0] * q[0] + H * q[0] * p[0]


def mcmillan(q, p):
    """Conserved by McMillan's map with μ = 0.7: x²y² + x² + y² − 2μxy, x = q, y = q − p."""
    x, y = q[0], q[0] - p[0]
    return x * x * y * y + x * x + y * y - 1.4 * x * y


MCMILLAN = dvi.System(
    lambda t0, t1, q, p, args: p @ p / 2 + q @ q - 0.7 * log(1 + q @ q),
    force=lambda t0, t1, q, p, args: 2 * q / (1 + q**2),
)

OTHERS = (
    one("double well about its hill, order 2", KEPT, forced(lambda q, p: -(q**3), HILL), 6, 2,
        (3, 2, 1), (over_the_hill,)),
    one("hill with friction", LOST, forced(lambda q, p: -p, HILL), 4, 1, (2, 0), ()),
    one("free particle in a weak harmonic well", KEPT, forced(lambda q, p: -q, FREE), 2, 2,
        (2, 1, 1), (lambda q, p: p[0] ** 2,), exact=True),
    one("free particle in a weak quartic well", KEPT, forced(lambda q, p: -(q**3), FREE), 4, 1,
        (4, 1), (lambda q, p: p[0] ** 2,)),
    one("free particle with friction, where p + εq is conserved", KEPT,
        forced(lambda q, p: -p, FREE), 3, 2, (3, 3, 3), (lambda q, p: p[0],), exact=True),
    one("falling particle in a weak harmonic well", KEPT,
        forced(lambda q, p: -q, lambda t0, t1, q, p, args: (p @ p) / 2 + q.sum()), 4, 2,
        (2, 2, 2), (lambda q, p: p[0] ** 2 / 2 + q[0] - H / 2 * p[0],)),
    Case("McMillan's map with another μ", KEPT,
         "x²y² + x² + y² − 2(μ + ε)xy is conserved at every ε", MCMILLAN, dvi.Polynomials(4),
         box(1, 150), (mcmillan,), h=1.0, order=2, survivors=(1, 1, 1), exact=True),
    Case("McMillan's map with friction", LOST, "friction contracts areas; a level curve shrinks",
         dvi.System(MCMILLAN.H_D, force=lambda t0, t1, q, p, args: -p), dvi.Polynomials(4),
         box(1, 150), (), h=1.0, order=1, survivors=(1, 0)),
)  # fmt: skip

UNEQUAL = oscillators(1, 2)
"""H_D of two oscillators with frequencies 1 and √2."""


def fast_action(q, p):
    return form(q, p, 1, 2)


TUNED = oscillators(1, 3.99)
"""H_D whose map has angles of rotation per step with the ratio 1:2 exactly: ω2² = 4 − h²."""

DETUNED = oscillators(1, 4)
"""H_D with frequencies 1 and 2, whose map detunes them by O(h²)."""


def tuned_action(q, p):
    """I1 + 2 I2 of the map `TUNED`, whose actions are h form/(2 sin θ)."""
    # sin 2θ = 2 sin θ cos θ, cos θ = 1 − h²/2 = 0.995
    return form(q, p, 0) + form(q, p, 1, 3.99) / 0.995


COUPLED = (
    two("frequencies 1 and √2, coupling q1²q2", KEPT, perturbed(lambda q, p: q[0] ** 2 * q[1],
        UNEQUAL), 3, 1, (2, 2), (action, fast_action)),
    two("frequencies 1 and √2, coupling q1²q2²", KEPT,
        perturbed(lambda q, p: q[0] ** 2 * q[1] ** 2, UNEQUAL), 4, 1, (5, 2),
        (action, fast_action)),
    two("frequencies 1 and √2, coupling q1q2", KEPT, perturbed(lambda q, p: q[0] * q[1], UNEQUAL),
        2, 2, (2, 2, 2), (action, fast_action)),
    two("frequencies 1 and √2, coupling q1q2, with powers of the actions", KEPT,
        perturbed(lambda q, p: q[0] * q[1], UNEQUAL), 4, 1, (5, 5), (action, fast_action)),
    two("a spring and a friction", KEPT, forced(lambda q, p: vector(-q[0], -p[1]), UNEQUAL),
        2, 2, (2, 1, 1), (action,)),
    two("equal frequencies, a coupling without reaction", RESONANT,
        forced(lambda q, p: vector(-q[0], q[0]), TWO), 2, 1, (4, 2),
        (action, lambda q, p: second_action(q, p) + 2 * mixed(q, p))),
    two("a spring, and friction of the difference", LOST,
        forced(lambda q, p: vector(p[1] - p[0], p[0] - p[1]), UNEQUAL), 2, 1, (2, 0), ()),
    two("equal frequencies, coupling q1q2", RESONANT, perturbed(lambda q, p: q[0] * q[1]), 2, 2,
        (4, 2, 2), (total, mixed)),
    two("equal frequencies, coupling by L", RESONANT, perturbed(angular_momentum), 2, 1, (4, 2),
        (total, angular_momentum)),
    two("equal frequencies, coupling q1²q2²", RESONANT,
        perturbed(lambda q, p: q[0] ** 2 * q[1] ** 2), 4, 1, (13, 1), (total,)),
    two("equal frequencies, central quartic force", RESONANT,
        perturbed(lambda q, p: (q @ q) ** 2), 4, 1, (13, 3), (total, angular_momentum)),
    two("equal frequencies, force of a curl", RESONANT,
        forced(lambda q, p: vector(-q[1], q[0]), TWO), 2, 1, (4, 2),
        (mixed, lambda q, p: action(q, p) - second_action(q, p))),
    two("frequencies that differ by 5e-4, coupling q1q2", RESONANT,
        perturbed(lambda q, p: q[0] * q[1], oscillators(1, 1.001)), 2, 1, (2, 2),
        (action, lambda q, p: form(q, p, 1, 1.001))),
    two("frequencies that differ by 5e-7, coupling q1q2", RESONANT,
        perturbed(lambda q, p: q[0] * q[1], oscillators(1, 1.000001)), 2, 1, (2, 2),
        (action, lambda q, p: form(q, p, 1, 1.000001))),
    two("Hénon–Heiles, order 1", RESONANT, HENON_HEILES, 3, 1, (4, 4),
        (action, second_action, angular_momentum)),
    two("Hénon–Heiles, order 2", RESONANT, HENON_HEILES, 4, 2, (13, 4, 2),
        (total, angular_momentum)),
    two("frequencies 1 and 2 of the flow, detuned by the step", RESONANT,
        perturbed(lambda q, p: q[0] ** 2 * q[1], DETUNED), 3, 1, (2, 2),
        (action, lambda q, p: form(q, p, 1, 4))),
    two("angles 1:2 of the map, coupling q1²q2", RESONANT,
        perturbed(lambda q, p: q[0] ** 2 * q[1], TUNED), 3, 1, (4, 1), (tuned_action,)),
)  # fmt: skip

ANGLE = float(np.arccos(1 - H**2 / 2))
"""Of rotation in a step of the map of the oscillator."""

EIGEN = float(np.sin(ANGLE) / H)
"""p − hq/2 + i EIGEN q turns by `ANGLE` in each step."""

RATE = ANGLE / H
QUADRATICS = dvi.Basis({"q²": lambda q, p: q @ q, "q p": lambda q, p: q @ p,
                        "p²": lambda q, p: p @ p}, complexity=2)  # fmt: skip


def driven(function):
    """One oscillator with the force W(t, q, p)."""
    return dvi.System(ONE, force=lambda t0, t1, q, p, args: function(t0, q, p))


def waves(rate, count=1):
    return dvi.Trigonometric(count, "t", period=2 * np.pi / rate, constant=True)


def turned(part, rate, power=1):
    """The real or imaginary part of ((p − hq/2 + i EIGEN q) e^{−i rate t})^power."""

    def function(q, p, t):
        x, y = p[0] - H / 2 * q[0], EIGEN * q[0]
        if power == 2:
            x, y = x * x - y * y, 2 * x * y
        c, s = cos(power * rate * t), sin(power * rate * t)
        return x * c + y * s if part == "real" else y * c - x * s

    return function


LINES = dvi.Polynomials(1, ("q", "p"), constant=True)


def at_times(name, kind, system, basis, order, survivors, truth, times=40.0, **more):
    """A case of one oscillator with samples at random times."""
    return Case(name, kind, NORMAL_FORM, system, basis, timed(1, 200, times), truth, H, order,
                survivors=survivors, **more)  # fmt: skip


DRIVEN = (
    at_times("drive off resonance", KEPT, driven(lambda t, q, p: cos(2.3 * t) + 0 * q),
        QUADRATICS + LINES * waves(2.3, 2), 2, (1, 1, 1), (action,), exact=True),
    at_times("drive on the resonance of the map", RESONANT,
        driven(lambda t, q, p: cos(RATE * t) + 0 * q),
        QUADRATICS + LINES * waves(RATE, 2), 1, (3, 1), (turned("imaginary", RATE),)),
    at_times("drive on the resonance of the map, with t in the basis", RESONANT,
        driven(lambda t, q, p: cos(RATE * t) + 0 * q),
        dvi.Basis({"t": lambda q, p, t: t}) + LINES * waves(RATE, 2), 1, (2, 2),
        (turned("imaginary", RATE), turned("real", RATE)), times=20.0),
    at_times("drive on the resonance of the flow, which the step detunes, late times", RESONANT,
        driven(lambda t, q, p: cos(t) + 0 * q), QUADRATICS + LINES * waves(1.0), 1, (1, 1),
        (action,), times=400.0),
    at_times("drive on the resonance of the flow, early times", RESONANT,
        driven(lambda t, q, p: cos(t) + 0 * q), QUADRATICS + LINES * waves(1.0), 1, (1, 1),
        (action,), times=40.0),
    at_times("drive off resonance, late times", KEPT, driven(lambda t, q, p: cos(2.3 * t) + 0 * q),
        QUADRATICS + LINES * waves(2.3), 1, (1, 1), (action,), times=1e4),
    at_times("frequency modulated off resonance", KEPT, driven(lambda t, q, p: -cos(2.7 * t) * q),
        QUADRATICS * waves(2.7), 1, (1, 1), (action,)),
    at_times("frequency modulated at twice the frequency", RESONANT,
        driven(lambda t, q, p: -cos(2 * RATE * t) * q), QUADRATICS * waves(2 * RATE, 2), 1, (3, 1),
        (turned("real", RATE, 2),)),
    at_times("friction whose sign alternates", KEPT, driven(lambda t, q, p: sin(1.3 * t) * p),
        QUADRATICS * waves(1.3), 1, (1, 1), (action,)),
    at_times("friction that is modulated", LOST, driven(lambda t, q, p: -(1 + sin(1.3 * t)) * p),
        QUADRATICS * waves(1.3), 1, (1, 0), ()),
)  # fmt: skip


def sigma(t):
    """20 tan(θ/2), θ the angle of rotation in a step of the slow oscillator: 1 + τ/4."""
    return 1 + t / 4


def slow_square(t):
    """ω², so that 2 − h²ω² = 2 cos θ."""
    return sigma(t) ** 2 / (1 + sigma(t) ** 2 / 400)


SLOW_OSCILLATOR = dvi.System(
    lambda t0, t1, q, p, args: (p @ p) / 2 + slow_square(t0) * (q @ q) / 2, slow_time=True
)
SLOW_FRICTION = dvi.System(SLOW_OSCILLATOR.H_D, force=lambda t0, t1, q, p, args: -p, slow_time=True)
SLOW_SPRING = dvi.System(ONE, force=lambda t0, t1, q, p, args: -t0 * q, slow_time=True)
SLOW_FRICTION_ALONE = dvi.System(ONE, force=lambda t0, t1, q, p, args: -t0 * p, slow_time=True)


def slow_action(q, p, t):
    """The discrete action h form/(2 sin θ), up to a factor."""
    s = sigma(t)
    return (1 / s + s / 400) * p[0] * p[0] + s * (q[0] * q[0] - H * q[0] * p[0])


def powers(*exponents):
    return dvi.Basis({f"σ^{k}": lambda q, p, t, k=k: sigma(t) ** k for k in exponents})


SLOWLY = (
    at_times("slow frequency, order 1", SLOW, SLOW_OSCILLATOR, QUADRATICS * powers(*range(-3, 4)),
        1, (5, 1), (slow_action,), times=6.0),
    at_times("slow frequency, order 2", SLOW, SLOW_OSCILLATOR, QUADRATICS * powers(*range(-5, 6)),
        2, (9, 1, 1), (slow_action,), times=6.0),
    at_times("slow frequency, basis without odd powers", SLOW, SLOW_OSCILLATOR,
        QUADRATICS * powers(-2, 0, 2), 1, (2, 0), (), times=6.0),
    at_times("slow frequency and friction", SLOW, SLOW_FRICTION,
        QUADRATICS * powers(*range(-3, 4)), 1, (5, 0), (), times=6.0),
    at_times("weak spring that grows slowly, order 1", SLOW, SLOW_SPRING,
        QUADRATICS * dvi.Polynomials(2, "τ", constant=True), 1, (3, 1), (action,), times=3.0),
    at_times("weak spring that grows slowly, order 2", SLOW, SLOW_SPRING,
        QUADRATICS * dvi.Polynomials(3, "τ", constant=True), 2, (4, 1, 1), (action,), times=3.0),
    at_times("weak friction that grows slowly", SLOW, SLOW_FRICTION_ALONE,
        QUADRATICS * dvi.Polynomials(2, "τ", constant=True), 1, (3, 0), (), times=3.0),
)  # fmt: skip


def angles(n, count, low, high):
    """Angles all around, momenta between low and high."""
    return lambda rng: (rng.uniform(0, 2 * np.pi, (count, n)), rng.uniform(low, high, (count, n)))


PENDULUM = perturbed(lambda q, p: cos(q[0]), FREE)
SMALL_DENOMINATORS = dvi.Basis({
    "cos(q − p/2)/sin(p/2)": lambda q, p: cos(q[0] - p[0] / 2) / sin(p[0] / 2),
    "sin(q − p/2)/sin(p/2)": lambda q, p: sin(q[0] - p[0] / 2) / sin(p[0] / 2),
})  # fmt: skip
ROTORS = perturbed(lambda q, p: cos(q[0] - q[1]), FREE)
DIFFERENCE = dvi.Basis({"cos(q1 − q2)": lambda q, p: cos(q[0] - q[1]),
                        "sin(q1 − q2)": lambda q, p: sin(q[0] - q[1])})  # fmt: skip
MOMENTA = ("p1", "p2")


def case(name, kind, system, basis, order, survivors, truth, samples, h=H, **more):
    return Case(name, kind, NORMAL_FORM, system, basis, samples, truth, h, order,
                survivors=survivors, **more)  # fmt: skip


TWISTS = (
    case("kicked rotor, basis with the small denominators", KEPT, PENDULUM,
        dvi.Polynomials(1, "p") + SMALL_DENOMINATORS, 1, (1, 1), (lambda q, p: p[0],),
        angles(1, 150, 0.5, 2.5), h=1.0, exact=False),
    case("kicked rotor, basis of waves", LOST, PENDULUM,
        dvi.Polynomials(3, "p") + dvi.Trigonometric(2, "q") * dvi.Polynomials(2, "p", True), 1,
        (3, 0), (), angles(1, 150, 0.5, 2.5), h=1.0),
    case("rotor with friction, basis of waves", LOST, forced(lambda q, p: -p, FREE),
        dvi.Polynomials(2, "p") + dvi.Trigonometric(2, "q") * dvi.Polynomials(1, "p", True), 1,
        (2, 0), (), angles(1, 150, 0.5, 2.5), h=1.0),
    case("two coupled rotors", KEPT, ROTORS, dvi.Polynomials(2, MOMENTA)
        + DIFFERENCE * dvi.Polynomials(1, MOMENTA, constant=True), 2, (5, 2, 2),
        (lambda q, p: p[0] + p[1],), angles(2, 150, 0.5, 2.5), h=1.0, exact=True),
    case("two coupled rotors with friction of one", LOST,
        dvi.System(FREE, force=lambda t0, t1, q, p, args: vector(-p[0], 0 * p[1]),
                   perturbation=ROTORS.perturbation),
        dvi.Polynomials(2, MOMENTA) + DIFFERENCE, 1, (5, 0), (),
        angles(2, 150, 0.5, 2.5), h=1.0),
)  # fmt: skip


def kepler(t0, t1, q, p, args):
    return (p @ p) / 2 - (q @ q) ** -0.5


def shell(n, count):
    """Positions at a distance between 0.8 and 2 from the origin."""

    def draw(rng):
        direction = rng.normal(size=(count, n))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return direction * rng.uniform(0.8, 2, (count, 1)), rng.uniform(-1, 1, (count, n))

    return draw


def component(i, j):
    return lambda q, p: q[i] * p[j] - q[j] * p[i]


WITH_RADIUS = dvi.Polynomials(2) + dvi.Radial()
OBLATE = perturbed(lambda q, p: (q @ q) ** -1.5 * (3 * q[2] ** 2 / (q @ q) - 1) / 2, kepler)

ORBITS = (
    case("Kepler, perturbed by 1/r³", KEPT, perturbed(lambda q, p: (q @ q) ** -1.5, kepler),
        WITH_RADIUS, 2, (1, 1, 1), (angular_momentum,), shell(2, 150), exact=True),
    case("Kepler with friction", LOST, forced(lambda q, p: -p, kepler), WITH_RADIUS, 1, (1, 0),
        (), shell(2, 150)),
    case("Kepler in a uniform field", LOST, perturbed(lambda q, p: q[0], kepler), WITH_RADIUS, 1,
        (1, 0), (), shell(2, 150)),
    case("Kepler in space, perturbed by r²", KEPT, perturbed(lambda q, p: q @ q, kepler),
        WITH_RADIUS, 1, (3, 3), (component(0, 1), component(1, 2), component(2, 0)),
        shell(3, 150), exact=True),
    case("oblate planet, order 1", KEPT, OBLATE, WITH_RADIUS, 1, (3, 1), (component(0, 1),),
        shell(3, 150), exact=True),
    case("oblate planet, order 2", KEPT, OBLATE, dvi.Polynomials(2), 2, (3, 1, 1),
        (component(0, 1),), shell(3, 150), exact=True),
)  # fmt: skip


def in_a_field(t0, t1, q, p, args):
    """A charge in a uniform magnetic field."""
    return ((p[0] + q[1] / 2) ** 2 + (p[1] - q[0] / 2) ** 2) / 2


FIELDS = (
    case("magnetic field and a weak electric one", RESONANT,
        perturbed(lambda q, p: q[0], in_a_field), dvi.Polynomials(2), 1, (6, 3),
        (lambda q, p: p[1] + q[0] / 2, lambda q, p: in_a_field(0, 0, q, p, None)), box(2, 100)),
    case("magnetic field with friction", LOST, forced(lambda q, p: -p, in_a_field),
        dvi.Polynomials(2), 1, (6, 0), (), box(2, 100)),
    case("magnetic field and a weak harmonic well", RESONANT,
        perturbed(lambda q, p: q @ q, in_a_field), dvi.Polynomials(2), 1, (6, 2),
        (angular_momentum, lambda q, p: in_a_field(0, 0, q, p, None)), box(2, 100)),
)  # fmt: skip

CASES = (*OSCILLATORS, *OTHERS, *COUPLED, *DRIVEN, *SLOWLY, *TWISTS, *ORBITS, *FIELDS)
