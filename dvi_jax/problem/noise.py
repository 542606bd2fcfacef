"""Noise: what it does to a system, and the Brownian paths that drive it."""

import abc
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

import lanewise
from lanewise.jaxprs.dependence import depends_on
from lanewise.jaxprs.jaxapi import is_traced, threefry2x32

from ..base.checks import array, whole
from ..base.signature import output_of, warn_of_exchanged, with_time
from ..base.types import Args, Interval, Scalar, State
from .flows import value_of

_NAMES = "(t, q, p, args)"


class Noise(eqx.Module):
    """Base class of noise by m independent Brownian motions B, in the sense of Stratonovich."""

    @property
    def functions(self) -> list[Callable[..., Any]]:
        """The functions of the user."""
        return [value for value in vars(self).values() if callable(value)]

    @abc.abstractmethod
    def count(self, t: Scalar, q: State, p: State, args: Args) -> int:
        """m. **Raises** `ValueError` for functions that return a wrong shape."""

    def energy(self, t: Scalar, q: State, p: State, args: Args, rates: Array) -> Any:
        """Σ_m h_m Ḃ_m for noise Hamiltonians h_m, with Ḃ = `rates`, shape (m,) [√time/time]."""
        return jnp.zeros((), p.dtype)

    def force(self, t: Scalar, q: State, p: State, args: Args, rates: Array) -> Any:
        """The rate of change of p that does not derive from `energy`."""
        return jnp.zeros_like(p)

    def kick(self, t: Scalar, q: State, p: State, args: Args, h: Scalar, dB: Array) -> State:
        """The change of p over a time h by `force` alone at constant q, exactly."""
        return h * self.force(t, q, p, args, dB / h)

    def reaction(self, args: Args, like: State, h: Scalar) -> Any:
        """The diagonal w of the change −w Gᵀμ by forces of constraint during `kick`."""
        return 1

    def check_fixed_momentum(self, method: str, t: Scalar, q: State, p: State, args: Args) -> None:
        """**Raises** `ValueError` if a method cannot take the factor of dB at a known momentum."""


class MomentumNoise(Noise):
    """dp = … + σ(t, q, p) ∘ dB, the noise of ``System(H_D, noise=sigma)``."""

    sigma: Callable[..., Any]

    def count(self, t, q, p, args):
        # Traced only: at the start σ may be singular.
        sigma = output_of(f"noise{_NAMES}", self.sigma, t, q, p, args)
        shapes = q.shape, (*q.shape, "m")
        array(f"noise{_NAMES}", sigma, *shapes, verb="return", integers=True, empty=True)
        return q.size if sigma.shape == q.shape else sigma.shape[-1]

    def force(self, t, q, p, args, rates):
        sigma = jnp.asarray(self.sigma(t, q, p, args), p.dtype)
        # Of the shape of q it is a diagonal matrix.
        return sigma * rates.reshape(q.shape) if sigma.shape == q.shape else sigma @ rates

    def check_fixed_momentum(self, method, t, q, p, args):
        if depends_on(lambda p: self.sigma(t, q, p, args), 0, p):
            raise ValueError(
                f"method=dvi.{method}() requires noise that does not depend on p. Use "
                "method=dvi.StochasticMidpoint()."
            )


class Ito(MomentumNoise):
    r"""Momentum noise in the sense of Itô: dp = … + σ(t, q, p) dB, with σ dB and not σ ∘ dB.

    The methods solve the equation of Stratonovich with the same solutions,

        dp_i = (… − ½ Σ_jm σ_jm ∂σ_im/∂p_j) dt + Σ_m σ_im ∘ dB_m

    (by autodiff; σ of the shape of q is a diagonal matrix). The correction is zero if σ does not
    depend on p: q has no noise, so that a dependence on q makes no difference.

    **Arguments** `sigma`: function ``(t, q, p, args)`` as for ``System(H_D, noise=sigma)``, of the
    shape of q or (*q.shape, m) [unit of p/√time].

    **Raises** `TypeError` for another function; `ValueError` in `integrate` for another shape, and
    for a σ that depends on p with another method than `StochasticMidpoint`.

    **Source** Kloeden & Platen 1992, *Numerical Solution of Stochastic Differential Equations*,
    4.9.
    """

    def __init__(self, sigma: Callable[..., Any]):
        self.sigma = with_time("sigma of dvi.Ito", sigma)
        warn_of_exchanged("sigma of dvi.Ito", self.sigma, _NAMES)

    def force(self, t, q, p, args, rates):
        def change(unit):
            """Σ_j σ_jm ∂σ_m/∂p_j of the motion with this unit vector."""

            def column(p):
                return MomentumNoise.force(self, t, q, p, args, unit)

            return jax.jvp(column, (p,), (column(p),))[1]

        changes = jax.vmap(change)(lanewise.unit_vectors(rates.size, p.dtype))
        return super().force(t, q, p, args, rates) - jnp.sum(changes, axis=0) / 2


