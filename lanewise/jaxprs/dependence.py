"""Whether an output of a function depends on an input, read from its jaxpr."""

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import jax

from .jaxapi import Jaxpr, Literal, jaxprs_in_params, scan_counts


def depends_on(function: Callable[..., Any], argnum: int, *args: Any) -> bool:
    """Whether any output of ``function(*args)`` can depend on the values in ``args[argnum]``.

    A value may depend on another one with a derivative of zero: sign(p) depends on p. The result is
    True where it is not certain, as for primitives whose body is unknown. `args` are arrays or
    shape structs: only shapes and types matter.
    """
    before = len(jax.tree.leaves(args[:argnum]))
    count = len(jax.tree.leaves(args[argnum]))
    closed = jax.make_jaxpr(function)(*args)
    marked = [before <= i < before + count for i in range(len(closed.jaxpr.invars))]
    return any(reached_outputs(closed.jaxpr, marked))


def reached_outputs(
    jaxpr: Jaxpr, reached_inputs: Sequence[bool], ends: frozenset[str] = frozenset()
) -> list[bool]:
    """Which outputs of `jaxpr` are reached from the inputs that are marked.

    Nothing is reached through the primitives named in `ends`.
    """
    known, question = _ANSWERS.setdefault(jaxpr, {}), (tuple(reached_inputs), ends)
    if question not in known:  # nested loops need the same result many times
        known[question] = _reached_outputs(jaxpr, *question)
    return list(known[question])


_ANSWERS: weakref.WeakKeyDictionary[Jaxpr, dict] = weakref.WeakKeyDictionary()


def _reached_outputs(jaxpr: Jaxpr, reached_inputs: Sequence[bool], ends: frozenset[str]) -> Any:
    # Equations come in the order of their dependence: one pass is enough.
    reached = {v for v, r in zip(jaxpr.invars, reached_inputs, strict=True) if r}

    def is_reached(atom: Any) -> bool:
        return not isinstance(atom, Literal) and atom in reached

    for eqn in jaxpr.eqns:
        inputs = [is_reached(v) for v in eqn.invars]
        if any(inputs):
            outputs = reached_by(eqn, inputs, ends)
            reached.update(v for v, r in zip(eqn.outvars, outputs, strict=True) if r)
    return [is_reached(v) for v in jaxpr.outvars]


def reached_by(eqn: Any, inputs: list[bool], ends: frozenset[str] = frozenset()) -> list[bool]:
    """Which outputs of an equation are reached from the inputs that are marked."""
    name, params = eqn.primitive.name, eqn.params
    if name in ends:
        return [False] * len(eqn.outvars)
    if name == "scan":
        consts, count = scan_counts(params)
        fixed, carry, xs = (
            inputs[:consts],
            inputs[consts : consts + count],
            inputs[consts + count :],
        )

        def scanned(carry):
            return reached_outputs(params["jaxpr"].jaxpr, [*fixed, *carry, *xs], ends)

        # A dependence of one part of the carry may become one of another part in the next round.
        carry = fixed_point(lambda carry: scanned(carry)[:count], carry)
        return [*carry, *scanned(carry)[count:]]
    if name == "while":
        first, second = params["cond_nconsts"], params["body_nconsts"]
        of_test, of_body = inputs[:first], inputs[first : first + second]

        def after(carry):
            (test,) = reached_outputs(params["cond_jaxpr"].jaxpr, [*of_test, *carry], ends)
            body = reached_outputs(params["body_jaxpr"].jaxpr, [*of_body, *carry], ends)
            # If the number of rounds is reached, so is everything that the rounds compute.
            return [test or r for r in body]

        return fixed_point(after, inputs[first + second :])
    if name == "cond":
        # The choice of the branch alone decides about all outputs.
        if inputs[0]:
            return [True] * len(eqn.outvars)
        per_branch = [reached_outputs(b.jaxpr, inputs[1:], ends) for b in params["branches"]]
        return [any(r) for r in zip(*per_branch, strict=True)]
    inner = _called_jaxpr(eqn)
    return [True] * len(eqn.outvars) if inner is None else reached_outputs(inner, inputs, ends)


def fixed_point(after: Callable[[list[bool]], list[bool]], marks: list[bool]) -> list[bool]:
    """The smallest set that holds `marks` and, with each set, what comes `after` it."""
    while True:
        more = [a or b for a, b in zip(marks, after(marks), strict=True)]
        if more == marks:
            return marks
        marks = more


def _called_jaxpr(eqn: Any) -> Jaxpr | None:
    """The body of a call (jit, checkpoint, `lanewise.call`, …) with the inputs and outputs of the
    equation; None for other equations."""
    if eqn.primitive.name == "lanewise":
        return eqn.params["program"].traced.all_inputs.jaxpr
    # With two bodies (a function and its derivative) it is not certain which one is run.
    bodies = list(jaxprs_in_params(eqn.params))
    if len(bodies) != 1:
        return None
    (body,) = bodies
    same = len(body.invars) == len(eqn.invars) and len(body.outvars) == len(eqn.outvars)
    return body if same else None
