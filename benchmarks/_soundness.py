"""Systems whose proofs are tested by other means: each as functions for JAX, from which the package
makes the proof, and again as explicit formulas for NumPy, from which the truth is computed.

Nothing here uses a list of operations, the search or the checker. A state is a list of arrays of
many points for each coordinate; `m` is NumPy, or `Digits` with the functions of mpmath.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import dvi_jax as dvi

LONG = np.longdouble


class Digits:
    """Functions of mpmath for arrays of its numbers."""

    def __getattr__(self, name):
        return np.frompyfunc(getattr(mpmath, name.replace("arctan", "atan")), 1, 1)


class Subject(NamedTuple):
    """A call of `bound_drift`, and its map and invariants for NumPy.

    - `system`, `found`: for JAX. `how`: other keywords of `bound_drift`.
    - `step`: ``(m, q, p, t, e)`` → (q1, p1). `truths`: functions ``(m, q, p, e, t)``, one for each
      invariant. `condition`: ``(q, p)`` → array, ≥ 0 where a state is inside.
    - `is_timed`, `is_slow`: whether there is an interval of times, and whether t is εt.
    """

    system: dvi.System
    found: Any
    how: dict[str, Any]
    step: Callable
    truths: list[Callable]
    condition: Callable | None = None

    @property
    def is_timed(self) -> bool:
        return "time" in self.how

    @property
    def is_slow(self) -> bool:
        return self.system.slow_time

    def prove(self, **options: Any) -> Any:
        how = {"ratio": 3.0, "max_boxes": 1500, "max_seconds": 60.0, "change": 0.02}
        return dvi.bound_drift(self.found, self.system, **how | self.how | options)


# --- methods in NumPy ----------------------------------------------------------------------------


def moved(x: list, rate: list, h: Any) -> list:
    return [a + h * b for a, b in zip(x, rate, strict=True)]


def plain(m, p):
    return p


def euler(force, h, velocity=plain):
    """p1 = p + h F(q, t), q1 = q + h v(p1)."""

    def step(m, q, p, t, e):
        p1 = moved(p, force(m, q, t, e), h)
        return moved(q, velocity(m, p1), h), p1

    return step


def verlet(force, h, slow=False, first="kick"):
    """Half a kick, a drift, half a kick at the end of the step; or half a drift first."""

    def kicks(m, q, p, t, e):
        half = moved(p, force(m, q, t, e), h / 2)
        q1 = moved(q, half, h)
        return q1, moved(half, force(m, q1, t + (e * h if slow else h), e), h / 2)

    def drifts(m, q, p, t, e):
        half = moved(q, p, h / 2)
        p1 = moved(p, force(m, half, t, e), h)
        return moved(half, p1, h / 2), p1

    return kicks if first == "kick" else drifts


def yoshida(force, h):
    """Three steps of `verlet`."""
    outer = 1.0 / (2.0 - 2.0 ** (1.0 / 3.0))

    def step(m, q, p, t, e):
        for part in (outer, 1 - 2 * outer, outer):
            q, p = verlet(force, part * h)(m, q, p, t, e)
        return q, p

    return step


def implicit(force, velocity, h):
    """p1 = p + h F(q, p1, t), q1 = q + h v(q, p1, t), by iteration."""

    def step(m, q, p, t, e):
        p1 = p
        for _ in range(40):
            p1 = moved(p, force(m, q, p1, t, e), h)
        return moved(q, velocity(m, q, p1, t, e), h), p1

    return step


# --- invariants in NumPy -------------------------------------------------------------------------


def dot(a: list, b: list) -> Any:
    return sum(x * y for x, y in zip(a, b, strict=True))


def oscillator(h):
    """(p² + q² − h q p)/2, for JAX and for NumPy: conserved by symplectic Euler."""
    return (
        lambda q, p, epsilon: (p @ p + q @ q - h * (q @ p)) / 2,
        lambda m, q, p, e, t: (dot(p, p) + dot(q, q) - h * dot(q, p)) / 2,
    )


def quadratic(t0, t1, q, p, args):
    return (p @ p + q @ q) / 2


def kinetic(t0, t1, q, p, args):
    return p @ p / 2


def box(*sides: float) -> np.ndarray:
    return np.array(sides)


# --- the systems ---------------------------------------------------------------------------------


def spring(h=0.1):
    found, truth = oscillator(h)
    how = {"h": h, "epsilon": 0.1, "domain": box(0.5)}
    step = euler(lambda m, q, t, e: [-q[0]], h)
    return Subject(dvi.System(quadratic), found, how, step, [truth])


def cubic(h=0.1, epsilon: Any = 0.01, r=0.5, **how):
    """The force −ε q³."""
    found, truth = oscillator(h)
    system = dvi.System(quadratic, force=lambda t0, t1, q, p, args: -(q**3))
    step = euler(lambda m, q, t, e: [-q[0] - e * q[0] * q[0] * q[0]], h)
    return Subject(
        system, found, {"h": h, "epsilon": epsilon, "domain": box(r)} | how, step, [truth]
    )


def asymmetric():
    how = {"domain": (np.array([[-0.3], [0.6]]), np.array([[-0.1], [0.5]]))}
    return cubic()._replace(how=cubic().how | how)


def grid():
    """Increments that are multiples of a quantum: the bound in exact arithmetic is the same."""
    return cubic(h=0.125, arithmetic=dvi.FixedPoint(2.0**-30))


def slow_pendulum(h=0.05, epsilon: Any = 0.01, time=(0.0, 6.3)):
    """H = p²/2 − (1 + ε sin τ) cos q."""
    system = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q)),
        force=lambda t0, t1, q, p, args: -jnp.sin(t0) * jnp.sin(q),
        slow_time=True,
    )

    def found(q, p, epsilon, t):
        w = 1 + epsilon * jnp.sin(t)
        return p @ p / 2 - w * jnp.sum(jnp.cos(q)) - h / 2 * w * jnp.sum(jnp.sin(q) * p)

    def truth(m, q, p, e, t):
        w = 1 + e * m.sin(t)
        return p[0] * p[0] / 2 - w * m.cos(q[0]) - h / 2 * w * m.sin(q[0]) * p[0]

    step = euler(lambda m, q, t, e: [-(1 + e * m.sin(t)) * m.sin(q[0])], h)
    how = {"h": h, "epsilon": epsilon, "domain": box(0.8), "time": time, "ratio": 4.0}
    return Subject(system, found, how, step, [truth])


def slow_spring(h=0.1, epsilon: Any = 0.01, time=(0.0, 1.0), change=1e-2):
    """The stiffness 1 + τ²/9, whose energy is no invariant."""
    system = dvi.System(
        lambda t0, t1, q, p, a: (p @ p + (1 + t0**2 / 9) * (q @ q)) / 2, slow_time=True
    )

    def found(q, p, epsilon, t):
        return (p @ p + (1 + t**2 / 9) * (q @ q - h * (q @ p))) / 2

    def truth(m, q, p, e, t):
        return (p[0] * p[0] + (1 + t * t / 9) * (q[0] * q[0] - h * q[0] * p[0])) / 2

    step = euler(lambda m, q, t, e: [-(1 + t * t / 9) * q[0]], h)
    how = {"h": h, "epsilon": epsilon, "domain": box(0.5), "time": time, "change": change}
    return Subject(system, found, how, step, [truth])


def driven(h=0.1, epsilon: Any = 0.01, time=(0.0, 3.0), change=2e-2):
    """The force −ε q t⁴: outside of the interval of times it is large."""
    found, truth = oscillator(h)
    system = dvi.System(quadratic, force=lambda t0, t1, q, p, args: -q * t0**4)
    step = euler(lambda m, q, t, e: [-q[0] - e * q[0] * t * t * t * t], h)
    how = {"h": h, "epsilon": epsilon, "domain": box(0.5), "time": time, "change": change}
    return Subject(system, lambda q, p, e, t: found(q, p, e), how, step, [truth])


def tide(h=0.1, time=(-20.0, 30.0)):
    """The force ε cos t of a time that begins anywhere."""
    found, truth = oscillator(h)
    system = dvi.System(quadratic, force=lambda t0, t1, q, p, args: jnp.cos(t0) * jnp.ones_like(q))
    step = euler(lambda m, q, t, e: [-q[0] + e * m.cos(t)], h)
    how = {"h": h, "epsilon": (-0.02, 0.01), "domain": box(0.5), "time": time}
    return Subject(system, lambda q, p, e, t: found(q, p, e), how, step, [truth])


def quartic(h=0.1, method="kick", **how):
    """H = p²/2 + q⁴/4 by velocity or position Verlet."""
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + jnp.sum(q**4) / 4)
    step = verlet(lambda m, q, t, e: [-q[0] * q[0] * q[0]], h, first=method)
    options = {"kick": dvi.Strang(), "drift": dvi.Strang(base=dvi.Adjoint())}
    return Subject(
        system,
        lambda q, p, e: p @ p / 2 + jnp.sum(q**4) / 4,
        {"h": h, "epsilon": 0.1, "domain": box(0.7), "method": options[method]} | how,
        step,
        [lambda m, q, p, e, t: p[0] * p[0] / 2 + q[0] ** 4 / 4],
    )


def high_order():
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q)))
    return Subject(
        system,
        lambda q, p, e: p @ p / 2 - jnp.sum(jnp.cos(q)),
        {"h": 0.2, "epsilon": 0.1, "domain": box(0.8), "method": dvi.Yoshida(4), "ratio": 4.0},
        yoshida(lambda m, q, t, e: [-m.sin(q[0])], 0.2),
        [lambda m, q, p, e, t: p[0] * p[0] / 2 - m.cos(q[0])],
    )


def henon_heiles(h=0.1, r=0.2, strang=False, epsilon: Any = 0.1):
    def V(q):
        return q[0] ** 2 * q[1] - q[1] ** 3 / 3

    system = dvi.System(quadratic, force=lambda t0, t1, q, p, a: -jax.grad(V)(q))

    def force(m, q, t, e):
        return [-q[0] - 2 * e * q[0] * q[1], -q[1] - e * (q[0] * q[0] - q[1] * q[1])]

    def truth(m, q, p, e, t):
        return (dot(p, p) + dot(q, q)) / 2 + e * (q[0] * q[0] * q[1] - q[1] ** 3 / 3)

    how = {"h": h, "epsilon": epsilon, "domain": box(r, r), "ratio": 4.0}
    how |= {"method": dvi.Strang() if strang else dvi.TypeII()}
    found = lambda q, p, e: (p @ p + q @ q) / 2 + e * V(q)  # noqa: E731
    return Subject(system, found, how, (verlet if strang else euler)(force, h), [truth])


def coupled(h=0.05, epsilon: Any = 0.01, force=False, method=None):
    """H = p²(1 + q²)/2 + q²/2: an implicit step."""
    H = lambda t0, t1, q, p, args: (p @ p) * (1 + q @ q) / 2 + q @ q / 2  # noqa: E731
    system = dvi.System(H, force=(lambda t0, t1, q, p, args: -(q**3)) if force else None)

    def pull(m, q, p, t, e):
        return [-q[0] * (1 + p[0] * p[0]) - (e * q[0] ** 3 if force else 0)]

    step = implicit(pull, lambda m, q, p, t, e: [p[0] * (1 + q[0] * q[0])], h)
    how = {"h": h, "epsilon": epsilon, "domain": box(0.3), "method": dvi.TypeII()}
    truth = lambda m, q, p, e, t: p[0] ** 2 * (1 + q[0] ** 2) / 2 + q[0] ** 2 / 2  # noqa: E731
    return Subject(system, lambda q, p, e: H(0, 0, q, p, None), how, step, [truth])


def slow_coupled(h=0.1, epsilon: Any = (-0.01, 0.02)):
    """H = p²(1 + τ q²/4)/2 + q²/2."""
    system = dvi.System(
        lambda t0, t1, q, p, a: (p @ p) * (1 + t0 * (q @ q) / 4) / 2 + q @ q / 2, slow_time=True
    )
    step = implicit(
        lambda m, q, p, t, e: [-q[0] * (1 + t * p[0] * p[0] / 4)],
        lambda m, q, p, t, e: [p[0] * (1 + t * q[0] * q[0] / 4)], h)  # fmt: skip
    found, truth = oscillator(h)
    how = {"h": h, "epsilon": epsilon, "domain": box(0.3), "time": (-1.0, 1.0)}
    how |= {"method": dvi.TypeII(), "change": 5e-3}
    return Subject(system, lambda q, p, e, t: found(q, p, e), how, step, [truth])


def damped(power=1, epsilon: Any = 0.02, h=0.1):
    """The force −ε p, or −ε p³: an implicit step that loses energy, or gains it for ε < 0."""
    system = dvi.System(quadratic, force=lambda t0, t1, q, p, args: -(p**power))
    step = implicit(lambda m, q, p, t, e: [-q[0] - e * p[0] ** power], lambda m, q, p, t, e: p, h)
    found, truth = oscillator(h)
    how = {"h": h, "epsilon": epsilon, "domain": box(0.5), "method": dvi.TypeII()}
    return Subject(system, found, how, step, [truth])


TABLE = np.array([0.5, -0.25, 0.125, 0.3])


def series(h=0.1):
    """The force ε Σ a_k sin(kq) with a table of constants."""

    def W(t0, t1, q, p, args):
        return jnp.full(1, jnp.asarray(TABLE) @ jnp.sin(jnp.arange(1.0, 5.0) * q[0]))

    system = dvi.System(quadratic, force=W)
    found, truth = oscillator(h)

    def force(m, q, t, e):
        return [-q[0] + e * sum(float(a) * m.sin(k * q[0]) for k, a in enumerate(TABLE, 1))]

    how = {"h": h, "epsilon": 0.02, "domain": box(0.5)}
    return Subject(system, found, how, euler(force, h), [truth])


STIFFNESS = np.array([[1.0, 0.3], [0.3, 1.7]])


def matrix(h=-0.1):
    """H = p²/2 + q·Kq/2 + ε q1³/3 with K in args, backwards."""
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ (args["K"] @ q)) / 2,
        perturbation=lambda t0, t1, q, p, args: q[0] ** 3 / 3,
    )

    def pulls(q):
        return [q[0] + 0.3 * q[1], 0.3 * q[0] + 1.7 * q[1]]

    def force(m, q, t, e):
        a, b = pulls(q)
        return [-a - e * q[0] * q[0], -b]

    def truth(m, q, p, e, t):
        return (dot(p, p) + dot(q, pulls(q)) - h * dot(p, pulls(q))) / 2 + e * q[0] ** 3 / 3

    def found(q, p, epsilon):
        pull = jnp.asarray(STIFFNESS) @ q
        return (p @ p + q @ pull - h * (p @ pull)) / 2 + epsilon * q[0] ** 3 / 3

    how = {"h": h, "epsilon": 0.05, "domain": box(0.3, 0.3), "args": {"K": STIFFNESS}}
    return Subject(system, found, how | {"ratio": 4.0}, euler(force, h), [truth])


def shifted(h=0.1):
    """q.at[0].add(−0.5), of which an earlier version lost the constant."""

    def V(q):
        Q = q.at[0].add(-0.5)
        return Q @ Q / 2 + Q[0] ** 2 * Q[1]

    def force(m, q, t, e):
        x, y = q[0] - 0.5, q[1]
        return [-x - 2 * x * y, -y - x * x]

    def truth(m, q, p, e, t):
        x, y = q[0] - 0.5, q[1]
        return dot(p, p) / 2 + (x * x + y * y) / 2 + x * x * y

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))
    how = {"h": h, "epsilon": 0.01, "domain": box(0.3, 0.3)}
    return Subject(system, lambda q, p, e: p @ p / 2 + V(q), how, euler(force, h), [truth])


def set_places(h=0.1):
    """A coordinate that is replaced by a constant, and one to which another is added."""

    def V(q):
        Q = q.at[1].set(0.3).at[0].add(q[1])
        return Q @ Q / 2 + jnp.sum(q**2)

    def force(m, q, t, e):
        return [-(q[0] + q[1]) - 2 * q[0], -(q[0] + q[1]) - 2 * q[1]]

    def truth(m, q, p, e, t):
        return dot(p, p) / 2 + ((q[0] + q[1]) ** 2 + 0.3 * 0.3) / 2 + dot(q, q)

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))
    how = {"h": h, "epsilon": 0.01, "domain": box(0.3, 0.3)}
    return Subject(system, lambda q, p, e: p @ p / 2 + V(q), how, euler(force, h), [truth])


def displaced():
    """(q + 1)²/2 by q.at[0].add(1.0), whose minimum is outside of the domain."""
    system = dvi.System(lambda t0, t1, q, p, a: (p @ p + q.at[0].add(1.0) @ q.at[0].add(1.0)) / 2)
    return Subject(
        system,
        lambda q, p, e: (p @ p + q.at[0].add(1.0) @ q.at[0].add(1.0)) / 2,
        {"h": 0.02, "epsilon": 0.01, "domain": box(0.5), "method": dvi.Strang()},
        verlet(lambda m, q, t, e: [-(q[0] + 1)], 0.02),
        [lambda m, q, p, e, t: (p[0] ** 2 + (q[0] + 1) ** 2) / 2],
    )


def chosen_places(h=0.1, strang=False):
    """`where` with a constant condition: q1² and q2⁴."""

    def V(q):
        return jnp.sum(jnp.where(jnp.array([True, False]), q**2, q**4)) / 2

    def force(m, q, t, e):
        return [-q[0], -2 * q[1] * q[1] * q[1]]

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))
    how = {"h": h, "epsilon": 0.01, "domain": box(0.4, 0.6), "ratio": 4.0}
    how |= {"method": dvi.Strang() if strang else dvi.TypeII()}
    return Subject(
        system,
        lambda q, p, e: p @ p / 2 + V(q),
        how,
        (verlet if strang else euler)(force, h),
        [lambda m, q, p, e, t: dot(p, p) / 2 + (q[0] ** 2 + q[1] ** 4) / 2],
    )


def scanned(h=0.1):
    """A polynomial by Horner's scheme in a `scan` over a table: Σ a_k q^k."""
    table = np.array([0.2, -0.1, 0.5, 0.0, 0.0])

    def V(x):
        return jax.lax.scan(lambda c, a: (c * x + a, None), 0.0 * x, jnp.asarray(table))[0]

    def force(m, q, t, e):
        x = q[0]
        return [-(0.8 * x * x * x - 0.1 * 3 * x * x + x)]

    def truth(m, q, p, e, t):
        x = q[0]
        V = 0.2 * x**4 - 0.1 * x**3 + 0.5 * x * x
        return p[0] * p[0] / 2 + V - h / 2 * p[0] * (0.8 * x**3 - 0.3 * x * x + x)

    def found(q, p, epsilon):
        return p @ p / 2 + V(q[0]) - h / 2 * p[0] * jax.grad(V)(q[0])

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q[0]))
    how = {"h": h, "epsilon": 0.01, "domain": box(0.5)}
    return Subject(system, found, how, euler(force, h), [truth])


