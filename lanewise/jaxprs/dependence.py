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
    start = len(jax.tree.leaves(args[:argnum]))
    count = len(jax.tree.leaves(args[argnum]))
    function_jaxpr = jax.make_jaxpr(function)(*args)
    marks = [start <= i < start + count for i in range(len(function_jaxpr.jaxpr.invars))]
    return any(reached_outputs(function_jaxpr.jaxpr, marks))


def reached_outputs(
    jaxpr: Jaxpr, reached_inputs: Sequence[bool], ends: frozenset[str] = frozenset()
) -> list[bool]:
    """Which outputs of `jaxpr` are reached from the inputs that are marked.

    Nothing is reached through the primitives named in `ends`.
    """
    answers, question = _ANSWERS.setdefault(jaxpr, {}), (tuple(reached_inputs), ends)
    if question not in answers:  # nested loops need the same result many times
        answers[question] = _reached_outputs(jaxpr, *question)
    return list(answers[question])


_ANSWERS: weakref.WeakKeyDictionary[Jaxpr, dict] = weakref.WeakKeyDictionary()


def _reached_outputs(jaxpr: Jaxpr, reached_inputs: Sequence[bool], ends: frozenset[str]) -> Any:
    # Equations come in the order of their dependence: one pass is enough.
    variables = {
        var for var, is_marked in zip(jaxpr.invars, reached_inputs, strict=True) if is_marked
    }

    def is_reached(atom: Any) -> bool:
        return not isinstance(atom, Literal) and atom in variables

    for eqn in jaxpr.eqns:
        inputs = [is_reached(var) for var in eqn.invars]
        if any(inputs):
            outputs = reached_by(eqn, inputs, ends)
            variables.update(
                var for var, is_marked in zip(eqn.outvars, outputs, strict=True) if is_marked
            )
    return [is_reached(var) for var in jaxpr.outvars]


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

        def outputs_of_round(carry):
            return reached_outputs(params["jaxpr"].jaxpr, [*fixed, *carry, *xs], ends)

        # A dependence of one part of the carry may become one of another part in the next round.
        carry = fixed_point(lambda carry: outputs_of_round(carry)[:count], carry)
        return [*carry, *outputs_of_round(carry)[count:]]
    if name == "while":
        first, second = params["cond_nconsts"], params["body_nconsts"]
        of_test, of_body = inputs[:first], inputs[first : first + second]

        def next_carry(carry):
            (test,) = reached_outputs(params["cond_jaxpr"].jaxpr, [*of_test, *carry], ends)
            body = reached_outputs(params["body_jaxpr"].jaxpr, [*of_body, *carry], ends)
            # If the number of rounds is reached, so is everything that the rounds compute.
            return [test or r for r in body]

        return fixed_point(next_carry, inputs[first + second :])
    if name == "cond":
        # The choice of the branch alone decides about all outputs.
        if inputs[0]:
            return [True] * len(eqn.outvars)
        per_branch = [reached_outputs(b.jaxpr, inputs[1:], ends) for b in params["branches"]]
        return [any(r) for r in zip(*per_branch, strict=True)]
    inner = _called_jaxpr(eqn)
    return [True] * len(eqn.outvars) if inner is None else reached_outputs(inner, inputs, ends)


def fixed_point(step: Callable[[list[bool]], list[bool]], marks: list[bool]) -> list[bool]:
    """The smallest set that contains `marks` and, with each set, ``step(set)``."""
    while True:
        union = [mark or new_mark for mark, new_mark in zip(marks, step(marks), strict=True)]
        if union == marks:
            return marks
        marks = union


def _called_jaxpr(eqn: Any) -> Jaxpr | None:
    """The body of a call (jit, checkpoint, `lanewise.call`, …) with the inputs and outputs of the
    equation; None for other equations."""
    if eqn.primitive.name == "lanewise":
        return eqn.params["program"].trace.all_inputs.jaxpr
    # With two bodies (a function and its derivative) it is not certain which one is run.
    bodies = list(jaxprs_in_params(eqn.params))
    if len(bodies) != 1:
        return None
    (body,) = bodies
    has_equal_lengths = len(body.invars) == len(eqn.invars) and len(body.outvars) == len(
        eqn.outvars
    )
    return body if has_equal_lengths else None
