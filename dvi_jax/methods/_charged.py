"""Explicit methods for charged particles, in positions and velocities."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.dependence import depends_on
from lanewise.jaxprs.jaxapi import ClosedJaxpr, jaxpr_as_fun

from ..base.checks import array, whole
from ..base.types import Interval, Scalar, State
from ..engine.newton import RootInfo, RootSolver, find_root
from ._schemes import as_scheme, check_scheme
from ._splitting import PartFlow, SplittingMethod
from ._strang import Strang
from .step import Equations, judge, no_solve, no_step_yet

_MOST_NODES = 8


class _Motion(NamedTuple):
    r"""The equations of motion in positions and velocities,

        q̇ = v,    v̇ = a(t, q, v) = c × v + (−∂φ/∂q − ∂A/∂t + εW)/m,    c = −(∇ × A)/m

    of H = Σ |p − A(t, q)|²/(2m) + φ(t, q), with v = ∂H/∂p. `zero` is the time 0.
    """

    equations: Equations
    zero: Scalar
    mass: Array  # of each particle
    inverse_mass: Array  # a product with it takes less time than a quotient

    @classmethod
    def of(cls, equations: Equations, interval: Interval, q: State) -> "_Motion":
        """**Raises** `ValueError` for another H, or for positions of another shape."""
        array("q0 of a charged particle", q, (2,), (3,), ("particles", 2), ("particles", 3))
        # States relative to an origin: coordinates that are no linear functions of them need all.
        in_full = dataclasses.replace(equations, origin=None)

        def inverse_mass(p):
            velocity = lambda p: in_full.position_rate(interval, q, p)  # noqa: E731
            return jax.jvp(velocity, (p,), (jnp.ones_like(p),))[1][..., :1]

        if depends_on(inverse_mass, 0, q):
            raise ValueError(
                "methods for charged particles require H_D = Σ |p − A(q)|²/(2m) + φ(q), but it is "
                "not quadratic in p1."
            )
        # One mass of a particle, that of its first component: `check` compares the others with it.
        inverse = inverse_mass(q)
        return cls(in_full, jnp.zeros_like(interval.h), 1 / inverse, inverse)

    def velocity(self, t: Scalar, q: State, p: State) -> State:
        return self.equations.position_rate(Interval(t, t, self.zero), q, p)

    def momentum(self, t: Scalar, q: State, v: State) -> State:
        """p = m v + A, of a velocity at (t, q)."""
        return self.mass * (v - self.velocity(t, q, jnp.zeros_like(q)))

    def turning(self, t: Scalar, q: State) -> Array:
        """c, with one component if q has two."""
        zero, n = jnp.zeros_like(q), q.shape[-1]
        units = [jnp.broadcast_to(unit, q.shape) for unit in lanewise.unit_vectors(n, q.dtype)]
        # −A/m is the velocity for p = 0.
        slopes = [jax.jvp(lambda q: self.velocity(t, q, zero), (q,), (unit,))[1] for unit in units]
        pairs = [(0, 1)] if n == 2 else [(1, 2), (2, 0), (0, 1)]
        return jnp.stack([slopes[i][..., j] - slopes[j][..., i] for i, j in pairs], axis=-1)

    def push(self, t: Scalar, q: State) -> State:
        """(−∂φ/∂q + εW)/m, of W at rest."""
        p, equations = self.momentum(t, q, jnp.zeros_like(q)), self.equations
        system, epsilon, args = equations.system, equations.epsilon, equations.args
        phi = _potential(lambda q, p: system.hamiltonian(t, t, q, p, epsilon, args), q, p)
        # With a quantum a rate has to have the bits that it has elsewhere.
        if phi is None or equations.quantum is not None:
            return self.inverse_mass * equations.momentum_rate(Interval(t, t, self.zero), q, p)
        force = system.disturbing_force(t, t, q, p, epsilon, args)
        return self.inverse_mass * (force - jax.grad(phi)(q))

    def at_rest(self, t: Scalar, q: State) -> State:
        """a at v = 0."""
        p = self.momentum(t, q, jnp.zeros_like(q))
        # The induced electric field: A changes in time, at constant p.
        _, induction = jax.jvp(lambda t: self.velocity(t, q, p), (t,), (jnp.ones_like(t),))
        return induction + self.push(t, q)

    def friction(self, t: Scalar, q: State, v: State) -> State:
        """εW/m."""
        system, epsilon, args = self.equations.system, self.equations.epsilon, self.equations.args
        p = self.momentum(t, q, v)
        return self.inverse_mass * system.disturbing_force(t, t, q, p, epsilon, args)

    def has_friction(self, t: Scalar, q: State) -> bool:
        """Whether W depends on the velocity."""
        return depends_on(lambda v: self.friction(t, q, v), 0, q)

    def acceleration(self, t: Scalar, q: State, v: State) -> State:
        a = _plus_cross(self.at_rest(t, q), self.turning(t, q), v)
        # x − x is not 0 in compiled code, where x may be NaN.
        if not self.has_friction(t, q):
            return a
        return a + (self.friction(t, q, v) - self.friction(t, q, jnp.zeros_like(v)))


def _potential(hamiltonian: Callable, q: State, p: State) -> Callable[[State], Scalar] | None:
    """φ of H(q, p) = Σ (p − A(q))²/(2m) + φ(q), or None where the jaxpr does not show it.

    The gradient of H at p = A(q) is that of φ too, but it contains the derivative of A times 0.
    """
    closed = jax.make_jaxpr(hamiltonian)(q, p)
    jaxpr = closed.jaxpr

    def uses(variable):
        return [eqn for eqn in jaxpr.eqns if any(variable is atom for atom in eqn.invars)]

    positions, momenta = jaxpr.invars
    sums = uses(momenta)
    if len(sums) != 1 or sums[0].primitive.name not in ("sub", "add"):
        return None
    (kinetic,) = sums[0].outvars  # p ± A, of which H must contain squares only

    def is_square(eqn):
        name, power = eqn.primitive.name, eqn.params.get("y", 2)
        is_product = name in ("integer_pow", "square", "mul", "dot_general") and power >= 2
        return is_product and all(atom is kinetic for atom in eqn.invars)

    if kinetic.aval.shape != p.shape or not all(map(is_square, uses(kinetic))):
        return None
    rest = jaxpr.replace(
        invars=[positions, kinetic],
        eqns=[eqn for eqn in jaxpr.eqns if eqn is not sums[0]],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    function = jaxpr_as_fun(ClosedJaxpr(rest, closed.consts))
    return lambda q: function(q, jnp.zeros(p.shape, kinetic.aval.dtype))[0]


def _plus_cross(start: State, turning: Array, v: State) -> State:
    """start + turning × v; in a plane, with a vector normal to it."""
    if v.shape[-1] == 2:
        return start + turning * jnp.stack([-v[..., 1], v[..., 0]], axis=-1)

    first, second = (partial(jnp.roll, shift=-i, axis=-1) for i in (1, 2))  # (y, z, x), (z, x, y)
    # One sum after the other: each product becomes a fused multiply-add.
    return start + first(turning) * second(v) - second(turning) * first(v)


class _ChargedMethod(SplittingMethod):
    """Base of the methods whose parts are computed in positions and velocities."""

    has_coordinates: ClassVar[bool] = True

    def enter(self, equations, interval, q, p):
        motion = _Motion.of(equations, interval, q)
        v = motion.velocity(interval.t0, *equations.absolute(q, p))
        return q, v, no_step_yet(q)

    def leave(self, equations, interval, q, p):
        motion = _Motion.of(equations, interval, q)
        place, zero = equations.absolute(q, jnp.zeros_like(p))
        # Relative to the origin again, where there is one.
        return q, motion.momentum(interval.t1, place, p) - zero, no_step_yet(q)

    def check(self, equations, first_interval, q, p):
        interval = first_interval()
        motion, (q, p) = _Motion.of(equations, interval, q), equations.absolute(q, p)
        # At the state of the user: traced ones are not known, and a program without it is faster.
        # The velocity of a particle must be (p − A)/m: put into p = m v + A, it gives p again.
        t, name, mass = interval.t0, type(self).__name__, np.asarray(motion.mass)
        v = motion.velocity(t, q, p)
        rtol = 1e5 * float(jnp.finfo(q.dtype).eps)

        def differ(x, y, term):
            # Relative to a term as well, since the sum y may be zero.
            return not np.allclose(x, y, rtol, rtol * np.abs(np.stack([y, term])).max())

        if not (mass > 0).all() or differ(motion.momentum(t, q, v), p, p):
            raise ValueError(
                f"dvi.{name} requires ∂H_D/∂p1 = (p1 − A)/m with one positive mass of each "
                f"particle, but it is not that at the initial state with m = {mass.ravel()}."
            )
        # Of all particles together, from the equations of motion themselves.
        _, transport = jax.jvp(lambda t, q: motion.velocity(t, q, p), (t, q), (jnp.ones_like(t), v))
        rate = motion.equations.momentum_rate(Interval(t, t, motion.zero), q, p)
        total = transport + motion.inverse_mass * rate
        if differ(motion.acceleration(t, q, v), total, transport):
            raise ValueError(
                f"dvi.{name} requires that A at a particle depends on its own position only."
            )


def _drift(interval: Interval, q: State, v: State):
    q = q + interval.h * v
    return q, v, judge(no_solve(q), q, v)


def _rotation(change: State, turn: Array, v: State) -> State:
    """change + v1 − v, with v1 = v + turn × (v + v1): Cayley's form of a rotation."""
    scale = 2 / (1 + jnp.sum(turn * turn, axis=-1, keepdims=True))
    return _plus_cross(change, scale * turn, _plus_cross(v, turn, v))


