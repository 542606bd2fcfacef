"""A function of float64 numbers evaluated in pairs of them, operation by operation."""

import operator
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

import lanewise
from lanewise.jaxprs.jaxapi import ClosedJaxpr, Jaxpr, Literal, bodies, jaxpr_as_fun, scan_counts
from lanewise.jaxprs.traced import Trace
from lanewise.rules.moves import CALLS

from . import pair_functions as functions, pairs
from .pairs import Number, Pair, add, as_pair, is_pair, mul, rounded, sub


def in_pairs(function: Callable, *args: Any) -> Any:
    """``function(*args)`` with each operation on float64 numbers in pairs.

    `args` are pytrees whose arrays may be pairs; an array is exact, and so are numbers in the
    function. Float64 results are pairs. Derivatives are those in float64 at the rounded arguments.

    **Raises** `NotImplementedError` for a primitive of JAX that has no rule here.
    """
    # Methods and systems are modules with functions among their fields: those stay as they are.
    dynamic, static = eqx.partition(args, lambda x: is_pair(x) or eqx.is_array(x), is_leaf=is_pair)
    leaves, tree = jax.tree.flatten(dynamic, is_leaf=is_pair)

    def of_arrays(*leaves: Array) -> Any:
        return function(*eqx.combine(jax.tree.unflatten(tree, leaves), static))

    plain = rounded(leaves)
    trace = Trace.from_function(of_arrays, plain, jax.tree.structure(tuple(plain)))
    program = trace.all_inputs

    # Values of an outer trace that the function closes over are operands: they have a derivative.
    operands = [*trace.outer, *leaves]
    arrays, of_operands = jax.tree.flatten(operands)
    positions = jax.tree.leaves(rounded(jax.tree.unflatten(of_operands, range(len(arrays)))))
    results: list[Any] = []

    def evaluate(*arrays: Array) -> list[Array]:
        # Machine code also within a derivative, which XLA computes: it compiles pairs slowly.
        operands = jax.tree.unflatten(of_operands, arrays)
        out, tree = jax.tree.flatten(lanewise.call(_as_function(program), *operands))
        results.append(tree)
        return out

    def slope(arrays: list[Array], changes: dict[int, Array]) -> list[Array | None]:
        # In float64: the lower parts would change derivatives by round-off only.
        moving = [i for i in positions if i in changes]

        def of_moving(values: list[Array]) -> list[Array]:
            upper = dict(zip(moving, values, strict=True))
            return jaxpr_as_fun(program)(*(upper.get(i, arrays[i]) for i in positions))

        point, tangents = [arrays[i] for i in moving], [changes[i] for i in moving]
        _, change = jax.jvp(of_moving, (point,), (tangents,))
        places = rounded(jax.tree.unflatten(results[0], range(results[0].num_leaves)))
        of_place = dict(zip(places, change, strict=True))
        of_all = [of_place.get(i) for i in range(results[0].num_leaves)]
        return [c if c is not None and c.dtype != jax.dtypes.float0 else None for c in of_all]

    out = lanewise.with_derivative(evaluate, slope, arrays)
    return jax.tree.unflatten(trace.out_tree, jax.tree.unflatten(results[0], out))


def at_points_in_pairs(function: Callable, *points: Array) -> list[Any]:
    """The arrays of ``jax.vmap(function)(*points)`` in pairs, as NumPy arrays: see `in_pairs`. Each
    of `points` has the points as its first axis and is exact.

    Machine code of a function with many results takes long to compile: then each operation is
    computed for many points before the next one.
    """
    # The shapes of one point are those of all.
    program = jax.make_jaxpr(function)(*(x[0] for x in points))
    if sum(aval.size for aval in program.out_avals) <= _RESULTS_AT_ONCE:
        values = jax.jit(jax.vmap(lambda *point: in_pairs(function, *point)))(*points)
        return jax.tree.map(np.asarray, jax.tree.leaves(values, is_leaf=is_pair))
    evaluate = jax.vmap(_as_function(program))
    count, blocks = len(points[0]), []
    for first in range(0, count, _BLOCK):
        # All blocks have one size, so that each operation is compiled once.
        rows = np.minimum(np.arange(first, first + _BLOCK), count - 1)
        blocks.append(evaluate(*(x[rows] for x in points)))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *blocks)


_RESULTS_AT_ONCE = 100
_BLOCK = 128
"""Points at once: intermediate results of them fit into memory."""


