"""One step of the map (12)–(13), and its inverse."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

import lanewise
from lanewise.jaxprs.dependence import depends_on

from ..base.printing import printable
from ..base.results import RESULTS, first_failure
from ..base.types import Args, Interval, Scalar, State
from ..engine.newton import Newton, RootInfo, RootSolver, find_root, no_residual, worse
from ..engine.rounding import one_by_one
from ..problem.system import System


class StepInfo(NamedTuple):
    """Status of a step, number of iterations, and (largest last correction, its scale)."""

    result: RESULTS
    iterations: Int[Array, ""]
    residual: Float[Array, "2"]

    def then(self, later: "StepInfo") -> "StepInfo":
        """This step followed by another: first failure, total work, worst residual."""
        return StepInfo(
            first_failure(self.result, later.result),
            self.iterations + later.iterations,
            worse(self.residual, later.residual),
        )


def no_step_yet(like: State) -> StepInfo:
    """The neutral element of `StepInfo.then`."""
    # A status that is an array, as in the carry of a scan; `RESULTS.successful` itself is static.
    good = RESULTS.where(jnp.asarray(True), RESULTS.successful, RESULTS.not_finite)
    return StepInfo(good, *no_solve(like)[1:3])


@printable
class Equations(eqx.Module):
    """The equations (12)–(13) of one step of a system, for one ε and one set of args.

    `newton` solves their implicit part. If there is an `origin`, positions and momenta are relative
    to it. `increments` are the increments of the noise in the step, shape (parts of the step, m),
    for some methods with further rows for their areas.
    If there is a `quantum`, an explicit step changes the state by integer multiples of it.
    A rate has then the same bits in every evaluation.
    """

    system: System | Any  # or what has its functions, such as a system with the noise of a step
    epsilon: Scalar
    args: Args = None
    newton: RootSolver = Newton()
    origin: tuple[State, State] | None = None
    quantum: float | None = eqx.field(static=True, default=None)
    increments: Array | None = None

    def absolute(self, q: State, p: State) -> tuple[State, State]:
        """(q, p) in the coordinates of the system, the origin added."""
        if self.origin is None:
            return q, p
        return self.origin[0] + q, self.origin[1] + p

    def increment(self, h: Scalar, rate: State) -> State:
        """h·rate, rounded to a multiple of the quantum where there is one."""
        return h * rate if self.quantum is None else to_grid(h * rate, self.quantum)

    def momentum_rate(self, interval: Interval, q0: State, p1: State) -> State:
        """−∂H_D/∂q0 + εW at (t0, t1, q0, p1): the right side of (13)."""
        point = (self.system, *interval[:2], *self.absolute(q0, p1), self.epsilon, self.args)
        # With a quantum the last bits decide where a rate is rounded to: compiled separately they
        # are the same forwards and backwards.
        if self.quantum is None:
            return _momentum_rate(*point)
        return one_by_one(_momentum_rate, *point)

    def position_rate(self, interval: Interval, q0: State, p1: State) -> State:
        """∂H_D/∂p1 at (t0, t1, q0, p1): the right side of (12)."""
        point = (self.system, *interval[:2], *self.absolute(q0, p1), self.epsilon, self.args)
        if self.quantum is None:
            return _position_rate(*point)
        return one_by_one(_position_rate, *point)

    def rates(self, interval: Interval, q: State, p: State) -> tuple[State, State]:
        """(`position_rate`, `momentum_rate`) at one point, from one gradient of H_D."""
        # The two functions would evaluate H_D twice where XLA or `lanewise` sees no common part.
        if self.quantum is not None:
            return self.position_rate(interval, q, p), self.momentum_rate(interval, q, p)
        point = (self.system, *interval[:2], *self.absolute(q, p), self.epsilon, self.args)
        return _rates(*point)

    def constraint(self, q: State) -> Array:
        """g(q, args) of a constrained system, shape (m,)."""
        q, _ = self.absolute(q, jnp.zeros_like(q))
        return self.system.constraint(q, self.args).astype(q.dtype)  # pyright: ignore

    def step_is_explicit(self, interval: Interval, like: State) -> bool:
        """Whether p1 enters neither ∂H_D/∂q0 nor W, so that (13) needs no solve."""
        # Read from the jaxpr: a value-dependent test could not run under jit.
        return not depends_on(lambda p1: self.momentum_rate(interval, like, p1), 0, like)

    def inverse_is_explicit(self, interval: Interval, like: State) -> bool:
        """Whether q0 does not enter ∂H_D/∂p1, so that inverse and adjoint need no solve."""
        return not depends_on(lambda q0: self.position_rate(interval, q0, like), 0, like)


# Jitted: all calls in a run share one trace of the user's functions and of their derivatives.


@eqx.filter_jit
def _momentum_rate(system: System | Any, *point) -> State:
    gradient = jax.grad(system.hamiltonian, argnums=2)(*point)
    if system.force is None:
        return -gradient
    return -gradient + system.disturbing_force(*point).astype(gradient.dtype)


@eqx.filter_jit
def _position_rate(system: System | Any, *point) -> State:
    return jax.grad(system.hamiltonian, argnums=3)(*point)


@eqx.filter_jit
def _rates(system: System | Any, *point) -> tuple[State, State]:
    gradient, velocity = jax.grad(system.hamiltonian, argnums=(2, 3))(*point)
    if system.force is None:
        return velocity, -gradient
    return velocity, -gradient + system.disturbing_force(*point).astype(gradient.dtype)


def to_grid(x: State, quantum: float) -> State:
    """The multiple of `quantum`, a power of two, nearest to x (half to even)."""

    def nearest(x):
        return [jnp.round(x * (1 / quantum)) * quantum]

    def slope(operands, changes):
        # Slope 1, that of the map without rounding; the slope of a staircase is zero.
        return [changes[0]]

    return lanewise.with_derivative(nearest, slope, [x])[0]


def step(
    equations: Equations, interval: Interval, q0: State, p0: State
) -> tuple[State, State, StepInfo]:
    """The map Φ_h of (12)–(13): (q0, p0) at t0 → (q1, p1) at t1.

    p1 = p0 + h (−∂H_D/∂q0 + εW)(t0, t1, q0, p1)      solved for p1 where p1 enters
    q1 = q0 + h ∂H_D/∂p1 (t0, t1, q0, p1)
    """
    h, force = interval.h, functools.partial(equations.momentum_rate, interval, q0)
    # The result where p1 does not enter, and otherwise the guess, with an error O(h²).
    p1 = p0 + equations.increment(h, force(p0))
    p1, info = _solve(force, h, p0, p1, equations, equations.absolute(q0, p0)[1])
    q1 = q0 + equations.increment(h, equations.position_rate(interval, q0, p1))
    return q1, p1, judge(info, q1, p1, equations.quantum)


def inverse_step(
    equations: Equations, interval: Interval, q1: State, p1: State
) -> tuple[State, State, StepInfo]:
    """The inverse Φ_h⁻¹ of `step`: (q1, p1) at t1 → (q0, p0) at t0.

    q0 = q1 − h ∂H_D/∂p1 (t0, t1, q0, p1)             solved for q0 where q0 enters
    p0 = p1 − h (−∂H_D/∂q0 + εW)(t0, t1, q0, p1)
    """
    h, velocity = -interval.h, functools.partial(equations.position_rate, interval, p1=p1)
    q0 = q1 + equations.increment(h, velocity(q1))
    q0, info = _solve(velocity, h, q1, q0, equations, equations.absolute(q1, p1)[0])
    p0 = p1 - equations.increment(interval.h, equations.momentum_rate(interval, q0, p1))
    return q0, p0, judge(info, q0, p0, equations.quantum)


def continuous_rates(equations: Equations, like: Scalar) -> tuple[Callable, Callable]:
    """∂H/∂p and −∂H/∂q + εW as functions of (t, q, p), with H(t, q, p) = H_D(t, t, q, p)."""

    # Both times of H_D are t. The rates do not use the h of the interval, which is therefore 0.
    def instant(t: Scalar) -> Interval:
        return Interval(t, t, jnp.zeros_like(like))

    return (
        lambda t, q, p: equations.position_rate(instant(t), q, p),
        lambda t, q, p: equations.momentum_rate(instant(t), q, p),
    )


def no_solve(x: State) -> RootInfo:
    """The information on x where no solve is needed."""
    real = jnp.finfo(x.dtype).dtype
    return RootInfo(x, jnp.asarray(0, jnp.int32), no_residual(real), jnp.asarray(True))


def _solve(
    rate: Callable, h: Scalar, x0: State, guess: State, equations: Equations, size: State
) -> tuple[State, RootInfo]:
    """x1 = x0 + h rate(x1) near `guess`, which is x1 if `rate` does not depend on x1; `known` is x0
    with the origin, the scale of the accuracy."""
    if not depends_on(rate, 0, x0):
        return guess, no_solve(x0)
    start = x0.ravel()

    def residual(x1):
        return x1 - start - h * rate(x1.reshape(x0.shape)).ravel()

    # A small increment next to an origin has its own round-off, smaller than that of the whole
    # coordinate in `known`: both ends of the step as they are represented.
    represented_size = jnp.maximum(jnp.abs(x0), jnp.abs(guess)).ravel()
    x1, info = find_root(residual, guess.ravel(), size.ravel(), equations.newton, represented_size)
    return x1.reshape(x0.shape), info


def judge(info: RootInfo, q: State, p: State, quantum: float | None = None) -> StepInfo:
    """The status of a step, from its solve and from the state after it."""
    finite = jnp.all(jnp.isfinite(q)) & jnp.all(jnp.isfinite(p))
    result = RESULTS.where(info.converged, RESULTS.successful, RESULTS.not_converged)
    if quantum is not None:
        # Larger multiples of the quantum are not all representable: sums would round.
        largest = quantum * 2.0 ** (jnp.finfo(q.dtype).nmant + 1)
        fits = jnp.all(jnp.abs(q) <= largest) & jnp.all(jnp.abs(p) <= largest)
        result = RESULTS.where(fits, result, RESULTS.out_of_range)
    # Last, because NaN makes a solve fail as well, and is the reason that helps the user.
    result = RESULTS.where(finite, result, RESULTS.not_finite)
    return StepInfo(result, info.iterations, info.residual)


def info_of(method: eqx.Module, info: StepInfo, q: State, p: State) -> StepInfo:
    """The status of a step of any method: one of a user may have a state that is not finite, and
    yet the status `successful`. Those of the package judge their states themselves."""
    if is_of_package(method):
        return info
    good = jnp.all(jnp.isfinite(q)) & jnp.all(jnp.isfinite(p))
    good = good | (info.result != RESULTS.successful)
    return info._replace(result=RESULTS.where(good, info.result, RESULTS.not_finite))


def is_of_package(module: eqx.Module) -> bool:
    """Whether a module and those in it are of classes of this package."""
    modules = (value for value in vars(module).values() if isinstance(value, eqx.Module))
    return type(module).__module__.startswith("dvi_jax.") and all(map(is_of_package, modules))