def looped(h=0.1):
    """A `fori_loop` over the places of three coordinates, a chain with fixed ends."""

    def V(q):
        ends = jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)])
        add = lambda i, s: s + (ends[i + 1] - ends[i]) ** 2 / 2  # noqa: E731
        return jax.lax.fori_loop(0, 4, add, 0.0)

    def force(m, q, t, e):
        a, b, c = q
        return [b - 2 * a, a + c - 2 * b, b - 2 * c]

    def truth(m, q, p, e, t):
        a, b, c = q
        return dot(p, p) / 2 + (a * a + (b - a) ** 2 + (c - b) ** 2 + c * c) / 2

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))
    how = {"h": h, "epsilon": 0.01, "domain": box(0.2, 0.3, 0.2), "ratio": 4.0}
    return Subject(system, lambda q, p, e: p @ p / 2 + V(q), how, euler(force, h), [truth])


def solved(h=0.05):
    """H = p·M⁻¹p/2 + q²/2 with the mass matrix ((2 + q2², q2), (q2, 1)), solved by hand."""

    def rates(q, p):
        det = 2 + q[1] ** 2 - q[1] ** 2
        return jnp.stack([p[0] - q[1] * p[1], (2 + q[1] ** 2) * p[1] - q[1] * p[0]]) / det

    def H(t0, t1, q, p, args):
        return p @ rates(q, p) / 2 + q @ q / 2

    def velocity(m, q, p, t, e):
        return [(p[0] - q[1] * p[1]) / 2, ((2 + q[1] * q[1]) * p[1] - q[1] * p[0]) / 2]

    def force(m, q, p, t, e):
        return [-q[0], -q[1] - (2 * q[1] * p[1] * p[1] - 2 * p[0] * p[1]) / 4]

    def truth(m, q, p, e, t):
        return dot(p, velocity(m, q, p, t, e)) / 2 + dot(q, q) / 2

    how = {"h": h, "epsilon": 0.01, "domain": box(0.15, 0.15), "method": dvi.TypeII()}
    found = lambda q, p, e: H(0, 0, q, p, None)  # noqa: E731
    return Subject(
        dvi.System(H), found, how | {"ratio": 5.0}, implicit(force, velocity, h), [truth]
    )


