"""Brownian paths: increments, areas and points within a step, from keys."""

import abc
import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from lanewise.jaxprs.jaxapi import is_traced, threefry2x32

from ..base.checks import array, whole
from ..base.types import Interval, Scalar


class BrownianPath(eqx.Module):
    """Base class of the paths B(t) of m independent Brownian motions."""

    @abc.abstractmethod
    def increments(self, k: Int[Array, ""], interval: Interval, parts: int, count: int) -> Array:
        """The increments of `count` motions over the `parts` equal parts of step k of a run, shape
        (parts, count) [√time]; a pure function of these arguments."""

    # Not abstract: most methods and runs do not need it.
    def areas(self, k: Int[Array, ""], interval: Interval, parts: int, count: int) -> Array | None:
        """(1/l) ∫ (B(s) − ΔB s/l) ds, 0 ≤ s ≤ l, of each part of the length l, with B(0) = 0: the
        mean distance of the path from its chord. As `increments`; None: not available."""

    def part(
        self, k: Int[Array, ""], interval: Interval, fraction: Scalar, parts: int, count: int
    ) -> tuple[Array, Array] | None:
        """The increments and areas over the equal parts of the first `fraction` of step k, for
        states within the step; consistent with those of the step. None: not available."""

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
      numbers z with the indices n (first_step + k), …. Steps h, h/2, h/4 with n = 4, 2, 1 have the
      same path B(t), as tests of convergence require. `OBABO`, with two increments, doubles n.
      `StrongSplitting` uses areas as well, √(h/12) z of the m numbers z after those of ΔB.
    - `first_step`: number of the first step, an integer; N continues a run over N steps from its
      last state.

    **Raises** `ValueError` or `TypeError` for another key; `ValueError` for a `first_step` that is
    not an integer, and for more than 2³² parts.

    **Source** counter-based generators: Salmon, Moraes, Dror & Shaw 2011.
    """

    # Not converted here: in a sweep it is an axis of seeds.
    key: Any
    substeps: int = eqx.field(static=True, default=1)
    first_step: Any = 0

    def __check_init__(self):
        whole("substeps", self.substeps)
        if isinstance(self.key, str | float):  # other kinds may be axes, or traced
            words_of(self.key)

    def check(self, num_steps):
        first = jnp.asarray(self.first_step)
        if first.ndim or not jnp.issubdtype(first.dtype, jnp.integer):
            raise ValueError(f"first_step must be an integer, got {self.first_step!r:.200}.")
        if not is_traced(first):  # twice, for methods with two increments per step
            largest = 2**32 // (2 * self.substeps) - num_steps
            hint = "A path has 2³² parts: continue a longer run with another key."
            whole("first_step", int(first), 0, largest, hint)

    def increments(self, k, interval, parts, count):
        def term(i, number):
            return normals(self.key, number, count, interval.h.dtype)

        return self._sums(k, interval, jnp.zeros((parts, count), interval.h.dtype), term)

    def areas(self, k, interval, parts, count):
        size = self.substeps

        def term(i, number):
            # The mean distance from the chord of a path of `size` pieces, and those of the pieces.
            z, area = _pair(self.key, number, count, interval.h.dtype)
            return (size - 1 - 2 * i) / (2 * size) * z + area / size

        return self._sums(k, interval, jnp.zeros((parts, count), interval.h.dtype), term)

    def part(self, k, interval, fraction, parts, count):
        cells, dtype = parts * self.substeps, interval.h.dtype
        first, zero = self._first_number(k, cells), jnp.zeros(count, dtype)
        # Not differentiated: for derivatives the normals of this part are constants, as are those
        # of a step, and its increments scale with the root of its length.
        size = lax.stop_gradient(jnp.maximum(fraction, jnp.finfo(dtype).tiny)) * cells

        def at(x):
            """B and ∫ B dx after x substeps, with x as the time."""
            last = jnp.minimum(jnp.floor(x), cells - 1).astype(jnp.int32)

            def add(i, sums):
                z, area = _pair(self.key, first + jnp.uint32(i), count, dtype)
                new = sums[0] + z, sums[1] + sums[0] + z / 2 + area
                return jax.tree.map(lambda a, b: jnp.where(i < last, a, b), new, sums)

            B, integral = lax.fori_loop(0, cells, add, (zero, zero))
            x = x - last
            b, inner = _interior(self.key, first + last.astype(jnp.uint32), x, count, dtype)
            return B + b, integral + B * x + inner

        points = [(zero, zero), *(at(size * (i + 1) / parts) for i in range(parts))]
        B, integral = (jnp.stack(column) for column in zip(*points, strict=True))
        increments = jnp.diff(B, axis=0)
        areas = jnp.diff(integral, axis=0) * (parts / size) - B[:-1] - increments / 2
        scale = jnp.sqrt(fraction * interval.h / size)
        return scale * increments, scale * areas

    def _first_number(self, k, cells):
        # Modulo 2³², as the numbers of `fold_in` are; `check` excludes that they repeat.
        step = jnp.asarray(self.first_step).astype(jnp.uint32) + k.astype(jnp.uint32)
        return step * cells

    def _sums(self, k, interval, zero, term):
        """√(h/n) Σ_i ``term(i, number)`` over the n substeps of each part."""
        parts, size = len(zero), self.substeps
        first = self._first_number(k, parts * size)

        def add(i, sums):
            numbers = [first + jnp.uint32(part * size) + jnp.uint32(i) for part in range(parts)]
            return sums + jnp.stack([term(i, number) for number in numbers])

        # A loop, so that the code does not grow with the number of substeps.
        sums = add(0, zero) if size == 1 else lax.fori_loop(0, size, add, zero)
        return jnp.sqrt(interval.h / (parts * size)) * sums  # NaN for time that runs backwards


class NoisePath(eqx.Module):
    """The path of a run: a step has `parts` parts, with the increments of `count` motions each, of
    at most `limit` standard deviations (None: any), and their areas if it `has_areas`."""

    path: BrownianPath
    parts: int = eqx.field(static=True)
    count: int = eqx.field(static=True)
    limit: float | None = eqx.field(static=True)
    has_areas: bool = eqx.field(static=True)

    def increments_of(self, k: Int[Array, ""], interval: Interval) -> Array:
        """The increments of step k, shape (parts, count); the areas are further rows."""
        rows = [self._rows("increments", k, interval)]
        rows += [self._rows("areas", k, interval)] if self.has_areas else []
        return self._truncation(jnp.concatenate(rows), interval)

    def increments_within(self, k: Int[Array, ""], interval: Interval, fraction: Scalar) -> Array:
        """The same over the first `fraction` of step k; those of the step to the bit at its end."""
        rows = self.path.part(k, interval, fraction, self.parts, self.count)
        assert rows is not None  # checked before the run
        rows = jnp.concatenate(rows[: 1 + self.has_areas]).astype(interval.h.dtype)
        rows = self._truncation(rows, interval._replace(h=fraction * interval.h))
        return jnp.where(fraction == 1, self.increments_of(k, interval), rows)

    def _rows(self, name: str, k: Int[Array, ""], interval: Interval) -> Array:
        rows = getattr(self.path, name)(k, interval, self.parts, self.count)
        text = f"the {name} (parts, motions) of {type(self.path).__name__}"
        array(text, rows, (self.parts, self.count), integers=True)
        return rows.astype(interval.h.dtype)  # a path of the user may have another type

    def _truncation(self, increments: Array, interval: Interval) -> Array:
        # A method that solves for the state may have no root for an increment that is rare.
        if self.limit is None:
            return increments
        largest = self.limit * jnp.sqrt(jnp.abs(interval.h))
        return jnp.clip(increments, -largest, largest)


def as_path(path: Any) -> BrownianPath | None:
    """The path of a run, its key as two words. **Raises** `TypeError` or `ValueError`."""
    if path is None or (not isinstance(path, Brownian) and isinstance(path, BrownianPath)):
        return path
    # Here and not in `Brownian`: keys of JAX have a type that generated code does not take.
    path = path if isinstance(path, Brownian) else Brownian(path)
    # Of its own class, which may have other increments.
    words, first_step = words_of(path.key), jnp.asarray(path.first_step)
    return dataclasses.replace(path, key=words, first_step=first_step)


def words_of(key: Any) -> Array:
    try:
        words = jnp.asarray(key)
    except TypeError:
        words = jnp.zeros(0)
    if words.shape == () and jnp.issubdtype(words.dtype, jnp.integer):
        words = jax.random.key(words, impl="threefry2x32")
    # Another generator has keys of another length, or another meaning.
    if words.shape == () and "fry" in str(words.dtype):
        return jax.random.key_data(words)
    if words.shape == (2,) and words.dtype == jnp.uint32:  # an old key of JAX: its words
        return words
    raise ValueError(
        "the key of a path must be an integer, or one key of jax.random with the generator "
        f"threefry2x32, got {key!r:.200}. For many paths use jax.vmap."
    )


_HALVINGS = 24
"""Of a substep, for a point in it: between the last ones the path is a straight line."""


def _interior(key: Array, number: Array, x: Scalar, count: int, dtype: Any) -> tuple[Array, Array]:
    """B and ∫ B dx at 0 ≤ x ≤ 1 of the path with unit step and this number."""

    # The increment w and the area c of an interval give those of its halves with two normals more
    # (Foster, Oberhauser & Lyons 2020): a point has one value, in every order of the requests.
    def halve(_, state):
        node, length, x, B, integral, w, c = state
        z, area = _pair(key, number, count, dtype, node)
        turn, spread = 1.5 * c + jnp.sqrt(length) / 4 * z, jnp.sqrt(length) / 2 * area
        mean = c / 4 - jnp.sqrt(length) / 8 * z
        is_right = x >= 0.5
        w1, c1 = w / 2 + turn, mean + spread
        return (
            2 * node + is_right.astype(jnp.uint32),
            length / 2,
            jnp.where(is_right, 2 * x - 1, 2 * x),
            jnp.where(is_right, B + w1, B),
            jnp.where(is_right, integral + length / 2 * (B + w1 / 2 + c1), integral),
            jnp.where(is_right, w / 2 - turn, w1),
            jnp.where(is_right, mean - spread, c1),
        )

    zero, one = jnp.zeros(count, dtype), jnp.ones((), dtype)
    start = jnp.uint32(1), one, x, zero, zero, *_pair(key, number, count, dtype)
    _, length, x, B, integral, w, _ = lax.fori_loop(0, _HALVINGS, halve, start)
    return B + x * w, integral + length * x * (B + x * w / 2)


def _pair(key: Array, number: Array, count: int, dtype: Any, node: Any = 0) -> tuple[Array, Array]:
    """Increment and area over a unit time: normals with the variances 1 and 1/12."""
    z, y = jnp.split(normals(key, number, 2 * count, dtype, node), 2)
    return z, y / math.sqrt(12)


def normals(key: Array, number: Array, count: int, dtype: Any, node: Any = 0) -> Array:
    """``jax.random.normal(jax.random.fold_in(key, number), (count,), dtype)`` to round-off; other
    numbers for each other `node`."""
    # What `fold_in` does: the words of the number, encrypted with the key, are a new key.
    step_key = jnp.stack(threefry2x32(key, jnp.uint32(0), number))
    # What `random_bits` does: the index of each number in two words.
    words = threefry2x32(step_key, jnp.uint32(node), jnp.arange(count, dtype=jnp.uint32))
    info, bits = jnp.finfo(dtype), words[0] ^ words[1]
    if info.bits == 64:
        bits = words[0].astype(jnp.uint64) << 32 | words[1].astype(jnp.uint64)
    # The fraction of a float in [1, 2).
    unit = jnp.ones((), dtype).view(bits.dtype)
    uniform = (bits >> (info.bits - info.nmant) | unit).view(dtype) - 1
    # Between the numbers next to −1 and 1, as in JAX, so that no result is infinite.
    smallest = np.nextafter(dtype.type(-1), dtype.type(0))
    uniform = jnp.maximum(smallest, uniform * (1 - smallest) + smallest)
    return math.sqrt(2) * lax.erf_inv(uniform)