class Langevin(Noise):
    r"""Friction and thermal noise: Langevin's equation.

        dp = (−∂H/∂q + εW) dt − γ p dt + √(2 γ T m) dB

    With H = Σ p²/(2m) + V(q) and W = 0 the canonical distribution exp(−H/T) is stationary. At T = 0
    the flow is conformally symplectic: areas shrink as e^{−γt}. ε multiplies neither term.

    **Arguments** numbers, arrays that broadcast with q, or functions of args that return them:
    `friction` is γ [1/time], `temperature` is T, which means k_B T [energy], and `mass` is m, that
    of H [energy·time²/(unit of q)²].

    **Raises** `ValueError` for a friction or temperature below 0, a mass that is not positive, and
    values that do not broadcast with q0. Such values from args, or traced ones, give the status
    `not_finite`, as NaN does.

    **Source** Langevin 1908; Leimkuhler & Matthews 2015, *Molecular Dynamics*, 6.
    """

    friction: Any
    temperature: Any = 0.0
    mass: Any = 1.0

    def __check_init__(self):
        for name, value in vars(self).items():
            if callable(value) or is_traced(value):  # known in a run only
                continue
            entries, is_mass = np.asarray(value), name == "mass"
            invalid = np.full(entries.shape, entries.dtype.kind not in "iuf")
            if not invalid.any():  # NaN gives the state NaN
                invalid = entries <= 0 if is_mass else entries < 0
            if invalid.any():
                rule = "positive" if is_mass else "zero or positive"
                number = entries[invalid][0]
                raise ValueError(f"{name} of dvi.Langevin must be {rule}, got {number}.")

    def _values(self, args: Args, like: State) -> list[Array]:
        parameters = (self.friction, self.temperature, self.mass)
        values = [value_of(parameter, args, like) for parameter in parameters]
        # Numbers stay numbers: e^{−γh} of a step is then computed once.
        return [jnp.broadcast_to(value, like.shape) if value.ndim else value for value in values]

    def count(self, t, q, p, args):
        try:
            self._values(args, q)
        except ValueError as error:
            raise ValueError(
                "friction, temperature and mass of dvi.Langevin must broadcast with q0, shape "
                f"{q.shape}: {error}"
            ) from None
        return q.size

    def force(self, t, q, p, args, rates):
        friction, temperature, mass = self._values(args, p)
        return -friction * p + _amplitude(2 * friction, temperature, mass) * rates.reshape(p.shape)

    def kick(self, t, q, p, args, h, dB):
        # The Ornstein–Uhlenbeck process, exact in distribution: its noise is normal with this
        # variance, and the increment takes the place of its integral.
        friction, temperature, mass = self._values(args, p)
        rate = -jnp.expm1(-2 * friction * h) / h
        noise = _amplitude(rate, temperature, mass) * dB.reshape(p.shape)
        return jnp.expm1(-friction * h) * p + noise

    def reaction(self, args, like, h):
        # The midpoint rule of the constrained equation with 2 tanh(γh/2) in place of γh: exact for
        # an equal friction of all coordinates, and the canonical distribution is stationary for
        # every friction (Lelièvre, Rousset & Stoltz 2012).
        friction = self._values(args, like)[0]
        return 1 + jnp.expm1(-friction * h) / 2 if friction.ndim else 1


class NoiseHamiltonians(Noise):
    r"""Noise by Hamiltonians, a stochastic Hamiltonian system in the sense of Stratonovich:

        dq = ∂H/∂p dt + Σ_m ∂h_m/∂p ∘ dB_m,    dp = (−∂H/∂q + εW) dt − Σ_m ∂h_m/∂q ∘ dB_m

    Its flow is symplectic for each path if W = 0. ε does not multiply the noise.

    **Arguments** `h`: function ``(q, p)`` or ``(t, q, p, args)`` → array of shape (m,)
    [energy·√time].

    **Raises** `TypeError` for another function, `ValueError` if it returns another shape.

    **Source** Bismut 1981, *Mécanique aléatoire*; Milstein, Repin & Tretyakov 2002, *SIAM J. Numer.
    Anal.* 39, 2066.
    """

    h: Callable[..., Any]

    def __init__(self, h: Callable[..., Any]):
        self.h = with_time("h of dvi.NoiseHamiltonians", h)

    def count(self, t, q, p, args):
        energies = jax.eval_shape(self.h, t, q, p, args)
        hint = "For one noise return jnp.array([energy])."
        name = f"h{_NAMES} of dvi.NoiseHamiltonians"
        array(name, energies, ("m",), verb="return", integers=True, empty=True, hint=hint)
        return energies.shape[0]

    def energy(self, t, q, p, args, rates):
        return jnp.sum(jnp.asarray(self.h(t, q, p, args), p.dtype) * rates)

    # Positions change as well: there is no exact flow at constant q.
    def kick(self, t, q, p, args, h, dB):
        raise ValueError(
            "dvi.BAOAB() and dvi.OBABO() require noise on the momenta, got noise Hamiltonians. Use "
            "dvi.StochasticMidpoint() or dvi.StochasticEuler()."
        )


