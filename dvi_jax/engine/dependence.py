"""Whether an output of a function depends on an input, read from its jaxpr."""

from collections.abc import Callable
from typing import Any

import jax

from .._compat import Jaxpr, Literal, jaxprs_in_params


def depends_on(function: Callable[..., Any], argnum: int, *args: Any) -> bool:
    """Whether any output of ``function(*args)`` can depend on the values in ``args[argnum]``.

    Dependence of values is meant, not a non-zero derivative: sign(p) depends on p. The
    answer errs on the side of True, through loops and primitives that are not looked into.
    `args` are arrays or shape structs (only shapes and types matter).
    """
    before = len(jax.tree.leaves(args[:argnum]))
    count = len(jax.tree.leaves(args[argnum]))
    closed = jax.make_jaxpr(function)(*args)
    tainted = [before <= i < before + count for i in range(len(closed.jaxpr.invars))]
    return any(_propagate(closed.jaxpr, tainted))


def _propagate(jaxpr: Jaxpr, tainted_inputs: list[bool]) -> list[bool]:
    """Which outputs of `jaxpr` are reached from the tainted inputs."""
    tainted = {v for v, t in zip(jaxpr.invars, tainted_inputs, strict=True) if t}

    def reached(atom: Any) -> bool:
        return not isinstance(atom, Literal) and atom in tainted

    for eqn in jaxpr.eqns:
        inputs = [reached(v) for v in eqn.invars]
        if any(inputs):
            inner = _called_jaxpr(eqn)
            outputs = [True] * len(eqn.outvars) if inner is None else _propagate(inner, inputs)
            tainted.update(v for v, t in zip(eqn.outvars, outputs, strict=True) if t)
    return [reached(v) for v in jaxpr.outvars]


def _called_jaxpr(eqn: Any) -> Jaxpr | None:
    """The body of a call whose inputs and outputs match the equation's one by one, if it is one.

    (jit, custom_jvp, custom_vjp, checkpoint and their like; a scan or while is not, because
    what goes round its loop would need a fixed point.)
    """
    if eqn.primitive.name in ("scan", "while", "cond"):
        return None
    bodies = list(jaxprs_in_params(eqn.params))
    if len(bodies) != 1:
        return None
    (body,) = bodies
    same = len(body.invars) == len(eqn.invars) and len(body.outvars) == len(eqn.outvars)
    return body if same else None
