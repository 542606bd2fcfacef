"""General relativity and oblateness of the Sun, as additions to the Newtonian `n_body`.

    dvi.System(hamiltonian, force=post_newtonian_force)
    dvi.System(hamiltonian, perturbation=post_newtonian_hamiltonian)
    dvi.System(hamiltonian_with_oblateness, force=post_newtonian_force)

with ``epsilon=1`` in `integrate`; its default, 0, switches relativity off. Body 0 is the Sun.
Everywhere q are positions [length] and p momenta [mass length / time], shape (bodies, dim). `args`
are those of `n_body.hamiltonian`, and ``"c"`` [length/time], by default `SPEED_OF_LIGHT`. Every
function **raises** `ValueError` when the shapes of q and masses do not agree, and is differentiable
in all its arguments.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..forces import Harmonics, Relativity
from ..n_body import hamiltonian, masses_of
from .solar_system import AU_IN_KM

SPEED_OF_LIGHT = 299792.458 * 86400 / AU_IN_KM
"""c [au/day], in the astronomical unit of DE421."""

SUN_RADIUS = 696000 / AU_IN_KM
"""Equatorial radius of the Sun [au], to which `SUN_J2` refers: 696000 km, as in the ephemerides."""

SUN_J2 = 2e-7
"""Quadrupole moment of the Sun, the value of DE421; helioseismology gives 2.2e-7."""

_RA, _DEC = np.deg2rad(286.13), np.deg2rad(63.87)
SUN_POLE = np.array([np.cos(_DEC) * np.cos(_RA), np.cos(_DEC) * np.sin(_RA), np.sin(_DEC)])
"""North pole of the Sun's rotation on the axes of the ICRF: RA 286.13°, dec 63.87° (IAU WGCCRE;
Archinal et al. 2018). A unit vector."""


def post_newtonian_force(t0, t1, q0, p1, args):
    r"""Force of the Sun's general relativity on every other body, W of a `System`.

        W_i = m_i GM / (c² r³) [(4 GM/r − v²) r + 4 (r·v) v],    W_0 = 0
        r = q0_i − q0_0,    v = p1_i/m_i − p1_0/m_0,    GM = G m_0

    Momenta are m times velocity. Returns shape (bodies, dim) [mass length / time²]. Another
    ``epsilon`` than 1 is relativity at c/√ε.

    Neglected: the recoil of the Sun, a fraction m_i/M of the force (so total momentum is not
    conserved), the relativity of the other bodies, of the same order, and O(1/c⁴).

    It is `dvi.forces.Relativity`, with the default c; `dvi.forces.PostNewtonian` has all terms.
    """
    masses_of(q0, args)
    return _RELATIVITY(t0, t1, q0, p1, args)


def post_newtonian_hamiltonian(t0, t1, q0, p1, args):
    r"""The Sun's general relativity as a Hamiltonian, H1_D of a `System`.

        H1 = −Σ_{i>0} (m_i/c²) [v⁴/8 + 3 GM v²/(2r) − GM²/(2r²)]
        r = |q0_i − q0_0|,    v = p1_i/m_i − p1_0/m_0,    GM = G m_0

    The conservative form of `post_newtonian_force`, a scalar [mass length² / time²]. It depends on
    differences only, so that total momentum is conserved, the Sun recoils, and the map is
    symplectic. It is not separable: every step is implicit. The acceleration is that of
    `post_newtonian_force` up to O(1/c⁴) and a fraction m_i/M.

    The canonical momentum is not m times velocity but p/m = V (1 + V²/(2c²) + 3GM/(c² r)) + …: use
    `momenta_from_velocities` and `velocities_from_momenta`. Initial momenta p = m V give another
    orbit, for Mercury by 9e-8 of the velocity.

    **Source** the Lagrangian of a test particle about a mass in harmonic coordinates,
    L = V²/2 + GM/r + [V⁴/8 + 3 GM V²/(2r) − GM²/(2r²)]/c² (Landau & Lifshitz, *The Classical Theory
    of Fields*, §106): to first order H1 is minus what 1/c² adds to L.
    """
    masses, mu = _masses(q0, args)
    r, v = _length(_from_sun(q0)), _from_sun(p1 / masses[:, None])
    v2 = jnp.sum(v**2, axis=-1, keepdims=True)
    terms = v2**2 / 8 + 1.5 * mu * v2 / r - mu**2 / (2 * r**2)
    return -jnp.sum(masses[1:, None] * terms) / _c(args) ** 2


def momenta_from_velocities(q: Any, v: Any, args: Any):
    r"""Canonical momenta of `hamiltonian` + `post_newtonian_hamiltonian` [mass length / time].

        p_i = m_i (v_i + w_i),    p_0 = m_0 v_0 − Σ m_i w_i
        w_i = (u²/(2c²) + 3 GM/(c² r)) u,    u = v_i − v_0,    r = |q_i − q_0|

    - `v`: velocities [length/time] in the frame of q. For another epsilon than 1, args has c/√ε.

    Total momentum is Σ m v. Errors are O(1/c⁴), as those of the Hamiltonian.
    """
    q, v = jnp.asarray(q), jnp.asarray(v)
    masses, _ = _masses(q, args)
    return masses[:, None] * v + _added_momenta(q, v, args)


def velocities_from_momenta(q: Any, p: Any, args: Any):
    r"""Velocities ∂H/∂p of `hamiltonian` + `post_newtonian_hamiltonian` [length/time].

    The inverse of `momenta_from_velocities` up to O(1/c⁴), and exact for this Hamiltonian:
    v_i = p_i/m_i − w_i, v_0 = p_0/m_0 + Σ m_i w_i / m_0 with u = p_i/m_i − p_0/m_0 in w_i.
    """
    q, p = jnp.asarray(q), jnp.asarray(p)
    masses, _ = _masses(q, args)
    ratios = p / masses[:, None]
    return ratios - _added_momenta(q, ratios, args) / masses[:, None]


def oblateness(q, args):
    r"""Potential energy of the bodies in the quadrupole of the Sun [mass length² / time²].

        U = Σ_{i>0} G M m_i J2 R² / (2 r³) (3 (r·n)²/r² − 1),    r = q_i − q_0

    An oblate Sun (J2 > 0) attracts more in its equatorial plane, where U < 0. Perihelia in that
    plane advance, nodes on it regress.

    - `args`: also ``"J2"``, the equatorial radius ``"R"`` [length], by default `SUN_RADIUS`, and
      the direction of the pole ``"pole"``, shape (dim,), of any length, by default `SUN_POLE`,
      which is on ICRF axes.

    Total momentum is conserved. The Sun's axis is fixed, so that only the component of angular
    momentum along the pole is conserved.

    **Raises** `ValueError` also when the shapes of q and the pole do not agree; in the plane it
    must be given.

    It is `dvi.forces.Harmonics`, with the Sun's defaults. **Source** potential
    −(GM/r) [1 − J2 (R/r)² P₂(sin φ)], sin φ = r·n/r: Murray & Dermott 1999, *Solar System
    Dynamics*, 6.11.
    """
    masses_of(q, args)
    return _OBLATENESS.energy(0.0, 0.0, q, jnp.zeros_like(q), args)


def hamiltonian_with_oblateness(t0, t1, q0, p1, args):
    """`n_body.hamiltonian` + `oblateness` of q0; separable."""
    return hamiltonian(t0, t1, q0, p1, args) + oblateness(q0, args)


def _masses(q, args):
    """Masses as an array, and GM of the Sun."""
    masses = masses_of(q, args)
    return masses, args.get("G", 1.0) * masses[0]


def _c(args):
    return args.get("c", SPEED_OF_LIGHT)


_RELATIVITY = Relativity(_c)
_OBLATENESS = Harmonics(
    lambda args: args.get("R", SUN_RADIUS),
    {2: lambda args: args["J2"]},
    pole=lambda args: args.get("pole", SUN_POLE),
)


def _from_sun(x):
    return x[1:] - x[:1]


def _length(r):
    return jnp.sqrt(jnp.sum(r**2, axis=-1, keepdims=True))


def _added_momenta(q, v, args):
    """The terms in 1/c² of the momenta: m_i w_i, and −Σ m_i w_i for the Sun."""
    masses, mu = _masses(q, args)
    u = _from_sun(v)
    w = (_length(u) ** 2 / 2 + 3 * mu / _length(_from_sun(q))) / _c(args) ** 2 * u
    corrections = masses[1:, None] * w
    return jnp.concatenate([-jnp.sum(corrections, axis=0, keepdims=True), corrections])
