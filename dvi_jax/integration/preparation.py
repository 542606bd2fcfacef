"""What a run needs, from checked arguments: the task, its initial state, and the plan of saves."""

import dataclasses
import functools
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, PyTree

from lanewise import Layout
from lanewise.jaxprs.jaxapi import is_traced

from ..base.keywords import user_level
from ..base.reads import reads
from ..base.signature import output_of
from ..base.types import Interval, State
from ..lattices import Lattice, Run
from ..methods import Method, warn_of_dissipation
from ..methods.constraint import check_start
from ..methods.step import Equations
from ..observe import Deviations, Running, is_observable
from ..observe.solution import Solution
from ..problem.paths import BrownianPath
from ..problem.system import System
from .adjoints import AbstractAdjoint
from .checks import check_jumps, check_memory, check_observe, noise_path
from .dense import requested_times
from .integrator import Integrator
from .task import Plan, Task, make_plan


class PreparedRun(NamedTuple):
    """A run that is ready to start.

    - `task`, `plan`, `q0`, `p0`: what the loop over the steps takes, in the variables of the
      lattice and in the representation of the arithmetic.
    - `observe`: the observables in these variables. `undo`: from a solution in these variables to
      that of `run`, the run that was requested.
    """

    run: Run
    task: Task
    plan: Plan
    q0: State
    p0: State
    observe: PyTree
    undo: Callable[[Solution], Solution]
    adjoint: AbstractAdjoint
    layout: Layout
    has_tracer: bool


def steps_of(
    lattice: Lattice, t0: Any, h: Any, num_steps: Any, t1: Any, duration: Any
) -> tuple[Any, Any, int]:
    """(t0, h, num_steps) of a run. **Raises** `ValueError` or `TypeError` if they do not fit."""
    # Methods of the class, here and below: equinox takes 20 µs to make a bound one of a module.
    kind = type(lattice)
    if t1 is not None or duration is not None:
        num_steps = kind.steps_to(lattice, t0, h, num_steps, t1, duration)
    return kind.prepare(lattice, t0, h, num_steps)


def prepare(
    run: Run, integrator: Integrator, h: Array, num_steps: int, path: BrownianPath | None
) -> PreparedRun:
    """The run in the variables of its lattice. **Raises** `ValueError` or `TypeError` for options
    that do not fit each other, the system or the initial state."""
    # Here and not in `Integrator`: the default method depends on the system.
    method = Integrator.method_for(integrator, run.system)
    # Before anything is compiled: an error in a function of the user would otherwise come from
    # within many frames of tracing.
    System.check_shapes(run.system, run.t0, run.q0, run.p0, run.epsilon, run.args)
    if (constraint := run.system.constraint) is not None:
        components = jax.eval_shape(constraint, run.q0, run.args).size
        run = run._replace(observe=_on_manifold(run.observe, 2 * (run.q0.size - components)))
    lattice, layout = integrator.lattice, integrator.layout
    noise = noise_path(run, path, integrator, method, h, num_steps)
    # The same run in the variables of the lattice, such as a fictitious time.
    image, undo = type(lattice).transform(lattice, run)
    type(lattice).check(lattice, method, integrator.arithmetic)
    task, q0, p0 = _task(image, integrator, method, h)
    if run.jumps:
        task = check_jumps(task, run, q0, p0)
    if noise is not None:
        task = dataclasses.replace(task, path=noise)
    plan = make_plan(run.save, num_steps)
    leaves = jax.tree.leaves((task, q0, p0))
    # An allocation that fails ends the process, or makes the machine swap.
    check_memory(run.save, plan, q0, check_observe(task, q0, p0), leaves, integrator)
    has_tracer = any(is_traced(leaf) for leaf in leaves)
    # Traced values are not known before the compiled program runs: they give a status.
    if not has_tracer:
        _check_start(task, q0, p0)
    if run.save.clock is not None:
        output_of("the clock of Save", run.save.clock, run.t0, run.q0, run.p0, run.args)
    if run.save.ts is not None:
        # The run itself saves nothing at these times: it stores the steps that contain them, and
        # `as_solution` evaluates the method between their ends.
        steps = requested_times(image.save, task, num_steps)
        task = dataclasses.replace(task, observe=steps)
    # A part of the key of compiled programs: with another value one is compiled again.
    vars(task)["reads"] = reads(task, run.observe, integrator.adjoint)
    adjoint, observe = integrator.adjoint, image.observe
    return PreparedRun(run, task, plan, q0, p0, observe, undo, adjoint, layout, has_tracer)


def _on_manifold(observe: PyTree, dimension: int) -> PyTree:
    """The observables of a system with a constraint, whose states are a manifold."""

    # Deviation vectors across the constraint are removed by the first step.
    def convert(leaf: Any) -> Any:
        if isinstance(leaf, Running):
            return Running(convert(leaf.reduction))
        return leaf.on_manifold(dimension) if isinstance(leaf, Deviations) else leaf

    return jax.tree.map(convert, observe, is_leaf=is_observable)


def _check_start(task: Task, q0: State, p0: State) -> None:
    """Checks of the first step, which need numbers that are known."""
    method, equations = task.method, task.equations
    system = equations.system
    first_interval = functools.partial(Task.first_interval, task)
    type(method).check(method, equations, first_interval, q0, p0)
    if system.constraint is not None:
        check_start(equations, task.t0, q0, p0)
    if system.force is not None:
        warn_of_dissipation(method, equations, first_interval, q0, p0)


def _task(run: Run, integrator: Integrator, method: Method, h: Array) -> tuple[Task, State, State]:
    """The trajectory to compute, and its initial state in the representation of the arithmetic."""
    system, epsilon = run.system, run.epsilon
    if not (system.depends_on_epsilon or is_traced(epsilon)) and float(epsilon) != 0:
        warnings.warn(
            f"epsilon = {float(epsilon):g} has no effect: the system has neither a force nor a "
            "perturbation. Leave epsilon out, or add force= or perturbation= in dvi.System(...).",
            stacklevel=user_level(),
        )
    lattice, arithmetic = integrator.lattice, integrator.arithmetic
    equations = Equations(system, epsilon, run.args, integrator.root_finder)

    def first_interval() -> Interval:
        return Interval(run.t0, run.t0 + h, h)

    kind = type(arithmetic)
    equations, q0, p0 = kind.prepare(arithmetic, method, equations, first_interval, run.q0, run.p0)
    task = Task(equations, method, lattice, run.observe, run.t0, h, arithmetic, run.stop, run.jumps)
    return task, q0, p0
