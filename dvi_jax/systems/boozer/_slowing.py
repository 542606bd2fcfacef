r"""Guiding centres that collide: slowing down and scattering of the pitch angle, to their ends.

A step over h is Strang's splitting C(h/2) M(h) C(h/2), with a step M of the motion without
collisions, and collisions C at a fixed guiding centre. Of C, the speed takes a step of weak order 2
(Kloeden & Platen 1992, 15.1.1), and the direction is rotated by a random angle α:

    cos α = 2r − 1,    r = exp(−e tanh(τ/2)),    τ = ∫ν dt,    e = (z₁² + z₂²)/2

with two normals z, which also give the azimuth. e has the distribution e^{−e}, so that

    ⟨P_l(cos α)⟩ = Π_{j=1}^{l} (k − j)/(k + j),    k = coth(τ/2):

e^{−τ} for l = 1, for every τ, and exp(−l(l + 1)τ/2) + O(τ³) of a Brownian motion on the sphere for
all l (our own; by the addition theorem these are the factors of the Legendre moments of ξ).
"""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base.checks import instance, positive
from ...base.printing import printable
from ...methods import GaussLegendre, Method
from ...methods.step import Equations, StepInfo
from ...observe import Stop
from ...problem.discretise import discretise
from ...problem.noise import Noise
from ...problem.system import System
from ._bounce import GuidingCentre, centre_of, complete
from ._field import Field, polynomial
from ._particles import Coordinates, GuidingCentres
from ._plasma import Plasma

_SLOWEST = 1e-6
"""A lower limit of v/v0 in the coefficients, where they are 0/0."""


@printable
class End(NamedTuple):
    """Ends of slowing down: s, energies [eV] and what became of the particles, shape (…).

    `energy` remains in the particle; `to_electrons` and `to_ions` were transferred by collisions.
    `error` is the rest of the initial energy, an error of the motion. `outcome` is "lost",
    "thermal", "slowing" (at no end yet) or "unknown" (NaN).
    """

    s: np.ndarray
    energy: np.ndarray
    to_electrons: np.ndarray
    to_ions: np.ndarray
    error: np.ndarray
    outcome: np.ndarray


class _Collisions(Noise):
    """The noise of `SlowingDown`: three Brownian motions for half a step of its method."""

    plasma: Plasma
    particles: GuidingCentres

    def count(self, t, q, p, args):
        return 3

    def force(self, t, q, p, args, rates):
        raise ValueError("collisions require the method of their boozer.SlowingDown, got another.")


def rotate(xi: Any, tau: Any, z: Any) -> Array:
    """ξ after scattering for the time τ = ∫ν dt, by two normals z."""
    e = (z[0] ** 2 + z[1] ** 2) / 2
    exponent = -e * jnp.tanh(tau / 2)
    r, complement = jnp.exp(exponent), -jnp.expm1(exponent)
    azimuth = z[0] / jnp.sqrt(jnp.where(e > 0, 2 * e, 1.0))
    sine = jnp.sqrt(jnp.maximum(1 - xi**2, 0.0))
    cosine = xi * (r - complement) + sine * 2 * jnp.sqrt(r * complement) * azimuth
    return jnp.clip(cosine, -1.0, 1.0)


class _Collisional(Method):
    """C(h/2) M(h) C(h/2), on q = (q_1, q_2, W_e, W_i), p = (p_1, p_2, μ, ∫ν dt) with the energies W
    that electrons and ions received."""

    base: Method

    order: ClassVar[int] = 2
    is_symmetric: ClassVar[bool] = False
    is_symplectic: ClassVar[bool] = False
    is_invertible: ClassVar[bool] = False
    increments: ClassVar[int] = 2

    def step(self, equations, interval, q0, p0):
        noise: Any = equations.system.noise
        rows = equations.increments
        rows = jnp.zeros((2, 3), q0.dtype) if rows is None else rows
        q, p = self._collide(equations, interval.h / 2, rows[0], q0, p0)
        origin = equations.origin
        if origin is not None:
            origin = origin[0][:2], origin[1][:2]
        args = {**equations.args, "mu": equations.absolute(q, p)[1][2]}
        inner = dataclasses.replace(
            equations, system=noise.particles.system, args=args, origin=origin, increments=None
        )
        q1, p1, info = self.base.step(inner, interval, q[:2], p[:2])
        q, p = jnp.concatenate([q1, q[2:]]), jnp.concatenate([p1, p[2:]])
        q, p = self._collide(equations, interval.h / 2, rows[1], q, p)
        return q, p, info

    def _collide(self, equations: Equations, h: Any, dB: Array, q: Any, p: Any) -> tuple[Any, Any]:
        noise = equations.system.noise
        dq, dp = collide(noise, equations.args, equations.epsilon, h, dB, *equations.absolute(q, p))
        return q + dq, p + dp

    def inverse(self, equations, interval, q1, p1) -> tuple[Any, Any, StepInfo]:
        raise ValueError("collisions have no inverse step: use adjoint=dvi.Direct().")

    def needs_no_solve(self, equations, interval, q) -> bool:
        return False


