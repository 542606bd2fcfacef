"""Small linear solves, linear maps with a transpose, and dependence read from the jaxpr."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import lanewise
from lanewise.jaxprs.dependence import depends_on
from lanewise.jaxprs.jaxapi import linear_map
from lanewise.linear import IN_A_LOOP

SOLVE = {
    "XLA": jax.jit(lanewise.solve),
    "machine code": jax.jit(lambda A, b: lanewise.call(lanewise.solve, A, b)),
}
EACH = pytest.mark.parametrize("solve", list(SOLVE))


@EACH
@settings(max_examples=60, deadline=None)
@given(n=st.integers(1, 5), seed=st.integers(0, 2**31))
def test_solve_agrees_with_lapack_in_backward_error(solve, n, seed):
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(n, n)), rng.normal(size=n)
    x = np.asarray(SOLVE[solve](A, b))
    backward = np.max(np.abs(A @ x - b)) / (np.max(np.abs(A)) * np.max(np.abs(x)) + 1)
    assert backward < 1e-13


@EACH
@pytest.mark.parametrize("n", [2, 3, 4])
def test_solve_pivots(solve, n):
    A = np.eye(n)[::-1].copy() + 1e-30 * np.eye(n)
    b = np.arange(1.0, n + 1)
    np.testing.assert_allclose(SOLVE[solve](A, b), b[::-1], rtol=1e-14)
    assert not np.allclose(_eliminate_without_pivoting(A, b), b[::-1])  # as without it


@np.errstate(all="ignore")
def _eliminate_without_pivoting(A, b):
    if len(b) == 1:
        return b / A[0]
    f = A[1:, 0] / A[0, 0]
    x = _eliminate_without_pivoting(A[1:, 1:] - np.outer(f, A[0, 1:]), b[1:] - f * b[0])
    return np.append((b[0] - A[0, 1:] @ x) / A[0, 0], x)


@EACH
def test_singular_matrix_gives_no_number(solve):
    assert not np.isfinite(SOLVE[solve](np.ones((2, 2)), np.array([1.0, 2.0]))).all()


@pytest.mark.parametrize("n", [4, 5, IN_A_LOOP, IN_A_LOOP + 1])
def test_batched_linear_systems_call_lapack_only_above_the_limit(n):
    """Calls of LAPACK for a batch may deadlock (on a CPU, compiled by XLA)."""

    def has_lapack(function):
        text = jax.jit(function).lower(jnp.ones((3, n, n)), jnp.ones((3, n))).as_text()
        return "getrf" in text or "trsm" in text

    assert has_lapack(jax.vmap(lanewise.solve)) == (n > IN_A_LOOP)
    assert has_lapack(jax.vmap(jnp.linalg.solve))


@pytest.mark.slow
@pytest.mark.parametrize("n", [pytest.param(5, marks=pytest.mark.slow), 16])
def test_batched_linear_systems_are_solved_with_exchanges_of_rows(n):
    rng = np.random.default_rng(n)
    A, b = rng.normal(size=(40, n, n)), rng.normal(size=(40, n))
    A = A * 10.0 ** rng.uniform(-6, 6, (40, n, 1))
    A[:, 0, 0] = 0.0  # without an exchange: a division by zero
    x = np.asarray(jax.vmap(lanewise.solve)(A, b))
    left = np.einsum("sij,sj->si", A, x) - b
    size = np.einsum("sij,sj->si", np.abs(A), np.abs(x)) + np.abs(b)
    assert np.max(np.abs(left) / size) < 1e-13
    slopes = jax.vmap(jax.grad(lambda A, b: jnp.sum(lanewise.solve(A, b)), 1))(A, b)
    ones = np.linalg.solve(np.swapaxes(A, 1, 2), np.ones((40, n, 1)))[..., 0]
    np.testing.assert_allclose(slopes, ones, rtol=1e-6)


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x, y: x, False),
        (lambda x, y: x + 0 * y, True),  # errs on the safe side
        (lambda x, y: x * jnp.sign(y), True),  # zero derivative, yet dependent
        (lambda x, y: jnp.where(y > 0, x, 2 * x), True),
        (lambda x, y: jax.jit(lambda a, b: (a * 2, b * 3))(x, y)[0], False),
        (lambda x, y: jax.jit(lambda a, b: (a * 2, b * 3))(x, y)[1], True),
        (lambda x, y: jax.grad(lambda a: jnp.sum(jnp.cos(a)) + jnp.sum(y**2))(x), False),
        (lambda x, y: jax.grad(lambda a: jnp.sum(jnp.cos(a) * y**2))(x), True),
        (lambda x, y: jax.lax.fori_loop(0, 3, lambda i, a: a * x, x), False),
        (lambda x, y: jax.lax.fori_loop(0, 3, lambda i, a: a * y, x), True),
        (lambda x, y: jax.lax.cond(y[0] > 0, lambda: x, lambda: 2 * x), True),
        (lambda x, y: jnp.linalg.norm(x) * x, False),
        (lambda x, y: lanewise.call(lambda a, b: (2 * a, 3 * b), x, y)[0], False),
        (lambda x, y: lanewise.call(lambda a, b: (2 * a, 3 * b), x, y)[1], True),
        (lambda x, y: lanewise.call(lambda a: a * y, x), True),  # what is closed over
        (lambda x, y: lanewise.call(lambda a: a * x, y), True),
        (lambda x, y: lanewise.call(lambda a: a * x, x), False),
    ],
)
def test_dependence(function, expected):
    x = jnp.ones(2)
    assert depends_on(function, 1, x, x) is expected


def _scaled(residuals, x):
    a, _ = residuals
    return {"y": jnp.sin(a) * jnp.stack([x[0] + 2 * x[1], 3 * x[0], x[1]])}


def _scaled_back(residuals, y):
    a, marks = residuals
    marks.append("transpose")
    u, v, w = y["y"]
    return jnp.sin(a) * jnp.stack([u + 3 * v, 2 * u + w])


def _mapped(a, x, marks, definition=_scaled):
    def pull(residuals, y):
        return _scaled_back((residuals[0], marks), y)

    def push(residuals, x):
        return lanewise.call(_scaled, residuals, x)

    return linear_map(push, pull, definition, (a, jnp.asarray(0)), x)


def by_residuals(f):
    return jax.grad(f, 0)


DERIVATIVES = [
    lambda f: f,
    lambda f: jax.grad(f, 1),
    lambda f: jax.jacfwd(f, 1),
    *(
        pytest.param(derivative, marks=pytest.mark.slow)
        for derivative in (
            lambda f: jax.jacrev(jax.grad(f, 0), 1),
            by_residuals,
            lambda f: jax.hessian(f, 1),
            lambda f: jax.jacfwd(jax.grad(f, 1), 0),
        )
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize("derivative", DERIVATIVES)
def test_a_linear_map_uses_its_own_transpose(derivative):
    """Forward, reverse, second derivatives, batched or not; against the map itself."""
    x, w = jnp.array([0.3, -1.2]), jnp.array([1.0, -2.0, 0.5])
    marks: list = []

    def ours(a, x):
        return w @ _mapped(a, x, marks)["y"] ** 2

    def plain(a, x):
        return w @ _scaled((a, None), x)["y"] ** 2

    a = jnp.array([0.7, 1.1, -0.4])
    found, expected = derivative(ours), derivative(plain)
    np.testing.assert_allclose(found(a[0], x), expected(a[0], x), rtol=1e-13)
    for axes, args in (((0, None), (a, x)), ((0, 0), (a, jnp.outer(a, x)))):
        np.testing.assert_allclose(
            jax.vmap(found, axes)(*args), jax.vmap(expected, axes)(*args), rtol=1e-13
        )
    # Derivatives by the residuals are those of the definition.
    is_reverse = derivative not in (DERIVATIVES[0], DERIVATIVES[2], by_residuals)
    assert bool(marks) == is_reverse  # the given transpose is used


def test_a_definition_gives_derivatives_and_on_any_takes_one_boolean():
    """By the residuals; negative control: a definition with another dependence on them."""

    def of(definition):
        return jax.grad(lambda a: jnp.sum(_mapped(a, jnp.ones(2), [], definition)["y"]))(0.7)

    np.testing.assert_allclose(of(_scaled), np.cos(0.7) * 7, rtol=1e-13)
    assert abs(float(of(lambda r, x: _scaled((2 * r[0], None), x))) - np.cos(0.7) * 7) > 0.1
    with pytest.raises(TypeError, match="must be one boolean"):
        lanewise.on_any(jnp.array([1.5, 2.0]))
    with pytest.raises(TypeError, match="rare"):
        lanewise.on_any(jnp.asarray(True), rare="often")  # pyright: ignore[reportArgumentType]
    assert bool(lanewise.on_any(jnp.asarray(True)))