def kepler(h=0.01, force=False):
    """A box on one side of the centre; the angular momentum is conserved exactly."""
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - 1 / jnp.sqrt(q @ q))

    def pull(m, q, t, e):
        r = m.sqrt(dot(q, q))
        return [-x / (r * r * r) for x in q]

    found = [
        lambda q, p, e: q[0] * p[1] - q[1] * p[0],
        lambda q, p, e: p @ p / 2 - 1 / jnp.sqrt(q @ q),
    ]
    truths = [
        lambda m, q, p, e, t: q[0] * p[1] - q[1] * p[0],
        lambda m, q, p, e, t: dot(p, p) / 2 - 1 / m.sqrt(dot(q, q)),
    ]
    domain = np.array([[0.8, -0.2], [1.1, 0.2]]), box(0.3, 0.9)
    how = {"h": h, "epsilon": 0.1, "domain": domain, "ratio": 6.0}
    return Subject(system, found, how, euler(pull, h), truths)


def toda(h=0.1):
    """Three bodies with V = Σ exp(q_i − q_{i+1}); the total momentum is conserved exactly."""

    def V(q):
        return jnp.sum(jnp.exp(q - jnp.roll(q, -1)))

    def force(m, q, t, e):
        f = [m.exp(q[i] - q[(i + 1) % 3]) for i in range(3)]
        return [f[i - 1] - f[i] for i in range(3)]

    def energy(m, q, p, e, t):
        return dot(p, p) / 2 + sum(m.exp(q[i] - q[(i + 1) % 3]) for i in range(3))

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))
    found = [lambda q, p, e: p @ p / 2 + V(q), lambda q, p, e: jnp.sum(p)]
    how = {"h": h, "epsilon": 0.01, "domain": box(0.2, 0.2, 0.2), "ratio": 4.0}
    truths = [energy, lambda m, q, p, e, t: sum(p)]
    return Subject(system, found, how, euler(force, h), truths)


