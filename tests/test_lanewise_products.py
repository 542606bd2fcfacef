"""Matrix products in array loops: tiles, operands that are turned, and what XLA computes faster."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lanewise
from lanewise.elements import nests, reductions, tiles
from lanewise.targets import TARGETS, elements
from lanewise.targets.elements import Elements

RNG = np.random.default_rng(7)


def rounds(function, x, *args):
    """Two rounds of a loop that carries an array."""
    return jax.lax.fori_loop(0, 2, lambda _, x: function(x, *args), x)


def by_numpy(function, x, *args):
    return function(function(x, *args), *args)


def with_target(target, function, *args):
    """The results by this target only, also where XLA would be faster."""
    saved = TARGETS["cpu"], elements.reason_for_xla
    TARGETS["cpu"], elements.reason_for_xla = (target,), lambda _: None
    compiled = functools.partial(lanewise.call, functools.partial(rounds, function))
    try:
        jax.clear_caches()
        (part,) = lanewise.explain(compiled, *args).parts
        assert part.reason is None
        return jax.jit(compiled)(*args)
    finally:
        TARGETS["cpu"], elements.reason_for_xla = saved
        jax.clear_caches()


def array(*shape):
    return RNG.standard_normal(shape) / 4


CASES = {
    "square": (lambda x, a: a @ x, (67, 67), (67, 67)),
    "narrow": (lambda x, a: a @ x, (13, 9), (13, 13)),
    "one row of tiles": (lambda x, a: x @ a, (8, 70), (70, 70)),
    "a few columns": (lambda x, a: a @ x, (70, 3), (70, 70)),
    "more terms than a part": (lambda x, a: x @ a, (10, 271), (271, 271)),
    "both turned": (lambda x, a: a.T @ x.T, (50, 50), (50, 50)),
    "second turned": (lambda x, a: a @ x.T, (50, 50), (50, 50)),
    "with itself": (lambda x, a: x @ x.T + a, (37, 37), (37, 37)),
    "matrix times vector": (lambda x, a: a @ x, (59,), (59, 59)),
    "vector times matrix": (lambda x, a: x @ a, (59,), (59, 59)),
    "two in one group": (lambda x, a: x @ a + a @ x, (59,), (59, 59)),
    "short rows": (lambda x, a: a @ (x @ a), (60,), (60, 10)),
    "matrices": (lambda x, a: a @ x, (6, 12, 11), (6, 12, 12)),
    "small matrices": (lambda x, a: a @ x, (61, 4, 4), (61, 4, 4)),
    "a computed operand": (lambda x, a: (x * x + 0.1) @ (a - 0.5 * x), (20, 20), (20, 20)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow) if x == "square" else x for x in CASES]
)
def test_products_are_those_of_numpy(name):
    function, *shapes = CASES[name]
    x, *args = (array(*shape) for shape in shapes)
    expected = by_numpy(function, x, *args)
    result = with_target(Elements(), function, x, *args)
    np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-13 * np.max(abs(expected)))


@pytest.mark.parametrize("dtype", ["float32", "int32"])
def test_products_of_other_types(dtype):
    x, a = (RNG.integers(-3, 4, (33, 33)).astype(dtype) for _ in range(2))
    result = with_target(Elements(), lambda x, a: a @ x, x, a)
    assert result.dtype == dtype
    np.testing.assert_array_equal(result, a @ (a @ x))  # whole numbers: without rounding


def test_sums_over_two_axes():
    x, a = array(7, 9, 20), array(7, 9, 20, 20)

    def function(x, a):
        return x + jnp.einsum("ijk,ijkl->l", x, a)[None, None]

    result = with_target(Elements(), function, x, a)
    step = lambda x: x + np.einsum("ijk,ijkl->l", x, a)  # noqa: E731
    np.testing.assert_allclose(result, step(step(x)), rtol=1e-12)


def of_width(numbers):
    class OfWidth(Elements):
        def write(self, function, lane_flags, lanes, width):
            return self.write_for(function, lane_flags, numbers)

    return OfWidth()


@pytest.mark.parametrize("name", ["narrow", "more terms than a part", "two in one group"])
def test_bits_depend_neither_on_the_length_of_vectors_nor_on_the_batch(name):
    function, *shapes = CASES[name]
    x, a = (array(*shape) for shape in shapes)
    results = [with_target(of_width(width), function, x, a) for width in (8, 4, 2)]
    for other in results[1:]:
        np.testing.assert_array_equal(results[0], other)
    batch = np.stack([0.5 * x, x, x + 1])
    batch[2, 0] = np.nan
    compiled = functools.partial(lanewise.call, functools.partial(rounds, function))
    saved = TARGETS["cpu"]
    TARGETS["cpu"] = (Elements(),)
    try:
        of_batch = jax.jit(jax.vmap(compiled, (0, None)))(batch, a)
        for i in range(3):
            np.testing.assert_array_equal(of_batch[i], jax.jit(compiled)(batch[i], a))
    finally:
        TARGETS["cpu"] = saved


def test_controls_of_tiles_and_turned_operands(monkeypatch):
    """With a wrong decision the numbers are wrong."""
    function, *shapes = CASES["more terms than a part"]
    x, a = (array(*shape) for shape in shapes)
    expected = by_numpy(function, x, a)
    error = lambda: np.max(abs(with_target(Elements(), function, x, a) - expected))  # noqa: E731
    assert error() < 1e-12
    monkeypatch.setattr(nests.Nests, "begin_reduction", lambda *_: None)  # sums begin anywhere
    assert not error() < 1e-3
    monkeypatch.undo()

    def turned(x, a):
        return x @ x.T + a

    x, a = array(30, 30), array(30, 30)
    expected = by_numpy(turned, x, a)
    error = lambda: np.max(abs(with_target(Elements(), turned, x, a) - expected))  # noqa: E731
    assert error() < 1e-12
    # What changes in each round must be turned in each round.
    monkeypatch.setattr(reductions, "_is_fixed", lambda _: True)
    assert not error() < 1e-3


def test_tiles_are_used():
    function, *shapes = CASES["square"]
    calls = []
    write = tiles.Tiles.write
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiles.Tiles, "write", lambda self: calls.append(self) or write(self))
        with_target(Elements(), function, *(array(*shape) for shape in shapes))
    assert calls


def reason(function, *args):
    (part,) = lanewise.explain(lambda *x: lanewise.call(function, *x), *args).parts
    return part.reason or part.target


def test_what_xla_computes_faster_is_left_to_it():
    def product(x, a):
        return rounds(lambda x, a: a @ x, x, a)

    def with_functions(x, a):
        def function(x, a):
            y = a @ x
            return sum(jnp.sin(y + i) for i in range(40))

        return rounds(function, x, a)

    def sort(x):
        return rounds(lambda x: 0.5 * jnp.sort(x) + jnp.sin(x), x)

    n = 120
    vector, matrix = jnp.ones(n), jnp.ones((n, n))
    assert "14400 numbers" in reason(product, vector, matrix)
    assert reason(product, jnp.ones(60), jnp.ones((60, 60))) == "elements"
    assert reason(product, matrix, matrix) == "elements"
    assert reason(with_functions, vector, matrix) == "elements"
    assert "sort of 120" in reason(sort, vector)
    np.testing.assert_allclose(lanewise.call(sort, vector), sort(vector), rtol=1e-14)
