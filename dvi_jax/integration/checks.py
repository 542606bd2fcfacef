"""Checks before a run: its observables, its noise, and the memory of its results."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise import Layout
from lanewise.jaxprs.jaxapi import batch_size, is_traced
from lanewise.primitive import generates

from ..base.checks import function as check_function
from ..base.machine import results_memory
from ..base.signature import tracing_note
from ..lattices import Lattice, Run
from ..methods import Method
from ..observe import FORMS, Deviations, Range, Reduction, Running, Section, is_observable
from ..observe.solution import Save
from ..problem.noise import BrownianPath, NoisePath
from .arithmetic import Compensated, FloatingPoint
from .integrator import Integrator
from .task import Plan, Task


def check_observe(task: Task, q0: Array, p0: Array) -> int:
    """**Raises** `TypeError` or `ValueError` for observables that are not functions of a step with
    an array as value. **Returns** the bytes of those without a reduction, at one save point."""
    size = 0
    for leaf in jax.tree.leaves(task.observe, is_leaf=is_observable):
        if isinstance(leaf, type) and issubclass(leaf, Reduction | Running):
            raise TypeError(
                f"observe contains the class {leaf.__name__}: give an object of this class. "
                "Examples are dvi.MEGNO(), dvi.Running(dvi.MEGNO()) and dvi.MaxDrift(function), "
                f"with a function of {FORMS}."
            )
        if not is_observable(leaf):
            raise TypeError(
                f"observe must be a function of {FORMS}, a reduction such as dvi.MaxDrift(f), "
                f"dvi.Running(reduction), or a dict, list or tuple of these, got {leaf!r:.200}."
            )
        if isinstance(leaf, Running):
            leaf = leaf.reduction
        if isinstance(leaf, Deviations):
            _check_deviations(leaf, task, q0, p0)
            continue
        function = leaf.function if isinstance(leaf, Reduction) else leaf
        called = getattr(function, "__name__", type(function).__name__)
        check_function(f"the argument of {type(leaf).__name__}", function, FORMS)
        t0, bound = task.t0, task.bound(function)
        try:
            out = eqx.filter_eval_shape(bound, t0, t0, q0, p0, q0, p0, task.args)
        except Exception as error:
            # The error itself stays: its type and traceback show the line of the user.
            error.add_note(f"(in the observable {called}, with the arguments {FORMS})")
            error.add_note(tracing_note(called, error))
            raise
        if not hasattr(out, "shape") and not isinstance(out, int | float):
            seen = "None (is a return missing?)" if out is None else f"type {type(out).__name__}"
            raise TypeError(
                f"the observable {called!r} must return one array, got {seen}. For several values "
                "use jnp.stack, or give observe a dict of observables."
            )
        if isinstance(leaf, Range) and jnp.issubdtype(jnp.result_type(out), jnp.complexfloating):
            raise TypeError(
                f"dvi.Range requires real values, but the observable {called!r} returns complex "
                "values. Take their real part, imaginary part or absolute value."
            )
        if not isinstance(leaf, Reduction):
            size += int(np.prod(np.shape(out), dtype=int)) * jnp.result_type(out).itemsize
    return size


def _check_deviations(leaf: Deviations, task: Task, q0: Array, p0: Array) -> None:
    name = type(leaf).__name__
    # The derivative of a step is taken at a fixed h; the derivative of h would be missing.
    if task.lattice.has_memory:
        raise ValueError(
            f"{name} requires steps whose size does not depend on the state, got "
            f"lattice={task.lattice!r}. Use lattice=dvi.Uniform() or dvi.Given(ts)."
        )
    eqx.filter_eval_shape(leaf.start, jnp.zeros(2 * q0.size, q0.dtype))  # counts and units


def noise_path(
    run: Run, path: BrownianPath | None, how: Integrator, method: Method, h: Array, num_steps: int
) -> NoisePath | None:
    """The path for a run, None without noise. **Raises** `ValueError` if they do not fit."""
    noise = run.system.noise
    if noise is None and path is None:  # nearly every run
        return None
    observed = jax.tree.leaves(run.observe, is_leaf=is_observable)
    stops = run.save.ts is not None or run.stop is not None
    adapts = how.lattice.has_memory or type(how.lattice).transform is not Lattice.transform
    # What the user has to change first comes first.
    wrong = {
        "path has no effect, because the system has no noise: leave path out, or give noise= in "
        "dvi.System.": noise is None,
        "path must be given for a system with noise: path=dvi.Brownian(jax.random.key(0)), or an "
        "integer, the seed of a key.": path is None,
        f"method={method!r:.200} is not a method for systems with noise. Use dvi.BAOAB() or "
        "dvi.OBABO() for noise on the momenta, dvi.StochasticEuler() or dvi.StochasticMidpoint() "
        "for every kind of noise.": not method.increments,
        # The path would not be independent of the state.
        f"lattice={how.lattice!r:.200} cannot be used with noise, because its steps depend on the "
        "state. Use dvi.Uniform() or dvi.Given(ts).": adapts,
        f"arithmetic={how.arithmetic!r:.200} cannot be used with noise. Use dvi.FloatingPoint() "
        "or dvi.Compensated().": not isinstance(how.arithmetic, FloatingPoint | Compensated),
        f"h must be positive for a system with noise, got h={h}.": not is_traced(h) and not h > 0,
        # Between the ends of a step the path is not known.
        "dvi.Save(ts=...), dvi.Stop and dvi.Section cannot be used with noise, because they need "
        "states within a step. Use dvi.Save(every=m) and a reduction such as dvi.Range.": stops
        or any(isinstance(f, Section) for f in observed),
    }
    if found := [why for why, is_so in wrong.items() if is_so]:
        raise ValueError(found[0])
    assert noise is not None
    assert path is not None
    path.check(num_steps)
    return NoisePath(path, method.increments, noise.count(run.t0, run.q0, run.p0, run.args))


def check_memory(
    save: Save, plan: Plan, q0: Array, beside: int, leaves: list[Any], layout: Layout
) -> None:
    """**Raises** `ValueError` for results that no memory can hold; `beside`: bytes of observables
    at a save point."""
    memory = results_memory()
    saved = plan.num_blocks + 1 + plan.save_tail if save.ts is None else save.ts.shape[0]
    each = (2 * q0.size + 2) * q0.dtype.itemsize + beside  # q, p, t and h
    count, is_compiled = batch_size(leaves)
    if memory is None or count * saved * each <= memory:
        return
    # XLA does not compute results that the function around this one does not use.
    if is_compiled and (layout.form == "arrays" or not generates()):
        return
    batch = f" of each of {count} trajectories" if count > 1 else ""
    disk = ", run fewer trajectories at once, or write results to disk with dvi.sweep(store=...)"
    raise ValueError(
        f"the results need {count * saved * each / 2**30:.3g} GiB of memory ({saved} saved "
        f"state{'s' * (saved > 1)}{batch}), but only {memory / 2**30:.3g} GiB are available. Save "
        "fewer states with save=dvi.Save(every=m), dvi.Save(final=True) or dvi.Save(ts=times)"
        f"{disk * (count > 1)}. A reduction such as dvi.MaxDrift(function) observes every step in "
        "constant memory."
    )