def standard(epsilon: Any = 0.1):
    """p1 = p + ε sin q, q1 = q + p1."""
    system = dvi.System(kinetic, force=lambda t0, t1, q, p, args: jnp.sin(q))
    return Subject(
        system,
        lambda q, p, e: p @ p / 2 + e * jnp.sum(jnp.cos(q) + jnp.sin(q) * p / 2),
        {"h": 1.0, "epsilon": epsilon, "domain": (box(3.2), box(0.5))},
        euler(lambda m, q, t, e: [e * m.sin(q[0])], 1.0),
        [lambda m, q, p, e, t: p[0] ** 2 / 2 + e * (m.cos(q[0]) + m.sin(q[0]) * p[0] / 2)],
    )


def mcmillan():
    """A rational map with a biquadratic invariant; the potential has a logarithm."""
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ q - jnp.sum(jnp.log(1 + q * q)))

    def invariant(x, y):
        return x * x * (y * y) + x * x + y * y - 2 * x * y

    return Subject(
        system,
        lambda q, p, e: invariant(q[0], q[0] - p[0]),
        {"h": 1.0, "epsilon": 0.1, "domain": box(0.5)},
        euler(lambda m, q, t, e: [2 * q[0] / (1 + q[0] * q[0]) - 2 * q[0]], 1.0),
        [lambda m, q, p, e, t: invariant(q[0], q[0] - p[0])],
    )


