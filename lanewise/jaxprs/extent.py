"""How large a function is: operations, and numbers that its loops carry."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

from ..llvm.ir import MOST_OPERATIONS
from .jaxapi import ClosedJaxpr, bodies, is_once, scan_counts


def functions_in(eqn: Any) -> list[ClosedJaxpr]:
    """The function of a `call`, if an equation is one: it is not among its `bodies`."""
    is_call = eqn.primitive.name == "lanewise"
    return [eqn.params["program"].trace.closed_jaxpr] if is_call else []


def carry_size(jaxpr: Any) -> int:
    """Numbers that the innermost loop with most of them carries from step to step."""
    largest = 0
    for eqn in jaxpr.eqns:
        for body in bodies(eqn):
            largest = max(largest, carry_size(body.jaxpr))
        if eqn.primitive.name == "scan":
            _, count = scan_counts(eqn.params)
            state = [var.aval for var in eqn.outvars[:count]]
            # Large arrays stay in memory and take no register; integers are few.
            sizes = [aval.size for aval in state if aval.size <= 64 and aval.dtype.kind == "f"]
            largest = max(largest, sum(sizes))
    return largest


MOST_IN_PAIRS = 150_000
"""The same for functions with exact products, whose long chains of sums XLA compiles to code that
takes minutes to run."""


FOR_AN_EQUATION = 8
"""Operations that are compiled in the time that XLA takes for one equation, about a millisecond."""


def most_operations(jaxpr: Any) -> int:
    """The largest number of operations of a function for which code is generated."""
    limit = MOST_IN_PAIRS if _has_exact_products(jaxpr) else MOST_OPERATIONS
    return max(limit, FOR_AN_EQUATION * _equation_count(jaxpr))


def _equation_count(jaxpr: Any) -> int:
    inner = (_equation_count(function.jaxpr) for eqn in jaxpr.eqns for function in _evaluated(eqn))
    return len(jaxpr.eqns) + sum(inner)


def _has_exact_products(jaxpr: Any) -> bool:
    functions = [f for eqn in jaxpr.eqns for f in (*bodies(eqn), *functions_in(eqn))]
    has_one = any(eqn.primitive.name == "lost_by_product" for eqn in jaxpr.eqns)
    return has_one or any(_has_exact_products(function.jaxpr) for function in functions)


def _evaluated(eqn: Any) -> list[ClosedJaxpr]:
    if eqn.primitive.name == "custom_linear_solve":  # only this one of its four functions is run
        return [eqn.params["jaxprs"].solve]
    return [*bodies(eqn), *functions_in(eqn)]


def primitives_in(jaxpr: Any) -> set[str]:
    """The names of the primitives of a function and of all that it calls."""
    inner = (primitives_in(body.jaxpr) for eqn in jaxpr.eqns for body in _evaluated(eqn))
    return {eqn.primitive.name for eqn in jaxpr.eqns}.union(*inner)


def operation_count(jaxpr: Any) -> int:
    """How many operations on numbers the evaluation is made of, loops counted once; roughly."""
    return sum(_operations(eqn) for eqn in _innermost(jaxpr))


def calls_of_marked(jaxpr: Any) -> dict[Any, int]:
    """The jaxprs of functions marked by `once`, and in how many places they are called."""
    places: dict[Any, int] = {}
    visits: set[Any] = set()

    def count(jaxpr: Any) -> None:
        for eqn in jaxpr.eqns:
            for function in (f.jaxpr for f in _evaluated(eqn)):
                if is_once(eqn):
                    places[function] = places.get(function, 0) + 1
                if function not in visits:
                    visits.add(function)
                    count(function)

    count(jaxpr)
    return places


def largest_bytes(jaxpr: Any) -> int:
    """Bytes of the largest operands and results of an operation, with all arrays of one."""
    equations = ((*eqn.invars, *eqn.outvars) for eqn in _innermost(jaxpr))
    sizes = (sum(v.aval.size * v.aval.dtype.itemsize for v in arrays) for arrays in equations)
    return max([1, *sizes])


def _innermost(jaxpr: Any) -> Iterator[Any]:
    """The equations of a function and of all that it calls that call no function."""
    for eqn in jaxpr.eqns:
        functions = _evaluated(eqn)
        if not functions:
            yield eqn
        for function in functions:
            yield from _innermost(function.jaxpr)


def _operations(eqn: Any) -> int:
    name, size = eqn.primitive.name, max((v.aval.size for v in eqn.outvars), default=0)
    if name == "dot_general":
        return size * _terms(eqn)  # one fused multiply-add for each term
    if name.startswith("reduce_"):
        return eqn.invars[0].aval.size
    if name == "eliminate":
        n, matrices = eqn.invars[0].aval.shape[-1], eqn.invars[0].aval.size
        return matrices * n // 3 + size * n - matrices  # more columns of one matrix
    return 0 if name in _FREE else size


def _terms(eqn: Any) -> int:
    """Terms of each sum of a matrix product."""
    (axes, _), _ = eqn.params["dimension_numbers"]
    return math.prod(eqn.invars[0].aval.shape[i] for i in axes)


_MOVES = (
    "broadcast_in_dim reshape squeeze expand_dims transpose slice concatenate stack split "
    "unstack pad rev copy convert_element_type stop_gradient"
)
_FREE = frozenset(_MOVES.split())


_FUNCTIONS = (
    "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p "
    "log2 cbrt erf erfc erf_inv logistic pow"
)
_COSTS = {**dict.fromkeys(_FUNCTIONS.split(), 24), "div": 6, "sqrt": 6, "rsqrt": 12, "rem": 12}


def cost_of(name: str) -> int:
    """The time of an elementwise operation, where that of an addition is 1."""
    return _COSTS.get(name, 1)


SHORT = 8
"""An axis that is not longer is written out, not computed by a loop."""

TERMS_READ_ONCE, TERMS_IN_BLOCKS = 10_000, 2**26
"""Terms of matrix products in a round, above which XLA is faster if they take most of the time:
where each number of a matrix is used at most twice, and of all others."""


def reason_for_xla(jaxpr: Any) -> str | None:
    """Why XLA is faster for a program with long arrays; None if it is not."""
    for body in _loop_bodies(jaxpr) or [jaxpr]:
        single_use = blocks = remainder = 0
        for eqn in _innermost(body):
            operations = _operations(eqn)
            # A network of comparisons would be longer than all other code.
            if eqn.primitive.name == "sort":
                return f"the sort of {eqn.invars[0].aval.size} numbers"
            # Short sums are written out, as other operations are.
            if eqn.primitive.name != "dot_general" or _terms(eqn) <= SHORT:
                remainder += operations * cost_of(eqn.primitive.name)
            # How often each number of an operand is used.
            elif any(operations <= 2 * v.aval.size for v in eqn.invars):
                single_use += operations
            else:
                blocks += operations
        if single_use > max(TERMS_READ_ONCE, 3 * remainder):
            return f"matrices of {single_use} numbers times vectors: XLA reads them once in a batch"
        if blocks > max(TERMS_IN_BLOCKS, 3 * remainder):
            return f"matrix products of {blocks} terms: XLA computes them in blocks for the cache"
    return None


def _loop_bodies(jaxpr: Any) -> list[Any]:
    bodies_of = []
    for eqn in jaxpr.eqns:
        functions = _evaluated(eqn)
        if eqn.primitive.name in _LOOPS:
            bodies_of += [function.jaxpr for function in functions]
        for function in functions:
            bodies_of += _loop_bodies(function.jaxpr)
    return bodies_of


LONG_CARRY, LONG_VALUE, LARGE_SYSTEM = 48, 4096, 32
HALF_CARRY, PAIRS = 24, 384
"""Sums over all pairs of 14 bodies or more: number by number they are slower, also in a batch."""


def has_long_arrays(jaxpr: Any) -> bool:
    """Whether a loop carries an array of more than 48 elements, or computes one of more than 4096
    in a round (384 if it carries more than 24 and has no large matrices); without any loop,
    whether an array of more than 48 elements is computed.

    Rows that a loop collects do not count, nor what is done to them after it. A linear system of
    more than 32 unknowns has long arrays, too.
    """
    unknowns = _most_unknowns(jaxpr)
    if unknowns > LARGE_SYSTEM or _has_long_loop(jaxpr):
        return True
    # The Jacobian of a small system is no long array.
    return not unknowns and not _has_loop(jaxpr) and _longest(jaxpr) > LONG_CARRY


def _most_unknowns(jaxpr: Any) -> int:
    """Unknowns of the largest linear system."""
    systems = (eqn for eqn in _innermost(jaxpr) if eqn.primitive.name == "eliminate")
    return max((eqn.invars[0].aval.shape[-1] for eqn in systems), default=0)


def _has_long_loop(jaxpr: Any) -> bool:
    for eqn in jaxpr.eqns:
        if eqn.primitive.name in _LOOPS:
            values = [_longest(body.jaxpr) for body in bodies(eqn)]
            has_pairs = _carried(eqn) > HALF_CARRY and not _has_matrices([*bodies(eqn)])
            limit = PAIRS if has_pairs else LONG_VALUE
            if _carried(eqn) > LONG_CARRY or max(values) > limit:
                return True
        if any(_has_long_loop(f.jaxpr) for f in (*bodies(eqn), *functions_in(eqn))):
            return True
    return False


def _has_matrices(functions: Sequence[ClosedJaxpr]) -> bool:
    """Whether a linear system is solved, or a product of matrices has more than 384 elements, each
    a sum of more than 8 terms."""
    equations = [eqn for function in functions for eqn in _innermost(function.jaxpr)]
    products = (eqn for eqn in equations if eqn.primitive.name == "dot_general")
    is_large = any(eqn.outvars[0].aval.size > PAIRS and _terms(eqn) > SHORT for eqn in products)
    return is_large or any(eqn.primitive.name == "eliminate" for eqn in equations)


def _has_loop(jaxpr: Any) -> bool:
    return any(
        eqn.primitive.name in _LOOPS
        or any(_has_loop(f.jaxpr) for f in (*bodies(eqn), *functions_in(eqn)))
        for eqn in jaxpr.eqns
    )


def _carried(eqn: Any) -> int:
    """Elements of the longest array that a loop carries."""
    count = scan_counts(eqn.params)[1] if eqn.primitive.name == "scan" else len(eqn.outvars)
    return max((var.aval.size for var in eqn.outvars[:count]), default=0)


def _longest(jaxpr: Any) -> int:
    """Elements of the longest array that is computed. Moves, choices between arrays and the rows of
    loops do not count: a table of a function passes through them."""
    longest = 0
    for eqn in jaxpr.eqns:
        inner = (*bodies(eqn), *functions_in(eqn))
        sizes = [_longest(f.jaxpr) for f in inner]
        if eqn.primitive.name == "scan":
            sizes.append(_carried(eqn))
        elif not inner and eqn.primitive.name not in (*_FREE, "select_n"):
            sizes += [var.aval.size for var in eqn.outvars]
        longest = max([longest, *sizes])
    return longest


_LOOPS = ("scan", "while")
