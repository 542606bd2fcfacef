"""Particles over many turns with the quantum excitation of a ring that radiates."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.jaxapi import threefry2x32

from ...base.checks import require
from ...problem.paths import _words as words_of  # pyright: ignore[reportPrivateUsage]
from ._damping import MAGNETS
from ._maps import Particle
from ._ring import Ring
from ._turn import Passage, start


def fly_with_noise(
    ring: Ring, z: Array, epsilon: Array, counts: tuple[int, int, int], key: Any
) -> tuple[Array, Array, Array, Array]:
    """What `_track` of `track` returns, with noise; particle i has the key ``fold_in(key, i)``."""
    hint = "The noise is that of a ring that radiates: use rings.radiating(ring)."
    require("rings.track(key=...)", {"loss": ring.columns.get("loss")}, hint=hint)
    return _fly(ring, z, epsilon, words_of(key), counts)


@eqx.filter_jit
def _fly(ring: Ring, z: Array, epsilon: Array, words: Array, counts: tuple[int, int, int]):
    blocks, every, first = counts
    passage = Passage.from_ring(ring)
    slices = [p.slices if p.name in MAGNETS else 0 for p in passage.parts]
    slices = np.asarray(slices)[passage.numbers["part"]]
    # Each slice of each magnet has a number of its own.
    rows = {**passage.rows, "counter": jnp.asarray(np.cumsum(slices) - slices, float)}

    def forward(numbers, tables, z, epsilon, key):
        line = Passage(tables[0], tables[1], numbers, passage.parts, key)

        def one_turn(state, _):
            k, flight = state
            return (k + 1, line.fly(flight, k, epsilon)), None

        def block(state, _):
            (k, flight), _ = lax.scan(one_turn, state, None, every)
            return (k, flight), jnp.stack(flight.z)

        state = jnp.asarray(first, jnp.int32), start(Particle(*z))
        (_, flight), states = lax.scan(block, state, None, blocks)
        return states, flight.turn, flight.row, jnp.stack(flight.last)

    index = jnp.arange(len(z), dtype=jnp.uint32)
    keys = jnp.stack(threefry2x32(words, jnp.zeros_like(index), index), 1)
    batch = jax.vmap(functools.partial(lanewise.call, forward), (None, None, 0, 0, 0))
    return batch(passage.numbers, (rows, passage.slopes), z, epsilon, keys)
