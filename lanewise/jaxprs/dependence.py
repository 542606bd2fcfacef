"""Whether an output of a function depends on an input, read from its jaxpr."""

import itertools
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
    """Which outputs are reached from the marked inputs, not through the primitives in `ends`."""
    answers, question = _ANSWERS.setdefault(jaxpr, {}), (tuple(reached_inputs), ends)
    if question not in answers:  # nested loops need the same result many times
        answers[question] = _reached_outputs(jaxpr, *question)
    return list(answers[question])


_ANSWERS: weakref.WeakKeyDictionary[Jaxpr, dict] = weakref.WeakKeyDictionary()


def _reached_outputs(jaxpr: Jaxpr, reached_inputs: Sequence[bool], ends: frozenset[str]) -> Any:
    # Equations come in the order of their dependence: one pass is enough.
    variables = set(itertools.compress(jaxpr.invars, reached_inputs))

    def is_reached(atom: Any) -> bool:
        return not isinstance(atom, Literal) and atom in variables

    for eqn in jaxpr.eqns:
        inputs = [is_reached(atom) for atom in eqn.invars]
        if any(inputs):
            variables.update(itertools.compress(eqn.outvars, reached_by(eqn, inputs, ends)))
    return [is_reached(atom) for atom in jaxpr.outvars]


def reached_by(eqn: Any, inputs: list[bool], ends: frozenset[str] = frozenset()) -> list[bool]:
    """Which outputs of an equation are reached from the inputs that are marked."""
    name, params = eqn.primitive.name, eqn.params
    if name in ends:
        return [False] * len(eqn.outvars)
    if name == "scan":
        consts, count = scan_counts(params)
        fixed, carry, xs = cut(inputs, consts, count)

        def outputs_of_round(carry):
            return reached_outputs(params["jaxpr"].jaxpr, [*fixed, *carry, *xs], ends)

        # A dependence of one part of the carry may become one of another part in the next round.
        carry = fixed_point(lambda carry: outputs_of_round(carry)[:count], carry)
        return [*carry, *outputs_of_round(carry)[count:]]
    if name == "while":
        of_test, of_body, carry = cut(inputs, params["cond_nconsts"], params["body_nconsts"])

        def next_carry(carry):
            (test,) = reached_outputs(params["cond_jaxpr"].jaxpr, [*of_test, *carry], ends)
            body = reached_outputs(params["body_jaxpr"].jaxpr, [*of_body, *carry], ends)
            # If the number of rounds is reached, so is everything that the rounds compute.
            return [test or is_reached for is_reached in body]

        return fixed_point(next_carry, carry)
    if name == "cond":
        # The choice of the branch alone decides about all outputs.
        if inputs[0]:
            return [True] * len(eqn.outvars)
        per_branch = [reached_outputs(b.jaxpr, inputs[1:], ends) for b in params["branches"]]
        return [any(is_reached) for is_reached in zip(*per_branch, strict=True)]
    inner = _called_jaxpr(eqn)
    return [True] * len(eqn.outvars) if inner is None else reached_outputs(inner, inputs, ends)


def cut(items: list, first: int, second: int) -> tuple[list, list, list]:
    """The first items, the second ones, and those after them."""
    return items[:first], items[first : first + second], items[first + second :]


def fixed_point(step: Callable[[list[bool]], list[bool]], marks: list[bool]) -> list[bool]:
    """The smallest set that contains `marks` and, with each set, ``step(set)``."""
    while True:
        union = [mark or new_mark for mark, new_mark in zip(marks, step(marks), strict=True)]
        if union == marks:
            return marks
        marks = union


def _called_jaxpr(eqn: Any) -> Jaxpr | None:
    """The body of a call (jit, checkpoint, `lanewise.call`, …), None for other equations."""
    if eqn.primitive.name == "lanewise":
        return eqn.params["program"].trace.all_inputs.jaxpr
    # With two bodies (a function and its derivative) it is not certain which one is run.
    bodies = list(jaxprs_in_params(eqn.params))
    if len(bodies) != 1:
        return None
    (body,) = bodies
    counts = len(body.invars), len(body.outvars)
    return body if counts == (len(eqn.invars), len(eqn.outvars)) else None
