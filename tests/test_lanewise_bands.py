"""Linear systems in array loops: bands, other orders of the unknowns, full matrices."""

import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
import lanewise
from dvi_jax.base.results import status_code
from lanewise.elements import bands


def band(n, low, high, diagonal, seed=0):
    """A random band matrix, and its rows."""
    rng = np.random.default_rng(seed)
    A, rows = np.zeros((n, n)), np.zeros((n, low + high + 1))
    for i in range(n):
        for j in range(max(0, i - low), min(n, i + high + 1)):
            A[i, j] = rows[i, j - i + low] = rng.normal() + diagonal * (i == j)
    return A, jnp.asarray(rows)


@pytest.mark.parametrize(("low", "high"), [(0, 0), (1, 1), (3, 0), (1, 3)])
def test_a_band_is_solved_as_numpy_solves_it(low, high):
    A, rows = band(40, low, high, 6.0)
    b = np.random.default_rng(1).normal(size=(40, 2))
    exact = np.linalg.solve(A, b)
    factors = bands.factorise(rows, low)
    assert not factors.weak
    np.testing.assert_allclose(bands.substitute(factors, jnp.asarray(b)), exact, 0, 1e-14)
    np.testing.assert_allclose(bands.with_exchanges(rows, jnp.asarray(b), low), exact, 0, 1e-14)


def test_rows_are_exchanged_where_factors_are_large():
    A, rows = band(40, 1, 1, 0.0)
    A[0, 0], rows = 1e-14, rows.at[0, 1].set(1e-14)
    b = np.random.default_rng(1).normal(size=40)
    exact, factors = np.linalg.solve(A, b), bands.factorise(rows, 1)
    assert factors.weak

    def error(x):
        return float(np.max(np.abs(x[:, 0] - exact)) / np.max(np.abs(exact)))

    right = jnp.asarray(b)[:, None]
    assert error(bands.solve(factors, rows, right)) < 1e-12
    assert error(bands.substitute(factors, right)) > 1e-6  # the control: without exchanges


def test_axes_of_length_1_in_an_array_of_many_parts():
    def function(x):
        parts = [x[3 * i : 3 * i + 3] * (i + 1) for i in range(30)]
        y = jnp.concatenate(parts)[None]
        return (y + jnp.concatenate(parts)[::-1][None])[0] * x

    x = jnp.linspace(0.0, 1.0, 90)
    found = jax.jit(lambda x: lanewise.call(function, x))(x)
    np.testing.assert_allclose(found, function(x), rtol=1e-15)


def random_equations(seed):
    """(n, F): equations F(x, q) = 0 of n unknowns that are coupled to some others."""
    draw = random.Random(seed)
    n, kind = draw.choice([20, 34, 60, 100]), draw.choice(["open", "ring", "halves", "pairs"])
    terms = [
        (draw.choice(["product", "sine", "choice", "quotient", "square", "inner", "sum"]),
         draw.choice([-2, -1, 1, 3]), draw.uniform(-0.3, 0.3))
        for _ in range(draw.choice([1, 2, 3]))
    ]  # fmt: skip
    weak = draw.random() < 0.2

    def moved(x, k):
        if kind == "ring":
            return jnp.roll(x, k)
        return jnp.pad(x, (k, 0))[:n] if k > 0 else jnp.concatenate([x[-k:], jnp.ones(-k)])

    def term(name, x, y, q):
        if name == "inner":
            return jnp.zeros(n).at[1:-1].add(y[2:] * x[1:-1])
        return {
            "product": x * y, "sine": jnp.sin(y) * q, "choice": jnp.where(y > 0, y, 0.2 * x),
            "quotient": y / (2 + x * x), "square": (y - x) ** 2, "sum": jnp.sum(y) * q / n,
        }[name]  # fmt: skip

    def F(x, q):
        y = 1e-3 * x if weak else x
        if kind == "halves":
            a, b = x.reshape(2, -1)
            y = jnp.concatenate([a + 0.2 * b * b, 2 * b - a])
        if kind == "pairs":
            z = x.reshape(-1, 2)
            y = (z + 0.2 * z[:, ::-1] * z + 0.1 * jnp.roll(z, 1, 0)).reshape(-1)
        return y + sum(c * term(name, x, moved(x, k), q) for name, k, c in terms) - q

    return n, F


def solutions(F, x, q):
    """Two steps of Newton's method with one Jacobian, a solution with its transpose, and one in a
    branch."""
    value, push = jax.linearize(lambda x: F(x, q), x)
    J = jax.vmap(push, out_axes=1)(lanewise.unit_vectors(x.size, x.dtype))
    a = lanewise.solve(J, value)
    last = jax.lax.cond(q[0] > 0, lambda: lanewise.solve(J, q * q), lambda: q)
    return a, lanewise.solve(J, F(x - a, q)), lanewise.solve(J.T, q), last


