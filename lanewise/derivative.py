"""Functions with a derivative of their own."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax import Array

from .jaxprs.jaxapi import ClosedJaxpr, batch_in_front, has_derivative, jaxpr_as_fun, primitive

Rule = Callable[[list[Array], dict[int, Array]], list[Array | None]]
"""``rule(operands, changes)`` → the changes of the results, linear in the changes of the operands.
These are given by position, for those that change; None for a result that does not change."""


def with_derivative(function: Callable, rule: Rule, operands: Sequence[Any]) -> list[Array]:
    """The list of arrays ``function(*operands)``, with the user-defined derivative `rule`.

    It is used in derivatives of every order. (JAX loses the rule of a `jax.custom_jvp` in a loop:
    partial evaluation moves operations out of the loop that depend on its constants alone, and
    replaces calls with a rule by their bodies. Second derivatives by reverse mode are then those of
    the body.) Neither function may close over traced values: they have to be operands.

    **Example**

    ```python
    import lanewise

    def rounded(x):                                     # a step function, with the slope 1
        return lanewise.with_derivative(lambda x: [jnp.round(x)], lambda x, dx: [dx[0]], [x])[0]

    print(*jax.value_and_grad(rounded)(1.7))
    # 2.0 1.0
    ```
    """
    program = jax.make_jaxpr(lambda *operands: list(function(*operands)))(*operands)
    return _operation.bind(*operands, program=program, rule=rule)


def _values(*operands: Array, program: ClosedJaxpr, rule: Rule) -> list[Array]:
    return jaxpr_as_fun(program)(*operands)


def _batch_rule(operands, axes, *, program: ClosedJaxpr, rule: Rule):
    size, operands, axes = batch_in_front(operands, axes)
    of_batch = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(program), axes, axis_size=size))(*operands)

    def rule_of_batch(operands, changes):
        def of_one(operands, moving):
            return rule(operands, dict(zip(changes, moving, strict=True)))

        moving, moving_axes = list(changes.values()), [axes[i] for i in changes]
        return jax.vmap(of_one, (axes, moving_axes), axis_size=size)(operands, moving)

    outs = _operation.bind(*operands, program=of_batch, rule=rule_of_batch)
    return outs, [0] * len(outs)


def _derivative(operands, changes, *, program: ClosedJaxpr, rule: Rule):
    outs = _operation.bind(*operands, program=program, rule=rule)
    return outs, rule(list(operands), changes)


_operation = primitive("with_derivative", _values, _batch_rule, multiple=True)
has_derivative(_operation, _derivative)
