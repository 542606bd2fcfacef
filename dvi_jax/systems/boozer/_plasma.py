r"""Collisions of a fast particle with the Maxwellian electrons and ions of a plasma.

The test-particle operator for the species b, with Γ_b = n_b Z²Z_b² e⁴ ln Λ/(4πε₀² m²), x = v/v_b,
v_b = √(2T_b/m_b) and Chandrasekhar's function G(x) = (erf x − x erf' x)/(2x²):

    C f = Σ_b ν_b/2 ∂/∂ξ (1 − ξ²) ∂f/∂ξ + v⁻² ∂/∂v v² (F_b f + D_b ∂f/∂v)

    ν_b = Γ_b (erf x − G)/v³,    F_b = Γ_b G m/T_b,    D_b = Γ_b G/v

Its process in the sense of Itô is, for E = v²/2,

    dE = −L dt + v√(2D) dB,    L_b = Γ_b (G mv/T_b − x erf' x/v)

and a Brownian motion of the direction on the sphere, with ⟨ξ⟩ ∝ exp(−∫ν dt). F_b = m D_b v/T_b is
the relation of detailed balance: exp(−mv²/2T) is stationary if all T_b are T.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array

from ...base.checks import in_range, positive
from ...base.printing import printable

EV = 1.602176634e-19
_ELECTRON_MASS, _ATOMIC_MASS, _EPSILON_0 = 9.1093837015e-31, 1.66053906660e-27, 8.8541878128e-12
_DEUTERIUM_TRITIUM = ((2.0136, 1.0, 0.5), (3.0155, 1.0, 0.5))
_COLDEST = 1.0
"""A lower limit of temperatures [eV]: profiles may vanish at the edge."""


@printable
class Rates(NamedTuple):
    """Coefficients of collisions of a particle with the electrons, and with all ions: shape (2, …).

    `scattering` is ν [1/s], `diffusion` D [m²/s³], and `loss` L [m²/s³] the mean rate at which the
    particle loses energy, over its mass.
    """

    scattering: Array
    diffusion: Array
    loss: Array


@printable
class Plasma(eqx.Module):
    r"""Profiles of a plasma of Maxwellian electrons and ions, on which fast particles slow down.

    **Arguments**

    - `density`: of the electrons [1/m³]; `electron_temperature`, `ion_temperature` [eV]: functions
      of s, or numbers. Outside of s = 1 they have the values at s = 1; a temperature below 1 eV
      counts as 1 eV.
    - `ions`: (mass [u], charge [e], density over that of the electrons) of each species; the
      default is deuterium and tritium in equal parts. The charges must add up to one per electron.
    - `coulomb_log`: ln Λ of collisions with electrons and with ions.

    **Raises** `ValueError` for ions that do not neutralise the electrons, or for a ln Λ that is not
    positive.

    **Source** Helander & Sigmar 2002, *Collisional Transport in Magnetized Plasmas*, 3.4;
    Chandrasekhar 1943, *Astrophys. J.* 97, 255.
    """

    density: Callable[[Any], Any] | float
    electron_temperature: Callable[[Any], Any] | float
    ion_temperature: Callable[[Any], Any] | float
    ions: tuple[tuple[float, float, float], ...] = eqx.field(
        static=True, default=_DEUTERIUM_TRITIUM
    )
    coulomb_log: tuple[float, float] = eqx.field(static=True, default=(17.0, 20.0))

    def __check_init__(self):
        for name, value in zip(("electrons", "ions"), self.coulomb_log, strict=True):
            positive(f"coulomb_log of {name}", value)
        total = sum(charge * share for _, charge, share in self.ions)
        in_range("charge of the ions per electron", total, 1 - 1e-6, 1 + 1e-6)

    def profiles(self, s: Any) -> tuple[Array, Array, Array]:
        """n_e [1/m³], T_e and T_i [eV] at s."""
        s, like = jnp.clip(s, 0.0, 1.0), jnp.zeros_like(s)
        functions = self.density, self.electron_temperature, self.ion_temperature
        n, electrons, ions = (like + (f(s) if callable(f) else f) for f in functions)
        return n, jnp.maximum(electrons, _COLDEST), jnp.maximum(ions, _COLDEST)

    def rates(self, s: Any, v: Any, mass: float, charge: float) -> Rates:
        """The `Rates` of particles at one s with speeds v [m/s], a mass [kg] and a charge [e]."""
        v = jnp.asarray(v)
        n, *T = self.profiles(jnp.broadcast_to(s, v.shape))
        own_mass, z, share = np.array([(_ELECTRON_MASS / _ATOMIC_MASS, 1.0, 1.0), *self.ions]).T
        shape = (-1, *[1] * v.ndim)
        scale = (charge * EV**2 / mass / _EPSILON_0) ** 2 / (4 * np.pi)
        log = np.array([self.coulomb_log[0], *[self.coulomb_log[1]] * len(self.ions)])
        gamma = (scale * log * share * z**2).reshape(shape) * n[None]
        energy = EV * jnp.stack([T[0], *[T[1]] * len(self.ions)])
        x = v[None] * jnp.sqrt((_ATOMIC_MASS / 2 * own_mass).reshape(shape) / energy)
        error, slope, G = _chandrasekhar(x)
        friction, over_v = gamma * G * mass / energy, gamma / v[None]
        terms = (
            over_v / v[None] ** 2 * (error - G), over_v * G,
            v[None] * friction - over_v * x * slope,
        )  # fmt: skip
        return Rates(*(jnp.stack([term[0], jnp.sum(term[1:], axis=0)]) for term in terms))

    def critical_speed(self, s: Any) -> Array:
        r"""v_c [m/s]: above it a fast particle heats mostly electrons, below mostly ions.

        v_c³ = (3√π/4) Σ_i (n_i Z_i² m_e ln Λ_i)/(n_e m_i ln Λ_e) v_e³ for v_i ≪ v ≪ v_e.

        **Source** Stix 1972, *Plasma Phys.* 14, 367; the limits of F_b: G → 2x/(3√π) and 1/(2x²).
        """
        T, ratio = (
            self.profiles(s)[1],
            self.coulomb_log[1] / self.coulomb_log[0] * _ELECTRON_MASS / _ATOMIC_MASS,
        )
        weight = sum(z**2 * share / mass for mass, z, share in self.ions)
        cube = 0.75 * np.sqrt(np.pi) * ratio * weight
        return cube ** (1 / 3) * jnp.sqrt(2 * EV * T / _ELECTRON_MASS)

    def slowing_time(self, s: Any, mass: float, charge: float) -> Array:
        """τ_s [s]: v³ + v_c³ of a fast particle decreases as e^{−3t/τ_s}, for v_i ≪ v ≪ v_e."""
        n, T, _ = self.profiles(s)
        energy, speed = EV * T, jnp.sqrt(2 * EV * T / _ELECTRON_MASS)
        gamma = (charge * EV**2 / mass / _EPSILON_0) ** 2 / (4 * np.pi) * self.coulomb_log[0] * n
        return 1.5 * np.sqrt(np.pi) * energy * speed / (gamma * mass)


def _chandrasekhar(x: Array) -> tuple[Array, Array, Array]:
    """erf x, its derivative, and G(x) = (erf x − x erf' x)/(2x²)."""
    error, slope = erf(x), 2 / np.sqrt(np.pi) * jnp.exp(-x * x)
    # The difference cancels at small x, where two terms of the series have all digits.
    large = jnp.maximum(x, 1e-3)
    series = 2 / np.sqrt(np.pi) * x * (1 / 3 - x * x / 5)
    G = jnp.where(x < 1e-3, series, (error - x * slope) / (2 * large * large))
    return error, slope, G
