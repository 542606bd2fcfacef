"""Brownian paths: the increments of a run, step by step."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from lanewise.jaxapi import is_traced, threefry2x32

from .._checks import whole
from .._types import Interval


class BrownianPath(eqx.Module):
    """Base class of the paths B(t) of m independent Brownian motions."""

    @abc.abstractmethod
    def increments(self, k: Int[Array, ""], interval: Interval, parts: int, count: int) -> Array:
        """The increments of `count` motions over the `parts` equal parts of step k of a run, shape
        (parts, count) [√time]; a pure function of these arguments."""

    def check(self, num_steps: int) -> None:
        """**Raises** `ValueError` for a run of more steps than the path has."""


class Brownian(BrownianPath):
    r"""Brownian motions whose increments are made from a key and the number of the step.

        ΔB_k = √h z_k,     z_k = jax.random.normal(jax.random.fold_in(key, first_step + k), (m,))

    to round-off, for the generator threefry2x32 with the default settings of JAX. Step k has these
    numbers in every run: alone, in a batch, backwards in the gradients of `Reversible`, with
    `progress`, after a resume.

    **Arguments**

    - `key`: a key of `jax.random`, or an integer, the seed of one. Under `vmap` over keys, and in a
      `sweep` over an axis of seeds, each trajectory has its own path.
    - `substeps`: n, number of the equal parts of a step. ΔB_k is √(h/n) times the sum of the n
      numbers z with the indices n (first_step + k), …, so that runs with steps h, h/2, h/4 and
      4, 2 and 1 substeps have the same path B(t), as tests of convergence require.
    - `first_step`: number of the first step. A run over N steps is continued by a run from its last
      state with ``first_step=N``.

    A method that takes two increments per step, `OBABO`, doubles n.

    **Raises** `ValueError` or `TypeError` for another key; `ValueError` for more than 2³² parts.

    **Source** counter-based generators: Salmon, Moraes, Dror & Shaw 2011.
    """

    # Not converted here: in a sweep it is an axis of seeds.
    key: Any
    substeps: int = eqx.field(static=True, default=1)
    first_step: Any = 0

    def __check_init__(self):
        whole("substeps", self.substeps)

    def check(self, num_steps):
        if not is_traced(self.first_step):  # twice, for methods with two increments per step
            most = 2**32 // (2 * self.substeps) - num_steps
            hint = "A path has 2³² parts: continue a longer run with another key."
            whole("first_step", int(self.first_step), 0, most, hint)

    def increments(self, k, interval, parts, count):
        # Modulo 2³², as the numbers of `fold_in` are; `check` excludes that they repeat.
        first = jnp.asarray(self.first_step).astype(jnp.uint32) + k.astype(jnp.uint32)
        dtype, size = interval.h.dtype, self.substeps

        def total(part):
            """The sum of the numbers of a part."""

            def add(i, x):
                number = (first * parts + part) * size + jnp.asarray(i).astype(jnp.uint32)
                return x + _normal(self.key, number, count, dtype)

            zero = jnp.zeros(count, dtype)
            # A loop, so that the code does not grow with the number of substeps.
            return add(0, zero) if size == 1 else lax.fori_loop(0, size, add, zero)

        root = jnp.sqrt(interval.h / (parts * size))  # NaN for time that runs backwards
        return root * jnp.stack([total(np.uint32(part)) for part in range(parts)])


class NoisePath(eqx.Module):
    """The path of a run: a step has `parts` parts, with the increments of `count` motions each."""

    path: BrownianPath
    parts: int = eqx.field(static=True)
    count: int = eqx.field(static=True)

    def at(self, k: Int[Array, ""], interval: Interval) -> Array:
        """The increments of step k, shape (parts, count)."""
        # A path of the user has the dtype of its own functions.
        found = self.path.increments(k, interval, self.parts, self.count)
        if found.shape != (self.parts, self.count):
            raise ValueError(
                f"the increments of {type(self.path).__name__} must have the shape (parts, number "
                f"of motions) = {(self.parts, self.count)}, got {found.shape}."
            )
        return found.astype(interval.h.dtype)


def as_path(path: Any) -> BrownianPath | None:
    """The path of a run, its key as two words. **Raises** `TypeError` or `ValueError`."""
    if path is None or (not isinstance(path, Brownian) and isinstance(path, BrownianPath)):
        return path
    # Here and not in `Brownian`: keys of JAX have a type that generated code does not take.
    path = path if isinstance(path, Brownian) else Brownian(path)
    return Brownian(_words(path.key), path.substeps, jnp.asarray(path.first_step))


def _words(key: Any) -> Array:
    try:
        found = jnp.asarray(key)
    except TypeError:
        found = jnp.zeros(0)
    if jnp.issubdtype(found.dtype, jax.dtypes.prng_key):
        # Another generator has keys of another length, or another meaning.
        if found.shape == () and "fry" in str(found.dtype):
            return jax.random.key_data(found)
    elif found.shape == (2,) and found.dtype == jnp.uint32:  # an old key of JAX: its words
        return found
    elif found.shape == () and jnp.issubdtype(found.dtype, jnp.integer):
        return jax.random.key_data(jax.random.key(found, impl="threefry2x32"))
    raise ValueError(
        "the key of a path must be one key of jax.random with the generator threefry2x32, such as "
        f"jax.random.key(0), or an integer, got {key!r:.200}. For many paths use jax.vmap over "
        'keys, or dvi.sweep(..., path=dvi.Axis("seed", range(1000))).'
    )


def _normal(key: Array, number: Array, count: int, dtype: Any) -> Array:
    """``jax.random.normal(jax.random.fold_in(key, number), (count,), dtype)`` to round-off."""
    # What `fold_in` does: the words of the number, encrypted with the key, are a new key.
    folded = jnp.stack(threefry2x32(key, jnp.uint32(0), number))
    # What `random_bits` does: the index of each number in two words.
    words = threefry2x32(folded, jnp.uint32(0), jnp.arange(count, dtype=jnp.uint32))
    info = jnp.finfo(dtype)
    if info.bits == 64:
        high, low = (w.astype(jnp.uint64) for w in words)
        bits = lax.shift_left(high, jnp.full_like(high, 32)) | low
    else:
        bits = words[0] ^ words[1]
    # The fraction of a float in [1, 2).
    bits = lax.shift_right_logical(bits, jnp.full_like(bits, info.bits - info.nmant))
    one = lax.bitcast_convert_type(jnp.ones((), dtype), bits.dtype)
    uniform = lax.bitcast_convert_type(bits | one, dtype) - 1
    # Between the numbers next to −1 and 1, as in JAX, so that no result is infinite.
    least = jnp.nextafter(jnp.asarray(-1, dtype), jnp.asarray(0, dtype))
    uniform = jnp.maximum(least, uniform * (1 - least) + least)
    return jnp.sqrt(jnp.asarray(2, dtype)) * lax.erf_inv(uniform)
