"""Observables: checks before a run, and their values in the pytree of the user after it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

import lanewise
from lanewise import Layout

from ..base.checks import function as check_function
from ..base.signature import tracing_note
from ..lattices import Run
from ..observe import FORMS, Deviations, OfState, Range, Reduction, Running, is_observable
from .task import Task


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


def observed(observe: PyTree, alone: list[Any], reduced: list[Any]) -> PyTree:
    """The pytree `observe` with every observable replaced by its values."""
    # Both lists are in the order of the leaves, in which `Task.observables` has separated them.
    values, lone = iter(reduced), iter(alone)

    def value(f):
        if isinstance(f, Reduction):
            return next(values)
        if isinstance(f, Running):  # its final value is the last of its rows, and not needed
            next(values)
        return next(lone)

    return jax.tree.map(value, observe, is_leaf=is_observable)


def with_initial_values(observe: PyTree, found: PyTree, run: Run, layout: Layout) -> PyTree:
    """The values of functions of the state, with that at the initial state as their first row."""

    def value(f, values):
        if not isinstance(f, OfState):
            return values

        def at_start(t, q, p, args):
            return jnp.asarray(f(t, t, q, p, q, p, args))

        first = lanewise.call(at_start, run.t0, run.q0, run.p0, run.args, layout=layout)
        return jnp.concatenate([first[None].astype(values.dtype), values])

    return jax.tree.map(value, observe, found, is_leaf=is_observable)