def _amplitude(rate: Array, temperature: Array, mass: Array) -> Array:
    """√(rate T m); NaN if a factor is negative or NaN, or m = 0."""
    # The root of each factor: in units of atoms and in float32 their product underflows to 0, and
    # the product of two negative numbers is positive.
    return _root(rate) * _root(temperature) * jnp.where(mass > 0, jnp.sqrt(mass), jnp.nan)


def _root(x: Array) -> Array:
    """√x with a derivative of 0 at x = 0."""
    # At a temperature of 0 that of √x would be infinite, and the gradients of all else NaN.
    return jnp.where(x == 0, 0, jnp.sqrt(jnp.where(x == 0, 1, x)))


def as_noise(noise: Any) -> Noise | None:
    """The noise of a system: an object, or σ as a function. **Raises** `TypeError`."""
    if noise is None or isinstance(noise, Noise):
        return noise
    noise = with_time("noise", noise)
    warn_of_exchanged("noise", noise, _NAMES)
    return MomentumNoise(noise)


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
      numbers z with the indices n (first_step + k), …. Steps h, h/2, h/4 with n = 4, 2, 1 have the
      same path B(t), as tests of convergence require. `OBABO`, with two increments, doubles n.
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
            _words(self.key)

    def check(self, num_steps):
        first = jnp.asarray(self.first_step)
        if first.ndim or not jnp.issubdtype(first.dtype, jnp.integer):
            raise ValueError(f"first_step must be an integer, got {self.first_step!r:.200}.")
        if not is_traced(first):  # twice, for methods with two increments per step
            largest = 2**32 // (2 * self.substeps) - num_steps
            hint = "A path has 2³² parts: continue a longer run with another key."
            whole("first_step", int(first), 0, largest, hint)

    def increments(self, k, interval, parts, count):
        # Modulo 2³², as the numbers of `fold_in` are; `check` excludes that they repeat.
        step = jnp.asarray(self.first_step).astype(jnp.uint32) + k.astype(jnp.uint32)
        dtype, size = interval.h.dtype, self.substeps

        def add(i, sums):
            numbers = [(step * parts + part) * size + jnp.uint32(i) for part in range(parts)]
            return sums + jnp.stack([_normal(self.key, x, count, dtype) for x in numbers])

        zero = jnp.zeros((parts, count), dtype)
        # A loop, so that the code does not grow with the number of substeps.
        sums = add(0, zero) if size == 1 else lax.fori_loop(0, size, add, zero)
        return jnp.sqrt(interval.h / (parts * size)) * sums  # NaN for time that runs backwards


class NoisePath(eqx.Module):
    """The path of a run: a step has `parts` parts, with the increments of `count` motions each, of
    at most `limit` standard deviations (None: any)."""

    path: BrownianPath
    parts: int = eqx.field(static=True)
    count: int = eqx.field(static=True)
    limit: float | None = eqx.field(static=True)

    def increments_of(self, k: Int[Array, ""], interval: Interval) -> Array:
        """The increments of step k, shape (parts, count)."""
        increments = self.path.increments(k, interval, self.parts, self.count)
        name = f"the increments (parts, motions) of {type(self.path).__name__}"
        array(name, increments, (self.parts, self.count), integers=True)
        increments = increments.astype(interval.h.dtype)  # a path of the user may have another type
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
    return Brownian(_words(path.key), path.substeps, jnp.asarray(path.first_step))


def _words(key: Any) -> Array:
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


def _normal(key: Array, number: Array, count: int, dtype: Any) -> Array:
    """``jax.random.normal(jax.random.fold_in(key, number), (count,), dtype)`` to round-off."""
    # What `fold_in` does: the words of the number, encrypted with the key, are a new key.
    step_key = jnp.stack(threefry2x32(key, jnp.uint32(0), number))
    # What `random_bits` does: the index of each number in two words.
    words = threefry2x32(step_key, jnp.uint32(0), jnp.arange(count, dtype=jnp.uint32))
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
