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
from lanewise.jaxprs.jaxapi import linear_map

from ...base.checks import instance, whole
from ...base.machine import results_memory
from ...integration.reconstruction import fold_blocks
from ._maps import Particle
from ._ring import Ring
from ._turn import Passage, start


class Tracked(NamedTuple):
    """Particles after some turns.

    - `z`: (x, px, y, py, ζ, δ) after the last turn, shape (…, 6), or after every m-th turn, shape
      (…, turns/m, 6); NaN after a loss.
    - `turn`, `element`: where a particle was lost, −1 if it was not, shape (…). `last`: its
      coordinates there, shape (…, 6), NaN if it was not lost.
    """

    z: Array
    turn: Array
    element: Array
    last: Array

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
) -> Tracked:
    r"""Particles over `turns` turns, all of a batch at once.

    **Arguments** `z`: (x, px, y, py, ζ, δ), shape (…, 6): x, y [m], momenta over that of the
    reference particle, ζ = −c Δt [m] (late particles have ζ < 0), δ = Δp/p. `every`: save after
    each m-th turn, a divisor of `turns`; None: after the last one. `epsilon`: factor of what
    `Ring.perturbed` set aside. `first_turn`: number of the first turn, for cavities with a slip.

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
    z = jnp.asarray(z, float)
    if z.shape[-1:] != (6,):
        raise ValueError(
            "z must have six coordinates (x, px, y, py, ζ, δ) on its last axis, got an array of "
            f"shape {z.shape}."
        )
    needed, there = z.size * z.itemsize * (turns // every), results_memory()
    if there is not None and needed > there:
        raise ValueError(
            f"the results need {needed / 2**30:.3g} GiB of memory, but only {there / 2**30:.3g} "
            "GiB are available. Save fewer turns with a larger every, or track fewer particles."
        )
    shape = z.shape[:-1]
    epsilon = jnp.broadcast_to(jnp.asarray(epsilon, float), shape).reshape(-1)
    counts = turns // every, every, first_turn
    saved, turn, element, last = _tracked(ring, z.reshape(-1, 6), epsilon, counts)
    saved = saved[:, -1] if turns == every else saved
    parts = saved, turn, element, last
    return Tracked(*(x.reshape(*shape, *x.shape[1:]) for x in parts))


def _batched(function, *on):
    """`function` of one particle as machine code for many; `on`: which arguments have one each."""
    return jax.vmap(functools.partial(lanewise.call, function), [0 if o else None for o in on])


@eqx.filter_jit
def _tracked(ring: Ring, z: Array, epsilon: Array, counts: tuple[int, int, int]):
    blocks, every, first = counts
    passage = Passage.of(ring)

    def forward(numbers, rows, z, epsilon):
        along = Passage(rows, numbers, passage.parts)

        def one(state, _):
            k, flight = state
            return (k + 1, along.flown(flight, k, epsilon)), None

        def block(state, _):
            (k, flight), _ = lax.scan(one, state, None, every)
            return (k, flight), jnp.stack(flight.z)

        state = jnp.asarray(first, jnp.int32), start(Particle(*z))
        (_, flight), saved = lax.scan(block, state, None, blocks)
        return saved, (flight.turn, flight.element, jnp.stack(flight.last))

    @jax.custom_jvp
    def tracked(rows, z, epsilon):
        return _batched(forward, False, False, True, True)(passage.numbers, rows, z, epsilon)

    @functools.partial(tracked.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        saved, losses = tracked(*primals)
        moves = jax.tree.map(lambda x: not isinstance(x, SymbolicZero), tangents)
        change = jax.tree.map(
            lambda t, x, m: t if m else jnp.zeros_like(x), tangents, primals, moves
        )

        def push(residuals, change):
            def along(numbers, x, change):
                return jax.jvp(lambda *x: forward(numbers, *x)[0], x, change)[1]

            axes = (None, (None, 0, 0), (None, 0, 0))
            return jax.vmap(functools.partial(lanewise.call, along), axes)(
                passage.numbers, residuals[0], change
            )

        def pull(residuals, cotangent):
            primals, saved = residuals
            return _pulled(passage, primals, saved, cotangent, counts, moves)

        moved = linear_map(push, pull, push, (primals, saved), change)
        none = [np.zeros(x.shape, jax.dtypes.float0) for x in losses[:2]]
        return (saved, losses), (moved, (*none, jnp.zeros_like(losses[2])))

    saved, losses = tracked(passage.rows, z, epsilon)
    return saved, *losses


_MISSED = 1e-6


def _pulled(passage, primals, saved, cotangent, counts, moves):
    """The cotangents of rows, z and ε: all particles backwards, turn by turn."""
    rows, z0, epsilon = primals
    blocks, every, first = counts
    moved = [n for n, m in moves[0].items() if m]
    by_epsilon = [n.removeprefix("ε ") for n in rows if n.startswith("ε ") and moves[2]]
    moving = sorted({n.removeprefix("ε ") for n in moved} | set(by_epsilon))

    def one_turn(numbers, rows, z, c, k, epsilon):
        along = Passage(rows, numbers, passage.parts)
        z, c, found = along.pulled(moving, Particle(*z), Particle(*c), k, epsilon)
        of_rows = {n: epsilon * found[n[2:]] if n.startswith("ε ") else found[n] for n in moved}
        of_epsilon = [jnp.sum(found[n] * rows[f"ε {n}"]) for n in by_epsilon]
        return jnp.stack(z), jnp.stack(c), of_rows, sum(of_epsilon, jnp.zeros(()))

    turn_back = _batched(one_turn, False, False, True, True, False, True)
    lost = jnp.isnan(saved[:, :, :1])
    # A lost particle has no influence, unless its cotangent is not zero.
    wrong = jnp.any(lost & (cotangent != 0), axis=(1, 2))
    saved = jnp.where(lost, 0.0, saved)
    starts = jnp.concatenate([z0[:, None], saved[:, :-1]], axis=1)

    def block(state, k, start, end, more):
        c, of_rows, of_epsilon, worst = state

        def undo(_, state):
            k, z, c, of_rows, of_epsilon = state
            z, c, found, by_epsilon = turn_back(passage.numbers, rows, z, c, k, epsilon)
            of_rows = jax.tree.map(lambda a, b: a + jnp.sum(b, 0), of_rows, found)
            return k - 1, z, c, of_rows, of_epsilon + by_epsilon

        begin = (k + jnp.asarray(first + every - 1, jnp.int32), end, c + more, of_rows, of_epsilon)
        _, z, *state = lax.fori_loop(0, every, undo, begin)
        missed = jnp.max(jnp.abs(z - start), axis=1)
        return *state, jnp.maximum(worst, missed)

    none = jnp.zeros(len(z0))
    begin = jnp.zeros_like(z0), {n: jnp.zeros_like(rows[n]) for n in moved}, none, none
    xs = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (starts, saved, cotangent))
    c, of_rows, of_epsilon, worst = fold_blocks(block, begin, blocks, every, xs)
    fine = ~wrong & ((worst < _MISSED) | jnp.any(lost, axis=(1, 2)))
    all_fine = jnp.where(jnp.all(fine), 1.0, jnp.nan)
    nan = jnp.where(fine, 1.0, jnp.nan)
    of_rows = {n: all_fine * of_rows[n] if n in of_rows else jnp.zeros_like(rows[n]) for n in rows}
    return of_rows, nan[:, None] * c, nan * of_epsilon