def _middle(rate: Callable, h: Scalar, start: State, newton: RootSolver) -> tuple[State, RootInfo]:
    """v = start + h/2 (rate(v) − rate(0)), and the information on its solve."""
    zero = jnp.zeros_like(start)

    def half(v):
        return h / 2 * (rate(v) - rate(zero))

    def slope(v):
        return jax.jvp(half, (v,), (jnp.ones_like(v),))[1]

    if depends_on(slope, 0, start):
        guess = (start + half(start)).ravel()
        v, info = find_root(
            lambda v: v - (start + half(v.reshape(start.shape))).ravel(), guess, guess, newton
        )
        return v.reshape(start.shape), info
    # Linear: the columns of all particles at once, since none depends on another's velocity.
    units = [zero.at[..., i].set(1.0) for i in range(start.shape[-1])]
    matrix = jnp.stack([jax.jvp(half, (zero,), (unit,))[1] for unit in units], axis=-1)
    solve = jnp.vectorize(lanewise.solve, signature="(n,n),(n)->(n)")
    v = solve(jnp.eye(len(units), dtype=start.dtype) - matrix, start)
    return v, no_solve(v)


class Boris(_ChargedMethod):
    r"""The method of Boris for charged particles: explicit, symmetric, of order 2.

        q½ = q0 + h/2 v0,    v1 = v0 + h a(t½, q½, (v0 + v1)/2),    q1 = q½ + h/2 v1

    with v = ∂H/∂p and the acceleration a of H = Σ |p − A(t, q)|²/(2m) + φ(t, q) and of the force
    εW: for a charge in the fields E and B it is e (E + v × B)/m. It is linear in v, so that the
    velocity turns by 2 arctan(hΩ/2) about B, in closed form. The state of the run is (q, p), in the
    momenta of H; its steps are made in (q, v). For fields B and E without a potential A take
    H = |p|²/(2m) and the Lorentz force as W, with ε = 1; p is then m v.

    A step preserves the volume in (q, p) without a friction. It is not symplectic: |v| is exact in
    a magnetic field alone, but the energy in other fields may drift (Hairer & Lubich). For higher
    orders compose it: ``Yoshida(4, base=Boris())``.

    **Raises** `ValueError` in a run for an H that is not of this form, and for positions that are
    not of shape (2,), (3,), (particles, 2) or (particles, 3). Particles may interact by φ and W(q),
    but not by A.

    **Accuracy** order 2, also with a force that depends on v and is not linear in it: it is then
    solved for by `newton`.

    **Source** Boris 1970, *Proc. 4th Conf. Numer. Simul. Plasmas*, 3; Qin et al. 2013, *Phys.
    Plasmas* 20, 084503 (volume); Hairer & Lubich 2018, *BIT* 58, 969 (energy).

    **Example**

    ```python
    mirror = systems.magnetic_mirror()
    sol = dvi.integrate(mirror, num_steps=100_000, method=dvi.Boris(), save=dvi.Save(every=1000),
                        observe={"energy": dvi.MaxDrift(mirror.observables["energy"])})
    print(sol.status, sol.observed["energy"] < 1e-12)
    # successful True
    ```
    """

    is_symplectic: ClassVar[bool] = False
    scheme: ClassVar[Any] = Strang()

    def parts(self, equations, interval, q):
        motion = _Motion.of(equations, interval, q)
        # Decided before the step is compiled: without a friction it has a closed form.
        has_friction = motion.has_friction(interval.t0, q)

        def turn(interval, q, v):
            # Fields at the middle of the step make it symmetric in time.
            t, h = (interval.t0 + interval.t1) / 2, interval.h
            place, _ = equations.absolute(q, v)
            half, info = h / 2 * motion.at_rest(t, place), no_solve(v)
            if has_friction:
                rate = partial(motion.acceleration, t, place)
                middle, info = _middle(rate, h, v + half, equations.newton)
                change = h * rate(middle)
            else:
                turn = h / 2 * motion.turning(t, place)
                change = _rotation(2 * half, turn, v + half)
            # The change alone has the digits that a compensated sum keeps.
            v = v + change
            return q, v, judge(info, q, v)

        return [PartFlow(_drift, True), PartFlow(turn, True)]