@eqx.filter_jit  # one trace for both halves of a step
def collide(noise: Any, args: Any, epsilon: Any, h: Any, dB: Array, q: Any, p: Any) -> Any:
    """The change of (q, p) by collisions for the time h [m] at a fixed guiding centre."""
    particles, plasma = noise.particles, noise.plasma
    chart, v0, mass = particles.chart, particles.speed, particles.mass
    field, rho = complete(args, epsilon), args["rho"]
    args = {**args, "mu": p[2]}
    centre = centre_of(chart, q, p, args, epsilon)
    E, seconds, z = centre.energy, h / v0, dB / jnp.sqrt(h)
    width = jnp.sqrt(seconds)

    def coefficients(energy):
        """The speed, the rates, and the size v√(2D) of the noise of the energy, per √s."""
        v = jnp.maximum(jnp.sqrt(2 * jnp.abs(energy)), _SLOWEST)
        rates = plasma.rates(centre.s, v0 * v, mass, particles.charge)
        return v, rates, v * jnp.sqrt(2 * jnp.sum(rates.diffusion, axis=0)) / v0

    # In the energy, dE = −L dt + v√(2D) dB, all coefficients are finite at v = 0.
    v, rates, size = coefficients(E)
    mean = E - jnp.sum(rates.loss) * seconds / v0**2
    unit = jnp.ones_like(E)
    _, ahead, sizes = coefficients(mean + size * width * jnp.stack([z[0], unit, -unit]))
    losses = (rates.loss + ahead.loss[:, 0]) * seconds / (2 * v0**2)
    mean_size, difference = sizes[1] + sizes[2] + 2 * size, sizes[1] - sizes[2]
    fluctuation = (mean_size * z[0] + difference * (z[0] ** 2 - 1)) * width / 4
    energy = jnp.abs(E - jnp.sum(losses) + fluctuation)
    _, later, _ = coefficients(energy)
    tau = seconds / 2 * jnp.sum(rates.scattering + later.scattering)
    u = jnp.sqrt(2 * energy) * rotate(centre.u / v, tau, z[1:])
    # Each species receives its mean loss, and the fluctuation in proportion to its diffusion: the
    # expected part of the whole, which is the change of the energy exactly.
    excess = E - energy - jnp.sum(losses)
    gains = losses + excess * rates.diffusion / jnp.sum(rates.diffusion)
    p_zeta = p[1] + (u - centre.u) * polynomial(field.G, centre.s) / centre.B
    place = chart.at_momentum(field, rho, q, p, centre.s, p_zeta)
    mu = (energy - u**2 / 2) / centre.B
    dq = jnp.concatenate([(place[0] - q[0])[None], jnp.zeros_like(p[:1]), gains])
    return dq, jnp.stack([place[1] - p[0], p_zeta - p[1], mu - p[2], tau])


class _Energy(eqx.Module):
    """H of the state with μ among the momenta."""

    energy: Any

    def __call__(self, t, q, p, args):
        return self.energy.H(t, q[:2], p[:2], {**args, "mu": p[2]})


