"""The constants of a trajectory, and what the loop over its steps carries and saves."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from ..base.reads import Reads
from ..base.results import RESULTS
from ..base.types import Args, Bindable, Interval, Scalar, State
from ..engine.pairs import rounded
from ..lattices import Lattice
from ..methods import Method
from ..methods.step import Equations
from ..observe import Deviations, Reduction, Running, Stop, is_observable
from ..problem.noise import NoisePath
from .arithmetic import Arithmetic, FloatingPoint


class Task(eqx.Module):
    """The constants of a trajectory."""

    equations: Equations
    method: Method
    lattice: Lattice
    observe: PyTree
    t0: Scalar
    h: Scalar
    arithmetic: Arithmetic = FloatingPoint()
    stop: Stop | None = None
    reads: Reads = eqx.field(static=True, default=())
    path: NoisePath | None = None

    @property
    def args(self) -> Args:
        return self.equations.args

    def interval(self, k: Int[Array, ""]) -> Interval:
        """The interval of step k; of a lattice with a memory, of the first step only."""
        return self.in_precision(self.lattice.interval(self.t0, self.h, k))

    def equations_at(self, k: Int[Array, ""], interval: Interval) -> Equations:
        """The equations of step k, with the increments of its noise."""
        if self.path is None:
            return self.equations
        return dataclasses.replace(self.equations, increments=self.path.increments_of(k, interval))

    def first_interval(self) -> Interval:
        """The interval of step 0."""
        return self.interval(jnp.asarray(0, jnp.int32))

    def in_precision(self, interval: Interval) -> Interval:
        # The times of a user may be float64 where the state is float32, which sets the precision.
        return Interval(*(x.astype(self.h.dtype) for x in interval))

    def observables(self) -> tuple[list[Callable], list[Reduction]]:
        """The functions without a reduction, and the reductions, in tree order."""
        alone = [self.bound(f) for f in self._leaves() if not isinstance(f, Reduction | Running)]
        found = [f.reduction if isinstance(f, Running) else f for f in self._leaves()]
        return alone, [f for f in found if isinstance(f, Reduction)]

    def at_save(self, carry: "Carry", taken: "StepTaken | None") -> list[Any]:
        """The values of functions without a reduction and the running values of reductions, in tree
        order, at a save point after the step `taken`."""
        # A running value is NaN after a failure: the reduction still has that of the steps before.
        memories, values = iter(carry.reductions), []
        for f in self._leaves():
            if isinstance(f, Running):
                value = self.finished(f.reduction, next(memories))
                values.append(or_nan(carry.result == RESULTS.successful, value))
            elif isinstance(f, Reduction):
                next(memories)
            else:
                assert taken is not None
                values.append(taken.value(self.bound(f), self.args))
        return values

    def evaluate(self, reduction: Reduction, function: Callable, *args: Any) -> Any:
        """``function(*args)``, a part of the reduction, in the arithmetic of the run."""
        # Deviation vectors and recorded steps are values in floating point.
        if isinstance(reduction, Deviations) or not reduction.has_running_value:
            return function(*rounded(args))
        return self.arithmetic.evaluated(function)(*args)

    def finished(self, reduction: Reduction, memory: Any) -> Any:
        """The reduced value of a memory."""
        return rounded(self.evaluate(reduction, reduction.finish, memory))

    def _leaves(self) -> list[Any]:
        return jax.tree.leaves(self.observe, is_leaf=is_observable)

    @property
    def has_running_values(self) -> bool:
        """Whether a reduction has a value at every save point."""
        return any(isinstance(f, Running) for f in self._leaves())

    @property
    def has_deviations(self) -> bool:
        """Whether a reduction follows deviation vectors, for which steps are differentiated."""
        return any(isinstance(r, Deviations) for r in self.observables()[1])

    def bound(self, observable: Callable) -> Callable:
        """The observable, bound to the system and ε if it requires them."""
        if isinstance(observable, Bindable):
            return observable.bind(self.equations.system, self.equations.epsilon)
        return observable


class Carry(NamedTuple):
    """State between steps; k is the number of the next one."""

    k: Int[Array, ""]
    q: State
    p: State
    lattice: Any
    result: RESULTS
    failed_step: Int[Array, ""]
    failed_residual: Float[Array, "2"]
    iterations: Int[Array, ""]
    residual: Float[Array, "2"]
    reductions: list[Any]
    beside: Any = None  # memory of the arithmetic
    stop: Any = None  # with a `Stop`: the last step, as a row


class StepTaken(NamedTuple):
    """One step, the arguments of an observable."""

    t0: Scalar
    t1: Scalar
    q0: State
    p0: State
    q1: State
    p1: State

    def value(self, observable: Callable, args: Args) -> Array:
        return jnp.asarray(observable(*self, args))

    def number(self, observable: Callable, args: Args) -> Array:
        """The value for a reduction, as real numbers also if it is integer or boolean."""
        value = self.value(observable, args)
        if not jnp.issubdtype(value.dtype, jnp.inexact):
            value = value.astype(self.q1.dtype)
        # The barrier keeps a product in the value from being contracted (FMA) with the difference
        # in a reduction: equal values would then have a drift of one rounding error.
        return lax.optimization_barrier(value)


class Saved(NamedTuple):
    """The saved values of a step."""

    t: Array
    h: Array
    q: Array
    p: Array
    observed: list[Any]
    inner: Any = None  # checkpoints since the save point before, for a reversible gradient


class Outcome(NamedTuple):
    """Result of the loop: last carry, saved states with the start in front, reduced observables,
    and the largest error of a reconstructed state if it was requested."""

    carry: Carry
    saved: Saved
    reduced: list[Any]
    round_trip_defect: Array | None = None


def or_nan(good: Array, x: Any) -> Any:
    """x where it is good, else NaN."""
    return jax.tree.map(lambda x: jnp.where(good, x, jnp.full_like(x, jnp.nan)), x)