class MagneticSplitting(_ChargedMethod):
    r"""An explicit symplectic splitting for charged particles: one component of v after the other.

        H = φ(t, q) + Σ_i m_i v_i²/2,    m_i v_i = p_i − A_i(t, q)

    The flow of m_i v_i²/2 moves the particle along the axis i at constant speed, and changes the
    other components by the integral of the magnetic field over this path,

        q_i ← q_i + h v_i,    v_j ← v_j + ∫₀ʰ (∂_j A_i − ∂_i A_j)/m_j v_i dt

    by Gauss's quadrature, which is exact for polynomials in q_i of a degree below twice the number
    of nodes. That of φ changes v; time advances by a flow of its own.

    **Arguments**

    - `scheme`: a composition as for `Splitting`: Strang() has order 2.
    - `nodes`: of the quadrature, from 1 to 8.

    **Raises** `TypeError` for another scheme, `ValueError` for other nodes and, in a run, as
    `Boris`, and for a force that depends on p (take `Boris`).

    **Accuracy** the order of the scheme. Symplectic up to the error of the quadrature, of the order
    2·nodes + 1 in the path over the length in which the field changes.

    **Source** He, Sun, Liu & Qin 2015, *Phys. Plasmas* 22, 124503; Xiao et al. 2015, *Phys.
    Plasmas* 22, 112504.

    **Example**

    ```python
    mirror = systems.magnetic_mirror()
    method = dvi.MagneticSplitting(dvi.BlanesMoan(6))
    sol = dvi.integrate(mirror, num_steps=1000, method=method, save=dvi.Save(final=True),
                        observe={"energy": dvi.MaxDrift(mirror.observables["energy"])})
    print(sol.status, sol.observed["energy"] < 1e-9)
    # successful True
    ```
    """

    scheme: Any = eqx.field(static=True, default_factory=Strang, converter=as_scheme)
    nodes: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        check_scheme(self.scheme)
        whole("nodes", self.nodes, 1, _MOST_NODES)

    def parts(self, equations, interval, q):
        motion = _Motion.of(equations, interval, q)
        t0 = interval.t0
        if motion.has_friction(t0, q):
            raise ValueError(
                "dvi.MagneticSplitting requires a force that does not depend on p: use dvi.Boris()."
            )
        nodes, weights = np.polynomial.legendre.leggauss(self.nodes)
        # In the precision of the state: numbers of NumPy would make it double.
        fractions, weights = (jnp.asarray(x, q.dtype) for x in ((1 + nodes) / 2, weights / 2))

        def clock(interval, q, v):
            place, _ = equations.absolute(q, v)
            # A changes in time, and p does not: the velocity changes. The flow of φ would have to
            # contain −∂A/∂t instead, which is no gradient, and would not be symplectic.
            p = motion.momentum(interval.t0, place, v)
            v = v + (
                motion.velocity(interval.t1, place, p) - motion.velocity(interval.t0, place, p)
            )
            return q, v, judge(no_solve(q), q, v)

        def axis_flow(i, interval, q, v):
            place, _ = equations.absolute(q, v)
            axis = np.arange(q.shape[-1]) == i
            # A straight line at constant speed: the field along it turns the other components only.
            path = jnp.where(axis, interval.h * v, 0.0)
            # A value at each node of the path, on which the field differs.
            fields = [
                motion.turning(interval.t0, place + fraction * path) for fraction in fractions
            ]
            turning = jnp.tensordot(weights, jnp.stack(fields), 1)
            v = _plus_cross(v, turning, path)
            return q + path, v, judge(no_solve(q), q, v)

        def kick(interval, q, v):
            place, _ = equations.absolute(q, v)
            # At v = 0, since the magnetic field belongs to the flows of the axes.
            v = v + interval.h * motion.push(interval.t0, place)
            return q, v, judge(no_solve(q), q, v)

        # Time has a flow of its own only if something depends on it, since one more takes longer.
        # The first flow carries the time, and is exact only for what does not depend on it.
        flows = [*(partial(axis_flow, i) for i in range(q.shape[-1])), kick]
        if depends_on(lambda t: motion.acceleration(t, q, q), 0, t0):
            flows = [clock, *flows]
        return [PartFlow(flow, True) for flow in flows]
