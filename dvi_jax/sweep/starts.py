"""Initial conditions that are generated on demand: number i of a sweep as a function of i."""

import abc
import itertools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..base.checks import finite, positive, whole
from ..base.printing import printable
from ..base.signature import with_time
from ..base.types import Args, Scalar
from ..engine.bracket import bracketed_root
from .axes import refuse_non_finite

_TRIES = 64  # Points that are tried for one initial condition on an energy shell
_DOUBLINGS = 100


class Starts(eqx.Module):
    """Base class of generated initial conditions: number i is a function of the index i.

    They are not stored, so that there may be any number. A subclass defines `at`; its fields are
    what the initial conditions depend on. In the result they are the dimension `name`.
    """

    count: eqx.AbstractVar[int]
    name: eqx.AbstractVar[str]

    @abc.abstractmethod
    def at(self, index: Array, t0: Scalar, args: Args) -> tuple[Any, ...]:
        """Initial condition number `index` as (q0, p0), or as (q0, p0, args) where parameters of
        the system belong to it. It is traced: a function of JAX arrays."""


def _box(owner: str, **ends: Any) -> tuple[list[tuple[float, ...]], tuple[int, ...]]:
    """Pairs (q, p), the first at most the last, as flat tuples of numbers, and the shape of q."""
    arrays = []
    for name, pair in ends.items():
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise TypeError(f"{name} of {owner} must be a pair (q, p), got {pair!r:.200}.")
        for array in (np.asarray(x, float) for x in pair):
            refuse_non_finite(f"{name} of {owner}", array)
            arrays.append(array)
    shapes = [array.shape for array in arrays]
    if len(set(shapes)) > 1:
        names, text = " and ".join(ends), " and ".join(map(str, dict.fromkeys(shapes)))
        raise ValueError(f"all arrays in {names} of {owner} must have one shape, got {text}.")
    flat = [np.ravel(arrays[i : i + 2]) for i in range(0, len(arrays), 2)]
    if (too_low := flat[0] > flat[-1]).any():
        raise ValueError(
            f"low of {owner} must not exceed high in any component, got {flat[0][too_low][0]} and "
            f"{flat[-1][too_low][0]}."
        )
    return [tuple(x.tolist()) for x in flat], shapes[0]


class Seeded(Starts):
    """Base class of generators with a seed: a key for each index."""

    count: int = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    seed: int = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(self, count: int, shape: tuple[int, ...], seed: int, name: str):
        owner = type(self).__name__
        self.count, self.shape = whole(f"count of {owner}", count), shape
        self.seed, self.name = whole(f"seed of {owner}", seed, 0, 2**32 - 1), name

    def key(self, index: Array) -> Array:
        """A random key for each index, also above 2³²."""
        index = jnp.asarray(index)
        key = jax.random.fold_in(jax.random.key(self.seed), index & 0x7FFFFFFF)
        return jax.random.fold_in(key, index >> 31)

    def state(self, flat: Array) -> tuple[Array, Array]:
        """(q, p) from all their numbers."""
        q, p = jnp.split(flat, 2)
        return q.reshape(self.shape), p.reshape(self.shape)


class InBox(Seeded):
    """Base class of initial conditions in a box: scaled points of the unit cube.

    - `count`, `low`, `high`, `seed`, `name`: as for `Random`.
    """

    low: tuple[float, ...] = eqx.field(static=True)
    high: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, count: int, low: Any, high: Any, seed: int = 0, name: str = "start"):
        (self.low, self.high), shape = _box(type(self).__name__, low=low, high=high)
        super().__init__(count, shape, seed, name)

    @abc.abstractmethod
    def in_unit_cube(self, index: Array, like: Array) -> Array:
        """Point number `index`: numbers from 0 to 1, in the shape and precision of `like`."""

    def at(self, index, t0, args):
        low, high = jnp.asarray(self.low), jnp.asarray(self.high)
        return self.state(low + (high - low) * self.in_unit_cube(index, low))


class Random(InBox):
    """Independent initial conditions, uniformly distributed in a box.

    - `count`: number of initial conditions. `low`, `high`: corners of the box, pairs (q, p).
    - `seed`: initial condition i of a seed is always the same, for any count.
    - `name`: of the dimension in the result.
    """

    def in_unit_cube(self, index, like):
        return jax.random.uniform(self.key(index), like.shape, like.dtype)


class Halton(InBox):
    """Initial conditions that fill a box evenly: Halton's sequence with a random shift.

    The bases are the first primes. The error of a mean decreases nearly as 1/count in few
    dimensions, that of `Random` as 1/√count. The shift (modulo one) depends on `seed`, and makes
    the mean unbiased.

    - `count`, `low`, `high`, `seed`, `name`: as for `Random`. Fixed components (low = high) do not
      use a dimension of the sequence.

    **Source** Halton 1960, Numer. Math. 2, 84; the shift: Cranley & Patterson 1976, SIAM J. Numer.
    Anal. 13, 904.
    """

    def in_unit_cube(self, index, like):
        free = [i for i, (a, b) in enumerate(zip(self.low, self.high, strict=True)) if a != b]
        shift = np.random.default_rng(self.seed).random(len(free))
        u = jnp.zeros_like(like)
        for i, base, s in zip(free, _primes(len(free)), shift, strict=True):
            x = _radical_inverse(index + 1, base, self.count + 1, like.dtype) + s
            u = u.at[i].set(jnp.where(x >= 1, x - 1, x))
        return u


