"""Adaptive steps by a transformation of time, in extended phase space."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..base.inputs import start_state
from ..base.signature import with_time
from ..base.types import Args, Bindable, Scalar, State
from ..engine.rounding import one_by_one
from ..observe import (
    Crossings,
    Deviations,
    Jump,
    Jumps,
    Reduction,
    Running,
    Section,
    Stop,
    Stopped,
    Trend,
    has_initial_value,
    is_observable,
)
from ..observe.solution import Save, Solution
from ..problem.system import System
from ._base import Lattice, Run, check_speed
from ._uniform import Uniform


class TimeTransformed(Uniform):
    r"""Equal steps in a fictitious time σ with dt = g(t, q, p) dσ: small steps where g is small.

    The trajectory is one of the Hamiltonian (Poincaré, Sundman)

        K(q, t; p, p_t) = g(t, q, p) (H(t, q, p) + p_t),    p_t = −H at the start,

    with t as a position and p_t its momentum. On K = 0 it is a trajectory of H with other steps.
    Every method keeps its structure in the extended phase space; a step size that is chosen at each
    step would destroy it. H is H_D at t1 = t0; a force W becomes g W for p and −g W·∂H/∂p for p_t.

    **Arguments** `speed`: g, function ``(q, p)`` or ``(t, q, p, args)`` → positive scalar; for
    Kepler's problem |q| or |q|^{3/2}, for example.

    `integrate` then interprets `h` as the step of σ [time / unit of g], and takes num_steps of
    them; ``solution.hs`` are the steps of t. Observables receive t. K couples q and p even where
    H_D is separable: every step needs a solve. The map conserves K up to O(h^order), not exactly.

    **Raises** `TypeError` for a speed that is not a function, and in `integrate` `ValueError` for
    one that is not a positive scalar at the start, and for a `Trend`, whose time would be σ.

    **Source** Hairer 1997, *Appl. Numer. Math.* 25, 219; Reich 1999, *SIAM J. Numer. Anal.* 36,
    1549; Hairer, Lubich & Wanner 2006, VIII.2.1.

    **Example**

    ```python
    kepler = systems.kepler()
    slow_near_the_sun = dvi.TimeTransformed(lambda q, p: jnp.sqrt(q @ q))
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1, num_steps=100,
                        lattice=slow_near_the_sun, method=dvi.Strang())
    print(round(float(sol.hs.min()), 3), round(float(sol.hs.max()), 3))
    # 0.083 0.57
    ```
    """

    speed: Callable[..., Any]

    # The steps are equal in σ: their number does not follow from a time t1.
    steps_to = Lattice.steps_to

    def __init__(self, speed: Callable[..., Any]):
        self.speed = with_time("the speed of TimeTransformed", speed)

    def transform(self, run):
        """The run in extended phase space, in the time σ from 0 on."""
        # K contains ε: for the extended problem it is a parameter, which may be traced.
        problem = ExtendedSpace(run.system, self.speed, run.epsilon, run.q0.shape)
        check_speed(type(self).__name__, self.speed, run)
        q0, p0 = start_state(*problem.start(run.t0, run.q0, run.p0, run.args))
        observe = jax.tree.map(problem.on_steps, run.observe, is_leaf=is_observable)
        save, stop = run.save, run.stop
        # Requested times are those of t, which here is a coordinate: a clock reads it.
        if save.ts is not None:
            save = Save(ts=save.ts, clock=_PointFunction(save.clock or _own_time, problem))
        if stop is not None:
            stop = Stop(_PointFunction(stop.g, problem))
        has_force = run.system.force is not None
        system = System(problem.hamiltonian, problem.force if has_force else None)
        # ε is inside of K and its force. Zero without a force: an ε that has no effect warns.
        epsilon = (jnp.ones_like if has_force else jnp.zeros_like)(run.epsilon)
        observe = (observe, _time_gained)  # the second gives ``solution.hs``
        start = jnp.zeros_like(run.t0), q0, p0
        jumps = tuple(map(problem.jump, run.jumps))
        return Run(system, *start, epsilon, run.args, observe, save, stop, jumps), problem.undo


class ExtendedSpace(eqx.Module):
    """The transformed problem: positions (q, t) and momenta (p, p_t), flat, of shape (n + 1,)."""

    system: System
    speed: Callable[..., Any]
    epsilon: Scalar
    shape: tuple[int, ...] = eqx.field(static=True)

    def start(self, t: Scalar, q: State, p: State, args: Args) -> tuple[Array, Array]:
        """The extended state, on K = 0."""
        # Compiled separately: p_t then has the same bits alone and in a batch.
        energy = one_by_one(_energy, self.system, t, q, p, self.epsilon, args)
        return jnp.append(q.ravel(), t), jnp.append(p.ravel(), -energy)

    def parts(self, position: Array, momentum: Array) -> tuple[State, State, Scalar, Scalar]:
        """(q, p, t, p_t); leading axes stay in front."""
        lead = position.shape[:-1]
        q = position[..., :-1].reshape(*lead, *self.shape)
        p = momentum[..., :-1].reshape(*lead, *self.shape)
        return q, p, position[..., -1], momentum[..., -1]

    def hamiltonian(self, s0, s1, position, momentum, args):
        """K = g (H + p_t)."""
        del s0, s1  # K is autonomous, also where H depends on time: t is a coordinate
        q, p, t, pt = self.parts(position, momentum)
        H = self.system.hamiltonian(t, t, q, p, self.epsilon, args)
        return jnp.asarray(self.speed(t, q, p, args), H.dtype) * (H + pt)

    def force(self, s0, s1, position, momentum, args):
        """(g εW, −g εW·∂H/∂p)."""
        del s0, s1
        q, p, t, _ = self.parts(position, momentum)
        point = (t, t, q, p, self.epsilon, args)
        W = self.system.disturbing_force(*point)
        # p_t balances the power of the force, so that K stays 0 although the energy changes.
        power = jnp.sum(W * jax.grad(self.system.hamiltonian, argnums=3)(*point))
        return self.speed(t, q, p, args) * jnp.append(W.ravel(), -power)

    def on_steps(self, observable: Any) -> Any:
        """An observable of the user, evaluated on steps of the extended problem."""
        if not is_observable(observable):
            return observable  # `check_observe` raises for it, and names it
        if isinstance(observable, Running):
            return Running(self.on_steps(observable.reduction))
        if isinstance(observable, Trend):
            raise ValueError(
                "observe must not contain a dvi.Trend with lattice=TimeTransformed(...), since its "
                "slope would be that in fictitious time. Use observe=f, and fit a line."
            )
        if isinstance(observable, Deviations):
            raise ValueError(
                f"{type(observable).__name__} requires lattice=dvi.Uniform() or dvi.Given(ts), "
                "whose steps do not depend on the state."
            )
        if isinstance(observable, Section):
            return eqx.tree_at(lambda s: s.g, observable, _PointFunction(observable.g, self))
        if isinstance(observable, Reduction):
            return eqx.tree_at(lambda r: r.function, observable, self.on_steps(observable.function))
        # Bound here: later it would be bound to the extended system, which the user does not know.
        if isinstance(observable, Bindable):
            observable = observable.bind(self.system, self.epsilon)
        return _Observable(observable, self)

    def jump(self, jump: Jump) -> Jump:
        """A jump of the user, in the extended problem."""
        g, image = _PointFunction(jump.g, self), _Image(jump.map, self)
        return Jump(g, image, jump.returns, jump.capacity)

    def undo(self, solution: Solution) -> Solution:
        """A solution of the extended problem as one of the original problem."""

        def original(value):
            if isinstance(value, Crossings):
                q, p, t, _ = self.parts(value.qs, value.ps)
                return Crossings(t, q, p, value.count)
            return value

        q, p, t, _ = self.parts(solution.qs, solution.ps)
        observed, hs = solution.observed
        observed = jax.tree.map(original, observed, is_leaf=lambda x: isinstance(x, Crossings))
        stop = solution.stop
        if stop is not None:
            q_end, p_end, t_end, _ = self.parts(stop.q, stop.p)
            stop = Stopped(t_end, q_end, p_end)
        jumps = solution.jumps
        if jumps is not None:
            q0, p0, ts, _ = self.parts(jumps.qs_before, jumps.ps_before)
            q1, p1, _, _ = self.parts(jumps.qs_after, jumps.ps_after)
            jumps = Jumps(ts, jumps.index, q0, p0, q1, p1, jumps.count)
        return Solution(t, q, p, hs, observed, solution.result, solution.stats, stop, jumps)


def _energy(system: System, t: Scalar, q: State, p: State, epsilon: Scalar, args: Args) -> Scalar:
    return system.hamiltonian(t, t, q, p, epsilon, args)


class _Observable(eqx.Module):
    """An observable of the user on steps of the extended problem."""

    function: Callable[..., Any]
    space: ExtendedSpace

    @property
    def is_of_state(self) -> bool:
        return has_initial_value(self.function)

    def __call__(self, s0, s1, position0, momentum0, position1, momentum1, args):
        q0, p0, t0, _ = self.space.parts(position0, momentum0)
        q1, p1, t1, _ = self.space.parts(position1, momentum1)
        return self.function(t0, t1, q0, p0, q1, p1, args)


class _PointFunction(eqx.Module):
    """A function ``(t, q, p, args)`` of the user at points of the extended problem."""

    function: Callable[..., Any]
    space: ExtendedSpace

    def __call__(self, s, position, momentum, args):
        q, p, t, _ = self.space.parts(position, momentum)
        return self.function(t, q, p, args)


class _Image(_PointFunction):
    """The map of a jump at points of the extended problem; K is 0 after it."""

    def __call__(self, s, position, momentum, args):
        q, p, *rest = super().__call__(s, position, momentum, args)
        t = position[-1]
        return *self.space.start(t, q, p, rest[0] if rest else args), *rest


# Functions of the module, which are equal in every run: closures would be compiled again.
def _own_time(t, q, p, args):
    return t


def _time_gained(s0, s1, position0, momentum0, position1, momentum1, args):
    return position1[-1] - position0[-1]
