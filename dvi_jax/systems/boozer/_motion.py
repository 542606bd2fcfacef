r"""Guiding centres in Boozer coordinates as a canonical Hamiltonian system.

Units: mass m, speed v0 = √(2E0/m) of the particles and 1 m; the unit of time is 1 m/v0. With
ρ = m v0/(Ze) [T m], u = v∥/v0 and the moment μ in units of m v0²/T the phase-space Lagrangian is

    L = p_θ θ̇ + p_ζ ζ̇ − H,    p_θ = ψ/ρ + u I/B,    p_ζ = −χ/ρ + u G/B,    H = u²/2 + μ B

(the gyrophase is left out: μ is constant). So θ, ζ and p_θ, p_ζ are canonical [1, m]. The flux
follows from the momenta alone, G p_θ − I p_ζ = (G ψ + I χ)/ρ, and then u = (p_ζ + χ/ρ) B/G.

At the magnetic axis the angle θ is not defined. The canonical coordinates of the runs are therefore

    Y = √(2p_θ) sin θ,    X = √(2p_θ) cos θ,    dp_θ ∧ dθ = dX ∧ dY,

with q = (Y, ζ) and p = (X, p_ζ), in which H is smooth everywhere. For a negative charge ρ and p_θ
are negative: then Y = √(−2p_θ) cos θ and X = √(−2p_θ) sin θ, of which dp_θ ∧ dθ = dX ∧ dY as well.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ...problem.implicit import Implicit
from ._field import Field, polynomial
from ._sums import total


def flux_equation(field: Field, rho: Any, p_theta: Any, p_zeta: Any, s: Any) -> Array:
    """(G p_θ − I p_ζ)ρ/(G ψ_edge) − (s + I χ/(G ψ_edge)): zero at the s of these momenta."""
    ratio = rho / field.psi_edge
    if field.I is None:
        return ratio * p_theta - s
    current = polynomial(field.I, s) / polynomial(field.G, s)
    toroidal = ratio * p_zeta + field.poloidal_flux(s) / field.psi_edge
    return ratio * p_theta - s - current * toroidal


def _per_action(field: Field, rho: Any, p_zeta: Any, s: Any) -> Array:
    """s/p_θ at the s of the momenta: finite on the axis, where both are zero."""
    if field.I is None:
        return rho / field.psi_edge
    current = polynomial(field.I[1:], s) / polynomial(field.G, s)  # I/(s G)
    return rho / (field.psi_edge + current * (rho * p_zeta + field.poloidal_flux(s)))


def _ratio_of_actions(field: Field, rho: Any, p: Any, s: Any, p_zeta: Any) -> Any:
    """p_θ at this p_ζ over that of the momenta p, both at s: finite on the axis."""
    if field.I is None:
        return jnp.ones_like(p_zeta)
    return _per_action(field, rho, p[1], s) / _per_action(field, rho, p_zeta, s)


def speed_along(field: Field, rho: Any, s: Any, p_zeta: Any, B: Any) -> Array:
    """u = v∥/v0 = (p_ζ + χ/ρ) B/G."""
    return (p_zeta + field.poloidal_flux(s) / rho) * B / polynomial(field.G, s)


class Regular(eqx.Module):
    """The chart (Y, ζ; X, p_ζ), smooth at the axis; `sign`: that of the charge."""

    sign: int = eqx.field(static=True, default=1)

    def _cartesian(self, q: Any, p: Any) -> tuple[Any, Any]:
        """√|2p_θ| cos θ and √|2p_θ| sin θ."""
        return (p[0], q[0]) if self.sign > 0 else (q[0], p[0])

    def momentum(self, q: Any, p: Any) -> Any:
        """p_θ [m]."""
        return self.sign * (p[0] ** 2 + q[0] ** 2) / 2

    def point(self, field: Field, rho: Any, q: Any, p: Any, s: Any) -> tuple[Any, Any]:
        """√s cos θ and √s sin θ."""
        scale = jnp.sqrt(self.sign * _per_action(field, rho, p[1], s) / 2)
        x, y = self._cartesian(q, p)
        return scale * x, scale * y

    def state(self, theta: Any, zeta: Any, p_theta: Any, p_zeta: Any) -> tuple[Any, Any]:
        """(q, p)."""
        r = jnp.sqrt(2 * self.sign * p_theta)
        x, y = r * jnp.cos(theta), r * jnp.sin(theta)
        Y, X = (y, x) if self.sign > 0 else (x, y)
        return jnp.stack([Y, zeta], axis=-1), jnp.stack([X, p_zeta], axis=-1)

    def at_momentum(self, field: Field, rho: Any, q: Any, p: Any, s: Any, p_zeta: Any) -> Any:
        """(q[0], p[0]) at the same point with another p_ζ."""
        ratio = _ratio_of_actions(field, rho, p, s, p_zeta)
        return q[0] * jnp.sqrt(ratio), p[0] * jnp.sqrt(ratio)

    def angle(self, q: Any, p: Any) -> Any:
        """θ from −π to π."""
        x, y = self._cartesian(q, p)
        return jnp.arctan2(y, x)


class Angles(eqx.Module):
    """The chart (θ, ζ; p_θ, p_ζ), singular at the axis: for theory and for discovery."""

    def momentum(self, q: Any, p: Any) -> Any:
        """p_θ [m]."""
        return p[0]

    def point(self, field: Field, rho: Any, q: Any, p: Any, s: Any) -> tuple[Any, Any]:
        """√s cos θ and √s sin θ."""
        r = jnp.sqrt(s)
        return r * jnp.cos(q[0]), r * jnp.sin(q[0])

    def state(self, theta: Any, zeta: Any, p_theta: Any, p_zeta: Any) -> tuple[Any, Any]:
        """(q, p)."""
        return jnp.stack([theta, zeta], axis=-1), jnp.stack([p_theta, p_zeta], axis=-1)

    def at_momentum(self, field: Field, rho: Any, q: Any, p: Any, s: Any, p_zeta: Any) -> Any:
        """(q[0], p[0]) at the same point with another p_ζ."""
        return q[0], p[0] * _ratio_of_actions(field, rho, p, s, p_zeta)

    def angle(self, q: Any, p: Any) -> Any:
        """θ."""
        return q[0]


class _Relation(eqx.Module):
    chart: Regular | Angles

    def __call__(self, t, q, p, y, args):
        p_theta = self.chart.momentum(q, p)
        return flux_equation(args["field"], args["rho"], p_theta, p[1], y[0])[None]


class _Guess(eqx.Module):
    chart: Regular | Angles

    def __call__(self, t, q, p, args):
        return (args["rho"] / args["field"].psi_edge * self.chart.momentum(q, p))[None]


class _Energy(eqx.Module):
    chart: Regular | Angles

    def __call__(self, t, q, p, y, args):
        field, rho = args["field"], args["rho"]
        B = field.at(*self.chart.point(field, rho, q, p, y[0]), q[1])
        return speed_along(field, rho, y[0], p[1], B) ** 2 / 2 + args["mu"] * B


class _WithoutCurrent(eqx.Module):
    """`_Energy` where s follows from p_θ without a solve."""

    energy: _Energy
    guess: _Guess

    def __call__(self, t, q, p, args):
        return self.energy(t, q, p, self.guess(t, q, p, args), args)


class Breaking(eqx.Module):
    """The perturbation H1(ε), H(B + εB1) = H(B) + εH1 with the modes B1 = ``args["breaking"]``:

    H1 = (2 B B1 + ε B1²) [(p_ζ + χ/ρ)/G]²/2 + μ B1.
    """

    chart: Regular | Angles

    def __call__(self, t0, t1, q0, p1, args, epsilon):
        field, rho = args["field"], args["rho"]
        s = flux(self.chart, q0, p1, args)
        x, y = self.chart.point(field, rho, q0, p1, s)
        B = field.at(x, y, q0[1])
        B1 = total(args["breaking"], field.shape, x, y, q0[1])
        rate = speed_along(field, rho, s, p1[1], 1.0)
        return (2 * B + epsilon * B1) * B1 * rate**2 / 2 + args["mu"] * B1


def continuous_hamiltonian(field: Field, chart: Regular | Angles) -> Any:
    """H(t, q, p, args) for `discretise`; args: field, rho and mu."""
    energy, guess = _Energy(chart), _Guess(chart)
    if field.I is None:
        return _WithoutCurrent(energy, guess)
    return Implicit(energy, _Relation(chart), guess)


def flux(chart: Regular | Angles, q: Any, p: Any, args: Any) -> Array:
    """s of a state."""
    guess = _Guess(chart)
    if args["field"].I is None:
        return guess(0.0, q, p, args)[0]
    return Implicit(_Energy(chart), _Relation(chart), guess).solved(jnp.zeros(()), q, p, args)[0]
