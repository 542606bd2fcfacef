"""The systems and methods that tests parametrise over, and the oracles they compare with.

All methods are in `dvi_jax.testing.METHODS`: being listed there, a new one is certified and tested.
"""

import functools
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems, testing
from dvi_jax.testing import symplectic_defect as symplectic_defect


def non_separable(t0, t1, q0, p1, args):
    """H = (q² + 1)(p² + 1)/2, each degree of freedom by itself."""
    return jnp.sum((q0**2 + 1) * (p1**2 + 1)) / 2


def double_pendulum(t0, t1, q0, p1, args):
    """Two unit masses on unit rods, unit gravity; canonical angles and momenta."""
    difference = q0[0] - q0[1]
    kinetic = (p1[0] ** 2 + 2 * p1[1] ** 2 - 2 * p1[0] * p1[1] * jnp.cos(difference)) / (
        2 * (1 + jnp.sin(difference) ** 2)
    )
    return kinetic - 2 * jnp.cos(q0[0]) - jnp.cos(q0[1])


def pendulum(t0, t1, q0, p1, args):
    """H = p²/2 − cos q."""
    return jnp.sum(p1**2) / 2 - jnp.sum(jnp.cos(q0))


def damping(t0, t1, q0, p1, args):
    """W = −(1 + q²) p + cos t: dissipative, driven, implicit."""
    return -(1 + q0**2) * p1 + jnp.cos(t0)


SYSTEMS = {
    "pendulum": (dvi.System(pendulum, force=damping), [0.4], [0.7]),
    "kepler": (systems.kepler().system, [0.0, 1.2], [-1.0, -0.6]),
    "non_separable": (dvi.System(non_separable, force=damping), [0.3], [0.4]),
    "double_pendulum": (dvi.System(double_pendulum, force=damping), [0.5, -0.3], [0.2, 0.4]),
}
ARGS = {"K": 1.0}


@functools.cache
def problem(name, h=0.1):
    """A registered system as the checks of `dvi_jax.testing` take it."""
    system, q, p = SYSTEMS[name]
    return systems.Problem(name, system, np.array(q), np.array(p), h=h, args=ARGS)


IN_EVERY_RUN = ("TypeII", "Adjoint", "Strang", "Yoshida4", "Composition2", "RungeKutta4")
METHODS = {name: testing.METHODS[name] for name in IN_EVERY_RUN}
"""Those that run on every system in the quick tests too."""

ADJOINTS = {
    "Direct": dvi.Direct(),
    "Checkpointed": dvi.Checkpointed(),
    "Reversible": dvi.Reversible(checkpoint_every=5),
}


def covering(first, second, shift=0):
    """Pairs in which each item of both lists appears at least once.

    Every pair is a compilation. What is tested of a method, a system or an adjoint is tested of
    each of them, and of their combinations of this sample; `shift` takes another one.
    """
    first, second = list(first), list(second)
    count = max(len(first), len(second))
    return [(first[i % len(first)], second[(i + shift) % len(second)]) for i in range(count)]


def flow(system, method, h, num_steps=1, epsilon=0.0, t0=0.0, args=ARGS, adjoint=dvi.Direct()):
    """z = (q, p) as one vector → the state after `num_steps` steps, as one vector."""
    # `Direct` compiles fastest; tests of gradients compare all adjoints.

    how = {"h": h, "num_steps": num_steps, "t0": t0, "epsilon": epsilon, "args": args}
    how |= {"method": method, "save": dvi.Save(final=True), "adjoint": adjoint}

    def of(z):
        sol = dvi.integrate(system, *jnp.split(z, 2), **how)
        return jnp.concatenate([sol.qs[-1], sol.ps[-1]])

    return of


def state(name):
    """The start of a registered system as one vector."""
    _, q, p = SYSTEMS[name]
    return jnp.asarray([*q, *p])


def central_difference(f, x, direction, step=1e-5):
    """(f(x + s d) − f(x − s d))/2s at two steps, extrapolated: error O(s⁴), 1e-10 or so."""

    def at(s):
        forward = jax.tree.map(lambda a, d: a + s * d, x, direction)
        backward = jax.tree.map(lambda a, d: a - s * d, x, direction)
        return (f(forward) - f(backward)) / (2 * s)

    return (4 * at(step) - at(2 * step)) / 3


def gradient_by_differences(f, v):
    """The gradient of f at v, by differences of fourth order in 1e-4 of each component."""

    def slope(step):
        low, below, above, high = (float(f(v + x * step)) for x in (-2, -1, 1, 2))
        return (low - 8 * below + 8 * above - high) / (12 * step.sum())

    return np.array([slope(step) for step in 1e-4 * np.diag(v)])


def measured_orders(errors, ratio, floor):
    """Orders between neighbouring step sizes, round-off plateau (below `floor`) masked out."""
    errors = np.asarray(errors)
    keep = errors > floor
    assert keep.sum() >= 3, f"fewer than three points above round-off: {errors}"
    errors = errors[keep]
    return np.log(errors[:-1] / errors[1:]) / np.log(ratio)


def run_problem(made, num_steps, **options):
    """`integrate` from a `Problem` of the library; `options` take the place of its fields."""
    own = {"q0": made.q0, "p0": made.p0, "h": made.h, "args": made.args}
    return dvi.integrate(made.system, num_steps=num_steps, **(own | options))


needs_ephemeris = pytest.mark.skipif(
    find_spec("jplephem") is None or find_spec("skyfield_data") is None,
    reason="the ephemeris is not installed",
)
