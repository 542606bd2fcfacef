"""Splittings of N bodies around Kepler orbits: the method of Wisdom and Holman."""

import functools
import warnings
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.dependence import depends_on

from ..base.checks import array, one_of, positive, whole
from ..base.keywords import user_level
from ..base.types import Args, Interval, State
from ..engine.newton import find_root
from ..problem import kepler as _kepler
from ..problem.flows import value_of
from ..problem.frames import Democratic, Jacobi
from ._encounters import Encounters, at_pericentre, close_pairs
from ._schemes import ORDERS_OF_CORRECTORS, as_scheme, check_scheme, corrector, join_neighbours
from ._splitting import PartFlow, SplittingMethod, Stage
from ._strang import Strang
from .step import Equations, judge, no_solve, no_step_yet

_FEWEST = 10
"""Evaluations of the interaction in a revolution, below which a run warns."""

_ATTEMPTS = 4
"""Of a step whose end has further pairs of bodies that are close."""

Coordinates = Literal["jacobi", "democratic"]


_COORDINATES = {"jacobi": Jacobi, "democratic": Democratic}


class WisdomHolman(SplittingMethod):
    r"""The method of Wisdom and Holman: N bodies as Kepler orbits and their weak interaction.

        H_D = T(p) + V(q) = H_A + H_B,    H_A = Kepler orbits and the motion of the centre of mass

    Any `System` with T = Σ |p_i|²/(2 m_i) and positions of shape (bodies, 2 or 3), the dominant
    body first and the others from the inside to the outside, such as those of `systems.n_body` and
    `interop.from_rebound`. The masses are read from T; bodies after the last entry of
    ``args["masses"]`` are test particles of mass 0. V is not restricted: all that is not in H_A
    is in H_B, also a perturbation, an oblateness and a force εW. Forces that depend on momenta are
    solved for by the midpoint rule.

    **Arguments**

    - `coordinates`: "jacobi", or "democratic" (heliocentric positions, barycentric velocities),
      for bodies whose order changes or that come close to one another.
    - `corrector`: order 3, 5, 7, 11 or 17 of a symplectic corrector, 0: none; in Jacobi
      coordinates and with the scheme `Strang`. It removes the terms ε h², ε h⁴, … of the error from
      saved states. It is applied at save points and where states are observed, so save rarely: one
      output takes the time of 8 (order 3) to 64 (order 17) further steps.
    - `scheme`: as for `Splitting`, for example (10, 6, 4) for long steps at high accuracy.
    - `encounters`: pairs of bodies that come closer than this number of Hill radii, for example
      3.0, are integrated apart, in democratic coordinates; see below. None: no pair is.
    - `pericentres`: steps longer than this number of τ, for example 1.0, are those at a pericentre,
      in democratic coordinates; see below. None: none is.
    - `G`: the gravitational constant in the Kepler part, a number or a function of args; None:
      ``args["G"]`` if there is one, else 1. Another value changes the accuracy, not the limit.

    A run stays in these coordinates, also where states are observed: those that are saved or
    observed are converted copies. Between save points, where nothing is observed, the two half
    flows at the ends of neighbouring steps are one. An orbit may have any eccentricity.

    **Close encounters** of other bodies than the first are resolved with `encounters` only. A pair
    (i, j) is close if its distance, along straight lines during h/2 before and after, is less
    than `encounters` times the larger of r_i (m_i/3m_0)^{1/3}. In a step with close pairs

        H_A′ = H_A − Σ_close G m_i m_j/|q_i − q_j|,    H_B′ = H_B + Σ_close G m_i m_j/|q_i − q_j|,

    and the bodies in them are moved by H_A′ to round-off, by an extrapolation method of order 12.
    Pairs that are close at the end of a step and not at its start are added, and the step is
    repeated: a run with −h has the same pairs and returns to round-off. (Not where the steps with
    and without a pair differ in whether it is close at the end; then by the error of one step.)
    ``stats["encounter_steps"]`` counts the steps with close pairs. Derivatives are those for the
    given pairs. Many revolutions of a pair in one step fail with the status `not_converged`.

    **Pericentres** of eccentric orbits are resolved with `pericentres` only. In a step with
    |h| > `pericentres` τ for one of the bodies, at its start or at its end, where

        τ² = 2 |a|²/(|a'|² + |a| |a''|),    a the acceleration by the first body,

    all bodies are moved to round-off, under Newton's attraction and with the recoil of the first
    body: then H_B′ has only what else is in V, and the force. On a circle τ = 1/n, at a pericentre
    with e → 1 it is 0.82/ω. ``stats["pericentre_steps"]`` counts these steps.

    A run whose h and initial state are known **warns** if the interaction is evaluated less than
    ten times in the shortest period, or, without `pericentres`, in a circle with the angular
    velocity of a pericentre: such steps have resonances with the orbits.

    **Raises** `ValueError` for another corrector or other coordinates and, in a run, for positions
    of another shape, a system that is not T(p) + V(q), and a T of another form.

    **Source** Wisdom & Holman 1991, *Astron. J.* 102, 1528; Duncan, Levison & Lee 1998, *Astron.
    J.* 116, 2067 (democratic); Wisdom, Holman & Touma 1996, *Fields Inst. Commun.* 10, 217 and
    Wisdom 2006, *Astron. J.* 131, 2294 (correctors; their coefficients follow here from the linear
    conditions); Rein & Tamayo 2015, *MNRAS* 452, 376; Lu, Hernandez & Rein 2024, *MNRAS* 533, 3708
    (encounters, pericentres).
    """

    coordinates: Coordinates = eqx.field(static=True, default="jacobi")
    corrector: int = eqx.field(static=True, default=0)
    scheme: Any = eqx.field(static=True, default_factory=Strang, converter=as_scheme)
    G: Any = None
    encounters: float | None = eqx.field(static=True, default=None)
    pericentres: float | None = eqx.field(static=True, default=None)

    has_coordinates: ClassVar[bool] = True

    def __check_init__(self):
        one_of("coordinates", self.coordinates, get_args(Coordinates))
        one_of("corrector", self.corrector, (0, *ORDERS_OF_CORRECTORS))
        check_scheme(self.scheme)
        if self.corrector and (self.coordinates != "jacobi" or self.scheme != Strang()):
            raise ValueError(
                'corrector must be 0 unless coordinates="jacobi" and scheme=dvi.Strang(), got '
                f"corrector={self.corrector}, coordinates={self.coordinates!r}, "
                f"scheme={self.scheme!r}."
            )

        for name in ("encounters", "pericentres"):
            if (value := getattr(self, name)) is not None:
                positive(name, value)
                one_of(f"coordinates of a method with {name}", self.coordinates, ("democratic",))

    @property
    def _switches(self) -> bool:
        return self.encounters is not None or self.pericentres is not None

    def is_double_only(self, equations) -> bool:
        return True

    def check(self, equations, first_interval, q, p):
        interval = first_interval()
        start = jax.tree.map(np.asarray, _start(self, equations, interval, q, p))
        masses, scale, v = start.masses, start.scale, start.v
        rtol = 1e5 * float(jnp.finfo(q.dtype).eps)
        if not (scale > 0).all() or not np.allclose(scale * v, p, rtol=rtol, atol=0):
            raise ValueError(
                "dvi.WisdomHolman requires ∂H_D/∂p1 = p/m with positive masses, but it is not p/m "
                f"at the initial state with m = {scale[:, 0]}."
            )
        massive = _massive(equations.args, len(q))
        if np.any(start.force[massive:]):
            raise ValueError(
                f"dvi.WisdomHolman takes bodies without an entry in masses of args for test "
                f"particles of mass 0, here those after the first {massive}. They must not enter "
                "the potential in H_D; their attraction is a force."
            )
        if masses[0] < masses.max():
            raise ValueError(
                f"dvi.WisdomHolman requires the dominant body first, but body {masses.argmax()} "
                f"has the mass {masses.max():g} and body 0 only {masses[0]:g}."
            )
        self._check_steps(interval, start.X[1:], start.V[1:], start.mu)
        if self._switches and len(q) > 2:
            position, momentum = equations.absolute(q, p)
            values = _attraction(self, equations, interval, position, momentum, scale)
            size, of_first, difference = map(float, values)
            # Where the attraction is so small that the first body hides it, it is not compared.
            if size > 100 * of_first and difference > 0.1 * size:
                raise ValueError(
                    "encounters of dvi.WisdomHolman requires bodies that attract one another by "
                    "Newton's law with the masses and G of the Kepler orbits, but they do not."
                )

    def _check_steps(self, interval, X, V, mu):
        """Warn of too few evaluations of the interaction in a revolution, or at a pericentre."""
        X, V, mu = (np.asarray(x, float) for x in (X, V, mu))
        r2, v2, rv = (X * X).sum(axis=1), (V * V).sum(axis=1), (X * V).sum(axis=1)
        momentum = np.sqrt(np.maximum(r2 * v2 - rv * rv, 0))
        with np.errstate(all="ignore"):
            a = 1 / (2 / np.sqrt(r2) - v2 / mu)
            e = np.sqrt(np.maximum(1 - momentum**2 / (mu * a), 0))
            # Of a full circle at the angular velocity of the pericentre.
            times = 2 * np.pi * np.array([np.sqrt(a**3 / mu), (a * (1 - e)) ** 2 / momentum])
        times = np.where(np.isfinite(times), times, np.inf)  # none for an orbit that is not bound
        times = times if self.pericentres is None else times[:1]
        i, stages = int(times.min(axis=0).argmin()), len(self.substeps())
        steps = times[:, i] / abs(float(interval.h))
        if steps.min() * stages < _FEWEST:
            largest = times[:, i].min() * stages / _FEWEST
            places = [f", or {n:.2g} at the angular velocity of its pericentre" for n in steps[1:]]
            warnings.warn(
                f"h = {float(interval.h):g} is too long for dvi.WisdomHolman: the orbit of body "
                f"{i + 1} has the period {times[0, i]:.4g}, which are {steps[0]:.2g} steps"
                f"{''.join(places)}. At least {_FEWEST} are necessary: |h| ≤ {largest:.2g}, or a "
                "scheme with more stages.",
                stacklevel=user_level(),
            )

    def _frame(self, equations: Equations, interval: Interval, q: State) -> tuple[Any, Array]:
        """The coordinates, and p/v of each body, which is 1 for a test particle."""
        array("q0 of dvi.WisdomHolman", q, ("bodies", 2), ("bodies", 3))
        whole("the number of bodies", len(q), 2)

        def velocity(q, p):
            return equations.position_rate(interval, q, p)

        def inverse_mass(p):
            return jax.jvp(lambda p: velocity(q, p), (p,), (jnp.ones_like(p),))[1]

        is_coupled = depends_on(lambda q: velocity(q, jnp.ones_like(q)), 0, q)
        if is_coupled or depends_on(inverse_mass, 0, q):
            reason = "q0 enters ∂H_D/∂p1" if is_coupled else "it is not quadratic in p1"
            raise ValueError(
                f"dvi.WisdomHolman requires H_D = Σ |p_i|²/(2 m_i) + V(q0), but {reason}."
            )
        # The momentum of a test particle is its velocity: T has a mass 1 where the frame has 0.
        scale = 1 / inverse_mass(q)[:, :1]
        masses = scale[:, 0].at[_massive(equations.args, len(q)) :].set(0.0)
        return _COORDINATES[self.coordinates](masses), scale

    def _strength(self, equations: Equations, q: State) -> Any:
        """The gravitational constant."""
        return value_of(_gravity if self.G is None else self.G, equations.args, q)

    def parts(self, equations, interval, q, close=None):
        """The parts. The attraction of `close` pairs of bodies is in the first one."""
        frame, scale = self._frame(equations, interval, q)
        mu = self._strength(equations, q) * frame.central_mass()
        # With an origin states are relative to it, in these coordinates too: they are linear.
        zero = jnp.zeros_like(q)
        position, momentum = equations.absolute(zero, zero)
        base = frame.from_bodies(position), frame.velocities_of(momentum / scale)
        implicit = not equations.step_is_explicit(interval, q)
        pairs = None if close is None else self._pairs(equations, interval, q, close)

        def attraction(X):
            """The accelerations of the Kepler part."""
            inner = X[1:]
            r = jnp.sqrt(jnp.sum(inner * inner, axis=1))
            pull = -(mu / (r * r * r))[:, None] * inner
            return jnp.concatenate([jnp.zeros_like(X[:1]), pull])

        def kepler(interval, X, V):
            h = interval.h
            full_X, full_V = base[0] + X, base[1] + V
            motion = _kepler.change(h, full_X[1:], full_V[1:], mu)
            if pairs is not None:
                motion = pairs.motion(h, full_X[1:], full_V[1:], motion)
            dX, dV, is_root = motion
            X1 = X + jnp.concatenate([h * full_V[:1], dX])
            V1 = V + jnp.concatenate([jnp.zeros_like(V[:1]), dV])
            return X1, V1, judge(no_solve(X)._replace(converged=is_root), X1, V1)

        def kick(interval, X, V):
            h, x = interval.h, frame.to_bodies(X)

            def rate(V):
                p = scale * frame.velocities_back(V)
                acceleration = equations.momentum_rate(interval, x, p) / scale
                if pairs is not None:
                    acceleration = pairs.without_pull(position + x, acceleration)
                return frame.velocities_of(acceleration) - attraction(base[0] + X)

            if not implicit:
                return V + h * rate(V), no_solve(X)

            def residual(V1):
                return V1 - V.ravel() - h * rate((V1.reshape(V.shape) + V) / 2).ravel()

            guess = (V + h * rate(V)).ravel()
            V1, info = find_root(residual, guess, V.ravel(), equations.newton)
            return V1.reshape(V.shape), info

        def interaction(interval, X, V):
            # The recoil of the first body is in this part: half before the kick, half after it.
            # At a pericentre it is in the part A.
            moves = 1 if pairs is None else jnp.where(pairs.has_recoil, 0, 1)
            X = X + moves * interval.h / 2 * frame.drift(base[1] + V)
            V, info = kick(interval, X, V)
            X = X + moves * interval.h / 2 * frame.drift(base[1] + V)
            return X, V, judge(info, X, V)

        return [PartFlow(kepler, True), PartFlow(interaction, not implicit)]

    def _pairs(
        self, equations: Equations, interval: Interval, q: State, close: Array
    ) -> Encounters:
        frame, _ = self._frame(equations, interval, q)
        mu = self._strength(equations, q) * frame.central_mass()
        args = equations.args if isinstance(equations.args, dict) else {}
        softening = jnp.asarray(args.get("softening", 0), q.dtype)
        # G m of each body, from μ of its orbit: G may be a function of the user.
        masses = frame.masses[1:] / frame.masses[0] * mu
        return Encounters(masses, mu, softening * softening, close)

    def _close(self, equations: Equations, interval: Interval, q: State, p: State) -> Array:
        """The pairs of bodies that are close at a state in these coordinates, and on the diagonal
        the bodies at a pericentre."""
        frame, scale = self._frame(equations, interval, q)
        position, momentum = equations.absolute(jnp.zeros_like(q), jnp.zeros_like(q))
        X, V = q + frame.from_bodies(position), p + frame.velocities_of(momentum / scale)
        point = interval.h, X[1:], V[1:]
        # Radii of Hill spheres, in units of the distance to the first body.
        radii = (self.encounters or 0) * jnp.cbrt(frame.masses[1:] / (3 * frame.masses[0]))
        close = close_pairs(*point, radii)
        if self.pericentres is None:
            return close
        mu = self._strength(equations, q) * frame.central_mass()
        return close | jnp.diag(at_pericentre(*point, mu, self.pericentres))

    def compose(self, equations, interval, q, p, stages, parts=None):
        compose = functools.partial(super().compose, equations, interval, q, p, stages)
        if not self._switches:
            return compose(parts)

        def attempt(state):
            close, *_ = state
            q1, p1, info = compose(self.parts(equations, interval, q, close))
            pairs = close | self._close(equations, interval, q1, p1)
            return pairs, jnp.all(pairs == close), q1, p1, info

        def repeat(state, _):
            is_final = state[1]

            def repetition():
                return jax.tree.map(lambda a, b: jnp.where(is_final, a, b), state, attempt(state))

            return lax.cond(lanewise.on_any(~is_final, rare=False), repetition, lambda: state), None

        # Pairs and pericentres are judged at both ends: with one at the end only, the step is
        # repeated from its start.
        close = self._close(equations, interval, q, p)
        start = close, jnp.asarray(False), q, p, no_step_yet(q)
        (_, _, q, p, info), _ = lax.scan(repeat, start, None, _ATTEMPTS)
        return q, p, info

    def count(self, equations, interval, q0, p0, q1, p1):
        if not self._switches:
            return {}
        ends = (self.enter(equations, interval, *state)[:2] for state in ((q0, p0), (q1, p1)))
        start, end = (self._close(equations, interval, *state) for state in ends)
        close, of_one = start | end, jnp.eye(len(start), dtype=bool)
        flags = {}
        if self.encounters is not None:
            flags["encounter_steps"] = close & ~of_one
        if self.pericentres is not None:
            flags["pericentre_steps"] = close & of_one
        return {name: jnp.any(flag).astype(jnp.int32) for name, flag in flags.items()}

    def in_loop(self, equations, interval, q):
        is_fixed = self._is_fixed(equations, interval, q) and not self._switches
        return super().in_loop(equations, interval, q) if is_fixed else None

    def in_coordinates(self, equations, interval, q):
        is_fixed = self._is_fixed(equations, interval, q)
        return super().in_coordinates(equations, interval, q) if is_fixed else None

    def _is_fixed(self, equations, interval, q) -> bool:
        """Whether the masses, and so the coordinates, are the same in all steps."""

        def masses(t):
            return self._frame(equations, interval._replace(t0=t, t1=t), q)[0].masses

        return not depends_on(masses, 0, interval.t0)

    def enter(self, equations, interval, q, p):
        frame, scale = self._frame(equations, interval, q)
        X, V = frame.from_bodies(q), frame.velocities_of(p / scale)
        return X, V, no_step_yet(X)

    def leave(self, equations, interval, q, p):
        frame, scale = self._frame(equations, interval, q)
        x, v = frame.to_bodies(q), frame.velocities_back(p)
        return x, scale * v, no_step_yet(q)

    @property
    def has_corrector(self) -> bool:
        return self.corrector > 0

    def correct(self, equations, interval, q, p, sign):
        if not self.corrector:
            return super().correct(equations, interval, q, p, sign)
        # The inverse of Z(a, b) is Z(−a, b), and a and −a are at opposite places: b changes sign.
        sequence = join_neighbours(
            stage
            for a, b in corrector(self.corrector)
            for stage in ((0, a), (1, sign * b), (0, -2 * a), (1, -sign * b), (0, a))
        )
        stages = [Stage(part, 0.0, 0.0, c) for part, c in sequence]
        return self.compose(equations, interval, q, p, stages)


