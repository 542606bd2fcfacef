"""Checks before a run: observables, jumps, noise, and the memory of its results."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import batch_size, is_traced
from lanewise.primitive import generates

from ..base.checks import array, function as check_function, instance, one_of
from ..base.machine import results_memory
from ..base.signature import array_type, notes_of, output_of
from ..lattices import Lattice, Run
from ..methods import Method
from ..observe import (
    FORMS,
    ConstraintForce,
    Deviations,
    Range,
    Reduction,
    Running,
    Section,
    has_initial_value,
    is_observable,
)
from ..observe._kept import KeptSteps
from ..observe.solution import Save
from ..problem.paths import Brownian, BrownianPath, NoisePath
from .adjoints import Direct
from .arithmetic import Compensated, FloatingPoint
from .integrator import Integrator
from .task import Plan, Task


def check_observe(task: Task, q0: Array, p0: Array) -> tuple[int, int]:
    """**Raises** `TypeError` or `ValueError` for observables that are not functions of a step with
    an array as value. **Returns** the bytes of those without a reduction, at one save point, and of
    the reductions."""
    at_save, of_reductions = 0, 0
    if task.stop is not None:
        output_of("g(t, q, p, args) of Stop", task.stop.g, task.t0, q0, p0, task.args)
    for leaf in jax.tree.leaves(task.observe, is_leaf=is_observable):
        is_class = isinstance(leaf, type) and issubclass(leaf, Reduction | Running)
        if is_class or not is_observable(leaf):
            value = f"the class {leaf.__name__} (no object)" if is_class else f"{leaf!r:.200}"
            raise TypeError(
                f"observe must be a function of {FORMS}, a reduction such as dvi.MaxDrift(f), or a "
                f"dict, list or tuple of these, got {value}."
            )
        if isinstance(leaf, Running):
            leaf = leaf.reduction
        if isinstance(leaf, Deviations):
            _check_deviations(leaf, task, q0)
            continue
        function = _function_of(leaf)
        name = getattr(function, "__name__", type(function).__name__)
        check_function(f"the argument of {type(leaf).__name__}", function, FORMS)
        t0, bound = task.t0, task.bound(function)
        subject = f"the observable {'Section' if isinstance(leaf, Section) else repr(name)}"
        hint = "Stack several values with jnp.stack, or observe a dict of functions."
        value = output_of(subject, bound, t0, t0, q0, p0, q0, p0, task.args, hint=hint)
        if isinstance(leaf, Range) and jnp.issubdtype(jnp.result_type(value), jnp.complexfloating):
            raise TypeError(
                f"dvi.Range requires real values, but {name!r} returns complex ones: observe their "
                "real or imaginary part, or absolute value."
            )
        size = int(np.prod(np.shape(value), dtype=int)) * jnp.result_type(value).itemsize
        if isinstance(leaf, Reduction):  # a Section has a row for each crossing
            of_reductions += size * getattr(leaf, "capacity", 1)
        else:
            at_save += size
    return at_save, of_reductions


def check_jumps(task: Task, request: Run, q0: Array, p0: Array) -> Task:
    """The task, which knows whether a jump changes args. **Raises** `ValueError` or `TypeError` for
    jumps that cannot be made, or not together with its other options."""
    point = task.t0, q0, p0, task.args
    for jump in task.jumps:
        output_of("g(t, q, p, args) of Jump", jump.g, *point)
        with notes_of("map of Jump"):
            image = eqx.filter_eval_shape(jump.map, *point)
        hint = "Return (q, p), or (q, p, args)."
        instance("map(t, q, p, args) of Jump", image, tuple, "a function with a tuple", hint)
        one_of("the number of values of map of Jump", len(image), (2, 3), hint)
        for name, value in zip("qp", image, strict=False):
            value = array_type(f"{name} of map of Jump", value)
            array(f"{name} of map of Jump", value, q0.shape, integers=True)
        if len(image) == 3:
            shapes = [jax.tree.map(jnp.shape, args) for args in (image[2], task.args)]
            hint = "Return all parameters of the run."
            one_of("shapes of args of map of Jump", shapes[0], shapes[1:], hint)
            task = dataclasses.replace(task, changes_args=True)
    leaves = jax.tree.leaves(request.observe, is_leaf=is_observable)
    leaves = [leaf.reduction if isinstance(leaf, Running) else leaf for leaf in leaves]
    functions = [getattr(x, "function", x) if isinstance(x, Reduction) else x for x in leaves]
    pairs = zip(leaves, functions, strict=True)
    others = [f for leaf, f in pairs if not isinstance(leaf, Deviations | KeptSteps)]
    has_points = request.save.ts is not None or any(isinstance(x, KeptSteps) for x in leaves)
    system = task.equations.system
    refuse_first(
        {
            "jump cannot be used with noise: its path is not known within a step.": (
                system.noise is not None
            ),
            "jump cannot be used for a system with a constraint, because the state after a jump "
            "need not satisfy it.": system.constraint is not None,
            f"jump requires arithmetic=dvi.FloatingPoint(), got {task.arithmetic!r:.200}.": (
                not task.arithmetic.is_plain
            ),
            f"jump requires steps that do not depend on those before: dvi.Uniform(), "
            f"dvi.Given(ts) or dvi.TimeTransformed(g), got {task.lattice!r:.200}.": (
                task.lattice.has_memory
            ),
            "jump cannot be used with an observable of a step, whose ends would lie on both sides "
            "of a jump: observe functions (q, p) or (t, q, p, args).": (
                not all(map(has_initial_value, others))
            ),
            "a Jump that changes args cannot be used with dvi.Section, dvi.Save(ts=...) or "
            "deviation vectors: let map return (q, p), or save steps with dvi.Save(every=m).": (
                task.changes_args and (has_points or task.has_deviations)
            ),
        }
    )
    return task


def refuse_first(conditions: dict[str, bool]) -> None:
    """**Raises** `ValueError` with the first message that applies."""
    messages = [message for message, applies in conditions.items() if applies]
    if messages:
        raise ValueError(messages[0])


def _check_deviations(leaf: Deviations, task: Task, q0: Array) -> None:
    # The derivative of a step is taken at a fixed h; the derivative of h would be missing.
    if task.lattice.has_memory:
        raise ValueError(
            f"{type(leaf).__name__} requires steps whose size does not depend on the state: "
            f"lattice=dvi.Uniform() or dvi.Given(ts), got {task.lattice!r}."
        )
    eqx.filter_eval_shape(leaf.start, jnp.zeros(2 * q0.size, q0.dtype))  # counts and units


def noise_path(
    run: Run, path: BrownianPath | None, integrator: Integrator, method: Method, h, num_steps: int
) -> NoisePath | None:
    """The path for a run, None without noise. **Raises** `ValueError` if they do not fit."""
    noise = run.system.noise
    if noise is None and path is None:  # nearly every run
        return None
    lattice, arithmetic = integrator.lattice, integrator.arithmetic
    observables = jax.tree.leaves(run.observe, is_leaf=is_observable)
    has_section = any(isinstance(observable, Section) for observable in observables)
    is_adaptive = lattice.has_memory or type(lattice).transform is not Lattice.transform
    # What the user has to change first comes first.
    conditions = {
        "path has no effect without noise: leave it out, or give noise= in dvi.System.": (
            noise is None
        ),
        "path must be given for a system with noise: path=dvi.Brownian(jax.random.key(0)), or an "
        "integer, the seed of a key.": path is None,
        f"method={method!r:.200} is not a method for systems with noise: use dvi.BAOAB() or "
        "dvi.OBABO() for noise on the momenta, dvi.StochasticEuler() for any noise.": (
            not method.increments
        ),
        # The path would not be independent of the state.
        f"lattice={lattice!r:.200} cannot be used with noise, because its steps depend on the "
        "state: use dvi.Uniform() or dvi.Given(ts).": is_adaptive,
        f"arithmetic={arithmetic!r:.200} cannot be used with noise: use dvi.FloatingPoint() or "
        "dvi.Compensated().": not isinstance(arithmetic, FloatingPoint | Compensated),
        f"h must be positive for a system with noise, got h={h}.": not is_traced(h) and not h > 0,
        f"path={path!r:.200} must have areas for method={method!r:.200}: use dvi.Brownian(key), or "
        "implement the method areas of dvi.BrownianPath.": (
            method.needs_areas and getattr(type(path), "areas", None) is BrownianPath.areas
        ),
        "dvi.ConstraintForce cannot be used with noise, because white noise is a part of it.": any(
            isinstance(_function_of(observable), ConstraintForce) for observable in observables
        ),
        # Between the ends of a step only some paths are known.
        f"path={path!r:.200} cannot be used with dvi.Save(ts=...), dvi.Stop and dvi.Section, which "
        "need states within a step: use dvi.Brownian(key), or implement the method part of "
        "dvi.BrownianPath.": (
            (run.save.ts is not None or run.stop is not None or has_section)
            and getattr(type(path), "part", None) is BrownianPath.part
        ),
    }
    refuse_first(conditions)
    assert noise is not None
    assert path is not None
    path.check(num_steps)
    count = noise.count(run.t0, run.q0, run.p0, run.args)
    # What a path of the user contains is what the user wants.
    limit = method.largest_increment if isinstance(path, Brownian) else None
    return NoisePath(path, method.increments, count, limit, method.needs_areas)


def _function_of(observable: Any) -> Any:
    """The function that an observable evaluates."""
    observable = observable.reduction if isinstance(observable, Running) else observable
    return observable.function if isinstance(observable, Reduction) else observable


_COPIES = {False: 2.5, True: 4.5}
"""Memory of a run, and of a run and its derivative, relative to that of the saved states: measured,
1.2 to 2.6 and 3.4 to 5.8. XLA holds those of the loop, with the initial state in front, the result,
and their cotangents."""


def check_memory(
    save: Save, plan: Plan, q0: Array, observed: tuple[int, int], leaves: list[Any], integrator: Any
) -> None:
    """**Raises** `ValueError` for a run that no memory can hold; `observed`: the bytes of
    observables at a save point, and of reductions."""
    memory, (at_save, of_reductions) = results_memory(), observed
    num_states = plan.num_blocks + 1 + plan.save_tail if save.ts is None else save.ts.shape[0]
    row = (2 * q0.size + 2) * q0.dtype.itemsize + at_save  # q, p, t and h
    lanes, is_compiled, is_differentiated = batch_size(leaves)
    size = lanes * (num_states * row + of_reductions)
    # Reverse mode through the scan stores values of each step, among them the states before it;
    # `Reversible` stores some states between save points.
    is_stored = is_differentiated and isinstance(integrator.adjoint, Direct)
    every = 1 if is_stored else getattr(integrator.adjoint, "checkpoint_every", plan.num_steps + 1)
    num_stored = plan.num_blocks * ((plan.block - (not is_stored)) // every) + plan.tail // every
    num_stored *= is_differentiated
    needed = _COPIES[is_differentiated] * size
    needed += 2 * lanes * num_stored * 2 * q0.size * q0.dtype.itemsize
    if save.ts is not None:  # the steps that contain the times are stored before these states
        needed += lanes * num_states * (1 + is_differentiated) * (row + 2 * q0.dtype.itemsize + 4)
    if memory is None or needed <= memory:
        return
    # XLA does not compute results that the function around this one does not use.
    if is_compiled and (integrator.layout.form == "arrays" or not generates()) and not is_stored:
        return
    is_reduced = of_reductions > num_states * row
    remedy = "adjoint=dvi.Reversible()" if is_stored else "a larger checkpoint_every"
    remedy = "a smaller max_crossings, or smaller values in reductions" if is_reduced else remedy
    remedy = f"Take {remedy}. " * (is_stored or is_reduced or num_stored > num_states)
    batch = f" of each of {lanes} trajectories" if lanes > 1 else ""
    other = ", run fewer trajectories at once, or use dvi.sweep(store=...)" if lanes > 1 else ""
    raise ValueError(
        f"the results need {size / 2**30:.3g} GiB of memory ({num_states} saved "
        f"state{'s' * (num_states > 1)}{' and reductions' * is_reduced}{batch}), and the run "
        f"{'with its derivative ' * is_differentiated}{needed / 2**30:.3g} GiB, but only "
        f"{memory / 2**30:.3g} GiB are available. {remedy}"
        f"Save fewer states with save=dvi.Save(every=m), final=True or ts=times{other}."
    )