def _evaluate(jaxpr: Jaxpr, consts: Sequence[Any], values: Sequence[Any]) -> list[Any]:
    environment: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    environment.update(zip(jaxpr.invars, values, strict=True))

    def read(atom: Any) -> Any:
        if isinstance(atom, Literal):
            return np.asarray(atom.val, atom.aval.dtype)[()]  # pyright: ignore[reportAttributeAccessIssue]
        return environment[atom]

    for eqn in jaxpr.eqns:
        out = _equation(eqn, [read(variable) for variable in eqn.invars])
        environment.update(zip(eqn.outvars, out, strict=True))
    return [read(variable) for variable in jaxpr.outvars]


def _equation(eqn: Any, values: list[Any]) -> list[Any]:
    name = eqn.primitive.name
    if name in _EQUATIONS:
        return _EQUATIONS[name](eqn, values)
    # Integers, truth values, and what moves or rounds exact numbers: as JAX does it.
    in_float64 = any(variable.aval.dtype == jnp.float64 for variable in eqn.outvars)
    has_pairs = any(map(is_pair, values))
    if not has_pairs and (not in_float64 or name in _EXACT or name in _MOVES):
        return _bound(eqn, values)
    if name in _MOVES:
        # Numbers change their places only: the lower parts move as the upper ones.
        lower = [value.lo if is_pair(value) else _zero(value) for value in values]
        upper = _bound(eqn, rounded(values))
        return [Pair(*x) for x in zip(upper, _bound(eqn, lower), strict=True)]
    if name in _ELEMENTWISE:
        return [_ELEMENTWISE[name](*values)]
    if name in _WITH_PARAMETERS:
        return [_WITH_PARAMETERS[name](eqn.params, *values)]
    if name in CALLS:
        (body, *_) = bodies(eqn)
        return _evaluate(body.jaxpr, body.consts, values)
    raise NotImplementedError(
        f"arithmetic=dvi.DoubleDouble() has no rule for the operation {name} of JAX. Use others, "
        "such as lanewise.solve(A, b), or arithmetic=dvi.Compensated()."
    )


def _bound(eqn: Any, values: Sequence[Any]) -> list[Any]:
    out = eqn.primitive.bind(*values, **eqn.params)
    return list(out) if eqn.primitive.multiple_results else [out]


def _zero(x: Any) -> Any:
    return jnp.zeros_like(x) if jnp.result_type(x) == jnp.float64 else x


# Sums over axes, and products of matrices


def _over_axes(operation: Callable, neutral: float) -> Callable:
    return lambda params, x: pairs.reduce_axes(operation, as_pair(x), params["axes"], neutral)


def _running(operation: Callable) -> Callable:
    def accumulate(params: dict, x: Number) -> Number:
        options = {"axis": params["axis"], "reverse": params["reverse"]}
        return lax.associative_scan(operation, as_pair(x), **options)

    return accumulate


def _dot(params: dict, x: Number, y: Number) -> Pair:
    (of_x, of_y), (with_x, with_y) = params["dimension_numbers"]

    def arrange(x: Number, batch: Sequence[int], contraction: Sequence[int]) -> tuple[Number, list]:
        shape = np.shape(rounded(x))
        free = [i for i in range(len(shape)) if i not in (*batch, *contraction)]
        groups = [[shape[i] for i in axes] for axes in (batch, free, contraction)]
        sizes = [int(np.prod(group, dtype=int)) for group in groups]
        return jax.tree.map(
            lambda a: jnp.transpose(a, (*batch, *free, *contraction)).reshape(sizes), x
        ), groups

    # All products first, then their sum: arrays of a step are small.
    x, (front, rows, _) = arrange(x, with_x, of_x)
    y, (_, columns, _) = arrange(y, with_y, of_y)
    x, y = jax.tree.map(lambda a: a[:, :, None], x), jax.tree.map(lambda a: a[:, None], y)
    total = pairs.reduce_axes(add, as_pair(_broadcast(mul, x, y)), [3], 0.0)
    return jax.tree.map(lambda a: a.reshape(*front, *rows, *columns), total)


def _broadcast(operation: Callable, x: Number, y: Number) -> Number:
    """The operation on numbers that are first repeated to one shape."""
    shape = np.broadcast_shapes(np.shape(rounded(x)), np.shape(rounded(y)))
    return operation(*(jax.tree.map(lambda a: jnp.broadcast_to(a, shape), z) for z in (x, y)))


def _scatter_add(eqn: Any, values: list[Any]) -> list[Any]:
    """Additions at indices: one row of updates at a time, so that none is added in float64."""
    operand, indices, updates = values
    if not any(map(is_pair, values)) and operand.dtype != jnp.float64:
        return _bound(eqn, values)
    shape = np.shape(rounded(updates))
    # The adjoint of indexing: several updates may have one index.
    window = eqn.params["dimension_numbers"].update_window_dims
    rows = [length if i not in window else 1 for i, length in enumerate(shape)]
    number = jnp.broadcast_to(jnp.arange(np.prod(rows, dtype=int)).reshape(rows), shape)

    def row(k: Array, part: Array) -> Array:
        update = jnp.where(number == k, part, 0.0)
        return _bound(eqn, [jnp.zeros_like(rounded(operand)), indices, update])[0]

    numbers = jnp.arange(np.prod(rows, dtype=int))
    terms = jax.tree.map(lambda x: jax.vmap(row, (0, None))(numbers, x), as_pair(updates))
    return [add(operand, pairs.reduce_axes(add, terms, [0], 0.0))]


