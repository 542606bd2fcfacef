"""Series in ε to high order: Taylor coefficients, null spaces order by order, invariants."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
import lanewise
from dvi_jax.discover.algebra.block_triangular import BlockTriangular, larger_than
from dvi_jax.discover.algebra.nullspace import toeplitz
from dvi_jax.discover.algebra.taylor import taylor_coefficients
from dvi_jax.engine.newton import Newton, find_root

X = jnp.array([0.3, 0.7, 1.1])


@jax.custom_jvp
def doubled(x):
    return jnp.sin(x)


doubled.defjvp(lambda p, t: (doubled(*p), 2 * jnp.cos(p[0]) * t[0]))  # a derivative of its own


def cube_root(e):
    """x³ = 1 + e."""
    return find_root(lambda x: x**3 - 1 - e, jnp.ones(1), jnp.ones(1), Newton())[0]


def nested(function, at, order):
    """Taylor coefficients by forward mode inside of forward mode."""
    out, scale = [], 1.0
    for m in range(order + 1):
        out.append(function(at) / scale)
        scale *= m + 1
        function = lambda x, f=function: jax.jvp(f, (x,), (jnp.ones_like(x),))[1]  # noqa: E731
    return jnp.stack(out)


FUNCTIONS = {
    "sums": lambda e: jnp.concatenate([X + e, e - X, 2 - e * X])[1:7].reshape(2, 3).sum(0),
    "products": lambda e: jnp.prod(jnp.stack([X + e, X * e + 1, X - e**2]), axis=0),
    "quotients": lambda e: (X + e) / (1 + e**2) / (2 - jnp.exp(e * X)),
    "powers": lambda e: (X + e) ** 1.5 + (X + e) ** -3 + X ** (1 + e) + jnp.sqrt(X + e),
    "functions": lambda e: jnp.tanh(X + e) * jnp.arctan2(X + e, 2 - e * X) + jnp.log(X + e),
    "choices": lambda e: jnp.where(X + e > 0.5, jnp.sin(X * e), e * X) + jnp.maximum(X + e, 0.5),
    "constant": lambda e: X + jax.lax.stop_gradient(e),
    "own derivative": lambda e: doubled(X * e + 1) * e,
    "gradient": lambda e: jax.grad(lambda y: jnp.sum(jnp.exp(y * e) * jnp.sin(y)))(X + e),
    "linear system": lambda e: lanewise.solve(jnp.diag(X) + e * jnp.outer(X, X), jnp.cos(e + X)),
    "root": lambda e: cube_root(jnp.sin(e)),
    "loop": lambda e: jax.lax.fori_loop(0, 3, lambda _, y: y * jnp.cos(e * y), X),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_taylor_coefficients_are_those_of_nested_derivatives(name):
    """Nested derivatives of roots and loops take long to compile."""
    function, order = FUNCTIONS[name], 2 if name in ("root", "loop", "linear system") else 4
    ours = jax.jit(lambda e: taylor_coefficients(function, e, order))
    theirs = jax.jit(lambda e: nested(function, e, order))(jnp.asarray(0.11))
    np.testing.assert_allclose(ours(0.11), theirs, rtol=1e-12, atol=1e-14)
    assert name == "constant" or np.max(np.abs(ours(0.12) - theirs)) > 1e-4


def test_taylor_coefficients_of_order_eight_are_the_known_ones():
    """(1 + ε)^(1/3) by Newton's iteration, and tan ε, also in a batch."""
    root = jax.jit(lambda e: taylor_coefficients(cube_root, e, 8))(0.0)[:, 0]
    known = [1, 1 / 3, -1 / 9, 5 / 81, -10 / 243, 22 / 729, -154 / 6561, 374 / 19683, -935 / 59049]
    np.testing.assert_allclose(root, known, rtol=1e-13)
    tan = jax.vmap(lambda a: taylor_coefficients(lambda e: jnp.tan(a * e), jnp.zeros(()), 8))
    one, two = jax.jit(tan)(jnp.array([1.0, 2.0]))
    known = np.array([0, 1, 0, 1 / 3, 0, 2 / 15, 0, 17 / 315, 0])
    np.testing.assert_allclose(one, known, atol=1e-15)
    np.testing.assert_allclose(two, known * 2.0 ** np.arange(9), atol=1e-13)


@pytest.mark.slow
def test_operations_of_a_series_do_not_double_with_each_order():
    def operations(order, series):
        f = lambda e: jnp.tanh(jnp.sin(X + e) / (1 + e) * jnp.exp(e))  # noqa: E731
        traced = jax.make_jaxpr(lambda e: series(f, e, order))(0.1)
        return len(traced.jaxpr.eqns)

    assert operations(6, taylor_coefficients) < 5 * operations(2, taylor_coefficients)
    assert operations(6, nested) > 20 * operations(2, nested)


