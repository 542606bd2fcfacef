"""Array loops: which stores are left out, which arrays share memory, and what does not change."""

import functools
import resource
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lanewise
from lanewise.elements import places as places_of, schedule as schedule_of
from lanewise.elements.equations import Translation, row_major
from lanewise.elements.places import Lives, places
from lanewise.elements.schedule import dead_memories, groups, schedule
from lanewise.elements.tree import Loop, Memory, Reduce, Store
from lanewise.jaxprs.extent import has_long_arrays
from lanewise.targets import TARGETS
from lanewise.targets.elements import Elements

N = 60


def program(function, *shapes):
    """The scheduled tree of a function, with the memories of its arguments."""
    translation = Translation()
    arguments = [jnp.zeros(shape) for shape in shapes]
    inputs = [Memory(x.shape, x.dtype, row_major(x.shape), pointer="given") for x in arguments]
    outs = translation.evaluate(
        jax.make_jaxpr(function)(*arguments), [memory.load(translation.table) for memory in inputs]
    )
    for x in outs:
        memory = Memory(x.shape, x.dtype, row_major(x.shape), pointer="result")
        translation.store(x, memory.place)
    schedule(translation.block)
    return translation.block, inputs


def loop_of(block) -> Loop:
    (loop,) = (item for item in block.items if isinstance(item, Loop))
    return loop


def chain(x, y):
    def step(state, _):
        x, y = state
        y = y + 0.1 * (jnp.roll(x, 1) - 2 * x + jnp.roll(x, -1))
        return (x + 0.1 * y, y), None

    return jax.lax.scan(step, (x, y), None, length=5)[0]


def rotation(x):
    return jax.lax.fori_loop(0, 5, lambda _, x: jnp.roll(x, 1) + 0.5 * x, x)


def test_a_separable_step_is_computed_in_place():
    block, _ = program(chain, (N,), (N,))
    at, size = places(block, dead_memories(block))
    for now, new in loop_of(block).memories:
        assert at[now] == at[new]
    assert size == 2 * 512  # two arrays of 60 numbers, in whole cache lines
    kick, drift, *_ = loop_of(block).body.items
    assert _neighbours(kick)
    assert not _neighbours(drift)


def _neighbours(group) -> bool:
    return any(node.offset for node in group.memory_reads())


def test_an_array_that_is_read_at_neighbours_is_not_written_over():
    block, _ = program(rotation, (N,))
    at, _ = places(block, dead_memories(block))
    ((now, new),) = loop_of(block).memories
    assert at[now] != at[new]


def guarded(x, y):
    """A step of a reverse pass: all of it is zero after a failure."""

    def step(state, _):
        x, y = state
        y = y + 0.1 * x
        x = x + 0.1 * (jnp.roll(y, 1) - 2 * y + jnp.roll(y, -1))
        ok = jnp.isfinite(x).all() & jnp.isfinite(y).all()
        also = jnp.isfinite(x).all() | (jnp.sum(y) > 1e6)
        state = jax.lax.cond(
            ok & also,
            lambda *state: state,
            lambda *state: jax.tree.map(jnp.zeros_like, state),
            x,
            y,
        )
        return state, None

    return jax.lax.scan(step, (x, y), None, length=5)[0]


def test_what_a_branch_reads_is_written_before_others_read_it():
    block, _ = program(guarded, (N,), (N,))
    at, size = places(block, dead_memories(block))
    for now, new in loop_of(block).memories:
        assert at[now] == at[new]
    assert size == 2 * 512


def test_a_sum_is_computed_once_in_a_block():
    block, _ = program(guarded, (N,), (N,))
    body = loop_of(block).body
    sums = [s for s in body.statements if isinstance(s, Reduce)]
    assert len(sums) == 3  # whether x and y are finite, and the sum of y


def test_arrays_that_are_read_later_keep_their_memory():
    def function(x, y):
        def step(state, _):
            x, y = state
            new = x + 0.1 * y
            return (new, y + jnp.sum(x * new)), None  # x is read after `new` is made

        return jax.lax.scan(step, (x, y), None, length=3)[0]

    block, _ = program(function, (N,), (N,))
    dead = dead_memories(block)
    lives = Lives(block, dead)
    at, _ = places(block, dead, lives)
    for memory, others in lives.conflicts.items():
        for other in others:
            assert memory not in at or other not in at or at[memory] != at[other]


def test_an_array_that_is_read_where_it_is_made_is_not_written():
    def function(x):
        square = jnp.sin(x) * x  # many operations, and used twice
        return square + jnp.cos(square)

    block, _ = program(function, (N,))
    assert {m.shape for m in dead_memories(block)} == {(N,)}
    block, _ = program(lambda x: function(x) + jnp.roll(jnp.sin(x) * x, 1), (N,))
    assert not dead_memories(block)


def test_statements_of_one_level_share_their_loops():
    translation = Translation()
    x, y, z = (Memory((N,), "float64") for _ in range(3))
    given = Memory((N,), "float64", pointer="given").load(translation.table)
    double = translation.apply("add", given, given)
    translation.store(double, x.place)
    at_x = x.load(translation.table)
    translation.store(translation.apply("mul", at_x, at_x), y.place)  # at the same element
    turned = translation.move("rev", {"dimensions": (0,)}, [at_x], (N,))[0]
    translation.store(turned, z.place)  # at another one
    same, other = groups(translation.block.statements, set())
    assert [s.memory for s in same.statements if isinstance(s, Store)] == [x, y]
    assert [s.memory for s in other.statements if isinstance(s, Store)] == [z]


