"""Taylor coefficients of a function of one number, by series in place of its values."""

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import ClosedJaxpr, Literal, bodies, jaxpr_as_fun, of_one_equation

_CALLS = {"jit", "pjit", "closed_call"}
# Linear in their operands of real numbers, of which any may be constant.
_LINEAR = {
    "add", "add_any", "sub", "neg", "reduce_sum", "cumsum", "convert_element_type", "select_n",
    "reshape", "broadcast_in_dim", "transpose", "squeeze", "slice", "concatenate", "rev", "pad",
    "gather", "dynamic_slice", "dynamic_update_slice", "scatter-add", "split", "stack", "unstack",
    "copy", "copy_p",
}  # fmt: skip
_BILINEAR = {"mul", "dot_general"}


def taylor_coefficients(function: Callable[[Array], Array], point: Array, order: int) -> Array:
    """f(a), f'(a), f''(a)/2, …, stacked in front: shape (order + 1, *f(a).shape).

    Each operation y = g(x) of f is done on series in ε. Sums and products have their own rule; for
    all others y' = ∂g(x) x' gives the coefficient k + 1 of y from the first k + 1 of x and y, with
    the forward derivative of g (of a Newton solve the implicit one). The cost grows as order² (as
    2^order in loops and branches).

    **Source** Griewank & Walther 2008, *Evaluating Derivatives*, ch. 13.
    """
    jaxpr = jax.make_jaxpr(function)(point)
    program = _SeriesProgram(jaxpr, [_Series(order > 0, point, jnp.ones_like(point))])
    for k in range(order + 1):
        program.advance(k)
    (out,), (aval,) = program.outputs, jaxpr.out_avals
    return jnp.stack([_or_zeros(out[k], aval) for k in range(order + 1)])


class _Series:
    """A series in ε, `self[k]` None where zero by structure; `moves`: whether it depends on ε."""

    def __init__(self, moves: bool, *terms: Any):
        self.moves, self.terms = moves, list(terms)

    def __getitem__(self, k: int) -> Any:
        return self.terms[k] if k < len(self.terms) else None


class _Derivative(_Series):
    """d/dε of a series that is known one coefficient farther."""

    def __init__(self, series: _Series):
        super().__init__(True)
        self.series = series

    def __getitem__(self, k: int) -> Any:
        for j in range(len(self.terms), k + 1):
            term = self.series[j + 1]
            self.terms.append(None if term is None else (j + 1) * term)
        return self.terms[k]


class _SeriesProgram:
    """A jaxpr on series, one coefficient after the other. `context`: equations around it, with
    their operands and outputs, so that a derivative uses y = g(x) where it is known."""

    def __init__(self, closed_jaxpr: ClosedJaxpr, inputs: Sequence[_Series], context: tuple = ()):
        jaxpr = closed_jaxpr.jaxpr
        constants = [_Series(False, constant) for constant in closed_jaxpr.consts]
        values = dict(zip(jaxpr.constvars, constants, strict=True))
        values.update(zip(jaxpr.invars, inputs, strict=True))

        def series_of(atom: Any) -> _Series:
            return _Series(False, atom.val) if isinstance(atom, Literal) else values[atom]

        self.parts: list[Any] = []
        for eqn in jaxpr.eqns:
            operands = list(map(series_of, eqn.invars))
            outputs = next((y for e, x, y in context if _is_equal(eqn, operands, e, x)), None)
            if outputs is None:
                if eqn.primitive.name in _CALLS:
                    part = _SeriesProgram(next(bodies(eqn)), operands, context)
                else:
                    part = _Operation(jaxpr, eqn, operands, context)
                self.parts.append(part)
                outputs = part.outputs
            values.update(zip(eqn.outvars, outputs, strict=True))
        self.outputs = list(map(series_of, jaxpr.outvars))

    def advance(self, k: int) -> None:
        for part in self.parts:
            part.advance(k)


def _is_equal(eqn: Any, operands: list, other: Any, other_operands: list) -> bool:
    """Whether two equations do the same to the same series."""
    if eqn.primitive is not other.primitive or len(operands) != len(other_operands):
        return False
    return all(map(operator.is_, operands, other_operands)) and eqn.params == other.params


