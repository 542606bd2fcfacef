"""Noise: what it does to a system."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.dependence import depends_on
from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import array
from ..base.signature import output_of, warn_of_exchanged, with_time
from ..base.types import Args, Scalar, State
from .flows import value_of
from .paths import Brownian as Brownian, BrownianPath as BrownianPath

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

            def column(momentum):
                return MomentumNoise.force(self, t, q, momentum, args, unit)

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
            "dvi.BAOAB(), dvi.OBABO() and dvi.StrongSplitting() require noise on the momenta, got "
            "noise Hamiltonians. Use dvi.StochasticMidpoint() or dvi.StochasticEuler()."
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
