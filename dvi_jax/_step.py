"""One step of the map (12)–(13), its inverse, and its adjoint."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._results import RESULTS, first_failure
from ._system import System
from ._types import Args, Interval, Scalar, State
from .engine.dependence import depends_on
from .engine.newton import Newton, RootInfo, find_root


class StepInfo(NamedTuple):
    """Status of a step, Newton iterations spent, largest relative residual left."""

    result: RESULTS
    iterations: Int[Array, ""]
    residual: Float[Array, ""]

    def then(self, later: "StepInfo") -> "StepInfo":
        """This step followed by another: first failure, total work, worst residual."""
        return StepInfo(
            first_failure(self.result, later.result),
            self.iterations + later.iterations,
            jnp.maximum(self.residual, later.residual),
        )


def no_step_yet(like: State) -> StepInfo:
    """The information that `StepInfo.then` starts from."""
    real = jnp.finfo(like.dtype).dtype
    zero = jnp.asarray(0, jnp.int32)
    good = RESULTS.where(jnp.asarray(True), RESULTS.successful, RESULTS.not_finite)
    return StepInfo(good, zero, jnp.zeros((), real))


class Equations(eqx.Module):
    """The discrete equations of a system at one ε and one set of args, ready to be stepped.

    `newton` says how their implicit part is solved.
    """

    system: System
    epsilon: Scalar
    args: Args = None
    newton: Newton = Newton()

    def momentum_rate(self, interval: Interval, q0: State, p1: State) -> State:
        """−∂H_D/∂q0 + εW at (t0, t1, q0, p1): the right side of (13)."""
        at = (interval.t0, interval.t1, q0, p1, self.epsilon, self.args)
        gradient = jax.grad(self.system.hamiltonian, argnums=2)(*at)
        if self.system.force is None:
            return -gradient
        return -gradient + self.system.disturbing_force(*at).astype(gradient.dtype)

    def position_rate(self, interval: Interval, q0: State, p1: State) -> State:
        """∂H_D/∂p1 at (t0, t1, q0, p1): the right side of (12)."""
        at = (interval.t0, interval.t1, q0, p1, self.epsilon, self.args)
        return jax.grad(self.system.hamiltonian, argnums=3)(*at)

    def step_is_explicit(self, interval: Interval, like: State) -> bool:
        """Whether p1 enters neither ∂H_D/∂q0 nor W, so that (13) needs no solve."""
        return not depends_on(lambda p1: self.momentum_rate(interval, like, p1), 0, like)

    def inverse_is_explicit(self, interval: Interval, like: State) -> bool:
        """Whether q0 does not enter ∂H_D/∂p1, so that inverse and adjoint need no solve."""
        return not depends_on(lambda q0: self.position_rate(interval, q0, like), 0, like)


def step(
    equations: Equations, interval: Interval, q0: State, p0: State
) -> tuple[State, State, StepInfo]:
    """The map Φ_h of (12)–(13): (q0, p0) at t0 → (q1, p1) at t1.

    p1 = p0 + h (−∂H_D/∂q0 + εW)(t0, t1, q0, p1)      solved for p1 where p1 enters
    q1 = q0 + h ∂H_D/∂p1 (t0, t1, q0, p1)
    """
    p1, info = _increment(
        lambda p1: equations.momentum_rate(interval, q0, p1),
        p0,
        interval.h,
        equations.newton,
        explicit=equations.step_is_explicit(interval, q0),
    )
    q1 = q0 + interval.h * equations.position_rate(interval, q0, p1)
    return q1, p1, judge(info, q1, p1)


def inverse_step(
    equations: Equations, interval: Interval, q1: State, p1: State
) -> tuple[State, State, StepInfo]:
    """The inverse Φ_h⁻¹ of `step`: (q1, p1) at t1 → (q0, p0) at t0.

    q0 = q1 − h ∂H_D/∂p1 (t0, t1, q0, p1)             solved for q0 where q0 enters
    p0 = p1 − h (−∂H_D/∂q0 + εW)(t0, t1, q0, p1)
    """
    q0, info = _increment(
        lambda q0: equations.position_rate(interval, q0, p1),
        q1,
        -interval.h,
        equations.newton,
        explicit=equations.inverse_is_explicit(interval, q1),
    )
    p0 = p1 - interval.h * equations.momentum_rate(interval, q0, p1)
    return q0, p0, judge(info, q0, p0)


def adjoint_step(
    equations: Equations, interval: Interval, q0: State, p0: State
) -> tuple[State, State, StepInfo]:
    """The adjoint Φ*_h = (Φ_{−h})⁻¹: (q0, p0) at t0 → (q1, p1) at t1.

    It is the inverse of the step that walks the interval backwards; H_D and W are
    evaluated at (t1, t0, q1, p0).
    """
    return inverse_step(equations, interval.reversed(), q0, p0)


def _increment(rate, x0, h, newton, explicit) -> tuple[State, RootInfo]:
    """x1 = x0 + h rate(x1), by one evaluation if `rate` ignores x1, else by Newton's method."""
    guess = x0 + h * rate(x0)
    if explicit:
        real = jnp.finfo(x0.dtype).dtype
        return guess, RootInfo(jnp.asarray(0, jnp.int32), jnp.zeros((), real), jnp.asarray(True))
    shape = x0.shape
    known = x0.ravel()

    def residual(x1):
        return x1 - known - h * rate(x1.reshape(shape)).ravel()

    x1, info = find_root(residual, guess.ravel(), known, newton)
    return x1.reshape(shape), info


def judge(info: RootInfo, q: State, p: State) -> StepInfo:
    """What became of a step: its solve, and whether the state that it led to is finite."""
    finite = jnp.all(jnp.isfinite(q)) & jnp.all(jnp.isfinite(p))
    result = RESULTS.where(info.converged, RESULTS.successful, RESULTS.not_converged)
    result = RESULTS.where(finite, result, RESULTS.not_finite)
    return StepInfo(result, info.iterations, info.residual)
