"""A system in extended phase space: time as a position, so that steps may adapt."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from lanewise.jaxapi import is_traced

from ._solution import Save, Solution
from ._system import System
from ._types import Args, Bindable, Scalar, State
from .engine.rounding import one_by_one
from .lattices import TimeTransformed
from .observe import Crossings, Deviations, Reduction, Running, Section, Stop, Stopped, Trend


class Extended(eqx.Module):
    """The transformed problem of `TimeTransformed`.

    Positions are (q, t) and momenta (p, p_t), flattened, shape (n + 1,).
    """

    system: System
    speed: Callable[..., Any]
    epsilon: Scalar
    shape: tuple[int, ...] = eqx.field(static=True)

    def start(self, t: Scalar, q: State, p: State, args: Args) -> tuple[Array, Array]:
        """The extended state, on K = 0."""
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
        del s0, s1
        q, p, t, pt = self.parts(position, momentum)
        H = self.system.hamiltonian(t, t, q, p, self.epsilon, args)
        return jnp.asarray(self.speed(t, q, p, args), H.dtype) * (H + pt)

    def force(self, s0, s1, position, momentum, args):
        """(g εW, −g εW·∂H/∂p)."""
        del s0, s1
        q, p, t, _ = self.parts(position, momentum)
        at = (t, t, q, p, self.epsilon, args)
        W = self.system.disturbing_force(*at)
        power = jnp.sum(W * jax.grad(self.system.hamiltonian, argnums=3)(*at))
        return self.speed(t, q, p, args) * jnp.append(W.ravel(), -power)

    def as_system(self) -> System:
        """K and its force as a `System`, to be run at ε = 1."""
        return System(self.hamiltonian, None if self.system.force is None else self.force)


def _energy(system: System, t: Scalar, q: State, p: State, epsilon: Scalar, args: Args) -> Scalar:
    return system.hamiltonian(t, t, q, p, epsilon, args)


class _Seen(eqx.Module):
    """An observable of the user's on steps of the extended problem."""

    function: Callable[..., Any]
    extended: Extended

    def __call__(self, s0, s1, position0, momentum0, position1, momentum1, args):
        q0, p0, t0, _ = self.extended.parts(position0, momentum0)
        q1, p1, t1, _ = self.extended.parts(position1, momentum1)
        return self.function(t0, t1, q0, p0, q1, p1, args)


class _SeenPoint(eqx.Module):
    """A function ``(t, q, p, args)`` of the user's at points of the extended problem."""

    function: Callable[..., Any]
    extended: Extended

    def __call__(self, s, position, momentum, args):
        q, p, t, _ = self.extended.parts(position, momentum)
        return self.function(t, q, p, args)


def _own_time(t, q, p, args):
    return t


def _time_gained(s0, s1, position0, momentum0, position1, momentum1, args):
    return position1[-1] - position0[-1]


def run_extended(
    integrate: Callable[..., Solution],
    system: System,
    lattice: TimeTransformed,
    q0: State,
    p0: State,
    t0: Scalar,
    epsilon: Scalar,
    args: Args,
    observe: Any,
    is_observable: Callable[[Any], bool],
    save: Save,
    stop: Stop | None,
    **settings: Any,
) -> Solution:
    """`integrate` on the extended problem, told as a solution of the one that was given."""
    extended = Extended(system, lattice.speed, epsilon, q0.shape)
    _check_speed(lattice.speed, t0, q0, p0, args)

    def seen(observable):
        if not is_observable(observable):
            return observable  # refused by name further on
        if isinstance(observable, Running):
            return Running(seen(observable.reduction))
        if isinstance(observable, Trend):
            raise ValueError(
                "a Trend over a TimeTransformed lattice would be a slope in its fictitious time: "
                "observe the function alone and fit a line to it over solution.ts."
            )
        if isinstance(observable, Deviations):
            raise ValueError(
                f"{type(observable).__name__} needs steps whose size does not depend on the state, "
                "and those of a TimeTransformed lattice do: take lattice=dvi.Uniform() or "
                "dvi.Given(ts)."
            )
        if isinstance(observable, Section):
            return eqx.tree_at(lambda s: s.g, observable, _SeenPoint(observable.g, extended))
        if isinstance(observable, Reduction):
            return eqx.tree_at(lambda r: r.function, observable, seen(observable.function))
        if isinstance(observable, Bindable):
            observable = observable.bind(system, epsilon)
        return _Seen(observable, extended)

    def told(crossing):
        if isinstance(crossing, Crossings):
            q, p, t, _ = extended.parts(crossing.qs, crossing.ps)
            return Crossings(t, q, p, crossing.count)
        if isinstance(crossing, Stopped):
            q, p, t, _ = extended.parts(crossing.q, crossing.p)
            return Stopped(t, q, p)
        return crossing

    if save.ts is not None:
        save = Save(ts=save.ts, clock=_SeenPoint(save.clock or _own_time, extended))
    if stop is not None:
        stop = Stop(_SeenPoint(stop.g, extended))
    solution = integrate(
        extended.as_system(),
        *extended.start(t0, q0, p0, args),
        epsilon=jnp.ones_like(epsilon) if system.force is not None else jnp.zeros_like(epsilon),
        args=args,
        observe=(jax.tree.map(seen, observe, is_leaf=is_observable), _time_gained),
        save=save,
        stop=stop,
        **settings,
    )
    q, p, t, _ = extended.parts(solution.qs, solution.ps)
    observed, hs = solution.observed
    observed = jax.tree.map(told, observed, is_leaf=lambda x: isinstance(x, Crossings))
    return Solution(t, q, p, hs, observed, solution.result, solution.stats, told(solution.stop))


def _check_speed(speed, t0, q0, p0, args) -> None:
    value = jnp.asarray(speed(t0, q0, p0, args))
    if value.shape != () or (not is_traced(value) and not float(value) > 0):
        raise ValueError(
            "the speed of TimeTransformed must be a positive scalar; at the start it is "
            f"{value if value.shape == () else f'an array of shape {value.shape}'}."
        )