class _Operation:
    """One equation of a jaxpr on series."""

    def __init__(self, jaxpr: Any, eqn: Any, operands: list[_Series], context: tuple):
        self.eqn, self.operands, self.context = eqn, operands, context
        moves = any(operand.moves for operand in operands)
        self.outputs = [_Series(moves and _is_real(variable)) for variable in eqn.outvars]
        self.derivative_program: _SeriesProgram | None = None
        # A jaxpr of this equation alone.
        variables = dict.fromkeys(x for x in eqn.invars if not isinstance(x, Literal))
        self.places = [eqn.invars.index(variable) for variable in variables]
        self.alone = of_one_equation(jaxpr, eqn, list(variables))

    def function(self, *operands: Any) -> list[Any]:
        """g: all outputs from all operands."""
        return jaxpr_as_fun(self.alone)(*(operands[i] for i in self.places))

    def values(self, k: int) -> list[Any]:
        """Coefficients of the operands; numbers that are not real are constant."""
        pairs = zip(self.operands, self.eqn.invars, strict=True)
        return [_or_zeros(x[k], atom) if _is_real(atom) else x[0] for x, atom in pairs]

    def apply(self, *operands: Any) -> list[Any]:
        """g of sums and products, of which literals are operands too."""
        outputs = self.eqn.primitive.bind(*operands, **self.eqn.params)
        return outputs if self.eqn.primitive.multiple_results else [outputs]

    def advance(self, k: int) -> None:
        """Compute the coefficients k of the outputs."""
        if k == 0 or any(series.moves for series in self.outputs):
            terms = self.coefficients(k) if k else self.function(*self.values(0))
            for series, term in zip(self.outputs, terms, strict=True):
                series.terms.append(term)

    def coefficients(self, k: int) -> list[Any]:
        """Those of order k ≥ 1."""
        name, x = self.eqn.primitive.name, self.operands
        if name in _LINEAR:
            is_zero = all(y[k] is None for y in x)
            return [None] * len(self.outputs) if is_zero else self.apply(*self.values(k))
        if name in _BILINEAR:
            pairs = [(x[0][j], x[1][k - j]) for j in range(k + 1)]
            return [_sum(self.apply(a, b)[0] for a, b in pairs if not (a is None or b is None))]
        if name == "div":
            pairs = [(x[1][j], self.outputs[0][k - j]) for j in range(1, k + 1)]
            terms = [-(a * b) for a, b in pairs if not (a is None or b is None)]
            numerator = _sum([*terms, *(a for a in (x[0][k],) if a is not None)])
            return [None if numerator is None else numerator / x[1][0]]
        if self.derivative_program is None:
            self.derivative_program = self.derivative()
        self.derivative_program.advance(k - 1)
        changes = iter(self.derivative_program.outputs)
        slopes = [next(changes)[k - 1] if y.moves else None for y in self.outputs]
        return [None if y is None else y / k for y in slopes]

    def derivative(self) -> _SeriesProgram:
        """y' = ∂g(x) x' as a program on x and x'."""
        moving = [i for i, x in enumerate(self.operands) if x.moves]

        def change(values, changes):
            def moving_outputs(*replacements):
                new = dict(zip(moving, replacements, strict=True))
                outputs = self.function(*(new.get(i, x) for i, x in enumerate(values)))
                return [y for y, s in zip(outputs, self.outputs, strict=True) if s.moves]

            return jax.jvp(moving_outputs, [values[i] for i in moving], changes)[1]

        values = self.values(0)
        jaxpr = jax.make_jaxpr(change)(values, [values[i] for i in moving])
        inputs = [*self.operands, *(_Derivative(self.operands[i]) for i in moving)]
        equation = self.eqn, self.operands, self.outputs
        return _SeriesProgram(jaxpr, inputs, (*self.context, equation))


def _is_real(atom: Any) -> bool:
    return jnp.issubdtype(atom.aval.dtype, jnp.inexact)


def _or_zeros(term: Any, like: Any) -> Any:
    like = getattr(like, "aval", like)
    return jnp.zeros(like.shape, like.dtype) if term is None else term


def _sum(terms: Iterable[Any]) -> Any:
    """The sum, None without terms."""
    terms = list(terms)
    return functools.reduce(operator.add, terms) if terms else None
