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
    """Base class of noise: m independent Brownian motions B, in the sense of Stratonovich."""

    is_on_momenta: ClassVar[bool] = True
    """Whether noise changes momenta only."""

    @abc.abstractmethod
    def functions(self) -> list[Callable[..., Any]]:
        """The functions of the user."""

    @abc.abstractmethod
    def count(self, t: Scalar, q: State, p: State, args: Args) -> int:
        """m. **Raises** `ValueError` for functions that return another shape than they must."""

    def energy(self, t: Scalar, q: State, p: State, args: Args, rates: Array) -> Any:
        """Σ_m h_m Ḃ_m for noise Hamiltonians h_m, with Ḃ = `rates`, shape (m,) [√time/time]."""
        return 0.0

    def force(self, t: Scalar, q: State, p: State, args: Args, rates: Array) -> Any:
        """The rate of change of p that is not in `energy`."""
        return jnp.zeros_like(p)

    def kick(self, t: Scalar, q: State, p: State, args: Args, h: Scalar, dB: Array) -> State:
        """The change of p over a time h by noise and its friction alone, at constant q."""
        return h * self.force(t, q, p, args, dB / h)

    def depends_on_momentum(self, t: Scalar, q: State, p: State, args: Args) -> bool:
        """Whether the factor of dB in dp depends on p."""
        return False


class MomentumNoise(Noise):
    """dp = … + σ(t, q, p) ∘ dB, the noise of ``System(H_D, noise=sigma)``."""

    sigma: Callable[..., Any]

    def functions(self):
        return [self.sigma]

    def count(self, t, q, p, args):
        shape = jax.eval_shape(self.sigma, t, q, p, args).shape
        if shape == q.shape:
            return q.size
        if len(shape) == q.ndim + 1 and shape[:-1] == q.shape:
            return shape[-1]
        raise ValueError(
            f"noise{_NAMES} must return an array like q0, {q.shape}, for an independent noise in "
            f"each momentum, or of the shape {(*q.shape, 'm')} for m noises; got shape {shape}."
        )

    def force(self, t, q, p, args, rates):
        sigma = jnp.asarray(self.sigma(t, q, p, args), p.dtype)
        if sigma.shape == q.shape:
            return sigma * rates.reshape(q.shape)
        return jnp.sum(sigma * rates, -1)

    def depends_on_momentum(self, t, q, p, args):
        return depends_on(lambda p: self.sigma(t, q, p, args), 0, p)


class Langevin(Noise):
    r"""Friction and thermal noise: Langevin's equation.

        dp = (−∂H/∂q + εW) dt − γ p dt + √(2 γ T m) dB

    With H = Σ p²/(2m) + V(q) and W = 0 the canonical distribution exp(−H/T) is stationary. At T = 0
    the flow is conformally symplectic: areas shrink as e^{−γt}.

    **Arguments** numbers, arrays that broadcast with q, or functions of args that return them:

    - `friction`: γ [1/time]. `temperature`: T, which means k_B T [energy].
    - `mass`: m, that of H [energy·time²/(unit of q)²].

    ε does not multiply friction and noise.

    **Raises** `ValueError` for values that do not broadcast with q0.

    **Source** Langevin 1908; Leimkuhler & Matthews 2015, *Molecular Dynamics*, 6.

    **Example**

    ```python
    H_D = lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + q0 @ q0 / 2
    system = dvi.System(H_D, noise=dvi.Langevin(1.0, lambda args: args["T"]))
    sol = dvi.integrate(system, [0.0], [0.0], h=0.2, num_steps=100_000, args={"T": 0.5},
                        method=dvi.BAOAB(), path=dvi.Brownian(1), save=dvi.Save(final=True),
                        observe=dvi.Mean(lambda q, p: q[0] ** 2))
    print(f"{sol.observed:.1f}")                                # T/k
    # 0.5
    ```
    """

    friction: Any
    temperature: Any = 0.0
    mass: Any = 1.0

    def functions(self):
        return [x for x in (self.friction, self.temperature, self.mass) if callable(x)]

    def _at(self, args: Args, like: State) -> list[Array]:
        values = (self.friction, self.temperature, self.mass)
        return [jnp.asarray(x(args) if callable(x) else x, like.dtype) for x in values]

    def count(self, t, q, p, args):
        for name, x in zip(("friction", "temperature", "mass"), self._at(args, q), strict=True):
            if jnp.broadcast_shapes(x.shape, q.shape) != q.shape:
                raise ValueError(
                    f"the {name} of dvi.Langevin must be a number or broadcast with q0, shape "
                    f"{q.shape}, got shape {x.shape}."
                )
        return q.size

    def force(self, t, q, p, args, rates):
        friction, temperature, mass = self._at(args, p)
        return -friction * p + _root(2 * friction * temperature * mass) * rates.reshape(p.shape)

    def kick(self, t, q, p, args, h, dB):
        # The Ornstein–Uhlenbeck process, exact in distribution: its noise is a normal number of
        # this variance, for which that of the increment is taken.
        friction, temperature, mass = self._at(args, p)
        variance = -jnp.expm1(-2 * friction * h) * temperature * mass
        return jnp.expm1(-friction * h) * p + _root(variance / h) * dB.reshape(p.shape)


