"""The constants of a trajectory, which of its steps are saved, and what the loop carries."""

import dataclasses
import functools
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
from ..engine.guard import all_finite, constant_unless
from ..engine.pairs import rounded
from ..lattices import Lattice
from ..methods import Method
from ..methods.step import Equations
from ..observe import Deviations, Jump, Reduction, Running, Stop, is_observable
from ..observe._kept import KeptSteps
from ..observe._reductions import no_value
from ..observe.solution import Save
from ..problem.paths import NoisePath
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
    jumps: tuple[Jump, ...] = ()
    changes_args: bool = eqx.field(static=True, default=False)
    """Whether a jump changes the parameters, which the loop then carries."""
    reads: Reads = eqx.field(static=True, default=())
    path: NoisePath | None = None
    is_transposed: bool = eqx.field(static=True, default=False)
    """Whether JAX transposes the loop over the steps itself, in reverse mode."""

    @property
    def args(self) -> Args:
        return self.equations.args

    def with_args(self, carry: "Carry") -> "Task":
        """The task with the parameters that a jump may have changed."""
        if not self.changes_args:
            return self
        equations = dataclasses.replace(self.equations, args=carry.args)
        return dataclasses.replace(self, equations=equations)

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
        functions = [
            self.bound(leaf) for leaf in self._leaves() if not isinstance(leaf, Reduction | Running)
        ]
        leaves = [leaf.reduction if isinstance(leaf, Running) else leaf for leaf in self._leaves()]
        return functions, [leaf for leaf in leaves if isinstance(leaf, Reduction)]

    def at_save(self, carry: "Carry", ends: "Ends | None") -> list[Any]:
        """The values of functions without a reduction and the running values of reductions, in tree
        order, at a save point after a step with these ends."""
        good = carry.result == RESULTS.successful
        memories, values = iter(carry.reductions), []
        for leaf in self._leaves():
            if isinstance(leaf, Running):
                # NaN after a failure: the reduction still has the value of the steps before.
                finish = functools.partial(self.finish, leaf.reduction)
                value = self.constant_unless(good, finish)(next(memories))
                values.append(or_nan(good, value))
            elif isinstance(leaf, Reduction):
                next(memories)
            else:
                assert ends is not None
                value = functools.partial(Ends.value, observable=self.bound(leaf), args=self.args)
                values.append(self.constant_unless(good, value, all_finite)(ends))
        return values

    def evaluate(self, reduction: Reduction, function: Callable, *args: Any) -> Any:
        """``function(*args)``, a part of the reduction, in the arithmetic of the run."""
        # Deviation vectors and recorded steps are values in floating point.
        if isinstance(reduction, Deviations) or not reduction.has_running_value:
            return function(*rounded(args))
        return self.arithmetic.interpret(function)(*args)

    def number(self, reduction: Reduction, ends: "Ends") -> Array:
        """The value of the observable of a reduction on a step."""
        function = self.bound(reduction.function)
        return ends.number(function, self.args, reduction.keeps_integers)

    def constant_unless(
        self, good: Array, function: Callable, succeeds: Callable | None = None
    ) -> Callable:
        """The function; for reverse mode a constant where the trajectory is not `good`, or where
        ``succeeds(result)`` is False."""
        if not self.is_transposed:
            return function
        return functools.partial(constant_unless, good, function, succeeds=succeeds)

    def finish(self, reduction: Reduction, memory: Any) -> Any:
        """The reduced value of a memory."""
        return rounded(self.evaluate(reduction, reduction.finish, memory))

    def _leaves(self) -> list[Any]:
        return jax.tree.leaves(self.observe, is_leaf=is_observable)

    @property
    def has_running_values(self) -> bool:
        """Whether a reduction has a value at every save point."""
        return any(isinstance(leaf, Running) for leaf in self._leaves())

    @property
    def records_jumps(self) -> bool:
        """Whether more than the number of jumps is needed."""
        is_kept = any(isinstance(reduction, KeptSteps) for reduction in self.observables()[1])
        return is_kept or any(jump.capacity for jump in self.jumps)

    @property
    def has_deviations(self) -> bool:
        """Whether a reduction follows deviation vectors, for which steps are differentiated."""
        return any(isinstance(reduction, Deviations) for reduction in self.observables()[1])

    def bound(self, observable: Callable) -> Callable:
        """The observable, bound to the system and ε if it requires them."""
        if isinstance(observable, Bindable):
            return observable.bind(self.equations.system, self.equations.epsilon)
        return observable


class Plan(NamedTuple):
    """Steps as blocks of `block` steps with a save after each, then a tail. Static."""

    num_blocks: int
    block: int
    tail: int
    save_tail: bool

    @property
    def num_steps(self) -> int:
        return self.num_blocks * self.block + self.tail


def make_plan(save: Save, num_steps: int) -> Plan:
    block = save.every
    if block is None:
        # Without `every` a run that saves its end only is one block. A block has at least one step.
        saves_end_only = save.final or save.ts is not None
        block = max(num_steps, 1) if saves_end_only else 1
    num_blocks, tail = divmod(num_steps, block)
    return Plan(num_blocks, block, tail, save.final and tail > 0)


def piece_length(count: int, target: int) -> int:
    """The length, about `target`, of the pieces of `count` steps."""
    # A divisor of `count`, if there is one near: with pieces of one length one loop is compiled.
    lengths = range(min(3 * target // 2, count), target // 2, -1)
    return next((n for n in lengths if count % n == 0), target)


def adds_start_outside(plan: Plan) -> bool:
    """Whether the start is added to the saved states after the compiled run, not in it."""
    # Among few states the start is a large fraction, which need not be written for a user who reads
    # the last state only. Among many it is a small fraction, and adding it later copies them all.
    return plan.num_blocks <= 4


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
    remainder: Any = None  # what the arithmetic stores next to q and p
    stop: Any = None  # with a `Stop`: the last step, as a row, and its number
    counts: Any = None  # the sums of `Method.count`
    method_state: Any = None  # of a method with an `InLoop`: the state in its own coordinates
    jumps: Any = None  # with a `Jump`: a `JumpMemory`
    args: Args = None  # where a jump changes them


class Ends(NamedTuple):
    """One step, the arguments of an observable."""

    t0: Scalar
    t1: Scalar
    q0: State
    p0: State
    q1: State
    p1: State

    def value(self, observable: Callable, args: Args) -> Array:
        return jnp.asarray(observable(*self, args))

    def number(self, observable: Callable, args: Args, integers: bool) -> Array:
        """The value for a reduction; as real numbers, unless it may be an integer or boolean."""
        value = self.value(observable, args)
        if not integers and not jnp.issubdtype(value.dtype, jnp.inexact):
            value = value.astype(self.q1.dtype)
        # The barrier keeps a product in the value from being contracted (FMA) with the difference
        # in a reduction: equal values would then have a drift of one rounding error.
        return lax.optimization_barrier(value)


class Rows(NamedTuple):
    """The values at save points, a row for each; or those at one save point."""

    t: Array
    h: Array
    q: Array
    p: Array
    observed: list[Any]
    inner: Any = None  # checkpoints since the save point before, for a reversible gradient


class Outcome(NamedTuple):
    """Result of the loop: last carry, rows with the start in front, results of the reductions, and
    the largest error of a reconstructed state if it was requested."""

    carry: Carry
    rows: Rows
    results: list[Any]
    round_trip_defect: Array | None = None


def or_nan(good: Array, x: Any) -> Any:
    """x where it is good, else NaN."""
    return jax.tree.map(lambda x: jnp.where(good, x, no_value(x)), x)
