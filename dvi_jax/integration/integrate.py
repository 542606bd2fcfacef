"""`integrate`, the function that computes one trajectory."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Never

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

import lanewise
from lanewise import Layout
from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import instance, refuse_unknown
from ..base.inputs import as_parameter, as_scalar, start_state
from ..base.progress import bar_of, reporter
from ..engine.guard import nan_where_used
from ..engine.newton import RootSolver
from ..lattices import Lattice, Run
from ..methods import Method
from ..observe import Jump, OfState, Stop, is_observable, of_steps, refuse_slow_time
from ..observe.solution import Save, Solution
from ..problem.paths import as_path
from ..problem.system import System, check_system, of_problem
from .adjoints import AbstractAdjoint
from .arithmetic import Arithmetic
from .integrator import Integrator, chosen
from .loop import results_of, run, start, with_start, with_tail
from .outcome import as_solution, raise_on_failure, with_initial_values
from .preparation import PreparedRun, prepare, steps_of
from .task import Carry, Outcome, Plan, Task

_MOST_REPORTS = 100
"""Maximum number of progress reports of a run."""


def integrate(
    system: Any,
    q0: Any = None,
    p0: Any = None,
    *,
    h: Any = None,
    num_steps: int | None = None,
    t0: Any = 0.0,
    t1: Any = None,
    duration: Any = None,
    epsilon: Any = None,
    args: PyTree = None,
    method: Method | str | None = None,
    lattice: Lattice | None = None,
    save: Save = Save(),
    observe: PyTree = None,
    adjoint: AbstractAdjoint | None = None,
    newton: RootSolver | None = None,
    root_finder: RootSolver | None = None,
    arithmetic: Arithmetic | None = None,
    layout: Layout | None = None,
    integrator: Integrator | None = None,
    stop: Stop | None = None,
    jump: Jump | Sequence[Jump] | None = None,
    path: Any = None,
    throw: bool = True,
    progress: bool | Callable[[int, int], None] | None = None,
    **unknown: Never,
) -> Solution:
    r"""One trajectory of a perturbed discrete Hamiltonian system.

    Iterates the map of `method`, by default (see `Integrator`) the paper's (12)–(13),

        q1 = q0 + h ∂H_D/∂p1,    p1 = p0 − h ∂H_D/∂q0 + h ε W(t0, t1, q0, p1).

    **Arguments**

    - `system`: a `System`; or a problem of the library, such as ``systems.kepler()``, which has
      defaults for q0, p0, h and args.
    - `q0`, `p0`: initial conditions, real arrays of one shape (any: ``(n,)``, ``(bodies, 3)``).
    - `h`: step size [time], not 0; negative to integrate backwards. `num_steps`: number of steps;
      static. In place of it, with equal steps: `t1`, the final time, or `duration`, t1 − t0; both
      are multiples of h, and static.
    - `t0`: initial time. `epsilon`: strength of the perturbation. A system with a force or a
      perturbation needs it (0.0: the unperturbed motion).
    - `args`: pytree that H_D, W and the observables receive.
    - `method`: an object, or its name such as "strang" or "KahanLi8": `TypeII`, `Adjoint`,
      `Strang`, the compositions `Yoshida`, `Suzuki`, `BlanesMoan`, `McLachlan`, `KahanLi`,
      `Composition`; `GaussLegendre`, `LobattoIIIAIIIB`; `RungeKutta4`.
    - `lattice`: the time grid: `Uniform()`; `Given(ts)`, which replaces h, num_steps and t0;
      `AdaptiveReversible(g)` and `TimeTransformed(g)`, with adaptive steps of about h g, explicit
      or implicit; or `Variational()`, whose steps solve (14), and h is the first of them.
    - `save`: the states to save, see `Save`.
    - `observe`: pytree of observables → array: functions ``(q, p)`` or ``(t, q, p, args)`` of the
      state, or ``(t0, t1, q0, p0, q1, p1, args)`` of a step. They receive the time t, also where
      H_D receives τ = εt (``slow_time=True``): ``systems.InSlowTime(f)`` is an observable with τ.
      A function of the state is evaluated at every saved state, one of a step on the steps that
      end at a saved state; in `MaxDrift`, `Range`, `Trend`, `Mean`, `Last` it is reduced over every
      step in constant memory. A `Section` finds the crossings of a surface.
    - `layout`: machine code or arrays, see `Layout`.
    - `stop`: a `Stop`, the condition of an early end (a collision, an escape); or None.
    - `jump`: a `Jump`, or a list of them: events that change the state (a bounce, a kick); or None.
    - `adjoint`: the computation of reverse-mode gradients: `Reversible`, `Checkpointed`, `Direct`.
    - `root_finder`, or `newton`: the solver of implicit steps: `PicardThenNewton`, `Newton`,
      `SimplifiedNewton`, `Picard`.
    - `arithmetic`: the representation of the state: `FloatingPoint`; for long runs `Compensated`,
      or `FixedPoint`, whose explicit steps can be undone bit for bit; `DoubleDouble`, 31 digits.
    - `integrator`: an `Integrator` in place of method, lattice, adjoint, newton, arithmetic and
      layout.
    - `path`: of a system with noise: a `Brownian` path, or an integer, the seed of one. The method
      is one for noise: `BAOAB`, `OBABO`, `StrongSplitting`, `StochasticEuler`,
      `StochasticMidpoint`.
    - `throw`: raise an error if the trajectory fails; otherwise read ``solution.result``.
    - `progress`: True shows a progress bar. A function is called as
      ``progress(steps_done, num_steps)`` at save points, at most about a hundred times during the
      run. The numbers are the same, bit for bit. Not under jit, vmap or grad.

    h, t0, epsilon, args, q0, p0 and the times of `Given` are traced: they may be batched by
    `vmap` and differentiated by `grad` and `jvp`. The precision is that of q0 and p0.

    **Returns** a `Solution`; time is the first axis of its saved values.

    **Raises** `ValueError` or `TypeError` for invalid input (shapes, types, values), and for
    results that need more memory than there is;
    `IntegrationError` when the trajectory fails and `throw` is True, with the status, the step
    and the residual (inside jit or vmap an equinox runtime error with the status).

    **Accuracy** order of the method in h. If h is small enough, the energy error of a symplectic
    method without perturbing force is O(h^order) and does not grow over very long times. Gradients
    are those of the discrete map, by the implicit function theorem through each solve.

    **Example**

    ```python
    kepler = systems.kepler()                                # a library of systems brings its start
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1,
                        num_steps=1000, epsilon=0.01, method=dvi.Strang(), save=dvi.Save(every=10),
                        observe={"drift": dvi.MaxDrift(kepler.observables["energy"])})
    print(sol.status, sol.ts.shape, sol.qs.shape)
    # successful (101,) (101, 2)
    print(round(float(sol.observed["drift"]), 4))
    # 0.0627
    ```
    """
    refuse_unknown("integrate", integrate, unknown)
    problem, (system, q0, p0, default_h, args) = (
        system,
        of_problem(system, q0, p0, h, args, jumps_allowed=True),
    )
    check_system(system, noise_allowed=True)
    options = {"method": method, "lattice": lattice, "adjoint": adjoint, "newton": newton}
    options |= {"root_finder": root_finder, "arithmetic": arithmetic, "layout": layout}
    integrator = chosen(integrator, **options)
    instance("save", save, Save, "a dvi.Save(...)", _save_hint(save))
    instance("stop", stop, Stop | None, "a dvi.Stop(g)")
    jumps: Any = tuple(jump) if isinstance(jump, list | tuple) else (jump,)
    jumps = getattr(problem, "jumps", ()) if jump is None else jumps
    for entry in jumps:
        instance("jump", entry, Jump, "a dvi.Jump(g, map), or a list of them")
    q0, p0 = start_state(q0, p0)
    check = getattr(problem, "check", None)
    if check is not None and not any(map(is_traced, jax.tree.leaves((q0, p0, args)))):
        check(q0, p0, args)
    if observe is not None:
        observe = of_steps(observe)
    grid = integrator.lattice
    if system.slow_time:
        refuse_slow_time(observe, stop, jumps, save.clock, getattr(grid, "speed", None))
    # The h of a problem does not count where the times are given.
    h = default_h if type(grid).takes_h else h
    t0, h, num_steps = steps_of(grid, t0, h, num_steps, t1, duration)
    t0 = as_scalar("t0", t0, q0.dtype)
    h = as_scalar("h", h, q0.dtype, zero_allowed=False)
    epsilon = as_scalar("epsilon", System.strength(system, epsilon), q0.dtype)
    args = jax.tree.map(as_parameter, args)
    request = Run(system, t0, q0, p0, epsilon, args, observe, save, stop, jumps)
    trajectory = prepare(request, integrator, h, num_steps, as_path(path))
    solution = solve(trajectory, progress)
    return raise_on_failure(solution, trajectory.task, request) if throw else solution


def solve(trajectory: PreparedRun, progress: Any = None) -> Solution:
    """The solution of a run; its status may be that of a failure."""
    request, task, plan, q0, p0, observe, undo, adjoint, layout, has_tracer = trajectory
    if progress is None or progress is False:
        solution = _in_one_program(task, plan, observe, q0, p0, adjoint, layout)
    elif has_tracer:
        raise ValueError("progress cannot be reported inside of jax.jit or another transformation.")
    elif getattr(adjoint, "report_defect", False):
        raise ValueError(
            "dvi.Reversible(report_defect=True) cannot be combined with progress: leave one out."
        )
    else:
        with _reporter(progress) as report:
            outcome = _in_pieces(task, plan, q0, p0, report, layout)
        solution = _solution(task, plan, observe, outcome, q0, p0, layout)
    solution = undo(solution)
    if request.observe is None or request.save.ts is not None:
        return solution
    observables = jax.tree.leaves(request.observe, is_leaf=is_observable)
    # In the variables of the request: those of the lattice may have no initial state of this form.
    if any(isinstance(observable, OfState) for observable in observables):
        return with_initial_values(solution, request, layout, task.reads)
    return solution


def _columns(steps: tuple[int, int]) -> dict[str, Any]:
    text = f"{steps[0]} of {steps[1]} steps"
    return {"completed": steps[0], "total": steps[1], "steps": text}


@contextmanager
def _reporter(progress: Any) -> Iterator[Callable[[int, int], Any]]:
    """A context with the function that receives the steps that are complete, and all steps."""
    if callable(progress):
        yield progress
        return
    with reporter(progress, bar_of("integrate", ("steps",), _columns)) as report:
        assert report is not None  # `progress` is True here
        yield lambda *steps: report(steps)


def _save_hint(save: Any) -> str:
    if isinstance(save, int):
        return f"Take dvi.Save(every={save})."
    return "Take dvi.Save(final=True)." if save == "final" else ""


# Compiled here, not by the user: a call without jax.jit takes one program, that of its shapes.
@eqx.filter_jit
def _in_one_program(
    task: Task, plan: Plan, observe: PyTree, q0, p0, adjoint: AbstractAdjoint, layout: Layout
) -> Solution:
    # A loss that uses a NaN of the solution, wherever it comes from, has no number as its gradient.
    arrays, functions = eqx.partition((task, q0, p0), eqx.is_array)
    rest: list[Solution] = []  # what is no array, such as the number of steps

    def solution_of(arrays):
        task, q0, p0 = eqx.combine(arrays, functions)
        outcome = adjoint.rollout(task, plan, q0, p0, layout)
        solution = as_solution(task, plan, observe, outcome, q0, p0, layout)
        values, others = eqx.partition(solution, eqx.is_array)
        rest.append(others)
        return values

    values = nan_where_used(solution_of, arrays)
    return eqx.combine(values, rest[-1])


_solution = eqx.filter_jit(as_solution)


# The parts of a run with progress. Each is compiled for itself; the carry between them has all that
# a step depends on, so that the numbers are those of one run.
@eqx.filter_jit
def _piece(task: Task, plan: Plan, state: Any, layout: Layout):
    arrays, functions = eqx.partition(task, eqx.is_array)

    def piece(arrays, state):
        task = eqx.combine(arrays, functions)
        # The start is a part of the first piece: the length of the arrays of a loop decides how the
        # whole program is compiled, on which the last bits depend.
        carry = state if isinstance(state, Carry) else start(task, *state)
        carry, rows, tail = run(task, plan, carry, lax.scan)
        return carry, with_tail(plan, rows, tail)

    return lanewise.call(piece, arrays, state, layout=layout)


def _in_pieces(task: Task, plan: Plan, q0, p0, report, layout) -> Outcome:
    """The same run in pieces between save points, with a report after each."""
    # Whole blocks, and as many in each piece (the last one may have fewer): one program serves all.
    size = max(1, -(-plan.num_blocks // _MOST_REPORTS))
    state: Any = q0, p0
    blocks, parts, is_last = 0, [], False
    while not is_last:
        count = min(size, plan.num_blocks - blocks)
        blocks += count
        is_last = blocks >= plan.num_blocks
        tail = (plan.tail, plan.save_tail) if is_last else (0, False)
        state, rows = _piece(task, Plan(count, plan.block, *tail), state, layout)
        # JAX computes asynchronously: without waiting all reports would come at the beginning.
        jax.block_until_ready(state)
        parts.append(rows if parts else with_start(rows, q0, p0))
        report(plan.num_steps if is_last else blocks * plan.block, plan.num_steps)
    rows = jax.tree.map(lambda *xs: jnp.concatenate(xs), *parts)
    return Outcome(state, rows, results_of(task, state))