class NoiseHamiltonians(Noise):
    r"""Noise by Hamiltonians, a stochastic Hamiltonian system in the sense of Stratonovich:

        dq = ∂H/∂p dt + Σ_m ∂h_m/∂p ∘ dB_m,    dp = (−∂H/∂q + εW) dt − Σ_m ∂h_m/∂q ∘ dB_m

    Its flow is symplectic for each path if W = 0.

    **Arguments**

    - `h`: function ``(t, q, p, args)`` → array of shape (m,) [energy·√time].

    **Raises** `TypeError` for another function, `ValueError` if it returns another shape.

    **Source** Bismut 1981, *Mécanique aléatoire*; Milstein, Repin & Tretyakov 2002, *SIAM J. Numer.
    Anal.* 39, 2066.

    **Example**

    ```python
    def energy(t, q, p, args):
        return (p @ p + q @ q) / 2

    oscillator = dvi.System(dvi.discretise(energy),             # Kubo's: the frequency is noisy
                            noise=dvi.NoiseHamiltonians(lambda *at: 0.3 * energy(*at)[None]))
    sol = dvi.integrate(oscillator, [1.0], [0.0], h=0.1, num_steps=1000, path=dvi.Brownian(0),
                        method=dvi.StochasticMidpoint(), observe=dvi.MaxDrift(energy))
    print(bool(sol.observed < 1e-12))                           # conserved for every path
    # True
    ```
    """

    h: Callable[..., Any]

    is_on_momenta: ClassVar[bool] = False

    def functions(self):
        return [self.h]

    def count(self, t, q, p, args):
        shape = jax.eval_shape(self.h, t, q, p, args).shape
        if len(shape) != 1:
            raise ValueError(
                f"the function of dvi.NoiseHamiltonians must return an array of shape (m,), got "
                f"shape {shape}. For one noise return its energy as jnp.array([energy])."
            )
        return shape[0]

    def energy(self, t, q, p, args, rates):
        return jnp.asarray(self.h(t, q, p, args), p.dtype) @ rates


def _root(x: Array) -> Array:
    """√x with a derivative of 0 at x = 0."""
    # At a temperature of 0 that of √x would be infinite, and the gradients of all else NaN.
    there = x > 0
    return jnp.where(there, jnp.sqrt(jnp.where(there, x, 1)), 0)


def as_noise(noise: Any) -> Noise | None:
    """The noise of a system: an object, or σ as a function. **Raises** `TypeError`."""
    if noise is None or isinstance(noise, Noise):
        found = noise
    else:
        check_takes("noise", noise, _NAMES)
        warn_of_exchanged("noise", noise, _NAMES)
        return MomentumNoise(noise)
    if isinstance(found, NoiseHamiltonians):
        check_takes("h of dvi.NoiseHamiltonians", found.h, _NAMES)
    return found