# Powers, conversions


def _power(x: Number, y: Any) -> Number:
    if isinstance(y, np.floating | np.integer) and float(2 * y).is_integer() and abs(y) <= 64:
        is_whole = float(y).is_integer()
        return pairs.power(x, int(y)) if is_whole else functions.root_power(x, int(2 * y))
    return functions.general_power(x, y if is_pair(y) else jnp.asarray(y, jnp.float64))


def _convert(params: dict, x: Any) -> Any:
    new = np.dtype(params["new_dtype"])
    if not is_pair(x) or new == np.float64:
        return x if is_pair(x) else lax.convert_element_type(x, new)
    if new == np.bool_:
        return (x.hi != 0) | (x.lo != 0)
    if jnp.issubdtype(new, jnp.integer):  # towards zero, whatever the sign of lo is
        integer = pairs.floor(pairs.magnitude(x))
        return jnp.where(x.hi < 0, -rounded(integer), rounded(integer)).astype(new)
    return x.hi.astype(new)


def _select(index: Array, *cases: Any) -> Any:
    upper = lax.select_n(index, *(jnp.asarray(rounded(case)) for case in cases))
    if not any(map(is_pair, cases)):
        return upper
    lower = [case.lo if is_pair(case) else _zero(case) for case in cases]
    return Pair(upper, lax.select_n(index, *lower))


def _remainder(x: Number, y: Number) -> Number:
    """x − y·n with the integer n that is x/y rounded towards zero."""
    a, b = pairs.magnitude(x), pairs.magnitude(y)
    r = sub(a, mul(pairs.floor(pairs.div(a, b)), b))
    # The quotient may be rounded to the integer next to it.
    r = pairs.where(r.hi < 0, add(r, b), r)
    r = pairs.where(pairs.compare(operator.ge)(r, b), sub(r, b), r)
    return pairs.where(rounded(x) < 0, pairs.negate(r), r)


def _clamp(low: Number, x: Number, high: Number) -> Number:
    return _broadcast(pairs.smaller, _broadcast(pairs.larger, x, low), high)


# Loops and branches: all float64 numbers that they carry are pairs


def _as_function(program: ClosedJaxpr) -> Callable:
    return lambda *values: [as_pair(x) for x in _evaluate(program.jaxpr, program.consts, values)]


def _scan(eqn: Any, values: list[Any]) -> list[Any]:
    params = eqn.params
    n, m = scan_counts(params)
    consts, carry, xs = values[:n], [as_pair(x) for x in values[n : n + m]], values[n + m :]
    body = _as_function(params["jaxpr"])

    def step(carry: list, x: list) -> tuple[list, list]:
        out = body(*consts, *carry, *x)
        return out[:m], out[m:]

    options = {name: params[name] for name in ("length", "reverse", "unroll")}
    # The type of a carry must not change, although it may begin exact.
    carry, ys = lax.scan(step, carry, xs, **options)
    return [*carry, *ys]


def _loop(eqn: Any, values: list[Any]) -> list[Any]:
    n, m = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
    test, body = _as_function(eqn.params["cond_jaxpr"]), _as_function(eqn.params["body_jaxpr"])
    begin = [as_pair(x) for x in values[n + m :]]
    consts = values[n : n + m]
    return lax.while_loop(lambda x: test(*values[:n], *x)[0], lambda x: body(*consts, *x), begin)


def _cond(eqn: Any, values: list[Any]) -> list[Any]:
    index, *operands = values
    # The results of all branches are pairs, so that their types agree.
    return lax.switch(index, [_as_function(branch) for branch in eqn.params["branches"]], *operands)


# Equations that are solved: the solution in float64, then corrections of it by residuals in pairs

_CORRECTIONS = 2
"""The error of the solution in float64, about 1e-16 relative, is multiplied by this in each."""


def _linear_solve(eqn: Any, values: list[Any]) -> list[Any]:
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    matvec, count = _as_function(jaxprs.matvec), sum(lengths)
    # The matrix in pairs for residuals; its factors in float64 for corrections.
    matrix = values[: lengths.matvec]
    consts, b = rounded(values[:count]), values[count:]
    x = [as_pair(y) for y in _bound(eqn, rounded(values))]
    for _ in range(_CORRECTIONS):
        defect = [sub(a, y) for a, y in zip(b, matvec(*matrix, *x), strict=True)]
        x = [add(a, d) for a, d in zip(x, _bound(eqn, [*consts, *rounded(defect)]), strict=True)]
    return x