@pytest.mark.parametrize("function", [chain, lambda x, y: (rotation(x), y)])
def test_controls_of_the_decisions(function, monkeypatch):
    """With a decision that is always yes the numbers are wrong."""
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((2, N))
    expected = jax.jit(function)(x, y)

    def error():
        jax.clear_caches()
        outs = jax.jit(lambda x, y: lanewise.call(function, x, y))(x, y)
        return max(float(jnp.max(abs(a - b))) for a, b in zip(outs, expected, strict=True))

    assert error() < 1e-13
    monkeypatch.setattr(places_of, "_takes_over", lambda *_: True)
    monkeypatch.setattr(schedule_of, "in_place", lambda *_: {})
    assert error() > 1e-3


def test_the_rule_of_choice_reads_the_program():
    def carries(n):
        return jax.make_jaxpr(chain)(jnp.zeros(n), jnp.zeros(n)).jaxpr

    assert not has_long_arrays(carries(48))
    assert has_long_arrays(carries(49))

    def rows(x):
        states = jax.lax.scan(lambda x, _: (1.01 * x, x), x, None, length=10_001)[1]
        return states * 2

    assert not has_long_arrays(jax.make_jaxpr(rows)(jnp.zeros(2)).jaxpr)

    def pairs(x):
        def step(x, _):
            return x + jnp.sum(jnp.sin(x[:, None] - x[None]), 1), None

        return jax.lax.scan(step, x, None, length=3)[0]

    def products(x):
        def step(x, _):
            return x + jnp.outer(x, x) @ jnp.outer(x, x) @ x, None

        return jax.lax.scan(step, x, None, length=3)[0]

    def has(function, n):
        return has_long_arrays(jax.make_jaxpr(function)(jnp.zeros(n)).jaxpr)

    assert [n for n in range(16, 52) if has(pairs, n)] == [*range(25, 52)]
    assert [n for n in range(16, 52) if has(products, n)] == [49, 50, 51]
    assert not has_long_arrays(jax.make_jaxpr(jnp.sin)(jnp.zeros(48)).jaxpr)
    assert has_long_arrays(jax.make_jaxpr(jnp.sin)(jnp.zeros(49)).jaxpr)


def sums(x, y):
    """Sums of long rows, of short ones, of all elements, and of those of one axis."""

    def step(state, _):
        x, y = state
        x = x + 1e-2 * (
            jnp.sum(x, 0, keepdims=True) - jnp.sum(jnp.sin(y), 1, keepdims=True)
        ) / jnp.sum(x * x)
        return (x, y * (1 + 1e-3 * jnp.max(x))), jnp.sum(x[:, :3])

    return jax.lax.scan(step, (x, y), None, length=4)


def test_bits_do_not_depend_on_the_length_of_vectors(monkeypatch):
    rng = np.random.default_rng(1)
    x, y = rng.standard_normal((2, 19, 70))
    results = []
    for width in (8, 4, 2):

        class OfWidth(Elements):
            def write(self, function, lane_flags, lanes, _, width=width):
                return self.write_for(function, lane_flags, width)

        monkeypatch.setitem(TARGETS, "cpu", (OfWidth(),))
        results.append(jax.jit(lambda x, y: lanewise.call(sums, x, y))(x, y))
        jax.clear_caches()
    for other in results[1:]:
        jax.tree.map(np.testing.assert_array_equal, results[0], other)


def test_a_trajectory_has_the_same_bits_alone_and_next_to_one_that_fails():
    rng = np.random.default_rng(2)
    x, y = rng.standard_normal((2, 5, N))
    x[3, 7] = np.nan
    batch = jax.jit(jax.vmap(functools.partial(lanewise.call, chain)))(x, y)
    one = jax.jit(functools.partial(lanewise.call, chain))
    for i in range(5):
        alone = one(x[i], y[i])
        for of_batch, of_one in zip(batch, alone, strict=True):
            np.testing.assert_array_equal(of_batch[i], of_one)
        assert bool(jnp.isnan(alone[0]).any()) == (i == 3)
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12),
        batch,
        jax.vmap(chain)(x, y),
    )


def test_explain_names_the_way():
    x = jnp.ones(N)
    (part,) = lanewise.explain(chain, x, x).parts
    assert part.target == "elements"
    assert part.loops >= 2
    assert part.stores >= 2
    assert "loops over the elements" in str(part)
    (part,) = lanewise.explain(chain, x[:40], x[:40]).parts
    assert part.target == "numbers"


def test_updates_at_computed_places_come_one_after_the_other():
    def function(x, k):
        def step(x, _):
            x = x.at[k].add(x[::-1][:5])  # twice the same place
            x = x.at[jnp.array([3, N + 2])].set(2.0, mode="drop")
            return jax.lax.dynamic_update_slice(x, jnp.cos(x[3:13]), (k[0] + 100,)), None

        return jax.lax.scan(step, x, None, length=3)[0]

    x, k = jnp.sin(jnp.arange(1.0 * N)), jnp.array([7, 50, 7, 9, 7])
    np.testing.assert_allclose(lanewise.call(function, x, k), function(x, k), rtol=1e-13)


_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")


@pytest.mark.skipif(
    not _PAGES.exists() or "[never]" in _PAGES.read_text(), reason="no large pages on this machine"
)
def test_long_arrays_of_a_run_are_in_large_pages():
    def function(x):
        def step(state, _):
            y, z = state
            return (y + 0.1 * jnp.roll(z, 1), z - 0.1 * y), None

        y = x * jnp.arange(2.0**21)
        return sum(map(jnp.sum, jax.lax.scan(step, (y, -y), None, length=2)[0]))

    f = jax.jit(lambda x: lanewise.call(function, x))
    jax.block_until_ready(f(1.0))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    jax.block_until_ready(f(1.0))
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    assert faults < 2**12  # two arrays of 16 MiB are 2¹³ pages of 4 KiB
