"""General relativity to first order in 1/c²: of the central body, of all bodies, of a rotation."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...base.checks import array, finite, positive
from ..n_body import masses_of
from ._base import Bodies, Central, Force, bodies_of, quantity


class Relativity(Central):
    r"""General relativity of the central mass in harmonic coordinates, to first order in 1/c².

        a = μ/(c² r³) [(4 μ/r − v²) r + 4 (r·v) v]

    - `c`: the velocity of light [length/time], a number or a function of args.

    The centre feels nothing, and other bodies have no relativity of their own: both neglect
    fractions m_i/m_0 of the force. `PostNewtonian` has the terms of all bodies.

    **Source** the Schwarzschild term, in the coordinates of the ephemerides: IERS Conventions 2010,
    (10.12) with β = γ = 1; Anderson et al. 1975, *Astrophys. J.* 200, 221.
    """

    c: Any = quantity(positive)

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        distance = jnp.sqrt(jnp.sum(r * r, -1, keepdims=True))
        rv, v2 = jnp.sum(r * v, -1, keepdims=True), jnp.sum(v * v, -1, keepdims=True)
        size = mu / (self.value("c", args, r) ** 2 * distance**3)
        return size * ((4 * mu / distance - v2) * r + 4 * rv * v)


class PrecessionPotential(Central):
    r"""A potential with the relativistic precession of the pericentre, in explicit steps.

        Φ = −3 μ²/(c² r²),    a = −6 μ² r/(c² r⁴),    ϖ advances by 6π μ/(c² p) in a revolution

    - `c`: the velocity of light [length/time], a number or a function of args.

    The mean motion and the effects of velocities are not those of `Relativity`. The exact advance
    is 2π (1 − 6 μ/(c² p))^{−1/2} − 2π, p = a (1 − e²) from the angular momentum.

    **Source** Nobili & Roxburgh 1986, *IAU Symp.* 114, 105.
    """

    c: Any = quantity(positive)

    def relative(self, t, r, v, mu, masses, args):
        square = jnp.sum(r * r, -1, keepdims=True)
        return -6 * (mu / (self.value("c", args, r) * square)) ** 2 * r


class PostNewtonian(Force):
    r"""General relativity of all bodies to first order in 1/c²: Einstein, Infeld & Hoffmann.

        a_i = (1/c²) Σ_{j≠i} μ_j/r³ {−d [v_i² + 2 v_j² − 4 v_i·v_j − 3 (d·v_j)²/(2 r²) − 4 φ_i − φ_j
              − d·g_j/2] + d·(4 v_i − 3 v_j) (v_i − v_j) + 7 r² g_j/2}
        d = q_i − q_j,  r = |d|,  μ_j = G m_j,  φ_i = Σ_{k≠i} μ_k/r_ik,  g_j = −∇φ: Newton's law

    - `c`: the velocity of light [length/time], a number or a function of args.

    Velocities are those of the inertial frame of the run. `energy` is the Hamiltonian of the same
    motion, for a `System` with `perturbation=`, which stays symplectic and conserves total
    momentum. Its momenta p are not m v: `momenta` and `velocities` convert. In a run with the force
    p is m v; there H + energy of `momenta`, and the sum of `momenta`, are constant up to O(1/c⁴).

    **Source** Einstein, Infeld & Hoffmann 1938, *Ann. Math.* 39, 65; Newhall, Standish & Williams
    1983, *Astron. Astrophys.* 125, 150; H: Landau & Lifshitz, *The Classical Theory of Fields*,
    §106.
    """

    c: Any = quantity(positive)

    def accelerations(self, t, bodies, args):
        d, r, weight = _pairs(bodies.x, bodies.masses)
        newton = -jnp.sum((weight / r**2)[..., None] * d, 1)
        return self.corrections(bodies, newton) / self.value("c", args, d) ** 2

    def corrections(self, bodies: Bodies, g: Array) -> Array:
        """c² a_i for the accelerations g_j on the right-hand side."""
        v = bodies.v
        d, r, weight = _pairs(bodies.x, bodies.masses)
        pull, phi = weight / r**2, jnp.sum(weight, 1)
        v2, vv = jnp.sum(v * v, -1), v @ v.T
        radial = jnp.sum(d * v[None], -1) / r
        factor = v2[:, None] + 2 * v2[None, :] - 4 * vv - 1.5 * radial**2
        factor = factor - 4 * phi[:, None] - phi[None, :] - jnp.sum(d * g[None], -1) / 2
        mixed = jnp.sum(d * (4 * v[:, None] - 3 * v[None]), -1)
        total = -(pull * factor)[..., None] * d + 3.5 * weight[..., None] * g[None]
        total = total + (pull * mixed)[..., None] * (v[:, None] - v[None])
        return jnp.sum(total, 1)

    def energy(self, t0, t1, q0, p1, args):
        """H1 of canonical momenta, of bodies with a mass [mass length²/time²]."""
        masses = masses_of(q0, args)
        return -self._lagrangian(bodies_of(q0, p1, args), masses, args)

    def momenta(self, q: Array, v: Array, args: Any) -> Array:
        """Canonical momenta m v + ∂L1/∂v of velocities v, up to O(1/c⁴)."""
        masses = masses_of(q, args)[:, None]
        return masses * v - jax.grad(self.energy, argnums=3)(0.0, 0.0, q, masses * v, args) * masses

    def velocities(self, q: Array, p: Array, args: Any) -> Array:
        """Velocities p/m + ∂H1/∂p of canonical momenta p."""
        masses = masses_of(q, args)[:, None]
        return p / masses + jax.grad(self.energy, argnums=3)(0.0, 0.0, q, p, args)

    def _lagrangian(self, bodies: Bodies, masses: Array, args: Any) -> Array:
        """The terms in 1/c² of the Lagrangian of the velocities."""
        v = bodies.v
        d, r, weight = _pairs(bodies.x, bodies.masses)
        v2, radial = jnp.sum(v * v, -1), jnp.sum(d * v[None], -1) / r
        pairs = 6 * v2[:, None] - 7 * (v @ v.T) + radial * radial.T
        of_pairs = jnp.sum(masses[:, None] * weight * pairs) / 4
        total = of_pairs + jnp.sum(masses * (v2**2 / 4 - jnp.sum(weight, 1) ** 2)) / 2
        return total / self.value("c", args, d) ** 2


def _pairs(x: Array, mu: Array) -> tuple[Array, Array, Array]:
    """d_ij = x_i − x_j, their lengths (1 for i = j), and μ_j/r_ij (0 for i = j)."""
    diagonal = jnp.eye(len(x), dtype=bool)
    d = x[:, None] - x[None]
    r = jnp.sqrt(jnp.where(diagonal, 1.0, jnp.sum(d * d, -1)))
    return d, r, jnp.where(diagonal, 0.0, mu[None, :] / r)


class LenseThirring(Central):
    r"""The rotation of the central mass in general relativity: a = 2 Ω × v.

        Ω = (2/(c² r³)) [3 (J·r) r/r² − J]/2 · G

    - `momentum`: G J, G times the angular momentum of the centre [length⁵/time³], shape (3,).
    - `c`: the velocity of light [length/time]. Numbers or functions of args.

    **Source** IERS Conventions 2010, (10.12).
    """

    momentum: Any = quantity(finite)
    c: Any = quantity(positive)

    has_recoil: ClassVar[bool] = False

    def relative(self, t, r, v, mu, masses, args):
        array("positions with forces.LenseThirring", r, ("bodies", 3), empty=True)
        J = self.value("momentum", args, r, (3,))[None]
        r2 = jnp.sum(r * r, -1, keepdims=True)
        radial = 3 * jnp.sum(J * r, -1, keepdims=True) / r2 * r
        return 2 / (self.value("c", args, r) ** 2 * r2**1.5) * jnp.cross(radial - J, v)
