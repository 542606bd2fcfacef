"""Particles over many turns, with losses and derivatives."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.jaxapi import linear_map, threefry2x32
from lanewise.linear_map import with_change

from ...base.checks import instance, require, whole
from ...base.machine import results_memory
from ...base.printing import printable
from ...integration.reconstruction import fold_blocks
from ...problem.paths import words_of
from ._damping import MAGNETS
from ._losses import loss_places
from ._maps import Particle
from ._ring import Ring
from ._turn import Passage, coordinates, start


@printable
class Tracked(NamedTuple):
    """Particles after some turns.

    - `z`: (x, px, y, py, ζ, δ) after the last turn, shape (…, 6), or after every m-th turn, shape
      (…, turns/m, 6); NaN after a loss.
    - `turn`, `element`: where a particle was lost, −1 if it was not, shape (…). `last`: its
      coordinates there, shape (…, 6), NaN if it was not lost. `row`: the number of the part in
      `ring.program.rows`, behind which it was lost. See `places` for s.
    """

    z: Array
    turn: Array
    element: Array
    last: Array
    row: Array

    def places(self, ring: Ring) -> Array:
        """s of each loss [m], inside of its element, shape (…); NaN for particles that survive.

        The first place at which a particle leaves the aperture or the limits of its coordinates, to
        round-off of the map of a part of the element, in which slices have the same number: the
        error is that of the integrator. Apertures are tested at the ends of elements, so that
        particles that leave them and return between are not lost. A loss at the entrance, such as
        one at a smaller pipe, is there, and one in an element that is a matrix at its end. NaN also
        where the motion cannot be traced back, as for a momentum with no direction along s.

        **Arguments** `ring`: the one that was tracked; of runs with an epsilon `ring.at(epsilon)`.
        **Raises** `TypeError` for results that are traced by JAX.

        **Example**

        ```python
        ring = rings.Ring([rings.drift("D", 2.0).inside(ellipse=(0.01, 0.01))])
        out = rings.track(ring, [0.0, 0.008, 0.0, 0.0, 0.0, 0.0])
        print(out.places(ring).round(6))
        # 1.25
        ```
        """
        return loss_places(ring, self.turn, self.row, self.last)

    @property
    def lost(self) -> Array:
        """Whether a particle was lost, shape (…)."""
        return self.turn >= 0


def track(
    ring: Ring,
    z: Any,
    turns: int = 1,
    *,
    every: int | None = None,
    epsilon: Any = 0.0,
    first_turn: int = 0,
    key: Any = None,
) -> Tracked:
    r"""Particles over `turns` turns, all of a batch at once.

    **Arguments** `z`: (x, px, y, py, ζ, δ), shape (…, 6): x, y [m], momenta over that of the
    reference particle, ζ = −c Δt [m] (late particles have ζ < 0), δ = Δp/p. `every`: save after
    each m-th turn, a divisor of `turns`; None: after the last one. `epsilon`: factor of what
    `Ring.perturbed` set aside. `first_turn`: number of the first turn, for cavities with a slip
    and for the noise. `key`: for the quantum excitation of a ring that radiates, an integer or a
    key of jax.random; None: without.

    A particle is lost at an aperture, or where |x|, |px|, |y|, |py| or |δ| exceeds 1.

    The result can be differentiated by z, epsilon and the parameters of the ring. In reverse mode
    particles are tracked backwards, so that the memory does not grow with `turns`. The derivative
    is NaN where the start is missed by more than 1e-6, after very long or chaotic motion; that of a
    lost particle is zero if the loss function does not use it.

    **Raises** `ValueError` for z of another shape, an `every` that does not divide `turns`, a
    parameter that is not finite, and results that do not fit into memory.

    **Example**

    ```python
    ring = rings.Ring([rings.quadrupole("QF", 0.5, k1=0.6), rings.drift("D", 2.0),
                       rings.quadrupole("QD", 0.5, k1=-0.5), rings.drift("D", 2.0),
                       rings.aperture("A", ellipse=(0.008, 0.004))])
    z = jnp.zeros((1000, 6)).at[:, 0].set(jnp.linspace(0, 0.01, 1000))
    out = rings.track(ring, z, 1000)
    print(int(out.lost.sum()), "of 1000 particles lost")
    # 495 of 1000 particles lost
    ```
    """
    instance("ring", ring, Ring, "a rings.Ring")
    ring.check()
    whole("turns", turns)
    every = turns if every is None else whole("every", every)
    if turns % every:
        raise ValueError(f"every must divide turns = {turns}, got every = {every}.")
    z = coordinates("z", z)
    size, memory = z.size * z.itemsize * (turns // every), results_memory()
    if memory is not None and size > memory:
        raise ValueError(
            f"the results need {size / 2**30:.3g} GiB of memory, got {memory / 2**30:.3g} GiB. Use "
            "a larger every, or fewer particles."
        )
    shape = z.shape[:-1]
    epsilon = jnp.broadcast_to(jnp.asarray(epsilon, float), shape).reshape(-1)
    counts = turns // every, every, first_turn
    if key is not None:
        hint = "The noise is that of a ring that radiates: use rings.radiating(ring)."
        require("rings.track(key=...)", {"loss": ring.columns.get("loss")}, hint=hint)
    words = None if key is None else words_of(key)
    states, turn, row, last = _track(ring, z.reshape(-1, 6), epsilon, counts, words)
    states = states[:, -1] if turns == every else states
    owner = np.asarray(ring.program.rows, np.int32)[:, 1]
    element = jnp.where(row < 0, -1, jnp.asarray(owner)[row])
    parts = states, turn, element, last, row
    return Tracked(*(x.reshape(*shape, *x.shape[1:]) for x in parts))


def _batched(function, *flags):
    """`function` of one particle as machine code for many; `flags`: which arguments are batches."""
    axes = [0 if flag else None for flag in flags]
    return jax.vmap(functools.partial(lanewise.call, function), axes)


@eqx.filter_jit
def _track(ring: Ring, z: Array, epsilon: Array, counts: tuple[int, int, int], words: Any):
    """`words`: of the key of the noise, or None; particle i has the key ``fold_in(key, i)``."""
    blocks, every, first = counts
    passage = Passage.from_ring(ring)

    def forward(numbers, tables, z, epsilon, key=None):
        rows, slopes = tables
        line = Passage(rows, slopes, numbers, passage.parts, key)

        def one_turn(state, _):
            k, flight = state
            return (k + 1, line.fly(flight, k, epsilon)), None

        def block(state, _):
            (k, flight), _ = lax.scan(one_turn, state, None, every)
            return (k, flight), jnp.stack(flight.z)

        state = jnp.asarray(first, jnp.int32), start(Particle(*z))
        (_, flight), states = lax.scan(block, state, None, blocks)
        return states, (flight.turn, flight.row, jnp.stack(flight.last))

    if words is not None:
        slices = [p.slices if p.name in MAGNETS else 0 for p in passage.parts]
        slices = np.asarray(slices)[passage.numbers["part"]]
        # Each slice of each magnet has a number of its own.
        rows = {**passage.rows, "counter": jnp.asarray(np.cumsum(slices) - slices, float)}
        index = jnp.arange(len(z), dtype=jnp.uint32)
        keys = jnp.stack(threefry2x32(words, jnp.zeros_like(index), index), 1)
        batch = _batched(forward, False, False, True, True, True)
        states, losses = batch(passage.numbers, (rows, passage.slopes), z, epsilon, keys)
        return states, *losses

    @jax.custom_jvp
    def states_and_losses(tables, z, epsilon):
        return _batched(forward, False, False, True, True)(passage.numbers, tables, z, epsilon)

    @functools.partial(states_and_losses.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        moves = jax.tree.map(lambda x: not isinstance(x, SymbolicZero), tangents)
        pairs = tangents, primals
        change = jax.tree.map(lambda t, x, flag: t if flag else jnp.zeros_like(x), *pairs, moves)

        def of_particle(numbers, primals, change):
            line = functools.partial(forward, numbers)
            states, slopes, losses = jax.jvp(line, primals, change, has_aux=True)
            return (states, losses), slopes

        axes = (None, (None, 0, 0), (None, 0, 0))

        def pair(primals, change):
            batch = jax.vmap(functools.partial(lanewise.call, of_particle), axes)
            return batch(passage.numbers, primals, change)

        def definition(residuals, change):  # machine code has no transpose
            return jax.vmap(of_particle, axes)(passage.numbers, residuals[0], change)[1]

        def pull(residuals, cotangent):
            primals, states = residuals
            return _pull(passage, primals, states, cotangent, counts, moves)

        (states, losses), slopes = with_change(
            lambda primals: states_and_losses(*primals),
            lambda primals, ends, x: linear_map(
                lambda point, x: pair(point[0], x)[1], pull, definition, (primals, ends[0]), x
            ),
            *(pair, primals, change),
        )
        none = [np.zeros(x.shape, jax.dtypes.float0) for x in losses[:2]]
        return (states, losses), (slopes, (*none, jnp.zeros_like(losses[2])))

    states, losses = states_and_losses((passage.rows, passage.slopes), z, epsilon)
    return states, *losses


_TOLERANCE = 1e-6
"""Largest distance [unit of z] between a start and what the turns backwards reach."""


def _pull(passage, primals, states, cotangent, counts, moves):
    """The cotangents of rows and slopes, z and ε: all particles backwards, turn by turn."""
    tables, z0, epsilon = primals
    blocks, every, first = counts
    names = [[n for n, is_moving in table.items() if is_moving] for table in moves[0]]
    by_epsilon = list(tables[1]) if moves[2] else []
    parameters = sorted({*names[0], *names[1], *by_epsilon})

    def one_turn(numbers, tables, z, c, k, epsilon):
        rows, slopes = tables
        line = Passage(rows, slopes, numbers, passage.parts)
        z, c, gradient = line.pulled(parameters, Particle(*z), Particle(*c), k, epsilon)
        # Of b(ε) = b + ε b' by b, b' and ε.
        of_rows = {n: gradient[n] for n in names[0]}
        of_slopes = {n: epsilon * gradient[n] for n in names[1]}
        of_epsilon = sum((jnp.sum(gradient[n] * slopes[n]) for n in by_epsilon), jnp.zeros(()))
        return jnp.stack(z), jnp.stack(c), (of_rows, of_slopes), of_epsilon

    turn_back = _batched(one_turn, False, False, True, True, False, True)
    is_lost = jnp.isnan(states[:, :, :1])
    # A lost particle has no influence, unless its cotangent is not zero.
    is_wrong = jnp.any(is_lost & (cotangent != 0), axis=(1, 2))
    states = jnp.where(is_lost, 0.0, states)
    starts = jnp.concatenate([z0[:, None], states[:, :-1]], axis=1)

    def block(state, k, start, end, of_end):
        c, of_tables, of_epsilon, distance = state

        def undo(_, state):
            k, z, c, of_tables, of_epsilon = state
            z, c, gradient, slope = turn_back(passage.numbers, tables, z, c, k, epsilon)
            of_tables = jax.tree.map(lambda a, b: a + jnp.sum(b, 0), of_tables, gradient)
            return k - 1, z, c, of_tables, of_epsilon + slope

        last = k + jnp.asarray(first + every - 1, jnp.int32)
        begin = last, end, c + of_end, of_tables, of_epsilon
        _, z, *state = lax.fori_loop(0, every, undo, begin)
        return *state, jnp.maximum(distance, jnp.max(jnp.abs(z - start), axis=1))

    zero = jnp.zeros(len(z0))
    of_tables = tuple(
        {n: jnp.zeros_like(table[n]) for n in group}
        for table, group in zip(tables, names, strict=True)
    )
    begin = jnp.zeros_like(z0), of_tables, zero, zero
    rows = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (starts, states, cotangent))
    c, of_tables, of_epsilon, distance = fold_blocks(block, begin, blocks, every, rows)
    is_good = ~is_wrong & ((distance < _TOLERANCE) | jnp.any(is_lost, axis=(1, 2)))
    factor = jnp.where(is_good, 1.0, jnp.nan)
    of_all = jnp.where(jnp.all(is_good), 1.0, jnp.nan)
    of_tables = tuple(
        {n: of_all * slope[n] if n in slope else jnp.zeros_like(table[n]) for n in table}
        for table, slope in zip(tables, of_tables, strict=True)
    )
    return of_tables, factor[:, None] * c, factor * of_epsilon
