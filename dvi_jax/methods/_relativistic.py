"""Explicit methods for relativistic charged particles, in positions and kinetic momenta."""

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..base.checks import array
from ..base.types import Interval, Scalar, State
from ._splitting import PartFlow, SplittingMethod
from ._strang import Strang
from .step import Equations, judge, no_solve, no_step_yet


class _Fields(NamedTuple):
    r"""The fields in the equations of motion of H = Σ c √(m²c² + |P|²) + φ(t, q), P = p − A(t, q),

        q̇ = v = P/(mγ),    Ṗ = E + v × B,    γ² = 1 + |P|²/(mc)²

    with E = −∂φ/∂q − ∂A/∂t and B = ∇ × A, times the charge, and the same of a force εW = E + v × B.
    """

    equations: Equations
    zero: Scalar  # the time 0
    largest: Scalar  # a momentum next to which A and mc are negligible
    c: Array
    mass: Array  # of each particle

    @classmethod
    def of(cls, equations: Equations, interval: Interval, q: State) -> "_Fields":
        """**Raises** `ValueError` for positions of another shape."""
        array("q0 of a charged particle", q, (2,), (3,), ("particles", 2), ("particles", 3))
        # Its square is finite.
        largest = jnp.asarray(float(jnp.finfo(q.dtype).max) ** 0.4, q.dtype)
        fields = cls(
            dataclasses.replace(equations, origin=None), jnp.zeros_like(interval.h), largest,
            jnp.ones_like(q), jnp.ones_like(q),
        )  # fmt: skip
        # A particle of very large momentum has the velocity c, one without momentum v = P/m.
        fields = fields._replace(c=fields._at_largest(fields._velocity, interval.t0, q, 0)[..., :1])
        p = fields.potential(interval.t0, q)
        _, inverse = jax.jvp(
            lambda p: fields._velocity(interval.t0, q, p), (p,), (jnp.ones_like(p),)
        )
        return fields._replace(mass=1 / inverse[..., :1])

    def _velocity(self, t: Scalar, q: State, p: State) -> State:
        return self.equations.position_rate(Interval(t, t, self.zero), q, p)

    def _at_largest(self, function: Any, t: Scalar, q: State, axis: int) -> State:
        return function(t, q, jnp.zeros_like(q).at[..., axis].set(self.largest))

    def potential(self, t: Scalar, q: State) -> State:
        """A, from the components of v across a very large momentum: v_j = −c A_j/p."""
        along_x, along_y = (self._at_largest(self._velocity, t, q, axis) for axis in (0, 1))
        v = jnp.concatenate([along_y[..., :1], along_x[..., 1:]], axis=-1)
        return -self.largest / self.c * v

    def velocity(self, P: State) -> State:
        return P / (self.mass * jnp.sqrt(self.square(P)))

    def fits(self, t: Scalar, q: State, p: State) -> Array:
        """Whether ∂H/∂p is `velocity`, at p and at a momentum larger by mc."""
        # At P ≪ mc alone any H is quadratic.
        A, more = self.potential(t, q), self.mass * self.c
        defects = [self._velocity(t, q, p) - self.velocity(p - A) for p in (p, p + more)]
        tolerance = 1e5 * jnp.finfo(q.dtype).eps * self.c * (1 + jnp.abs(A) / more)
        return jnp.all(jnp.abs(jnp.stack(defects)) <= tolerance[None]) & jnp.all(self.mass > 0)

    def square(self, P: State) -> Array:
        """γ² of each particle."""
        return 1 + jnp.sum((P / (self.mass * self.c)) ** 2, axis=-1, keepdims=True)

    def electric(self, t: Scalar, q: State) -> State:
        p, induction = jax.jvp(lambda t: self.potential(t, q), (t,), (jnp.ones_like(t),))
        return self.equations.momentum_rate(Interval(t, t, self.zero), q, p) - induction

    def magnetic(self, t: Scalar, q: State) -> Array:
        """B, with one component if q has two."""
        n = q.shape[-1]
        units = [jnp.zeros_like(q).at[..., i].set(1.0) for i in range(n)]
        slopes = [jax.jvp(lambda q: self.potential(t, q), (q,), (unit,))[1] for unit in units]
        pairs = [(0, 1)] if n == 2 else [(1, 2), (2, 0), (0, 1)]
        B = jnp.stack([slopes[i][..., j] - slopes[j][..., i] for i, j in pairs], axis=-1)
        system, epsilon, args = self.equations.system, self.equations.epsilon, self.equations.args
        if system.force is None:
            return B

        def force(t, q, p):
            return system.disturbing_force(t, t, q, p, epsilon, args)

        # Of W − W(v = 0) = v × B at velocities c along the first two axes.
        at_rest = force(t, q, self.potential(t, q))
        along_x, along_y = (self._at_largest(force, t, q, axis) - at_rest for axis in (0, 1))
        if n == 2:
            return B - along_x[..., 1:] / self.c
        of_force = jnp.stack([-along_y[..., 2], along_x[..., 2], -along_x[..., 1]], axis=-1)
        return B + of_force / self.c