def morse(h=-0.1):
    """V = (1 − exp(−q))²/2, backwards."""
    V = lambda q: jnp.sum((1 - jnp.exp(-q)) ** 2) / 2  # noqa: E731

    def force(m, q, t, e):
        x = m.exp(-q[0])
        return [-(1 - x) * x]

    def truth(m, q, p, e, t):
        x = m.exp(-q[0])
        return p[0] * p[0] / 2 + (1 - x) ** 2 / 2 - h / 2 * p[0] * (1 - x) * x

    def found(q, p, epsilon):
        return p @ p / 2 + V(q) - h / 2 * p @ jax.grad(V)(q)

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))
    how = {"h": h, "epsilon": 0.1, "domain": box(0.4)}
    return Subject(system, found, how, euler(force, h), [truth])


def relativistic(h=0.1):
    """H = √(1 + p²) + q²/2."""
    system = dvi.System(lambda t0, t1, q, p, args: jnp.sqrt(1 + p @ p) + q @ q / 2)
    return Subject(
        system,
        lambda q, p, e: jnp.sqrt(1 + p @ p) + q @ q / 2,
        {"h": h, "epsilon": 0.1, "domain": box(0.6)},
        euler(
            lambda m, q, t, e: [-q[0]], h,
            lambda m, p: [p[0] / m.sqrt(1 + p[0] * p[0])],
        ),
        [lambda m, q, p, e, t: m.sqrt(1 + p[0] * p[0]) + q[0] * q[0] / 2],
    )  # fmt: skip


def nonlinear_perturbation(h=0.1):
    """A perturbation that is not linear in ε: ε H1 = ε q²/(2 + 2ε)."""
    system = dvi.System(
        quadratic, perturbation=lambda t0, t1, q, p, args, epsilon: q @ q / (2 * (1 + epsilon))
    )

    def truth(m, q, p, e, t):
        return (dot(p, p) + dot(q, q) * (1 + e)) / 2

    step = euler(lambda m, q, t, e: [-q[0] * (1 + e / (1 + e))], h)
    found = lambda q, p, e: (p @ p + (q @ q) * (1 + e)) / 2  # noqa: E731
    how = {"h": h, "epsilon": (-0.1, 0.3), "domain": box(0.5), "method": dvi.TypeII()}
    return Subject(system, found, how, step, [truth])


def hyperbolic(h=0.1):
    """V = log cosh q, whose force is −tanh q."""
    V = lambda q: jnp.sum(jnp.log(jnp.cosh(q)))  # noqa: E731
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))
    return Subject(
        system,
        lambda q, p, e: p @ p / 2 + V(q),
        {"h": h, "epsilon": 0.1, "domain": box(0.6)},
        euler(lambda m, q, t, e: [-m.tanh(q[0])], h),
        [lambda m, q, p, e, t: p[0] * p[0] / 2 + m.log(m.cosh(q[0]))],
    )


def powers(h=0.02):
    """V = q^2.5/2.5 + q^−3/30 on q > 0."""
    V = lambda q: jnp.sum(q**2.5) / 2.5 + jnp.sum(q**-3) / 30  # noqa: E731
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q))

    def truth(m, q, p, e, t):
        x = q[0]
        return p[0] * p[0] / 2 + x * x * m.sqrt(x) / 2.5 + 1 / (x * x * x) / 30

    return Subject(
        system,
        lambda q, p, e: p @ p / 2 + V(q),
        {"h": h, "epsilon": 0.1, "domain": (np.array([[0.5], [1.0]]), box(0.4))},
        euler(lambda m, q, t, e: [-q[0] * m.sqrt(q[0]) + 1 / (q[0] ** 4 * 10)], h),
        [truth],
    )


