"""Smooth measures of a field that are related to losses of particles, for optimisation."""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ...base.checks import array, in_range, instance, known, positive, whole
from ...base.results import RESULTS
from ...integration.integrate import integrate
from ...integration.reversible import Reversible
from ...methods import GaussLegendre
from ...observe import Mean
from ...observe.solution import Save
from ._bounce import centre_of
from ._field import Field
from ._motion import flux
from ._particles import GuidingCentres

SURFACES = tuple(np.linspace(0.1, 1.0, 10).tolist())


_ENERGY_ERROR = 1e-3
"""Relative change of the energy in a run with a step that is too large for the field."""


def symmetry_error(
    field: Field,
    surfaces: Sequence[float] = SURFACES,
    helicity: int | None = None,
    points: tuple[int, int] = (48, 48),
) -> Array:
    r"""Distance from quasi-symmetry: mean over surfaces of the square of a derivative of ln B.

        f = ⟨ [(∂_ζ + N ∂_θ) B / B]² ⟩,    N = periods · helicity,    ⟨x⟩ = ∫x/B² / ∫1/B²

    It is zero if and only if |B| depends on s and θ − Nζ only. In Boozer coordinates it equals
    the two-term measure ⟨B⁻⁶ [(N − ι) B×∇B·∇ψ − (G + NI) B·∇B]²⟩ for all ι, G and I, and so it
    depends on the spectrum alone. For quasi-axisymmetry, (7/15) f is the mean of (dp_ζ/dt)² of
    isotropic particles, p_ζ in units of m v0 times 1 m and t in units of 1 m/v0.

    - `surfaces`: the s of the surfaces. `helicity`: that of the field by default.
    - `points`: of the grid in θ, and in ζ over one period.

    **Returns** a number. Differentiable in ``field.coefficients``; the derivatives with respect to
    ψ_edge, ι, G and I are zero.

    **Source** Landreman & Paul 2022, *Phys. Rev. Lett.* 128, 035001, eq. (1), with the mean in
    place of the sum over surfaces. The form in Boozer coordinates and the factor 7/15 are our own.
    """
    instance("field", field, Field, "a Field, such as boozer.precise_qa()")
    periods, h = field.shape
    points = array("points", known("points", points), (2,), integers=True, hint="They are (θ, ζ).")
    in_range("surfaces", surfaces, 0.0, 1.0)
    N = periods * (h if helicity is None else whole("helicity", helicity, -99))
    theta, zeta = (2 * np.pi * np.arange(whole("points", n)) / n for n in points)
    s, theta, zeta = np.meshgrid(np.asarray(surfaces, float), theta, zeta / periods, indexing="ij")
    s, theta, zeta = map(jnp.asarray, (s, theta, zeta))
    direction = jnp.full_like(theta, N), jnp.ones_like(zeta)
    B, change = jax.jvp(functools.partial(field.strength, s), (theta, zeta), direction)
    average = jnp.sum(change**2 / B**4, axis=(1, 2)) / jnp.sum(1 / B**2, axis=(1, 2))
    return jnp.mean(average)


class _Weight(eqx.Module):
    """(16π/3) sin(2πτ) sin²(πτ) s with τ = t/T, whose mean over a run is −Δs."""

    chart: Any

    def __call__(self, t, q, p, args):
        tau = t / args["duration"]
        weight = jnp.sin(2 * jnp.pi * tau) * jnp.sin(jnp.pi * tau) ** 2
        return 16 * jnp.pi / 3 * weight * flux(self.chart, q, p, args)


def _run(particles: GuidingCentres, start: Any, duration: tuple[int, Any], **options: Any):
    """A run of one particle with `duration` = (num_steps, h), of which the last state is saved."""
    start = array("start", jnp.asarray(start), (4,), integers=True, hint="It is s, θ, ζ, v∥/v0.")
    (num_steps, h), (q, p, args) = duration, particles.state(*start)
    args |= {"duration": num_steps * h}
    return integrate(
        particles.system, q, p, h=h, num_steps=num_steps, args=args, method=GaussLegendre(2),
        epsilon=None if particles.breaking is None else 1.0, save=Save(final=True), throw=False,
        **options,
    )  # fmt: skip


def _is_accurate(particles: GuidingCentres, start: Any, q: Any, p: Any) -> Array:
    """Whether the energy of a state of a run differs little from that at its start."""
    q0, p0, args = particles.state(*start)
    epsilon = None if particles.breaking is None else 1.0
    first, last = (centre_of(particles.chart, *x, args, epsilon).energy for x in ((q0, p0), (q, p)))
    return jnp.abs(last - first) < _ENERGY_ERROR * first