def check_random(seed):
    n, F = random_equations(seed)
    rng = np.random.default_rng(seed)
    x, q = jnp.asarray(rng.normal(size=n)), jnp.asarray(rng.normal(size=n))
    J, value = np.asarray(jax.jacfwd(F)(x, q)), np.asarray(F(x, q))
    a = np.linalg.solve(J, value)
    second, transposed = np.linalg.solve(J, F(x - a, q)), np.linalg.solve(J.T, q)
    last = np.linalg.solve(J, q * q) if q[0] > 0 else q
    function = jax.jit(lambda *z: lanewise.call(lambda *z: solutions(F, *z), *z))
    for found, exact in zip(function(x, q), (a, second, transposed, last), strict=True):
        size = np.max(np.abs(a)) + np.max(np.abs(exact))
        assert np.max(np.abs(found - exact)) <= 1e-13 * np.linalg.cond(J) * size


@pytest.mark.parametrize("seed", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in (1, 2))])
def test_random_equations(seed):
    check_random(seed)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(100, 200, 10))
def test_many_random_equations(first):
    for seed in range(first, first + 10):
        check_random(seed)


def chain(t0, t1, q0, p1, args):
    d = jnp.diff(q0)
    return jnp.sum(p1**2 * (1 + 0.3 * q0**2)) / 2 + jnp.sum(d**2 + args * p1[1:] * p1[:-1]) / 2


def ring(t0, t1, q0, p1, args):
    d = jnp.roll(q0, 1) - q0
    return jnp.sum(p1**2 * (1 + 0.3 * q0**2) + d**2 + args * p1 * jnp.roll(p1, 1)) / 2


def everyone(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 * (1 + 0.1 * jnp.mean(q0**2)) + jnp.sum(q0**2) / 2


def run(H_D, n, form="auto", **options):
    rng = np.random.default_rng(3)
    q, p = rng.uniform(-0.5, 0.5, (2, n))
    options = {"h": 0.05, "num_steps": 12, "throw": False, "save": dvi.Save(final=True)} | options

    def final(q, p, c):
        layout = dvi.Layout(form=form)
        s = dvi.integrate(dvi.System(H_D), q, p, args=c, layout=layout, **options)
        return s.qs[-1], s.ps[-1], status_code(s.result), s.stats["newton_iterations"]

    return final, (q, p, 0.2)


@pytest.mark.parametrize(
    ("H_D", "options"),
    [
        (chain, {"root_finder": dvi.Newton()}),
        (ring, {"root_finder": dvi.Newton()}),
        # The stages are far from each other in the vector of unknowns.
        pytest.param(chain, {"method": dvi.GaussLegendre(2), "h": 1.0}, marks=pytest.mark.slow),
        # Picard's iteration diverges: Newton's method, in a branch, with a full matrix.
        (everyone, {"method": dvi.GaussLegendre(1), "h": 3.0}),
    ],
    ids=["chain", "ring", "stages", "full"],
)
def test_implicit_steps_are_those_of_xla(H_D, options):
    final, inputs = run(H_D, 50, **options)
    reference, _ = run(H_D, 50, "arrays", **options)
    (part,) = lanewise.explain(final, *inputs).parts
    assert part.target == "elements"
    found, exact = jax.jit(final)(*inputs), jax.jit(reference)(*inputs)
    for x, y in zip(found[:2], exact[:2], strict=True):
        np.testing.assert_allclose(x, y, 0, 1e-13)
    assert found[2] == exact[2] == 0
    assert found[3] == exact[3]


def test_a_band_takes_memory_of_its_diagonals_only():
    def scratch(H_D, n):
        final, inputs = run(H_D, n, root_finder=dvi.Newton())
        (part,) = lanewise.explain(final, *inputs).parts
        return part.scratch / n

    # A matrix of 400 unknowns would have 3200 bytes for each.
    assert scratch(chain, 400) < 400
    assert scratch(ring, 400) < 700


def test_a_full_matrix_outside_of_a_branch_is_left_to_lapack():
    final, inputs = run(everyone, 60, root_finder=dvi.Newton())
    (part,) = lanewise.explain(final, *inputs).parts
    assert "LAPACK is faster" in part.reason


def test_gradients_of_implicit_steps_are_differences():
    final, (q, p, c) = run(ring, 60, root_finder=dvi.Newton(), adjoint=dvi.Reversible())
    loss = jax.jit(lambda c: jnp.sum(final(q, p, c)[0] ** 3))
    found, h = jax.jit(jax.grad(loss))(c), 1e-5
    differences = (loss(c + h) - loss(c - h)) / (2 * h)
    assert float(found) == pytest.approx(float(differences), rel=1e-8)


def test_a_nan_among_the_unknowns_is_a_failed_step():
    final, (q, p, c) = run(chain, 60, root_finder=dvi.Newton())
    *_, code, _ = jax.jit(final)(q, p.copy() * np.where(np.arange(60) == 7, np.nan, 1), c)
    reference, _ = run(chain, 60, "arrays", root_finder=dvi.Newton())
    *_, expected, _ = jax.jit(reference)(q, p * np.where(np.arange(60) == 7, np.nan, 1), c)
    assert code == expected != 0