def negative_power(h=1.0):
    """The force ε q⁻¹⁵ and the invariant p, where nearly all rounding is that of the power."""
    system = dvi.System(kinetic, force=lambda t0, t1, q, p, args: q**-15)
    domain = np.array([[1.98], [1.9999]]), box(1e-9)
    return Subject(
        system,
        lambda q, p, e: p[0],
        {"h": h, "epsilon": (0.999, 1.0), "domain": domain},
        euler(lambda m, q, t, e: [e / q[0] ** 15], h),
        [lambda m, q, p, e, t: p[0]],
    )


def disc(h=0.1):
    """A domain with a condition: the disc p² + q² ≤ 0.2 without its middle."""
    inside = lambda q, p: jnp.stack([0.2 - p @ p - q @ q, p @ p + q @ q - 0.01])  # noqa: E731

    def condition(q, p):
        r = q[0] * q[0] + p[0] * p[0]
        return np.minimum(0.2 - r, r - 0.01)

    subject = cubic(h, (-0.01, 0.01), inside=inside)
    return subject._replace(condition=condition)


def two_springs(h=0.1):
    """Two oscillators: neither energy is large all around the domain, their sum is."""

    def energies(i):
        return (
            lambda q, p, e: (p[i] ** 2 + q[i] ** 2 - h * q[i] * p[i]) / 2,
            lambda m, q, p, e, t: (p[i] * p[i] + q[i] * q[i] - h * q[i] * p[i]) / 2,
        )

    found, truths = map(list, zip(energies(0), energies(1), strict=True))
    system = dvi.System(
        quadratic, force=lambda t0, t1, q, p, a: jnp.stack([-(q[0] ** 3), q[1] ** 2])
    )

    def force(m, q, t, e):
        return [-q[0] - e * q[0] ** 3, -q[1] + e * q[1] * q[1]]

    how = {"h": h, "epsilon": 0.01, "domain": box(0.5, 0.4), "ratio": 4.0}
    return Subject(system, found, how, euler(force, h), truths)


CORPUS: dict[str, Callable[[], Subject]] = {
    "spring": spring,
    "spring backwards": functools.partial(spring, -0.1),
    "cubic": cubic,
    "cubic, ε of both signs": functools.partial(cubic, epsilon=(-0.02, 0.01)),
    "cubic backwards, ε < 0": functools.partial(cubic, -0.1, (-0.02, -0.01)),
    "cubic, asymmetric box": asymmetric,
    "cubic, FixedPoint": grid,
    "slow pendulum": slow_pendulum,
    "slow pendulum, ε < 0": functools.partial(slow_pendulum, epsilon=(-0.01, -0.002)),
    "slow spring, ε of both signs": functools.partial(slow_spring, epsilon=(-0.02, 0.01)),
    "slow spring backwards": functools.partial(slow_spring, h=-0.1),
    "slow spring backwards, ε of both signs": functools.partial(
        slow_spring, -0.1, (-0.01, 0.03), (-1.0, 1.0)),
    "driven": functools.partial(driven, epsilon=1e-5),
    "driven backwards": functools.partial(driven, -0.1, 1e-5),
    "driven, ε of both signs": functools.partial(driven, 0.1, (-1e-5, 2e-5)),
    "tide": tide,
    "tide backwards": functools.partial(tide, -0.1),
    "quartic, Strang": quartic,
    "quartic, Strang of the adjoint": functools.partial(quartic, 0.1, "drift"),
    "quartic, Strang backwards": functools.partial(quartic, -0.1),
    "pendulum, Yoshida": high_order,
    "Hénon-Heiles": henon_heiles,
    "Hénon-Heiles, Strang backwards": functools.partial(henon_heiles, -0.1, 0.2, True, (-0.2, 0.1)),
    "implicit": coupled,
    "implicit backwards, ε of both signs": functools.partial(coupled, -0.05, (-0.02, 0.01), True),
    "implicit, slow time": slow_coupled,
    "damped": damped,
    "damped, p³, ε of both signs": functools.partial(damped, 3, (-0.05, 0.05)),
    "table of sines": series,
    "matrix of args, backwards": matrix,
    "at add": shifted,
    "at set": set_places,
    "at add, Strang": displaced,
    "where": chosen_places,
    "where, Strang": functools.partial(chosen_places, 0.1, True),
    "scan": scanned,
    "fori_loop": looped,
    "solve": solved,
    "Kepler": kepler,
    "Toda": toda,
    "standard map, ε of both signs": functools.partial(standard, (-0.05, 0.1)),
    "McMillan": mcmillan,
    "Morse backwards": morse,
    "relativistic": relativistic,
    "perturbation not linear in ε": nonlinear_perturbation,
    "hyperbolic": hyperbolic,
    "powers": powers,
    "negative power": negative_power,
    "disc": disc,
    "two springs": two_springs,
}  # fmt: skip


# --- the truth -----------------------------------------------------------------------------------