def radial_drift(
    particles: GuidingCentres, start: Any, *, num_steps: int = 650, h: Any = 4.0
) -> tuple[Array, Array]:
    r"""Change Δs of s by drift during a run of one particle, with bounce oscillations averaged out.

        Δs = −(16π/3) (1/T) ∫₀ᵀ s(t) sin(2πt/T) sin²(πt/T) dt,    T = num_steps · h

    For s = s0 + v t it equals v T. An oscillation of s with a period below T/3 contributes little:
    the weight and its first two derivatives are zero at both ends. In a symmetric field Δs → 0 with
    T; for ions of 35 keV in a reactor it is below 1e-4 at T = 8000 m, and up to 0.1 for barely
    trapped ones at T = 2000 m (``pytest tests/test_boozer_gradients.py``).

    - `particles`: field and species. Particles of a lower energy have thinner orbits: their drift
      is that of the bounce average at one surface, and its gradients are less chaotic.
    - `start`: s, θ, ζ and v∥/v0. For a batch map over it: `jax.vmap`, or `mean_drift`.
    - `h`: step [m], in units of the particles (h/v0 in seconds).

    **Returns** Δs, and whether the run succeeded and the energy at its end differs from that at the
    start by less than 1e-3; Δs is 0 otherwise. A field with short wavelengths requires a smaller
    `h`, such as ``particles.h``. There is no loss at s = 1: B
    is continued by its polynomials.

    **Accuracy** that of `GaussLegendre(2)`, O(h⁴). Differentiable in the arrays of `particles` and
    in `start` by the adjoint `Reversible`. Value and gradient together take 3.7 times as long as
    the value alone (``python examples/alpha_optimise.py``). With `Checkpointed` or `Direct`,
    which are not machine code, it is about 50 times.
    """
    instance("particles", particles, GuidingCentres, "such as boozer.GuidingCentres(field)")
    num_steps = whole("num_steps", num_steps)
    adjoint, mean = Reversible(checkpoint_every=25), Mean(_Weight(particles.chart))
    sol = _run(particles, start, (num_steps, h), adjoint=adjoint, observe=mean)
    is_accurate = _is_accurate(particles, start, sol.qs[-1], sol.ps[-1])
    is_success = (sol.result == RESULTS.successful) & is_accurate
    return -jnp.where(is_success, sol.observed, 0.0), is_success


def mean_drift(
    particles: GuidingCentres,
    starts: Float[Array, "count 4"],
    *,
    num_steps: int = 650,
    h: Any = 4.0,
    width: float = 0.1,
) -> Array:
    r"""Fraction of particles with a large radial drift, smooth: the mean of Δs²/(Δs² + width²).

    For small Δs it is the mean of (Δs/width)². Each particle counts at most 1, so that the mean is
    not that of a few particles that leave. Those whose run failed count 1, with the gradient 0.

    - `particles`, `num_steps`, `h`: as for `radial_drift`.
    - `starts`: s, θ, ζ and v∥/v0 of each particle.
    - `width`: the Δs that counts 1/2.

    **Returns** a number from 0 to 1, differentiable as `radial_drift`.

    **Source** our own. Related measures, by integrals along field lines in place of orbits, are the
    effective ripple (Nemov et al. 1999, *Phys. Plasmas* 6, 4622) and Γ_c (Nemov et al. 2008,
    *Phys. Plasmas* 15, 052501).
    """
    positive("width", width)

    def term(start):
        drift, is_success = radial_drift(particles, start, num_steps=num_steps, h=h)
        square = drift**2
        return jnp.where(is_success, square / (square + width**2), 1.0)

    return jnp.mean(jax.vmap(term)(jnp.asarray(starts)))


def lost_at(particles: GuidingCentres, start: Any, *, num_steps: int, h: Any = 4.0) -> Array:
    """Time [s] at which one particle reaches s = 1; infinite if it does not. NaN if its run fails,
    or if the energy differs by more than 1e-3 at its end.

    Arguments as for `radial_drift`. It has no useful derivative.
    """
    sol = _run(particles, start, (whole("num_steps", num_steps), h), stop=particles.loss)
    stays = sol.result == RESULTS.successful
    seconds = jnp.where(stays, jnp.inf, particles.seconds(sol.stop.t))
    ends = (sol.qs[-1], sol.stop.q), (sol.ps[-1], sol.stop.p)
    is_accurate = _is_accurate(particles, start, *(jnp.where(stays, *end) for end in ends))
    return lax.stop_gradient(jnp.where(is_accurate, seconds, jnp.nan))