@printable
class SlowingDown(eqx.Module):
    r"""Fast particles that slow down and are scattered by a plasma, in the field of a device.

    The state is that of `particles` with μ and the transferred energies: q = (q_1, q_2, W_e, W_i),
    p = (p_1, p_2, μ, ∫ν dt), in the units of `GuidingCentres` (energies in m v0², which is twice
    the initial energy). Run it with ``system``, ``method``, a `dvi.Brownian` path and ``stop=end``.

    **Arguments**

    - `particles`: `GuidingCentres`, at the energy of birth. `plasma`: a `Plasma`.
    - `thermal`: a particle is thermal where its energy has decreased to `thermal` · T_i.
    - `base`: method of the motion without collisions.

    **Raises** `TypeError` for other objects, `ValueError` for a `thermal` that is not positive.

    **Accuracy** weak order 2; ⟨ξ⟩ decays at the exact rate. Resolve the collisions: √(2Dh) and Fh
    small against v, which holds for steps of the motion, ν h ≈ 1e-6.

    **Source** operator and splitting: Helander & Sigmar 2002, *Collisional Transport in Magnetized
    Plasmas*; Kloeden & Platen 1992, *Numerical Solution of Stochastic Differential Equations*,
    15.1; rotation of the direction: our own, derived in this module.
    """

    particles: GuidingCentres
    plasma: Plasma
    thermal: float = eqx.field(static=True, default=1.5)
    base: Method = GaussLegendre(2)

    def __check_init__(self):
        hint = "such as boozer.GuidingCentres(field)"
        instance("particles", self.particles, GuidingCentres, "GuidingCentres", hint)
        instance("plasma", self.plasma, Plasma, "a Plasma")
        positive("thermal", self.thermal)

    @property
    def field(self) -> Field:
        return self.particles.field

    @property
    def system(self) -> System:
        """The `System` of the motion with the noise of collisions."""
        inner = self.particles.system
        noise = _Collisions(self.plasma, self.particles)
        return System(discretise(_Energy(inner.H_D)), noise=noise)

    @property
    def method(self) -> Method:
        """The method for `system`, and for no other."""
        return _Collisional(self.base)

    def args(self) -> dict[str, Any]:
        """The args of a run: the same for all particles."""
        return self.particles.args(0.0)

    def start(self, s: Any, theta: Any, zeta: Any, pitch: Any) -> tuple[Array, Array, dict]:
        """(q0, p0, args) as `GuidingCentres.start`; args do not depend on the particle."""
        return self._with_moment(*self.particles.start(s, theta, zeta, pitch))

    def state(self, s: Any, theta: Any, zeta: Any, pitch: Any) -> tuple[Array, Array, dict]:
        """`start` without checks, for traced arrays of one shape."""
        return self._with_moment(*self.particles.state(s, theta, zeta, pitch))

    def _with_moment(self, q: Array, p: Array, args: dict) -> tuple[Array, Array, dict]:
        zeros = jnp.zeros_like(q)
        moment = jnp.stack([args["mu"], jnp.zeros_like(args["mu"])], axis=-1)
        q, p = jnp.concatenate([q, zeros], axis=-1), jnp.concatenate([p, moment], axis=-1)
        return q, p, self.args()

    def coordinates_of(self, q: Any, p: Any, epsilon: Any = None) -> Coordinates:
        """Boozer coordinates of states, see `GuidingCentres.coordinates_of`."""
        return self.particles.coordinates_of(q[..., :2], p[..., :2], epsilon)

    def _centre(self, q: Any, p: Any, args: Any, epsilon: Any = None) -> GuidingCentre:
        return centre_of(self.particles.chart, q, p, {**args, "mu": p[2]}, epsilon)

    @property
    def end(self) -> Stop:
        """Ends a run where the particle reaches s = 1, or the energy `thermal` · T_i."""
        return Stop(_End(self))

    def end_of(self, q: Any, p: Any, epsilon: Any = None) -> End:
        """The `End` of states of shape (…, 4), such as ``solution.stop.q`` and ``.p``."""
        q, p = jnp.asarray(q), jnp.asarray(p)
        flat = [x.reshape(-1, 4) for x in (q, p)]

        @eqx.filter_jit
        def end_state(q, p):
            centre = self._centre(q, p, self.args(), epsilon)
            return centre.s, centre.energy, _thermal_energy(self, centre.s)

        s, energy, thermal = (np.asarray(x) for x in eqx.filter_vmap(end_state)(*flat))
        unit = 2 * self.particles.energy
        outcome = np.full(s.shape, "slowing", dtype="U8")
        outcome[energy <= thermal * (1 + 1e-6)] = "thermal"
        outcome[s >= 1 - 1e-6] = "lost"
        outcome[~np.isfinite(s + energy)] = "unknown"
        gains = [unit * np.asarray(x) for x in (flat[0][:, 2], flat[0][:, 3])]
        error = self.particles.energy - unit * energy - sum(gains)
        values = s, unit * energy, *gains, error, outcome
        return End(*(x.reshape(q.shape[:-1]) for x in values))


def _thermal_energy(slowing: SlowingDown, s: Any) -> Array:
    """`thermal` · T_i in units of m v0²."""
    return slowing.thermal * slowing.plasma.profiles(s)[2] / (2 * slowing.particles.energy)


class _End(eqx.Module):
    slowing: SlowingDown

    def __call__(self, t, q, p, args):
        centre = self.slowing._centre(q, p, args)
        return jnp.maximum(centre.s - 1, _thermal_energy(self.slowing, centre.s) - centre.energy)
