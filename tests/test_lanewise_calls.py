"""Marked functions that a program calls several times are written once, with XLA's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from test_lanewise_threads import assert_same_bits, by_numbers, by_threads

import lanewise
from lanewise.native import machine
from lanewise.rules import calls

TABLE = jnp.linspace(0.5, 1.5, 200)  # an array in memory
LANES = 19


@lanewise.once
def inner(x):
    """A function that a large one calls twice."""
    for _ in range(31):
        x = x + 0.01 * jnp.roll(x, 1)
    return x


@lanewise.once
def large(x, scale, count, flag):
    """A function with a table, a loop, a branch, and results of all kinds."""
    y = inner(inner(jnp.sin(x) * scale) + TABLE[count])

    def search(state):
        y, n = state
        return y * 0.5, n + 1

    y, n = lax.while_loop(lambda state: jnp.max(jnp.abs(state[0])) > scale, search, (y, count))
    # Rows that later rounds of the loop do not read are results in memory.
    total, rows = lax.scan(lambda s, _: (s * 0.9 + y, s[0]), x, None, length=12)
    total = jnp.where(flag, total, lax.cond(y[0] > 0, lambda: y * 2.0, lambda: x))
    return total, n, y[0] > 0.3, rows, jnp.zeros(3), x, scale


def program(x, other):
    """Calls with numbers of a trajectory, with shared ones, and with constants."""
    first, n, positive, rows, zeros, *_ = large(x, other[0], 3, True)
    second, m, _, _, _, same, scale = large(first + zeros[1], 1.25, n, positive)
    second, *_ = large(second, 1.25, n, positive)

    def step(state, _):
        state, *_ = large(state, 2.0, m, positive)
        return state, state[1]

    third, path = lax.scan(step, second, None, length=5)
    shared, *_ = large(other, other[1], 1, False)
    return third, n + m, positive, rows, path, same * scale, shared


INPUTS = np.random.default_rng(3).uniform(0.1, 1, (LANES, 20)), np.linspace(0.2, 1.9, 20)


def batch(width=None):
    layout = lanewise.Layout(width=width)
    return lanewise.batched(program, (0, None), layout)(*map(jnp.asarray, INPUTS))


def texts():
    explanation = lanewise.explain(program, INPUTS[0][0], INPUTS[1])
    return [part.ir for part in explanation.parts if part.ir]


def test_a_repeated_function_is_written_once(monkeypatch):
    (text,) = texts()
    # A different text for constants and for numbers of a trajectory: fewer than calls.
    functions = text.count("define internal void @function")
    assert 1 < functions < text.count("call void @function")
    monkeypatch.setattr(calls, "is_once", lambda eqn: False)
    (inline,) = texts()
    assert "@function" not in inline
    assert len(text.splitlines()) < 0.8 * len(inline.splitlines())


def test_numbers_are_those_of_xla():
    reference = jax.vmap(program, (0, None))(*INPUTS)
    for ours, theirs in zip(batch(), reference, strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)


def test_bits_do_not_depend_on_the_batch():
    """Also in blocks of two vectors, whose calls follow one another."""
    whole, wide, i = batch(), batch(16), LANES - 1
    alone = lanewise.call(program, INPUTS[0][i], INPUTS[1])
    for one, all_of_them, others in zip(alone, whole, wide, strict=True):
        np.testing.assert_array_equal(one, all_of_them[i])
        np.testing.assert_array_equal(one, others[i])


def test_another_call_changes_no_bit(monkeypatch):
    """Such as that of an observable; the control is without a border for one call."""
    marked = lanewise.once(lambda x: (x * x) * x)

    def one(x):
        return marked(x * x) + x

    def two(x):
        return one(x), marked(x)

    x, before = INPUTS[0], lanewise.batched(one)(INPUTS[0])
    np.testing.assert_array_equal(before, lanewise.batched(two)(x)[0])
    monkeypatch.setattr(calls, "is_once", lambda eqn: False)
    assert np.any(before != lanewise.batched(lambda x: one(x) + 0)(x))


def product_and_sum():
    """A program with two calls of one function, as the targets take it."""
    function = jax.make_jaxpr(lambda x: inner(inner(x * x) + x) + x)(INPUTS[1])
    return function, (True,), [INPUTS[0]], LANES


def test_threads_of_a_gpu_have_the_bits_of_the_cpu():
    """There the function is a part of its caller, and no product crosses its border either."""
    arguments = product_and_sum()
    assert_same_bits(by_threads(*arguments), by_numbers(*arguments))


def test_the_passes_for_long_texts_change_no_bit(monkeypatch):
    arguments = product_and_sum()
    expected = by_numbers(*arguments)
    # A loop-invariant load is moved by the passes for short texts only.
    text = "define void @f(ptr noalias %a, ptr noalias %b, i64 %n) {\nentry:\n  br label %loop\n"
    text += "loop:\n  %i = phi i64 [0, %entry], [%j, %loop]\n  %x = load double, ptr %a\n"
    text += "  %p = getelementptr double, ptr %b, i64 %i\n  store double %x, ptr %p\n"
    text += "  %j = add i64 %i, 1\n  %c = icmp slt i64 %j, %n\n"
    text += "  br i1 %c, label %loop, label %end\nend:\n  ret void\n}\n"

    def is_in_the_loop():
        _, loop = str(machine.optimise(text, machine.target_machine())).split("loop:", 1)
        return "load double" in loop

    assert not is_in_the_loop()
    monkeypatch.setattr(machine, "_LONG", 0)
    assert is_in_the_loop()
    assert_same_bits(by_numbers(*arguments), expected)


def test_a_gradient_of_repeated_functions():
    def loss(x):
        def one(x):
            y, *_ = small(x)
            return small(y)[0].sum() + small(x * y)[0].sum()

        return lanewise.batched(one)(x).sum(), jax.vmap(one)(x).sum()

    @lanewise.once
    def small(x):
        for _ in range(40):
            x = x + 0.05 * jnp.sin(jnp.roll(x, 1))
        return x, jnp.zeros(2)

    ours, theirs = (jax.grad(lambda x, i=i: loss(x)[i])(INPUTS[0]) for i in range(2))
    np.testing.assert_allclose(ours, theirs, rtol=1e-12)
