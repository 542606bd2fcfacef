"""Brownian paths: the increments of a run, step by step."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from lanewise.jaxapi import threefry2x32

from .._checks import whole
from .._types import Interval

_MOST_NUMBERED = 2**32


class Path(eqx.Module):
    """Base class of Brownian paths B(t)."""

    @abc.abstractmethod
    def increments(self, k: Int[Array, ""], interval: Interval, parts: int, count: int) -> Array:
        """The increments of `count` independent motions over the `parts` equal parts of step k of
        a run, shape (parts, count) [√time]. They must depend on nothing else."""

    def check(self, num_steps: int, parts: int) -> None:
        """**Raises** `ValueError` if the path is too short for a run."""


class Brownian(Path):
    r"""Brownian motions whose increments are made from a key and the number of the step.

        ΔB_k = √h z_k,     z_k = jax.random.normal(jax.random.fold_in(key, first_step + k), (m,))

    to round-off, with the generator threefry2x32. Step k has these numbers whatever runs next to
    it: alone, in a batch, backwards in the gradients of `Reversible`, with `progress`, after a
    resume.

    **Arguments**

    - `key`: a key of `jax.random`, or an integer, the seed of one. Under `vmap` over keys, and in a
      `sweep` over an axis of seeds, each trajectory has its own path.
    - `substeps`: n, number of the equal parts of a step. ΔB_k is √(h/n) times the sum of the
      numbers z with the indices n (first_step + k), …, so that runs with steps h, h/2, h/4 and
      with 4, 2 and 1 substeps have the same path B(t). For convergence tests.
    - `first_step`: number of the first step. A run over N steps is continued by a run from its last
      state with ``first_step=N``.

    A method that needs the increments of the halves of a step, such as `OBABO`, takes twice as many
    parts.

    **Raises** `ValueError` or `TypeError` for another key, or more than 2³² parts.

    **Source** counter-based generators: Salmon, Moraes, Dror & Shaw 2011.

    **Example**

    ```python
    free = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2,
                      noise=lambda t, q, p, args: jnp.ones(1))
    run = dict(method=dvi.StochasticEuler(), save=dvi.Save(final=True))
    coarse = dvi.integrate(free, [0.0], [0.0], h=0.1, num_steps=8, path=dvi.Brownian(3, 2), **run)
    fine = dvi.integrate(free, [0.0], [0.0], h=0.05, num_steps=16, path=dvi.Brownian(3), **run)
    print(bool(jnp.allclose(coarse.ps[-1], fine.ps[-1])))
    # True
    ```
    """

    # Not converted here: in a sweep it is an axis of seeds.
    key: Any
    substeps: int = eqx.field(static=True, default=1)
    first_step: Any = 0

    def __check_init__(self):
        whole("substeps", self.substeps, 1)

    def check(self, num_steps, parts):
        first = 0 if isinstance(self.first_step, jax.core.Tracer) else int(self.first_step)
        numbers = (first + num_steps) * parts * self.substeps
        if first < 0 or numbers > _MOST_NUMBERED:
            raise ValueError(
                f"first_step must not be negative, and (first_step + num_steps) × substeps × parts "
                f"of a step must be at most 2³², got first_step={self.first_step}, "
                f"num_steps={num_steps}, substeps={self.substeps} and {parts} parts. Use another "
                "key for each piece of a longer run."
            )

    def increments(self, k, interval, parts, count):
        number = (jnp.asarray(self.first_step).astype(jnp.uint32) + k.astype(jnp.uint32)) * (
            parts * self.substeps
        )
        dtype = interval.h.dtype

        def total(j):
            """The sum of the numbers of part j."""
            first = number + jnp.uint32(j * self.substeps)
            if self.substeps == 1:
                return _normal(self.key, first, count, dtype)

            def add(i, x):
                return x + _normal(self.key, first + i.astype(jnp.uint32), count, dtype)

            return lax.fori_loop(0, self.substeps, add, jnp.zeros(count, dtype))

        root = jnp.sqrt(interval.h / (parts * self.substeps))  # NaN for time that runs backwards
        return root * jnp.stack([total(j) for j in range(parts)])


class Increments(Path):
    r"""Brownian motions from a function of the ends of a step.

    **Arguments**

    - `function`: ``(t0, t1)`` → array of the shape (m,), B(t1) − B(t0) [√time], such as the method
      ``evaluate`` of a `diffrax.VirtualBrownianTree`, whose path does not depend on the steps. It
      must be a pure function. m is the number of noises of the system.

    **Raises** `ValueError` if the function returns another shape.

    **Example**

    ```python
    def B(t0, t1):                                              # a smooth path, for a test
        return jnp.array([jnp.sin(t1) - jnp.sin(t0)])

    free = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2,
                      noise=lambda t, q, p, args: jnp.ones(1))
    sol = dvi.integrate(free, [0.0], [0.0], h=0.1, num_steps=10, path=dvi.Increments(B),
                        method=dvi.StochasticEuler())
    print(round(float(sol.ps[-1, 0]), 6), round(float(np.sin(1.0)), 6))
    # 0.841471 0.841471
    ```
    """

    function: Callable[[Any, Any], Any]

    def increments(self, k, interval, parts, count):
        ends = [interval.part(j / parts, (j + 1) / parts) for j in range(parts)]
        found = [jnp.asarray(self.function(*end[:2])) for end in ends]
        if any(x.shape != (count,) for x in found):
            raise ValueError(
                "the function of dvi.Increments must return one number for each noise of the "
                f"system, shape ({count},), got shape {found[0].shape}."
            )
        return jnp.stack(found).astype(interval.h.dtype)


class NoisePath(eqx.Module):
    """The path of a run: a step has `parts` parts, with the increments of `count` motions each."""

    path: Path
    parts: int = eqx.field(static=True)
    count: int = eqx.field(static=True)

    def at(self, k: Int[Array, ""], interval: Interval) -> Array:
        """The increments of step k, shape (parts, count)."""
        return self.path.increments(k, interval, self.parts, self.count)


def as_path(path: Any) -> Path | None:
    """The path of a run, its key as two words. **Raises** `TypeError` or `ValueError`."""
    if path is None:
        return None
    if not isinstance(path, Path):
        path = Brownian(path)
    if not isinstance(path, Brownian):
        return path
    first = jnp.asarray(path.first_step)
    if first.shape != () or not jnp.issubdtype(first.dtype, jnp.integer):
        raise TypeError(f"first_step must be an integer, got {path.first_step!r:.200}.")
    return Brownian(_words(path.key), path.substeps, first)


def _words(key: Any) -> Array:
    try:
        key = jnp.asarray(key)
    except TypeError:
        raise TypeError(_WRONG_KEY.format(f"{key!r:.200}")) from None
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        # Another generator has keys of another length, or another meaning.
        if key.shape == () and "fry" in str(key.dtype):
            return jax.random.key_data(key)
    elif key.shape == (2,) and key.dtype == jnp.uint32:  # an old key of JAX: its words
        return key
    elif key.shape == () and jnp.issubdtype(key.dtype, jnp.integer):
        return jax.random.key_data(jax.random.key(key, impl="threefry2x32"))
    raise ValueError(_WRONG_KEY.format(f"shape {key.shape}, dtype {key.dtype}"))


_WRONG_KEY = (
    "the key of a path must be one key of jax.random, such as jax.random.key(0), with the "
    "generator threefry2x32, or an integer, got {}. For many paths use jax.vmap over keys, or "
    'dvi.sweep(..., path=dvi.Axis("seed", range(1000))).'
)


def _normal(key: Array, number: Array, count: int, dtype: Any) -> Array:
    """``jax.random.normal(jax.random.fold_in(key, number), (count,), dtype)`` to round-off."""
    folded = jnp.stack(threefry2x32(key, jnp.uint32(0), number))
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