class Truth:
    """The largest changes of a subject, and its trajectories, for the domain of its proof."""

    def __init__(self, subject: Subject, seed: int = 0):
        self.subject, self.rng = subject, np.random.default_rng(seed)
        how = subject.how
        domain = how["domain"] if isinstance(how["domain"], tuple) else (how["domain"],) * 2
        sides = [(x[0], x[1]) if np.ndim(x) > 1 else (-x, x) for x in domain]
        self.n = len(sides[0][0])
        self.low, self.high = (np.concatenate([s[i] for s in sides])[:, None] for i in (0, 1))
        strengths = how["epsilon"] if np.ndim(how["epsilon"]) else (0.0, how["epsilon"])
        self.time = how.get("time", (0.0, 0.0))
        ends = [*zip(self.low[:, 0], self.high[:, 0], strict=True), self.time, strengths]
        self.least, self.largest = (np.array(x, LONG)[:, None] for x in zip(*ends, strict=True))

    def split(self, x: np.ndarray) -> tuple[list, list, Any, Any]:
        """q, p, t, ε of rows of points."""
        return [*x[: self.n]], [*x[self.n : -2]], x[-2], x[-1]

    def points(self, count: int) -> np.ndarray:
        """Random points, every fifth number of which is an end of its interval."""
        shares = self.rng.random((len(self.least), count))
        corners = self.rng.choice([0.0, 0.5, 1.0], shares.shape)
        shares = np.where(self.rng.random(shares.shape) < 0.2, corners, shares)
        return self.least + shares * (self.largest - self.least)

    def neighbours(self, x: np.ndarray, scale: float) -> np.ndarray:
        steps = scale * self.rng.normal(size=x.shape) * (self.rng.random(x.shape) < 0.6)
        return np.clip(x + steps * (self.largest - self.least), self.least, self.largest)

    def is_inside(self, q: list, p: list) -> np.ndarray:
        state = np.array([*q, *p])
        inside = ((state >= self.low) & (state <= self.high)).all(0)
        if self.subject.condition is not None:
            inside &= self.subject.condition(q, p) >= 0
        return inside

    def next(self, x: np.ndarray) -> np.ndarray:
        q, p, t, e = self.split(x)
        q1, p1 = self.subject.step(np, q, p, t, e)
        h = self.subject.how["h"]
        return np.array([*q1, *p1, t + (e * h if self.subject.is_slow else h), e])

    def values(self, x: np.ndarray) -> list[np.ndarray]:
        q, p, t, e = self.split(x)
        return [truth(np, q, p, e, t) for truth in self.subject.truths]

    def changes(self, x: np.ndarray, k: int) -> np.ndarray:
        """|I_k(x1) − I_k(x)|, infinite where it is not a number, −1 outside of the domain."""
        q, p, t, e = self.split(x)
        q1, p1, t1, e = self.split(self.next(x))
        truth = self.subject.truths[k]
        change = np.abs(truth(np, q1, p1, e, t1) - truth(np, q, p, e, t))
        return np.where(self.is_inside(q, p), np.where(np.isfinite(change), change, np.inf), -1)

    def largest_change(self, k: int, starts: int, rounds: int = 24) -> float:
        """Ascent from many starts: each moves where the change is larger, in smaller and smaller
        random directions; after half of the rounds only the best tenth continues."""
        x = self.points(starts)
        value = self.changes(x, k)
        for i in range(rounds):
            if i == rounds // 2:
                best = np.argsort(value)[-max(1, starts // 10) :]
                x, value = x[:, best], value[best]
            near = self.neighbours(x, 0.3 * 0.7**i)
            change = self.changes(near, k)
            x, value = np.where(change > value, near, x), np.maximum(change, value)
        return float(np.max(value))

    def reach(self, x: np.ndarray) -> np.ndarray:
        """How far states are from the middle of the domain: above 1 outside of it."""
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        reach = np.max(np.abs(x[:-2] - middle) / half, axis=0)
        q, p, *_ = self.split(x)
        outside = ~self.is_inside(q, p)
        return np.where(outside, np.fmax(reach, 2.0), reach)  # not a number: outside

    def farthest(self, x: np.ndarray, steps: np.ndarray | int) -> np.ndarray:
        """The largest `reach` of trajectories within a number of steps of each."""
        reach, steps = self.reach(x), np.broadcast_to(steps, x.shape[1])
        for i in range(int(np.max(steps, initial=0))):
            x = self.next(x)
            reach = np.where(i < steps, np.maximum(reach, self.reach(x)), reach)
        return reach

    def escape(self, bound: Any, starts: int, steps: int = 200, rounds: int = 5) -> float:
        """The largest `reach` of trajectories that the level of a proof confines: those that get
        farthest are changed, and run again, the best of them for ten times as many steps."""
        weights, level = bound.level

        def confined(x):
            x[-2] = bound.start_time
            q, p, *_ = self.split(x)
            total = sum(w * v for w, v in zip(weights, self.values(x), strict=True))
            return np.asarray(x[:, self.is_inside(q, p) & (total <= level)], float)

        x = confined(self.points(20 * starts))[:, :starts]
        if not x.size:
            raise ValueError("no start satisfies the level")
        count, best = min(bound.steps, steps), 0.0
        for i in range(rounds):
            reach = self.farthest(x, count)
            best = max(best, float(np.max(reach)))
            x = x[:, np.argsort(reach)[-starts // 5 :]]
            x = np.concatenate([x, confined(self.neighbours(np.tile(x, 8), 0.1 * 0.5**i))], 1)
            x = x[:, :starts]
        last = self.farthest(x[:, :50], min(bound.steps, 10 * steps))
        return max(best, float(np.max(last)))

    def escape_from_starts(self, bound: Any, starts: int, steps: int = 2000) -> float:
        """The largest `reach` of trajectories within the numbers of steps that `steps_inside`
        states for their starts."""
        x = np.asarray(self.points(starts), float)
        x[-2] = bound.start_time
        counts = [bound.steps_inside(c[: self.n], c[self.n : -2], float(c[-1])) for c in x.T]
        positive = np.array(counts) > 0
        if not positive.any():
            return 0.0
        counts = np.array([min(c, steps) for c in counts])[positive]
        return float(np.max(self.farthest(x[:, positive], counts)))


# --- computed steps ------------------------------------------------------------------------------

ROUNDED = (
    "cubic, ε of both signs",
    "quartic, Strang",
    "Hénon-Heiles, Strang backwards",
    "slow pendulum",
    "tide",
    "standard map, ε of both signs",
    "McMillan",
    "Kepler",
    "relativistic",
    "implicit backwards, ε of both signs",
)
"""Programs of sums, products, quotients, roots, sines and cosines, and an implicit one."""

OTHER_FUNCTIONS = ("Toda", "Morse backwards", "hyperbolic", "powers")
"""exp, tanh and powers."""

LAYOUTS = {"machine code": dvi.Layout(), "XLA": dvi.Layout(form="arrays")}


class ComputedSteps:
    """Steps that the package computes, next to the exact ones from the same states."""

    def __init__(self, subject: Subject, layout: dvi.Layout, length: int = 50, seed: int = 0):
        self.subject, self.truth, self.length = subject, Truth(subject, seed), length
        names = ("h", "args", "method", "arithmetic")
        how = {name: subject.how[name] for name in names if name in subject.how}

        def run(q, p, t0, e):
            how_long = {"num_steps": length, "t0": t0, "epsilon": e, "throw": False}
            sol = dvi.integrate(subject.system, q, p, layout=layout, **how_long, **how)
            return sol.qs, sol.ps

        self.run = jax.jit(jax.vmap(run))

    def batch(self, starts: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States before steps with (t, ε) and after them, rows of numbers, in long double; and the
        t after them. Only steps that begin in the domain."""
        truth, h = self.truth, LONG(self.subject.how["h"])
        q, p, t, e = truth.split(np.asarray(truth.points(starts), float))
        slow = self.subject.is_slow
        t0 = np.where(e == 0, 0.0, t / np.where(e == 0, 1.0, e)) if slow else t
        qs, ps = map(np.asarray, self.run(np.stack(q, 1), np.stack(p, 1), t0, e))
        rows = np.asarray(np.concatenate([qs, ps], axis=2), LONG)
        times = np.asarray(t0, LONG)[:, None] + np.arange(self.length + 1) * h
        strengths = np.broadcast_to(np.asarray(e, LONG)[:, None], times.shape)
        times = times * strengths if slow else times
        start = np.concatenate([rows, times[..., None], strengths[..., None]], axis=2)
        before = start[:, :-1].reshape(-1, start.shape[2]).T
        after, after_time = rows[:, 1:].reshape(-1, rows.shape[2]).T, times[:, 1:].ravel()
        q, p, t, e = truth.split(before)
        good = truth.is_inside(q, p)
        if self.subject.is_timed:
            good &= (t >= truth.time[0]) & (t <= truth.time[1])
        return before[:, good], after[:, good], after_time[good]

    def errors(self, m: Any, before: Any, after: Any, time: Any) -> list:
        """|I_k(computed) − I_k(exact)| after the steps."""
        q, p, t, e = self.truth.split(before)
        n, exact = self.truth.n, self.subject.step(m, q, p, t, e)
        return [
            abs(truth(m, [*after[:n]], [*after[n:]], e, time) - truth(m, *exact, e, time))
            for truth in self.subject.truths
        ]

    def errors_in_digits(self, before: Any, after: Any, time: Any) -> np.ndarray:
        """The same with 50 digits."""
        with mpmath.workdps(50):
            exact = np.frompyfunc(_as_digits, 1, 1)
            # 50 digits of (t, ε) are those of long double: the same states.
            rows = self.errors(Digits(), *(exact(x) for x in (before, after, time)))
            return np.array([[float(x) for x in row] for row in rows])

    def largest(
        self, count: int, starts: int = 4000
    ) -> tuple[list[float], float, list[float], int]:
        """The largest error of each I_k, the largest error of long double in one, the largest move
        of each coordinate, and the number of steps compared."""
        worst, slack, total = [0.0] * len(self.subject.truths), 0.0, 0
        moves = np.zeros(2 * self.truth.n)
        while total < count:
            before, after, time = self.batch(starts)
            total += len(time)
            errors = self.errors(np, before, after, time)
            size = np.max(np.abs(after - before[:-2]), axis=1, initial=0.0)
            moves = np.maximum(moves, np.asarray(size, float))
            for k, row in enumerate(errors):
                # A step that failed is not a number.
                row = np.where(np.isnan(row), np.inf, row)
                best = [*np.argsort(row)[-8:], *self.truth.rng.integers(0, len(row), 8)]
                digits = self.errors_in_digits(before[:, best], after[:, best], time[best])[k]
                slack = max(slack, float(np.max(np.abs(digits - row[best]))))
                worst[k] = max(worst[k], float(np.max(digits)), float(np.max(row)) - slack)
        return worst, slack, moves.tolist(), total


def _as_digits(x: Any) -> Any:
    """A number of long double as two of float64, exactly."""
    high = float(x)
    return mpmath.mpf(high) + mpmath.mpf(float(x - LONG(high)))


def rounding(name: str, way: str, count: int) -> tuple[str, list[str]]:
    """A row of a table, and what is wrong: computed steps of one program in one way of running,
    against the rounding and the reach that are proved."""
    subject = CORPUS[name]()
    bound = subject.prove(layout=LAYOUTS[way])
    with np.errstate(all="ignore"):
        worst, slack, moves, total = ComputedSteps(subject, LAYOUTS[way]).largest(count)
    reach = [float.fromhex(x) for x in bound.certificate["reach"]]
    parts = [f"{b:.3g} {x:.3g} {b / x if x else np.inf:.2f}" for b, x in
             zip(bound.rounding, worst, strict=True)]  # fmt: skip
    text = f"{name:38} {way:12} {total:12,d} steps: {'; '.join(parts)} (long double {slack:.1g})"
    pairs = zip(worst, bound.rounding, strict=True)
    wrong = [f"{name}, {way}: I_{k} {x:.3g} > {b:.3g}" for k, (x, b) in enumerate(pairs) if x > b]
    far = [i for i, (a, b) in enumerate(zip(moves, reach, strict=True)) if a > b]
    wrong += [f"{name}, {way}: coordinate {i} moves by {moves[i]} > {reach[i]}" for i in far]
    if slack > 0.02 * min(bound.rounding):
        wrong.append(f"{name}, {way}: long double is not exact enough")
    return text, wrong
