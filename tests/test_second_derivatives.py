"""Functions with a derivative of their own, in second derivatives of loops and branches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import dvi_jax as dvi
import lanewise
from dvi_jax.engine.guard import constant_unless, nan_where_used
from dvi_jax.engine.in_pairs import in_pairs
from dvi_jax.fit.optimise import _residual, _scalar_function
from dvi_jax.fit.posterior import _finite_potential
from dvi_jax.methods.step import to_grid
from dvi_jax.systems import rings
from dvi_jax.systems.boozer import _sums


def hypotenuse(p):
    """√(1 + p²), the Hamiltonian of the Lagrangian −√(1 − v²)."""
    H = dvi.legendre(lambda t, q, v, args: -jnp.sqrt(1 - v @ v))
    return H(0.0, jnp.zeros(1), p[None], None)


def root(x):
    """The y with y + y³ = x."""

    def solve(f, y):
        return lax.fori_loop(0, 30, lambda _, y: y - f(y) / (1 + 3 * y * y), y), ()

    def divide(linear, b):
        return b / linear(jnp.ones_like(b))

    return lanewise.implicit_root(lambda y: y + y**3 - x[None], jnp.ones(1), solve, divide)[0][0]


def cardano(x):
    w = jnp.sqrt(x * x / 4 + 1 / 27)
    return jnp.cbrt(x / 2 + w) + jnp.cbrt(x / 2 - w)


def potential(x):
    def value(u):
        return jnp.sum(jnp.sin(u))

    return _finite_potential(value, jax.value_and_grad(value))(x[None])


class Core:
    """The loss sin u in place of that of a fit."""

    def scalar(self, u, horizon, choice):
        return jnp.sum(jnp.sin(u))


def scaled_loss(x):
    setting = jnp.zeros(1), 2.0, None, None
    return _scalar_function(Core(), 2.0)(x[None], setting)[0]


SLOPES = jnp.array([[1.0], [-0.7]])


def residuals(x):
    """A linear residual vector whose value and Jacobian are inputs, as in a step of a fit."""
    linearisation = lax.stop_gradient((SLOPES @ x[None], SLOPES))
    return jnp.sum(jnp.sin(_residual(x[None], linearisation)) * jnp.array([1.0, 2.0]))


MODES = jnp.asarray(np.random.default_rng(0).normal(size=(1, 3, 3, 2)))
SHAPE = _sums.Shape(periods=2, helicity=0)


def in_run(adjoint, arithmetic):
    def last(x):
        system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + jnp.sum(jnp.cos(q)) * x)
        sol = dvi.integrate(
            system, x[None], jnp.ones(1), h=0.2, num_steps=2, method=dvi.Strang(), adjoint=adjoint,
            arithmetic=arithmetic, save=dvi.Save(final=True),
        )  # fmt: skip
        return sol.q_final[0]

    return last


def ring_run(x):
    """x after two turns in a ring of a thin sextupole and a drift."""
    ring = rings.Ring([rings.multipole("S", 0.0, (0.0, 0.0, 0.2)), rings.drift("D", 1.0)])
    problem = rings.problem(ring)
    sol = dvi.integrate(
        problem.system, jnp.stack([x, 0 * x, 0 * x]), jnp.zeros(3), h=1.0, num_steps=2,
        args=problem.args, method=rings.Turn(), save=dvi.Save(final=True),
    )  # fmt: skip
    return sol.q_final[0]


def henon(x):
    """The same as the map of Hénon."""
    p = 0.0
    for _ in range(2):
        p = p - 0.2 * x * x
        x = x + p
    return x


RULES = {
    "to_grid": (lambda x: to_grid(jnp.sin(x), 2.0**-40), jnp.sin),
    "in_pairs": (lambda x: in_pairs(jnp.sin, x).hi, jnp.sin),
    "constant_unless": (
        lambda x: constant_unless(x > -9, jnp.sin, x, succeeds=lambda y: y > -9),
        jnp.sin,
    ),
    "nan_where_used": (lambda x: nan_where_used(jnp.sin, x), jnp.sin),
    "legendre": (hypotenuse, lambda p: jnp.sqrt(1 + p * p)),
    "implicit_root": (root, cardano),
    "potential": (potential, jnp.sin),
    "residuals": (residuals, lambda x: jnp.sin(x) - 2 * jnp.sin(0.7 * x)),
    "scaled loss": (scaled_loss, lambda x: jnp.sin(2 * x) / 2),
    "ring": (ring_run, henon),
    "boozer": (
        lambda x: _sums.total(MODES, SHAPE, x, 0.3 * x, 0.7),
        lambda x: _sums.derivatives(MODES, SHAPE, x, 0.3 * x, 0.7, order=0)[0],
    ),
}
SITES = {
    "scan": lambda f: lambda k: lax.scan(lambda c, _: (f(k * c), None), k, None, 3)[0],
    "branch": lambda f: lambda k: lax.cond(k > 0, lambda k: f(k * k), jnp.sin, k),
    "checkpoint": lambda f: (
        lambda k: lax.scan(jax.checkpoint(lambda c, _: (k * f(c), None)), k, None, 2)[0]
    ),
    "machine code": lambda f: (
        lambda k: lanewise.call(lambda k: lax.scan(lambda c, _: (f(k * c), None), k, None, 3)[0], k)
    ),
}
ORDERS = [
    lambda f: jax.jacfwd(jax.grad(f)),
    lambda f: jax.jacfwd(jax.jacfwd(f)),
    lambda f: jax.grad(jax.grad(f)),
    lambda f: jax.grad(jax.jacfwd(f)),
]
K = jnp.array([0.4, 0.9])


def seconds(f):
    """The second derivatives in all orders, in a batch."""
    return jax.jit(jax.vmap(lambda k: jnp.stack([order(f)(k) for order in ORDERS])))(K)


QUICK = [(rule, "scan") for rule in ("to_grid", "in_pairs", "nan_where_used")]
CASES = [(rule, site) for rule in RULES for site in SITES]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rule", "site"),
    [c if c in QUICK else pytest.param(*c, marks=pytest.mark.slow) for c in CASES],
)
def test_second_derivatives_in_all_orders(rule, site):
    function, plain = RULES[rule]
    expected = jax.vmap(jax.jacfwd(jax.jacfwd(SITES[site](plain))))(K)
    result = seconds(SITES[site](function))
    np.testing.assert_allclose(result, np.repeat(expected[:, None], 4, 1), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES)
def test_forward_mode_of_a_loop_of_unknown_length(rule):
    function, plain = RULES[rule]

    def loop(f):
        return lambda k: lax.while_loop(
            lambda s: s[0] < 3, lambda s: (s[0] + 1, f(k * s[1])), (0, k)
        )[1]

    f, g = (jax.jit(jax.jacfwd(jax.jacfwd(loop(f)))) for f in (function, plain))
    np.testing.assert_allclose(f(0.4), g(0.4), rtol=1e-9)


def test_a_custom_jvp_loses_its_rule_in_a_scan():
    """The control: where JAX has corrected this, `with_derivative` is not needed any more."""

    @jax.custom_jvp
    def rounded(x):
        return jnp.round(x * 2.0**40) * 2.0**-40

    rounded.defjvp(lambda primals, tangents: (rounded(*primals), tangents[0]))
    result = seconds(SITES["scan"](lambda x: rounded(jnp.sin(x))))
    assert np.ptp(np.asarray(result[0])) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("arithmetic", [dvi.FixedPoint(2.0**-45), dvi.DoubleDouble()])
@pytest.mark.parametrize("adjoint", [dvi.Reversible(), dvi.Direct()])
def test_second_derivatives_of_runs(arithmetic, adjoint):
    plain = in_run(dvi.Direct(), dvi.FloatingPoint())
    f = jax.jit(jax.grad(plain))
    expected = [(f(k + 1e-5) - f(k - 1e-5)) / 2e-5 for k in K]
    result = seconds(in_run(adjoint, arithmetic))
    np.testing.assert_allclose(result, np.repeat(np.array(expected)[:, None], 4, 1), rtol=1e-7)


@pytest.mark.slow
def test_second_derivatives_of_tracked_particles():
    from dvi_jax.systems import rings

    parts = [rings.quadrupole("QF", 0.5, k1=0.6), rings.sextupole("S", 0.2, 3.0)]
    ring = rings.Ring([*parts, rings.drift("D", 2.0)])
    z = jnp.array([1e-2, 1e-3, 2e-3, -1e-3, 0.0, 1e-3])

    def f(k):
        return rings.track(ring, k * z, 2).z @ jnp.array([1.0, 2.0, -1.0, 0.5, 0.0, 0.0])

    slope = jax.jit(jax.grad(f))
    expected = (slope(0.9 + 1e-4) - slope(0.9 - 1e-4)) / 2e-4
    for order in ORDERS[:3]:
        np.testing.assert_allclose(jax.jit(order(f))(0.9), expected, rtol=1e-6)
