"""A function of JAX as a list of scalar operations.

The list is what a certificate contains: it is read from the jaxpr of the package's own step, so
that a user writes no second definition of the system. Operations that only move numbers (slices,
reshapes, gathers) disappear; what remains are sums, products, quotients, integer powers and
elementary functions. Those of constants remain, too, where float64 would round the result.

What the list cannot express is refused by name: a number of the state that is converted to another
type, an index or a condition that differs between states (`conditions`), any other operation. The
module `comparison` compares the list with the function afterwards.
"""

import contextlib
import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.jaxapi import ClosedJaxpr, Literal, scan_counts, without_outputs
from lanewise.llvm.ir import NotCompilable
from lanewise.rules.written import EXPANSIONS

from .conditions import CONDITIONS, decide, extreme
from .scalars import UNARY, NotAnalytic as NotAnalytic, ProgramNumber, ScalarProgram, total
from .ways import ARGUMENT_UNITS, MACHINE_CODE, RESULT_UNITS, XLA

_MOVES = (
    "reshape", "broadcast_in_dim", "squeeze", "transpose", "slice", "rev", "concatenate", "gather",
    "dynamic_slice", "pad", "select_n", "dynamic_update_slice", "scatter", "split",
    "stack", "unstack", "tile", "copy", "copy_p", "optimization_barrier", "stop_gradient",
)  # fmt: skip
_SUMS = ("scatter-add", "cumsum", "reduce_window_sum")
_INDICES = {
    "gather": (1,), "scatter": (1,), "scatter-add": (1,), "scatter-mul": (1,), "select_n": (0,),
    "scatter-min": (1,), "scatter-max": (1,),
    "dynamic_slice": range(1, 99), "dynamic_update_slice": range(2, 99),
}  # fmt: skip
"""Operands that say where numbers go, and are not such numbers themselves."""
_CALLS = ("remat", "remat2", "checkpoint", "custom_lin")  # next to names with "call" or "jit"


_MOST_ROUNDS = 1000
"""Of a loop without a stated length, which may have no end."""


def program_of(
    function: Callable,
    *shapes: tuple[int, ...],
    way: str = MACHINE_CODE,
    points: Sequence[np.ndarray] | None = None,
) -> dict[str, Any]:
    """The list of operations of a function of arrays of float64 with these shapes.

    `way`: the way of running whose rounding the list describes. `points`: for each argument an
    array of its values at points of the domain, at which conditions are decided.

    Returns ``{"operations": [[name, *operands], ...], "outputs": [...]}``: an operand is the number
    of an earlier operation; inputs and outputs are in the order of the raveled arrays.

    **Raises** `NotAnalytic` for operations that are not analytic, or that depend on the values.
    """
    structs = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes]
    closed_jaxpr = jax.make_jaxpr(function)(*structs)
    # Conditions of what no output needs, such as a status, are not decided.
    closed_jaxpr = without_outputs(closed_jaxpr, [True] * len(closed_jaxpr.out_avals))
    rows = None if points is None else np.hstack([np.reshape(x, (len(x), -1)) for x in points])
    program, inputs, offset = ScalarProgram(way, rows), [], 0
    for shape in shapes:
        size = int(np.prod(shape))
        numbers = [program.write("input", offset + i) for i in range(size)]
        inputs.append(_array(numbers, shape))
        offset += size
    outputs = _evaluate(program, closed_jaxpr.jaxpr, closed_jaxpr.consts, inputs)
    scalars = [x for out in outputs for x in _symbolic(program, out).ravel()]
    return program.as_json(scalars)


def _array(scalars: Sequence[ProgramNumber], shape: tuple[int, ...]) -> np.ndarray:
    array = np.empty(len(scalars), object)
    array[:] = scalars
    return array.reshape(shape)


def _is_symbolic(x: Any) -> bool:
    return isinstance(x, np.ndarray) and x.dtype == object


def _concrete(x: Any) -> Any:
    """The numbers of an array, if all of them are constants."""
    if not _is_symbolic(x) or any(scalar.value is None for scalar in x.ravel()):
        return x
    return np.array([scalar.value for scalar in x.ravel()]).reshape(x.shape)


