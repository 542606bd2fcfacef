"""Alpha particles as they are born: initial conditions from the fusion rate."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ...base.checks import function, in_range, instance
from ...base.printing import printable
from ...sweep.starts import Seeded
from ._field import Field, polynomial
from ._particles import GuidingCentres

_TABLE = 513
"""Points of the table of the distribution in s."""

_TRIES = 64
"""Points that are tried for one particle; the last one is taken if none was accepted, which has a
probability below 1e-9 for fields that vary by less than a factor of two on a surface."""


def fusion_rate(s: Any) -> Any:
    """Rate of D–T reactions per volume, relative, for the profiles n ∝ 1 − s⁵ and T = 11.5 (1 − s)
    keV.

        n² ⟨σv⟩,    ⟨σv⟩ ∝ T^{−2/3} exp(−19.94 T^{−1/3})

    **Source** reactivity: Wesson 2011, *Tokamaks*, 1.5, and NRL Plasma Formulary; profiles: Bader
    et al. 2021, *Nucl. Fusion* 61, 116060.
    """
    T = jnp.maximum(11.5 * (1 - s), 1e-3)
    return (1 - s**5) ** 2 * T ** (-2 / 3) * jnp.exp(-19.94 * T ** (-1 / 3))


def volume_element(field: Field, s: Any, theta: Any, zeta: Any) -> Any:
    """|√g| of (ψ, θ, ζ) [m³/(T m²)]: |G + ιI|/B²."""
    current = 0.0 if field.I is None else polynomial(field.iota, s) * polynomial(field.I, s)
    return jnp.abs(polynomial(field.G, s) + current) / field.strength(s, theta, zeta) ** 2


@printable
class Births(Seeded):
    r"""Random guiding centres of particles at birth: isotropic, at the rate of the reactions.

    The density in the coordinates is rate(s)·√g with √g = (G + ιI)/B², and the pitch v∥/v0 is
    uniform in [−1, 1]. Each trajectory has its own μ in args.

    **Arguments**

    - `count`: number of particles. `particles`: their `GuidingCentres`.
    - `rate`: function of s, the birth rate per volume; `fusion_rate` by default.
    - `surface`: all particles are born on this s, instead of `rate`.
    - `seed`, `name`: as for `dvi.starts.Random`.

    **Raises** `ValueError` for a rate that is negative, not finite, or zero everywhere, or a
    surface outside of [0, 1]; `TypeError` for objects of another type.
    """

    particles: GuidingCentres
    surface: float | None = eqx.field(static=True)
    cumulative: Any
    largest: Any

    def __init__(
        self,
        count: int,
        particles: GuidingCentres,
        rate: Callable[[Any], Any] = fusion_rate,
        surface: float | None = None,
        seed: int = 0,
        name: str = "start",
    ):
        super().__init__(count, (2,), seed, name)
        hint = "such as boozer.GuidingCentres(field)"
        self.particles = instance("particles", particles, GuidingCentres, "GuidingCentres", hint)
        function("rate", rate, "(s)")
        if surface is not None:
            in_range("surface", surface, 0.0, 1.0)
        self.surface = surface
        self.cumulative, self.largest = self._tables(rate)

    def _tables(self, rate: Callable[[Any], Any]) -> tuple[Any, Any]:
        """The fraction of births inside of equidistant s, and the largest √g there, on a grid."""
        s = np.linspace(0, 1, _TABLE)
        angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        theta, zeta = np.meshgrid(angles, angles / self.particles.field.shape.periods)
        element = eqx.filter_jit(volume_element)
        jacobian = np.asarray(element(self.particles.field, s[:, None, None], theta, zeta))
        mean = jacobian.mean((1, 2))
        density = np.asarray(rate(jnp.asarray(s)) * jnp.ones_like(s)) * mean
        if not np.isfinite(density).all() or (density < 0).any() or not density.any():
            raise ValueError(
                "rate(s) must be finite, not negative and not zero everywhere for 0 ≤ s ≤ 1, got "
                f"{np.min(density / mean):.3g} to {np.max(density / mean):.3g}."
            )
        midpoints = (density[1:] + density[:-1]) / 2
        fractions = np.concatenate([[0.0], np.cumsum(midpoints) / np.sum(midpoints)])
        return jnp.asarray(fractions), jnp.asarray(jacobian.max((1, 2)))

    def at(self, index, t0, args):
        of_s, of_pitch, of_angles = jax.random.split(self.key(index), 3)
        like = jnp.zeros((), jnp.result_type(float))
        nodes = jnp.linspace(0, 1, _TABLE)
        s = like + (0.0 if self.surface is None else self.surface)
        if self.surface is None:
            s = jnp.interp(jax.random.uniform(of_s, (), like.dtype), self.cumulative, nodes)
        # A margin, since the largest √g is known on a grid only.
        bound = 1.05 * jnp.interp(s, nodes, self.largest)

        field = self.particles.field

        def draw(k):
            u = jax.random.uniform(jax.random.fold_in(of_angles, k), (3,), like.dtype)
            return 2 * np.pi * u[:2], u[2]

        def proceed(k):
            angles, u = draw(k)
            return (u * bound > volume_element(field, s, *angles)) & (k < _TRIES)

        k = lax.while_loop(proceed, lambda k: k + 1, jnp.zeros((), jnp.int32))
        pitch = jax.random.uniform(of_pitch, (), like.dtype, -1.0, 1.0)
        (theta, zeta), _ = draw(k)
        return self.particles.state(s, theta, zeta, pitch)
