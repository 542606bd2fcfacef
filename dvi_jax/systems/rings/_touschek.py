"""The lifetime of a bunch by Touschek scattering."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base.checks import array, electronvolts, instance
from ._elements import C
from ._optics import optics
from ._radiation import ELECTRON, RADIUS
from ._ring import Ring, Where

_NODES, _DECAY = 200, 40.0
"""Points of the quadrature, and the exponent at which the integrand ends."""


def touschek_lifetime(
    ring: Ring,
    aperture: Any,
    particles: Any,
    *,
    emittance: Any,
    energy_spread: Any,
    bunch_length: Any,
    where: Where | None = None,
    mass: float = ELECTRON,
) -> Array:
    r"""Lifetime [s] of a bunch whose particles are lost if they scatter beyond the aperture of δ.

    Piwinski's formula for beams of any shape, with dispersion in both planes. The rate at a place,
    for the aperture δ and τ_m = δ², is

        1/T = r² c N B/(8π γ² σ_s √(σ_x² σ_y² − σ_δ⁴ D_x² D_y²))
              · ∫ F(τ) e^{−B₁τ} I₀(B₂τ) dτ/√(τ (1 + τ)),   B = √(π (B₁² − B₂²)),  τ from τ_m

    with F = (2τ+1)²(τ/τ_m/(1+τ) − 1)/τ + τ − √(ττ_m(1+τ)) − (2 + 1/(2τ)) log(τ/τ_m/(1+τ)). The
    result is 1 over the mean of the rates along the ring and over both signs of δ.

    **Arguments** `aperture`: negative and positive δ, shape (elements, 2), of
    `momentum_aperture(ring, where=where)`, or one pair for all places; between the elements `where`
    it is linear in s. `particles`: N in the bunch. `emittance`: of the modes x and y [m], at least
    two numbers, both positive; `energy_spread`; `bunch_length` [m]: of `equilibrium`, or others.
    `mass`: rest energy [eV].

    The result can be differentiated. **Raises** `ValueError` for other shapes; as `optics`.

    **Source** Piwinski 1998, DESY 98-179 (31), as in pyAT.

    **Example**

    ```python
    cell = rings.Ring([rings.quadrupole("QF", 0.4, k1=1.3), rings.bend("B", 1.5, np.pi / 16),
                       rings.quadrupole("QD", 0.4, k1=-1.3), rings.bend("B", 1.5, np.pi / 16)])
    lifetime = rings.touschek_lifetime(cell, (-0.02, 0.02), 1e9, emittance=(7e-8, 7e-10),
                                       energy_spread=3e-4, bunch_length=6e-3)
    print(f"{lifetime / 3600:.2f} h")
    # 72.94 h
    ```
    """
    o = optics(instance("ring", ring, Ring, "a rings.Ring"), chromatic=False)
    length, s = ring.columns["length"], ring.places[:-1]
    limits = jnp.asarray(aperture, float)
    if limits.ndim == 2:
        places = np.arange(len(ring)) if where is None else ring.where(where)
        array("aperture", limits, (len(places), 2), hint="It is that of rings.momentum_aperture.")
        if where is not None:
            limits = jnp.stack([jnp.interp(s, s[places], side) for side in limits.T], 1)
    limits = jnp.broadcast_to(limits, (len(ring), 2))
    gamma2 = (ring.energy / electronvolts("mass", mass, 1e5)) ** 2
    radius, sizes = RADIUS * ELECTRON / mass, jnp.asarray(emittance, float)[:2]
    beta, alpha, spread2 = o.beta[:-1], o.alpha[:-1], energy_spread**2
    D, slope = o.dispersion[:-1, ::2], o.dispersion[:-1, 1::2]
    rotation = D * alpha + slope * beta
    area = beta * sizes[None]  # σ² without dispersion
    height = 1 / (1 / spread2 + jnp.sum((D**2 + rotation**2) / area, 1))
    b = beta**2 / area * (1 - height[:, None] * rotation**2 / area) / (2 * gamma2)
    coupling = height**2 * jnp.prod(beta * rotation / area, 1) ** 2 / gamma2**2
    B1, B2 = jnp.sum(b, 1), jnp.sqrt((b[:, 0] - b[:, 1]) ** 2 + coupling)
    widths = jnp.prod(area + spread2 * D**2, 1) - spread2**2 * jnp.prod(D**2, 1)
    rates = jax.vmap(lambda tau: _integral(tau, B1, B2), 1, 1)(limits**2)
    factor = jnp.sqrt(jnp.pi * (B1**2 - B2**2)) / jnp.sqrt(widths)
    rates = (
        rates * (factor * radius**2 * C * particles / (8 * jnp.pi * gamma2 * bunch_length))[:, None]
    )
    return jnp.sum(length) / jnp.sum(length * jnp.mean(rates, 1))


def _integral(low: Array, B1: Array, B2: Array) -> Array:
    """The integral of `touschek_lifetime`, by Gauss quadrature in log τ."""
    points, weights = np.polynomial.legendre.leggauss(_NODES)
    high, shares = jnp.log1p(_DECAY / ((B1 - B2) * low))[None], (1 + points[:, None]) / 2
    low, B1, B2 = low[None], B1[None], B2[None]
    t = low * jnp.exp(shares * high)
    ratio = t / low / (1 + t)
    F = (2 * t + 1) ** 2 * (ratio - 1) / t + t - jnp.sqrt(t * low * (1 + t))
    F = F - (2 + 1 / (2 * t)) * jnp.log(ratio)
    decay = jnp.exp(-(B1 - B2) * t) * jax.scipy.special.i0e(B2 * t)
    return jnp.sum(high * (weights[:, None] / 2) * F * decay * jnp.sqrt(t / (1 + t)), 0)