def _cross(v: State, B: Array) -> State:
    """v × B, of a B normal to the plane if v has two components."""
    if v.shape[-1] == 2:
        return B * jnp.stack([v[..., 1], -v[..., 0]], axis=-1)
    return jnp.cross(v, B)


def _dot(left: Array, right: Array) -> Array:
    return jnp.sum(left * right, axis=-1, keepdims=True)


def _implicit_gamma(fields: _Fields, start: State, half: Array) -> Array:
    """γ of the momentum P = start + P × half/γ: the root of a quadratic equation."""
    along = 0.0 if start.shape[-1] == 2 else _dot(start / (fields.mass * fields.c), half)
    square = _dot(half, half)
    linear, constant = fields.square(start) - square, square + along * along
    root = jnp.sqrt(linear * linear + 4 * constant)
    # The other form of the same root has no cancellation where `linear` is negative.
    below = jnp.where(linear > 0, 1.0, root - linear)
    return jnp.sqrt(jnp.where(linear > 0, (linear + root) / 2, 2 * constant / below))


def _middle(fields: _Fields, start: State, half: Array, gamma: Array) -> State:
    """v of the momentum P = start + P × half/γ."""
    turn = half / gamma
    P = start + _cross(start, turn)
    if start.shape[-1] == 3:
        P = P + turn * _dot(start, turn)
    return P / ((1 + _dot(turn, turn)) * fields.mass * gamma)


class _RelativisticMethod(SplittingMethod):
    """Base of the methods q½ = q0 + h/2 v0, P1 = P0 + h (E + v̄ × B), q1 = q½ + h/2 v1, which differ
    in the mean velocity v̄ of P0 and P1."""

    has_coordinates: ClassVar[bool] = True
    is_symplectic: ClassVar[bool] = False
    scheme: ClassVar[Any] = Strang()

    def enter(self, equations, interval, q, p):
        fields = _Fields.of(equations, interval, q)
        t, (place, p) = interval.t0, equations.absolute(q, p)
        # Where `check` does not know the state, the run of another H must fail as well.
        info = no_solve(q)._replace(converged=fields.fits(t, place, p))
        P = p - fields.potential(t, place)
        return q, P, judge(info, q, P)

    def leave(self, equations, interval, q, p):
        fields = _Fields.of(equations, interval, q)
        place, zero = equations.absolute(q, jnp.zeros_like(p))
        # Relative to the origin again, where there is one.
        return q, p + fields.potential(interval.t1, place) - zero, no_step_yet(q)

    def check(self, equations, first_interval, q, p):
        interval = first_interval()
        t, (q, p) = interval.t0, equations.absolute(q, p)
        fields = _Fields.of(equations, interval, q)
        P = p - fields.potential(t, q) + fields.mass * fields.c  # which is not zero
        v = fields.velocity(P)
        p, change = jax.jvp(fields.potential, (t, q), (jnp.ones_like(t), v))
        rate = fields.equations.momentum_rate(Interval(t, t, fields.zero), q, p + P)
        force = fields.electric(t, q) + _cross(v, fields.magnetic(t, q))
        # Of the terms themselves: their sum may be zero.
        size = jnp.max(jnp.abs(jnp.stack([rate, change, force])))
        defect = jnp.max(jnp.abs(rate - change - force))
        if not fields.fits(t, q, p + P) or not defect <= 1e5 * jnp.finfo(q.dtype).eps * size:
            raise ValueError(
                f"dvi.{type(self).__name__} requires H_D = Σ c √(m²c² + |p1 − A(q)|²) + φ(q), with "
                "A at a particle a function of its own position, and a force E + v × B, but they "
                "are not that at the initial state."
            )

    @abc.abstractmethod
    def mean(self, fields: _Fields, h: Scalar, P: State, E: State, B: Array) -> State:
        """v̄ of a step from P."""

    def parts(self, equations, interval, q):
        fields = _Fields.of(equations, interval, q)

        def drift(interval, q, P):
            q = q + interval.h * fields.velocity(P)
            return q, P, judge(no_solve(q), q, P)

        def turn(interval, q, P):
            # Fields at the middle of the step make it symmetric in time.
            t, h = (interval.t0 + interval.t1) / 2, interval.h
            place, _ = equations.absolute(q, P)
            E, B = fields.electric(t, place), fields.magnetic(t, place)
            P = P + h * (E + _cross(self.mean(fields, h, P, E, B), B))
            return q, P, judge(no_solve(q), q, P)

        return [PartFlow(drift, True), PartFlow(turn, True)]