class Normal(Seeded):
    """Normally distributed initial conditions, with independent components.

    - `count`: number of initial conditions. `q0`, `p0`: their mean.
    - `sigma`: standard deviations, a pair (of q, of p) of numbers or arrays of that shape.
    - `seed`, `name`: as for `Random`.
    """

    middle: tuple[float, ...] = eqx.field(static=True)
    sigma: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self, count: int, q0: Any, p0: Any, sigma: Any, seed: int = 0, name: str = "start"
    ):
        (self.middle,), shape = _box("Normal", **{"(q0, p0)": (q0, p0)})
        if isinstance(sigma, tuple | list) and len(sigma) == 2:
            sigma = [np.broadcast_to(np.asarray(s, float), shape) for s in sigma]
        (self.sigma,), _ = _box("Normal", sigma=sigma)
        for number in self.sigma:
            positive("sigma of Normal", number, zero=True)
        super().__init__(count, shape, seed, name)

    def at(self, index, t0, args):
        middle, sigma = jnp.asarray(self.middle), jnp.asarray(self.sigma)
        z = jax.random.normal(self.key(index), middle.shape, middle.dtype)
        return self.state(middle + sigma * z)


def _radical_inverse(index: Array, base: int, largest: int, dtype: Any) -> Array:
    """The digits of index (at most `largest`) in a base, mirrored at the point."""
    digits = max(1, math.ceil(math.log(largest + 1) / math.log(base)) + 1)
    value = jnp.zeros((), dtype)
    for k in range(digits):
        value = value + (index % base).astype(dtype) * base ** -(k + 1.0)
        index = index // base
    return value


def _primes(count: int) -> list[int]:
    primes: list[int] = []
    while len(primes) < count:
        primes.append(next(n for n in itertools.count(2) if all(n % p for p in primes)))
    return primes


@printable
class EnergyShell(Seeded):
    r"""Random initial conditions on the surface H(t0, q, p, args) = energy.

    q is drawn uniformly from a box and a direction d of p from the sphere; then p = λ d with the
    λ > 0 for which H(t0, q, λ d, args) = energy, to the last digit. Points with H(t0, q, 0, args) ≥
    energy are redrawn up to 64 times; if no other is found the trajectory is NaN with the status
    `not_finite`. H should grow with λ, as kinetic energies do. The distribution is not the
    microcanonical measure; for that weight the points by |dλ/dE| λ^(n−1).

    - `count`: number of initial conditions.
    - `H`: function ``(q, p)`` or ``(t, q, p, args)`` → scalar.
    - `energy`: the value of H. `low`, `high`: corners of the box in q.
    - `seed`, `name`: as for `Random`.
    """

    H: Callable[..., Any]
    energy: float = eqx.field(static=True)
    low: tuple[float, ...] = eqx.field(static=True)
    high: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        count: int,
        H: Callable[..., Any],
        energy: float,
        low: Any,
        high: Any,
        seed: int = 0,
        name: str = "start",
    ):
        self.H = with_time("H of EnergyShell", H)
        ends, shape = _box("EnergyShell", low=(low, low), high=(high, high))
        self.low, self.high = (x[: len(x) // 2] for x in ends)
        self.energy = finite("energy of EnergyShell", energy)
        super().__init__(count, shape, seed, name)

    def at(self, index, t0, args):
        low, high = jnp.asarray(self.low), jnp.asarray(self.high)
        key = self.key(index)

        def draw(k):
            q_key, p_key = jax.random.split(jax.random.fold_in(key, k))
            q = low + (high - low) * jax.random.uniform(q_key, low.shape, low.dtype)
            return q, jax.random.normal(p_key, low.shape, low.dtype)

        def excess(q, p):
            return self.H(t0, q.reshape(self.shape), p.reshape(self.shape), args) - self.energy

        def proceed(k):
            q, p = draw(k)
            return ~(excess(q, 0 * p) < 0) & (k < _TRIES)

        k = lax.while_loop(proceed, lambda k: k + 1, jnp.zeros((), jnp.int32))
        q, d = draw(k)
        d = d / jnp.linalg.norm(d)

        def excess_on_ray(x):
            return excess(q, x * d)

        def is_below(state):
            x, n = state
            return (excess_on_ray(x) < 0) & (n < _DOUBLINGS)

        unit = jnp.ones((), low.dtype)
        x, _ = lax.while_loop(is_below, lambda s: (2 * s[0], s[1] + 1), (unit, jnp.int32(0)))
        is_bracket = (k < _TRIES) & (excess_on_ray(x) >= 0)
        ends = 0 * unit, excess_on_ray(0 * unit), x, excess_on_ray(x)
        size = bracketed_root(excess_on_ray, *ends, is_bracket)
        size = jnp.where(is_bracket, size, jnp.nan)
        return q.reshape(self.shape), (size * d).reshape(self.shape)