def _root(eqn: Any, values: list[Any]) -> list[Any]:
    problem, plain = eqn.params["rest"], rounded(values)
    x, *statistics = _bound(eqn, plain)
    parameters, consts = values[problem.own : -1], plain[problem.own : -1]
    # The iteration itself stays in float64, with its status; a Jacobian of float64 is enough to
    # continue from its root.
    equation = jax.make_jaxpr(problem.equation)(*consts, x)
    point, scale = x, jnp.max(jnp.abs(x), initial=0.0)

    def correct(x: Pair, _: None) -> tuple[Pair, Array]:
        (defect,) = _evaluate(equation.jaxpr, equation.consts, [*parameters, x])
        change = problem.divide(*consts, point, rounded(defect))
        return sub(x, change), jnp.max(jnp.abs(change), initial=0.0)

    x, (first, last) = lax.scan(correct, as_pair(x), None, _CORRECTIONS)
    # The next correction would be last²/first.
    small = last * last <= _NEXT_CORRECTION * scale * first
    return [x, *(h & small if h.dtype == bool else h for h in statistics)]


_NEXT_CORRECTION = 2.0**-96
"""The largest correction of a root that is left out, relative to its largest component."""


def _call(eqn: Any, values: list[Any]) -> list[Any]:
    program = eqn.params["program"]
    if eqn.params["lanes"] is not None:
        raise NotImplementedError(
            "arithmetic=dvi.DoubleDouble() has no rule for lanewise.batched: use jax.vmap alone."
        )
    inner = program.trace.all_inputs
    return _evaluate(inner.jaxpr, inner.consts, values)


_EQUATIONS: dict[str, Callable] = {
    "scan": _scan,
    "while": _loop,
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
    "implicit_root": _root,
    "lanewise": _call,
    "scatter-add": _scatter_add,
}

_MOVE_NAMES = (
    "broadcast_in_dim reshape squeeze expand_dims transpose slice dynamic_slice concatenate pad "
    "dynamic_update_slice rev gather scatter split unstack stack copy copy_p stop_gradient real "
    "optimization_barrier reshard sharding_constraint mesh_cast neg reduce_precision"
)
_MOVES = frozenset(_MOVE_NAMES.split())
"""Operations that move numbers, or change their signs."""

_EXACT_NAMES = (
    "convert_element_type iota floor ceil round sign abs max min rem clamp select_n unit_vectors "
    "empty"
)
_EXACT = frozenset(_EXACT_NAMES.split())
"""Operations whose float64 results are exact for float64 arguments."""

_FUNCTION_NAMES = (
    "tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p log2 cbrt "
    "logistic"
)

_ELEMENTWISE: dict[str, Callable] = {
    "add": add,
    "add_any": add,
    "sub": sub,
    "mul": mul,
    "div": pairs.div,
    "square": lambda x: mul(x, x),
    "sqrt": pairs.sqrt,
    "rsqrt": lambda x: functions.root_power(x, -1),
    "pow": _power,
    "abs": pairs.magnitude,
    "max": pairs.larger,
    "min": pairs.smaller,
    "clamp": _clamp,
    "floor": pairs.floor,
    "ceil": lambda x: pairs.negate(pairs.floor(pairs.negate(x))),
    "sign": lambda x: jnp.sign(rounded(x)),
    "rem": _remainder,
    "select_n": _select,
    "is_finite": lambda x: jnp.isfinite(x.hi),
    "sin": lambda x: functions.sin_cos(x)[0],
    "cos": lambda x: functions.sin_cos(x)[1],
    **{op: pairs.compare(getattr(operator, op)) for op in ("eq", "ne", "lt", "le", "gt", "ge")},
    **{name: getattr(functions, name) for name in _FUNCTION_NAMES.split()},
}

_WITH_PARAMETERS: dict[str, Callable] = {
    "integer_pow": lambda params, x: pairs.power(x, params["y"]),
    "convert_element_type": _convert,
    "dot_general": _dot,
    "reduce_sum": _over_axes(add, 0.0),
    "reduce_prod": _over_axes(mul, 1.0),
    "reduce_max": _over_axes(pairs.larger, -jnp.inf),
    "reduce_min": _over_axes(pairs.smaller, jnp.inf),
    "cumsum": _running(add),
    "cumprod": _running(mul),
    "cummax": _running(pairs.larger),
    "cummin": _running(pairs.smaller),
}