class RelativisticBoris(_RelativisticMethod):
    r"""The method of Boris for relativistic charged particles: explicit, symmetric, of order 2.

        q½ = q0 + h/2 v0,    P1 = P0 + h (E + v̄ × B),    q1 = q½ + h/2 v1,    v̄ = (P₋ + P₊)/(2mγ₋)

    for H = Σ c √(m²c² + |P|²) + φ(t, q), P = p − A(t, q), with E and B times the charge, at the
    middle of the step; P₋ = P0 + hE/2, P₊ = P1 − hE/2, γ₋ = √(1 + |P₋|²/(mc)²) = γ₊. Mass, c, A and
    φ are derived from H. For fields B and E without a potential A take H = c √(m²c² + |p|²) and the
    Lorentz force E + v × B as W, with ε = 1.

    A step preserves the volume in (q, p), but is not symplectic. At γ ≫ 1 the drift across E and B
    is wrong if the step is not small next to a gyration: take `HigueraCary`.

    **Raises** `ValueError` in a run for an H or a force that is not of this form; where the initial
    state is traced, the run has the status ``not_converged`` instead. Shapes as for `Boris`.

    **Source** Boris 1970, *Proc. 4th Conf. Numer. Simul. Plasmas*, 3; Ripperda et al. 2018,
    *Astrophys. J. Suppl.* 235, 21.
    """

    def mean(self, fields, h, P, E, B):
        start = P + h / 2 * E
        return _middle(fields, start, h / (2 * fields.mass) * B, jnp.sqrt(fields.square(start)))


class HigueraCary(_RelativisticMethod):
    r"""The method of Higuera and Cary for relativistic charged particles: order 2, symmetric.

    As `RelativisticBoris` with v̄ = P̄/√(m² + |P̄|²/c²), P̄ = (P₋ + P₊)/2: the velocity of the mean
    momentum, in closed form. A step preserves the volume in (q, p), and a particle for which
    E + v × B is zero remains in uniform motion: take it for γ ≫ 1.

    **Raises** `ValueError` as `RelativisticBoris`.

    **Source** Higuera & Cary 2017, *Phys. Plasmas* 24, 052104.
    """

    def mean(self, fields, h, P, E, B):
        start, half = P + h / 2 * E, h / (2 * fields.mass) * B
        return _middle(fields, start, half, _implicit_gamma(fields, start, half))


class Vay(_RelativisticMethod):
    r"""The method of Vay for relativistic charged particles: explicit, symmetric, of order 2.

    As `RelativisticBoris` with the mean v̄ = (v0 + v1)/2 of the velocities. A particle for which
    E + v × B is zero remains in uniform motion, but a step does not preserve the volume in (q, p):
    it is a reference for comparisons.

    **Raises** `ValueError` as `RelativisticBoris`.

    **Source** Vay 2008, *Phys. Plasmas* 15, 056701.
    """

    def mean(self, fields, h, P, E, B):
        v, half = fields.velocity(P), h / (2 * fields.mass) * B
        start = P + h * (E + _cross(v, B) / 2)
        return (v + _middle(fields, start, half, _implicit_gamma(fields, start, half))) / 2
