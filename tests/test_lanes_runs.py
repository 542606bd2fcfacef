"""Runs by components against runs in arrays: lattices, methods, failures, saves, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

COMPONENTS, ARRAYS = dvi.Layout(form="components"), dvi.Layout(form="arrays")
SLOW = pytest.mark.slow


def assert_same(found, expected, rtol=1e-10):
    paths = jax.tree_util.tree_flatten_with_path(expected)[0]
    for (path, b), a in zip(paths, jax.tree.leaves(found), strict=True):
        where = jax.tree_util.keystr(path)
        assert (a.shape, a.dtype) == (b.shape, b.dtype), where
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol, err_msg=where)


def both(run, rtol=1e-10):
    expected = run(ARRAYS)
    assert_same(run(COMPONENTS), expected, rtol)
    return expected


def final(system, q, p, h, layout, args=None, num_steps=20, **settings):
    settings = {"save": dvi.Save(final=True), **settings}
    sol = dvi.integrate(
        system, q, p, h=h, num_steps=num_steps, args=args, layout=layout, **settings
    )
    return jnp.sum(sol.qs[-1] ** 2)


def starts(lanes, *shape, seed=0, size=0.3):
    rng = np.random.default_rng(seed)
    return (jnp.asarray(size * rng.normal(size=(lanes, *shape))) for _ in range(2))


MIXED = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + q0 @ (args @ p1) + jnp.sum(q0**4) / 4)
"""I + h·args is the matrix of its implicit step."""


@pytest.mark.parametrize("pivot", [pytest.param(x, marks=SLOW) for x in (0.0, 1e-11, 1e-8)])
def test_gradients_where_elimination_needs_exchanges(pivot):
    """The first pivot of I + h M is next to nothing: digits without exchanges would be lost."""
    q, p = starts(3, 3)
    M = jnp.array([[-1.0, 0.7, 0.2], [0.9, 0.3, -0.4], [0.1, 0.6, 0.8]])
    h = 1.0 - pivot

    def gradient(layout):
        slope = jax.grad(lambda q, p, M: final(MIXED, q, p, h, layout, M, num_steps=2), (0, 2))
        return jax.jit(jax.vmap(slope, (0, 0, None)))(q, p, M)

    expected = both(gradient, rtol=1e-11)
    assert np.isfinite(expected[1]).all()


TABLE = jnp.array([1.0, 2.0, 3.0, 4.0])
CHOSEN = dvi.System(
    lambda t0, t1, q0, p1, args: (
        p1 @ p1 / 2 * TABLE[args["which"]]
        + jnp.where(args["strong"], 2.0, args["w"]) * (q0 @ q0) / 2
    )
)


@pytest.mark.parametrize("what", ["grad", pytest.param("jvp", marks=SLOW)])
@pytest.mark.parametrize("lanes_of", [pytest.param("state", marks=SLOW), "which"])
def test_derivatives_beside_whole_numbers_and_truth_values(what, lanes_of):
    """Integers in args are traced, and vary from lane to lane; they have no derivative."""
    q, p = starts(4, 2)
    on = lanes_of == "state"
    which = jnp.array([0, 3, 1, 2])
    arguments = (q, p, which) if on else (q[0], p[0], which)

    def slopes(layout):
        def loss(q, p, w, which):
            args = {"which": which, "w": w, "strong": which == 1}
            return final(CHOSEN, q, p, 0.02, layout, args)

        def of(q, p, which):
            if what == "grad":
                return jax.grad(loss, (0, 1, 2))(q, p, 1.5, which)
            return jax.jvp(lambda w: loss(q, p, w, which), (1.5,), (1.0,))

        axes = (0, 0, 0) if on else (None, None, 0)
        return jax.jit(jax.vmap(of, axes))(*arguments)

    expected = both(slopes)
    assert len(np.unique(np.round(expected[-1], 12))) > 1  # which of them it is does matter