def series_system(seed=0, orders=4, size=9, secular=3):
    """Random terms with A_0 of rank size − 3, whose null vectors are lost at order 1, lost at order
    3, and conserved."""
    rng = np.random.default_rng(seed)
    terms = rng.normal(size=(40, orders, size))
    terms[:, 0, -secular:] = 0.0
    terms[:, 1:, -1] = terms[:, :1, :4] @ rng.normal(size=4)  # in the range of A_0 at each order
    terms[:, 1:3, -2] = terms[:, :1, :4] @ rng.normal(size=4)
    terms[:, 1:, :4] = 0.0  # so that the corrections have no defects of their own
    return terms


def test_null_vectors_and_solutions_order_by_order():
    terms = series_system()
    system = BlockTriangular(terms, larger_than(1e-10))
    counts = [tuple(c.shape[2] for c in system.null(k)) for k in range(4)]
    assert counts == [(3, 0), (2, 3), (2, 5), (1, 7)]
    for k in range(4):
        matrix = toeplitz(terms, k)
        leading, shifts = (c.reshape((k + 1) * 9, -1) for c in system.null(k))
        columns = np.hstack([leading, shifts])
        assert np.max(np.abs(matrix @ columns)) < 1e-13
        singular = np.linalg.svd(matrix, compute_uv=False)
        assert np.sum(singular < 1e-10 * singular[0]) == columns.shape[1]
        assert np.linalg.matrix_rank(columns) == columns.shape[1]
        np.testing.assert_allclose(
            leading[:9].T @ leading[:9], np.eye(leading.shape[1]), atol=1e-12
        )
        assert not shifts[:9].any()
    terms[:, 3, -1] += 1e-3 * np.random.default_rng(1).normal(size=40)  # lost at order 3 as well
    assert BlockTriangular(terms, larger_than(1e-10)).null(3)[0].shape[2] == 0
    terms, rng = series_system(), np.random.default_rng(2)
    free = rng.uniform(size=(4, 9)) < 0.7
    c = np.where(free, rng.normal(size=(4, 9)), 0.0)[..., None]
    system = BlockTriangular(terms, larger_than(1e-10), free)
    right = system.left_sides(c)
    solution = system.solve(right)
    assert not solution[~free].any()
    np.testing.assert_allclose(system.left_sides(solution), right, atol=1e-12)
    right[2] += rng.normal(size=right[2].shape)  # outside of the range
    assert np.max(np.abs(system.left_sides(system.solve(right)) - right)) > 0.1


def change_in_a_step(series, powers, q, p, epsilon, h):
    """I(q1, p1) − I(q, p) for q'' = −q − ε q², in exact arithmetic."""

    def value(q, p):
        monomials = [q ** int(i) * p ** int(j) for i, j in powers]
        return sum(
            epsilon**m * sum(Fraction(float(x)) * y for x, y in zip(c, monomials, strict=True))
            for m, c in enumerate(series)
        )

    p1 = p + h * (-q - epsilon * q**2)
    return value(q + h * p1, p1) - value(q, p)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "degree", "survivors", "wrong_at", "largest"),
    [
        (2, 4, (2, 1, 1), 1, 40),
        # Fewer with each order, by the degree that remains for corrections.
        pytest.param(6, 8, (4, 3, 3, 2, 2, 1, 1), 4, 2, marks=pytest.mark.slow),
    ],
)
def test_an_invariant_of_an_order_changes_by_the_next_power_of_epsilon(
    order, degree, survivors, wrong_at, largest
):
    force = lambda t0, t1, q, p, args: -(q**2)  # noqa: E731
    system = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2, force=force)
    samples = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 120, 1))
    found = dvi.discover_invariants(system, dvi.Polynomials(degree), order, h=0.1, samples=samples)
    assert (found.survivors, found.count) == (survivors, 1)
    powers = found.basis.function.counts
    wrong = np.array(found.coefficients[0])
    wrong[wrong_at, np.argmax(np.abs(wrong[wrong_at]))] *= 2
    slopes = []
    for series in (np.asarray(found.coefficients[0]), wrong):
        changes = [
            abs(change_in_a_step(series, powers, Fraction(2, 5), Fraction(1, 3), e, Fraction(0.1)))
            for e in (Fraction(1, largest), Fraction(1, 2 * largest))
        ]
        slopes.append(np.log2(float(changes[0] / changes[1])))
    assert slopes[0] == pytest.approx(order + 1, abs=0.2)
    assert slopes[1] < wrong_at + 1  # wrong_at in the limit of small ε


@pytest.mark.slow
def test_orders_above_six_are_not_silent():
    system = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 40, 1))
    how = {"h": 0.1, "samples": samples}
    with pytest.warns(UserWarning, match="order=7: above order 6 rounding in float64"):
        dvi.discover_invariants(system, dvi.Polynomials(2), order=7, **how)
