"""Roots of equations, with the derivative that the implicit function theorem gives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax import Array

from .jaxprs.jaxapi import ClosedJaxpr, batch_in_front, has_derivative, jaxpr_as_fun, primitive
from .jaxprs.traced import Trace


def implicit_root(
    function: Callable[[Array], Array],
    guess: Array,
    solve: Callable[[Callable, Array], tuple[Array, Any]],
    divide: Callable[[Callable, Array], Array],
) -> tuple[Array, Any]:
    """``solve(function, guess)``: the root x of function(x) = 0, and arrays that say how it was
    found.

    The derivative of x with respect to anything that `function` closes over is dx = −(∂F/∂x)⁻¹ dF,
    in forward and reverse mode and to any order; ``divide(linear, b)`` gives the y with
    linear(y) = b. `solve` is never differentiated; neither the guess nor what `solve` closes over
    matters for the derivative.

    It differs from `jax.lax.custom_root` where reverse mode is taken of a batch, ``grad`` of
    ``vmap``: `lax.cond` is allowed in `function` then, because the batch is formed before the
    derivative. (JAX forms the batch of a `custom_jvp` rule after it, and has no transpose of the
    result.)
    """
    structure = jax.tree.structure((guess,))
    equation = Trace.from_function(function, [guess], structure)
    trees: list[Any] = []

    def search_root(*operands):
        *consts, x0 = operands
        x, info = solve(lambda x: equation(*consts, x)[0], x0)
        leaves, tree = jax.tree.flatten(info)
        trees.append(tree)
        return [x, *leaves]

    # Values that the equation closes over become operands, so that derivatives by it are found.
    operands = [*equation.outer, guess]
    search = Trace.from_function(search_root, operands, jax.tree.structure(tuple(operands)))
    rest = _Rest(
        lambda *arrays: jaxpr_as_fun(equation.all_inputs)(*arrays)[0],
        lambda *arrays: _divide(equation.all_inputs, divide, *arrays),
        # These come first among the operands. They do not change the root: it has no derivative by
        # them.
        len(search.outer),
    )
    inputs = [*search.outer, *operands]
    x, *info = _root.bind(*inputs, search=search.all_inputs, rest=rest)
    return x, jax.tree.unflatten(trees[-1], info)


class _Rest(NamedTuple):
    """``equation(*consts, x)``, ``divide(*consts, x, b)``, count of operands of the search only.

    Stored sweeps recognise their functions by the text of jaxprs, in which these names occur.
    """

    equation: Callable
    divide: Callable
    own: int


def _divide(equation: ClosedJaxpr, divide: Callable, *arrays: Array) -> Array:
    *consts, x, right = arrays
    _, linear = jax.linearize(lambda x: jaxpr_as_fun(equation)(*consts, x)[0], x)
    return divide(linear, right)


def _search(*operands: Array, search: ClosedJaxpr, rest: _Rest) -> list[Array]:
    return jaxpr_as_fun(search)(*operands)


def _batch_rule(operands, axes, *, search: ClosedJaxpr, rest: _Rest):
    size, operands, axes_in_front = batch_in_front(operands, axes)
    # The batch is formed now: a derivative that is taken later finds functions of a batch, in which
    # `lax.cond` has become a selection.
    new = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(search), axes_in_front, axis_size=size))(*operands)
    consts = axes_in_front[rest.own : -1]
    of_batch = _Rest(
        jax.vmap(rest.equation, [*consts, 0], axis_size=size),
        jax.vmap(rest.divide, [*consts, 0, 0], axis_size=size),
        rest.own,
    )
    outs = _root.bind(*operands, search=new, rest=of_batch)
    return outs, [0] * len(outs)


def _derivative(primals, changes: dict[int, Array], *, search: ClosedJaxpr, rest: _Rest):
    outs = _root.bind(*primals, search=search, rest=rest)
    x, consts = outs[0], primals[rest.own : -1]
    # Changes of the guess and of what the search alone uses are left out.
    indices = [i for i in range(len(consts)) if i + rest.own in changes]
    if not indices:
        return outs, [None] * len(outs)

    def defect(*moving):
        values = dict(zip(indices, moving, strict=True))
        return rest.equation(*(values.get(i, const) for i, const in enumerate(consts)), x)

    tangents = [changes[i + rest.own] for i in indices]
    _, change = jax.jvp(defect, [consts[i] for i in indices], tangents)
    return outs, [rest.divide(*consts, x, -change), *[None] * (len(outs) - 1)]


_root = primitive("implicit_root", _search, _batch_rule, multiple=True)
has_derivative(_root, _derivative)
