"""What noise does to a system: on momenta, as in Langevin's equation, or by Hamiltonians."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from lanewise.dependence import depends_on

from .._types import Args, Scalar, State
from ..engine.signature import check_takes, warn_of_exchanged

_NAMES = "(t, q, p, args)"


class Noise(eqx.Module):
    """Base class of noise by m independent Brownian motions B, in the sense of Stratonovich."""

    is_on_momenta: ClassVar[bool] = True
    """Whether noise changes momenta only."""

    @property
    @abc.abstractmethod
    def functions(self) -> list[Callable[..., Any]]:
        """The functions of the user."""

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

    def check_fixed_momentum(self, method: str, t: Scalar, q: State, p: State, args: Args) -> None:
        """**Raises** `ValueError` if a method cannot take the factor of dB at a known momentum."""


class MomentumNoise(Noise):
    """dp = … + σ(t, q, p) ∘ dB, the noise of ``System(H_D, noise=sigma)``."""

    sigma: Callable[..., Any]

    @property
    def functions(self):
        return [self.sigma]

    def count(self, t, q, p, args):
        # Traced only: at the start σ may be singular.
        shape = jax.eval_shape(self.sigma, t, q, p, args).shape
        if shape != q.shape and (len(shape) != q.ndim + 1 or shape[:-1] != q.shape):
            raise ValueError(
                f"noise{_NAMES} must return an array like q0, {q.shape}, for an independent noise "
                f"in each momentum, or of the shape {(*q.shape, 'm')} for m motions; got {shape}."
            )
        return q.size if shape == q.shape else shape[-1]

    def force(self, t, q, p, args, rates):
        sigma = jnp.asarray(self.sigma(t, q, p, args), p.dtype)
        if sigma.shape == q.shape:  # a diagonal matrix
            return sigma * rates.reshape(q.shape)
        return jnp.sum(sigma * jnp.broadcast_to(rates, sigma.shape), -1)

    def check_fixed_momentum(self, method, t, q, p, args):
        if depends_on(lambda p: self.sigma(t, q, p, args), 0, p):
            raise ValueError(
                f"the noise of the system depends on p, which dvi.{method}() cannot integrate in "
                "the sense of Stratonovich. Use method=dvi.StochasticMidpoint()."
            )


class Langevin(Noise):
    r"""Friction and thermal noise: Langevin's equation.

        dp = (−∂H/∂q + εW) dt − γ p dt + √(2 γ T m) dB

    With H = Σ p²/(2m) + V(q) and W = 0 the canonical distribution exp(−H/T) is stationary. At T = 0
    the flow is conformally symplectic: areas shrink as e^{−γt}. ε multiplies neither term.

    **Arguments** numbers, arrays that broadcast with q, or functions of args that return them:

    - `friction`: γ [1/time]. `temperature`: T, which means k_B T [energy].
    - `mass`: m, that of H [energy·time²/(unit of q)²].

    **Raises** `ValueError` for values that do not broadcast with q0.

    **Source** Langevin 1908; Leimkuhler & Matthews 2015, *Molecular Dynamics*, 6.
    """

    friction: Any
    temperature: Any = 0.0
    mass: Any = 1.0

    @property
    def functions(self):
        return [x for x in (self.friction, self.temperature, self.mass) if callable(x)]

    def _values(self, args: Args, like: State) -> list[Array]:
        values = (self.friction, self.temperature, self.mass)
        found = [jnp.asarray(x(args) if callable(x) else x, like.dtype) for x in values]
        # Numbers stay numbers: e^{−γh} of a step is then computed once.
        return [jnp.broadcast_to(x, like.shape) if x.ndim else x for x in found]

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
        return -friction * p + _root(2 * friction * temperature * mass) * rates.reshape(p.shape)

    def kick(self, t, q, p, args, h, dB):
        # The Ornstein–Uhlenbeck process, exact in distribution: its noise is normal with this
        # variance, and the increment takes the place of its integral.
        friction, temperature, mass = self._values(args, p)
        variance = -jnp.expm1(-2 * friction * h) * temperature * mass
        return jnp.expm1(-friction * h) * p + _root(variance / h) * dB.reshape(p.shape)


class NoiseHamiltonians(Noise):
    r"""Noise by Hamiltonians, a stochastic Hamiltonian system in the sense of Stratonovich:

        dq = ∂H/∂p dt + Σ_m ∂h_m/∂p ∘ dB_m,    dp = (−∂H/∂q + εW) dt − Σ_m ∂h_m/∂q ∘ dB_m

    Its flow is symplectic for each path if W = 0. ε does not multiply the noise.

    **Arguments** `h`: function ``(t, q, p, args)`` → array of shape (m,) [energy·√time].

    **Raises** `TypeError` for another function, `ValueError` if it returns another shape.

    **Source** Bismut 1981, *Mécanique aléatoire*; Milstein, Repin & Tretyakov 2002, *SIAM J. Numer.
    Anal.* 39, 2066.
    """

    h: Callable[..., Any]

    is_on_momenta: ClassVar[bool] = False

    def __check_init__(self):
        check_takes("h of dvi.NoiseHamiltonians", self.h, _NAMES)

    @property
    def functions(self):
        return [self.h]

    def count(self, t, q, p, args):
        shape = jax.eval_shape(self.h, t, q, p, args).shape
        if len(shape) != 1:
            raise ValueError(
                "the function of dvi.NoiseHamiltonians must return an array of shape (m,), got "
                f"shape {shape}. For one noise return jnp.array([energy])."
            )
        return shape[0]

    def energy(self, t, q, p, args, rates):
        return jnp.sum(jnp.asarray(self.h(t, q, p, args), p.dtype) * rates)

    # Positions change as well: there is no exact flow at constant q.
    def kick(self, t, q, p, args, h, dB):
        raise ValueError(
            "dvi.BAOAB() and dvi.OBABO() require noise on the momenta, but the system has noise "
            "Hamiltonians. Use method=dvi.StochasticMidpoint() or dvi.StochasticEuler()."
        )


def _root(x: Array) -> Array:
    """√x with a derivative of 0 at x = 0."""
    # At a temperature of 0 that of √x would be infinite, and the gradients of all else NaN.
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)


def as_noise(noise: Any) -> Noise | None:
    """The noise of a system: an object, or σ as a function. **Raises** `TypeError`."""
    if noise is None or isinstance(noise, Noise):
        return noise
    check_takes("noise", noise, _NAMES)
    warn_of_exchanged("noise", noise, _NAMES)
    return MomentumNoise(noise)