def _symbolic(program: ScalarProgram, x: Any) -> np.ndarray:
    if _is_symbolic(x):
        return x
    values = np.asarray(x)
    return _array([program.constant(v) for v in values.ravel()], values.shape)


def _evaluate(
    program: ScalarProgram, jaxpr: Any, consts: Sequence[Any], inputs: Sequence[Any]
) -> list:
    environment: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    environment.update(zip(jaxpr.invars, inputs, strict=True))

    def read(atom):
        return atom.val if isinstance(atom, Literal) else environment[atom]

    for equation in jaxpr.eqns:
        results = _apply(program, equation, [read(v) for v in equation.invars])
        environment.update(zip(equation.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _apply(program: ScalarProgram, equation: Any, values: list) -> list:
    name, params = equation.primitive.name, equation.params
    inner = params.get("jaxpr") or params.get("call_jaxpr") or params.get("fun_jaxpr")
    if inner is not None and (name in _CALLS or "call" in name or "jit" in name):
        if params.get("name") == "hypot" and _is_hypot(equation, inner):
            return [_hypot(program, equation, values)]
        if isinstance(inner, ClosedJaxpr):
            return _evaluate(program, inner.jaxpr, inner.consts, values)
        return _evaluate(program, inner, [], values)
    if name == "scan":
        return _scan(program, params, values)
    if name == "custom_linear_solve":  # what it solves with
        lengths, body = params["const_lengths"], params["jaxprs"].solve
        first = lengths.matvec + lengths.vecmat
        consts = values[first : first + lengths.solve]
        return _evaluate(program, body.jaxpr, body.consts, [*consts, *values[sum(lengths) :]])
    if name == "while" and (carry := _while(program, params, values)) is not None:
        return carry
    values = [_concrete(v) for v in values]
    if name == "cond" and not _is_symbolic(values[0]):
        branches = params["branches"]
        branch = branches[min(max(int(values[0]), 0), len(branches) - 1)]
        return _evaluate(program, branch.jaxpr, branch.consts, values[1:])
    is_constant = not any(map(_is_symbolic, values))
    # The run may compute another number than is computed here, unless it has no rounding.
    is_inexact = any(jnp.issubdtype(v.aval.dtype, jnp.inexact) for v in equation.outvars)
    if is_constant and name != "while" and (name in _EXACT or not is_inexact):
        out = equation.primitive.bind(*map(jnp.asarray, values), **params)
        return list(out) if equation.primitive.multiple_results else [out]
    if name in CONDITIONS and not is_constant:
        result = decide(program, equation, [_symbolic(program, v) for v in values])
        if result is not None:
            return [result]
    # XLA solves linear systems by other programs, and pairs by corrections: a sort has no rounding.
    if name in EXPANSIONS and (program.way == MACHINE_CODE or not is_inexact or name == "sort"):
        with contextlib.suppress(NotCompilable):
            body = jax.make_jaxpr(functools.partial(EXPANSIONS[name], **params))(
                *(v.aval for v in equation.invars)
            )
            results = _evaluate(program, body.jaxpr, body.consts, values)
            numbers = [x for result in results if _is_symbolic(result) for x in result.ravel()]
            if not any(program.operations[x.index][0] == "unknown" for x in numbers):
                return results
    obstacle = _obstacle(equation, values)
    if not obstacle and name in _MOVES:
        return _rearrange(program, equation, values)
    if not obstacle and name == "convert_element_type":
        return [values[0]]
    array = None
    if not obstacle:
        arrays = [_symbolic(program, v) for v in values]
        arrays = [_inexact(program, x, ARGUMENT_UNITS.get(name)) for x in arrays]
        array = _arithmetic(program, equation, arrays, values)
        array = _inexact(program, array, RESULT_UNITS.get(name))
    if array is None:  # which is an error only if an output needs it: a status does not
        placeholder = program.write("unknown", obstacle or name)
        shapes = [v.aval.shape for v in equation.outvars]
        return [_array([placeholder] * int(np.prod(shape)), shape) for shape in shapes]
    return [array]


def _is_hypot(equation: Any, inner: Any) -> bool:
    """Whether an inner function is `jnp.hypot`, and not a derivative of it or another function."""
    structs = [
        jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype, weak_type=v.aval.weak_type)
        for v in equation.invars
    ]
    return len(structs) == 2 and str(inner) == str(
        jax.make_jaxpr(jnp.hypot)(*structs).eqns[0].params["jaxpr"]
    )


def _hypot(program: ScalarProgram, equation: Any, values: list) -> np.ndarray:
    """√(x² + y²), which is computed as a√(1 + (b/a)²) with a ≥ b and at most 2 units more."""
    arrays = np.broadcast_arrays(*(_symbolic(program, v) for v in values))
    pairs = zip(*(x.ravel() for x in arrays), strict=True)
    roots = [(x.power(2) + y.power(2)).apply("sqrt").inexact(2) for x, y in pairs]
    return _array(roots, equation.outvars[0].aval.shape)


def _inexact(program: ScalarProgram, scalars: Any, units: int | None) -> Any:
    """Numbers with an error of so many units, where XLA computes them."""
    if scalars is None or units is None or program.way != XLA:
        return scalars
    return _array([x.inexact(units) for x in scalars.ravel()], scalars.shape)


def _obstacle(equation: Any, values: list) -> str:
    """Why an operation of numbers of the state is not one of float64, or moves them to computed
    places; empty if neither."""
    name = equation.primitive.name
    types = {str(v.aval.dtype) for v in equation.outvars} - {"float64"}
    if name == "convert_element_type":
        types |= {str(equation.invars[0].aval.dtype)} - {"float64"}
        return f"a conversion to or from {', '.join(sorted(types))}" if types else ""
    if types:
        return f"{name} with a result of type {', '.join(sorted(types))}"
    if any(_is_symbolic(v) for i, v in enumerate(values) if i in _INDICES.get(name, ())):
        return name if name == "select_n" else f"{name} with computed indices"
    return ""


def _arithmetic(
    program: ScalarProgram, equation: Any, arrays: list, values: list
) -> np.ndarray | None:
    """The output of an operation; None for one that has no list of operations."""
    name, params = equation.primitive.name, equation.params
    shape = equation.outvars[0].aval.shape
    scalar_rule = _ELEMENTWISE.get(name)
    if scalar_rule is not None:
        spread = [np.broadcast_to(a, shape) for a in arrays]
        return _array(
            [scalar_rule(*xs) for xs in zip(*(a.ravel() for a in spread), strict=True)], shape
        )
    if name in UNARY:
        return _array([x.apply(name) for x in arrays[0].ravel()], shape)
    if name == "integer_pow":
        return _array([x.power(int(params["y"])) for x in arrays[0].ravel()], shape)
    if name in ("reduce_sum", "reduce_prod"):
        columns = np.moveaxis(arrays[0], params["axes"], range(len(params["axes"])))
        flat = columns.reshape(-1, int(np.prod(shape)))
        combine: Any = total if name == "reduce_sum" else math.prod
        return _array([combine(column) for column in flat.T], shape)
    if name == "dot_general":
        return _dot(params["dimension_numbers"], *arrays).reshape(shape)
    if name in _SUMS:
        return _linear(program, equation, values)
    if name == "cumprod":
        flips = slice(None, None, -1 if params["reverse"] else 1)
        columns = np.moveaxis(arrays[0], params["axis"], 0)[flips]
        return np.moveaxis(np.cumprod(columns, axis=0)[flips], 0, params["axis"])
    if name == "conv_general_dilated":
        return _convolution(program, equation, *arrays)
    if name in _AT_PLACES:
        return _at_places(equation, arrays, values)
    return None


def _power(x: ProgramNumber, y: ProgramNumber) -> ProgramNumber:
    """x^y: of a computed exponent, or one that is not half of an integer, for x > 0 only."""
    if y.value is None or not (2 * y.value).is_integer():
        return (x.apply("log") * y).apply("exp")
    return (
        x.power(int(y.value)) if y.value.is_integer() else x.apply("sqrt").power(int(2 * y.value))
    )


def _atan2(y: ProgramNumber, x: ProgramNumber) -> ProgramNumber:
    """The angle of (x, y), without a value where it jumps: at y = 0, x < 0."""
    return 2.0 * (y / ((x * x + y * y).apply("sqrt") + x)).apply("atan")


_ELEMENTWISE: dict[str, Callable] = {
    "add": lambda a, b: a + b,
    "add_any": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "square": lambda a: a.power(2),
    "rsqrt": lambda a: 1.0 / a.apply("sqrt"),
    "expm1": lambda a: a.apply("exp") - 1.0,
    "log1p": lambda a: (a + 1.0).apply("log"),
    "logistic": lambda a: 1.0 / ((-a).apply("exp") + 1.0),
    "tanh": lambda a: 1.0 - 2.0 / ((a * 2.0).apply("exp") + 1.0),
    "sinh": lambda a: (a.apply("exp") - (-a).apply("exp")) * 0.5,
    "cosh": lambda a: (a.apply("exp") + (-a).apply("exp")) * 0.5,
    "asinh": lambda a: (a + (a.power(2) + 1.0).apply("sqrt")).apply("log"),
    "acosh": lambda a: (a + (a.power(2) - 1.0).apply("sqrt")).apply("log"),
    "atanh": lambda a: ((1.0 + a).apply("log") - (1.0 - a).apply("log")) * 0.5,
    "exp2": lambda a: (a * a.program.constant(2.0).apply("log")).apply("exp"),
    "cbrt": lambda a: (a.apply("log") / 3.0).apply("exp"),
    "pow": _power,
    "atan2": _atan2,
}


_EXACT = {
    *_MOVES, "neg", "abs", "sign", "floor", "ceil", "round", "max", "min", "clamp", "rem", "iota",
    "convert_element_type", "reduce_max", "reduce_min", "cummax", "cummin", "sort", "real", "imag",
    "complex", "device_put", "scatter-min", "scatter-max", "bitcast_convert_type",
    "reduce_precision",
}  # fmt: skip
"""Operations without rounding: their results for constants are the same in every program."""


def _dot(dimensions: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Σ a b over the contracted axes; batch axes first, then those of a, then those of b."""
    (ca, cb), (ba, bb) = dimensions
    parts = []
    for x, axes, batch in ((a, ca, ba), (b, cb, bb)):
        free = [i for i in range(x.ndim) if i not in (*axes, *batch)]
        matrix = np.transpose(x, (*batch, *free, *axes))
        sizes = [x.shape[i] for i in batch], [x.shape[i] for i in free]
        parts.append(matrix.reshape(*(int(np.prod(s)) for s in sizes), -1))
    left, right = parts
    out = np.empty((left.shape[0], left.shape[1], right.shape[1]), object)
    for index in np.ndindex(out.shape):
        pairs = zip(left[index[0], index[1]], right[index[0], index[2]], strict=True)
        out[index] = total([x * y for x, y in pairs])
    return out


def _rearrange(program: ScalarProgram, equation: Any, values: list) -> list:
    """Apply an operation that only moves numbers to their places in a list."""
    name, params = equation.primitive.name, dict(equation.params)
    # Places are integers. At place 0 is the number with which a gather fills what is out of range.
    table: list[Any] = [program.write("unknown", f"{name} with an index out of range")]
    if params.get("fill_value") is not None:
        table = [program.constant(params["fill_value"])]
    params |= {"fill_value": 0} if "fill_value" in params else {}
    places = []
    for i, value in enumerate(values):
        if i in _INDICES.get(name, ()):
            places.append(jnp.asarray(value))
        else:
            flat = _symbolic(program, value)
            places.append(jnp.arange(len(table), len(table) + flat.size).reshape(flat.shape))
            table.extend(flat.ravel())
    out = equation.primitive.bind(*places, **params)
    results = out if equation.primitive.multiple_results else [out]
    return [_array([table[i] for i in np.asarray(x).ravel()], x.shape) for x in results]


def _linear(program: ScalarProgram, equation: Any, values: list) -> np.ndarray:
    """An operation that is linear in all its numbers, by its effect on each of them."""
    indices = _INDICES.get(equation.primitive.name, ())
    zeros = [np.asarray(v) if i in indices else np.zeros(np.shape(v)) for i, v in enumerate(values)]
    parts, shape = [], equation.outvars[0].aval.shape
    for i, value in enumerate(values):
        if i in indices:
            continue
        scalars = _symbolic(program, value)
        for place in np.ndindex(scalars.shape):
            scalar: Any = scalars[place]
            if scalar.value == 0:
                continue
            units = [x.copy() for x in zeros]
            units[i][place] = 1.0
            out = equation.primitive.bind(*map(jnp.asarray, units), **equation.params)
            parts.append((scalar, np.asarray(out)))
    zero = program.constant(0.0)
    sums = [
        total([zero, *(x * float(m.ravel()[k]) for x, m in parts if m.ravel()[k])])
        for k in range(int(np.prod(shape)))
    ]
    return _array(sums, shape)


def _convolution(
    program: ScalarProgram, equation: Any, signal: np.ndarray, kernel: np.ndarray
) -> np.ndarray:
    """Sums of products: the number of the factor in the kernel is the output for one unit."""
    labels = jnp.arange(1.0, kernel.size + 1).reshape(kernel.shape)
    terms: list[list] = [
        [program.constant(0.0)] for _ in range(math.prod(equation.outvars[0].aval.shape))
    ]
    for place in np.ndindex(signal.shape):
        unit = np.zeros(signal.shape)
        unit[place] = 1.0
        factors = np.ravel(equation.primitive.bind(jnp.asarray(unit), labels, **equation.params))
        for k in np.flatnonzero(factors):
            terms[k].append(signal[place] * kernel.flat[round(factors[k]) - 1])
    return _array([total(x) for x in terms], equation.outvars[0].aval.shape)


_AT_PLACES: dict[str, tuple[float, Callable]] = {
    "scatter-mul": (2.0, operator.mul),
    "scatter-min": (0.0, lambda x, y: extreme(x, y, -1.0)),
    "scatter-max": (2.0, lambda x, y: extreme(x, y, 1.0)),
}
"""Scatters: a number that changes 1, and what is done to a number and another one."""


def _at_places(equation: Any, arrays: list, values: list) -> np.ndarray | None:
    """Each number of an array combined with those that a scatter moves to its place."""
    number, combine = _AT_PLACES[equation.primitive.name]
    out, ones = arrays[0].copy(), [np.ones(np.shape(v)) for v in values]
    for place in np.ndindex(arrays[2].shape):
        factors = ones[2].copy()
        factors[place] = number
        operands = map(jnp.asarray, (ones[0], values[1], factors))
        target = np.asarray(equation.primitive.bind(*operands, **equation.params)) == number
        out[target] = [combine(x, arrays[2][place]) for x in out[target]]
    return None if any(x is None for x in out.ravel()) else out


def _while(program: ScalarProgram, params: Any, values: list) -> list | None:
    """A loop whose condition is one of constants, such as a count, written out; None for others."""
    counts, rounds = (params["cond_nconsts"], params["body_nconsts"]), 0
    condition, body = params["cond_jaxpr"], params["body_jaxpr"]
    first, carry = values[: counts[0]], values[sum(counts) :]
    while rounds < _MOST_ROUNDS:
        (goes_on,) = _evaluate(program, condition.jaxpr, condition.consts, [*first, *carry])
        if _is_symbolic(goes_on):
            return None
        if not goes_on:
            return carry
        inputs = [*values[counts[0] : sum(counts)], *carry]
        carry, rounds = _evaluate(program, body.jaxpr, body.consts, inputs), rounds + 1
    return None


def _scan(program: ScalarProgram, params: Any, values: list) -> list:
    """A loop of a fixed length, written out."""
    (nc, nk), length = scan_counts(params), params["length"]
    body, consts, carry = params["jaxpr"], values[:nc], values[nc : nc + nk]
    rows: list[list] = []
    order = range(length)[:: -1 if params["reverse"] else 1]
    for i in order:
        xs = [v[i : i + 1].reshape(v.shape[1:]) for v in map(np.asarray, values[nc + nk :])]
        out = _evaluate(program, body.jaxpr, body.consts, [*consts, *carry, *xs])
        carry = out[:nk]
        rows.append(out[nk:])
    if params["reverse"]:
        rows.reverse()
    stacks = [
        # Counters remain integers: they are indices in the derivative of the loop.
        np.stack([_symbolic(program, y) for y in ys] if any(map(_is_symbolic, ys)) else ys)
        for ys in zip(*rows, strict=True)
    ]
    return [*carry, *stacks]