class _Start(NamedTuple):
    """What is checked at the initial state: of the bodies, and in the coordinates X, V."""

    masses: Array
    scale: Array
    v: Array
    force: Array
    X: Array
    V: Array
    mu: Array


@eqx.filter_jit
def _start(method: WisdomHolman, equations: Equations, interval: Interval, q: State, p: State):
    # One program: as some fifty small ones, it would take the seconds of the first call.
    frame, scale = method._frame(equations, interval, q)
    position, momentum = equations.absolute(q, p)
    point = (*interval[:2], position, momentum, equations.epsilon, equations.args)
    return _Start(
        frame.masses, scale, equations.position_rate(interval, q, p),
        jax.grad(equations.system.hamiltonian, argnums=2)(*point),
        frame.from_bodies(position), frame.velocities_of(momentum / scale),
        method._strength(equations, q) * frame.central_mass(),
    )  # fmt: skip


def _massive(args: Args, bodies: int) -> int:
    """The number of bodies with a mass: those without an entry in masses are test particles."""
    masses = args.get("masses") if isinstance(args, dict) else None
    return bodies if masses is None or np.ndim(masses) != 1 else min(len(masses), bodies)


def _gravity(args: Args) -> Any:
    return args.get("G", 1.0) if isinstance(args, dict) else 1.0


@eqx.filter_jit
def _attraction(method: WisdomHolman, equations: Equations, interval, q, p, scale):
    """Of bodies next to one another: their attraction by Newton's law, that of the first body, and
    by how much the acceleration differs from the former."""
    numbers, unit = np.arange(len(q) - 1), jnp.linalg.norm(q[1] - q[0])
    # All of them next to the second body, where their attraction exceeds that of the first one.
    x = q.at[1:].set(q[1:2] + 1e-6 * unit * numbers[:, None])
    pairs = method._pairs(equations, interval, x, ~jnp.eye(len(numbers), dtype=bool))
    pull = pairs.pull(x[1:, None] - x[None, 1:])
    difference = (equations.momentum_rate(interval, x, p) / scale)[1:] - pull
    return jnp.abs(pull).max(), pairs.mu[0] / unit**2, jnp.abs(difference).max()
