"""Component form within a kernel."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..._compat import ClosedJaxpr, bodies, scan_counts
from ..elementary import pow
from ..lanes import Evaluator, Value
from ..lanes._evaluate import _CALLS, IN_ARRAYS, SPLIT_UP_TO, _cut
from ..lanes._rules import algebra, apply, fold
from ..lanes._value import as_array, is_array, number, split, whole
from ..linear import by_elimination
from ._limits import NotInKernelError
from ._rows import Afterwards, Later, Round, Rows, Stored, joined, kept, rows_of


class InBlock(Evaluator):
    """Component form within a kernel: no arrays, rows written as they come."""

    def __init__(self, lanes: int, rows: Rows):
        super().__init__(lanes, {"pow": pow})
        self.in_kernel = True
        self.rows = rows
        self.rounds: list[Round | None] = []
        self.afterwards: list[Afterwards] = []

    def equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        name = eqn.primitive.name
        if eqn.params.get("name") == IN_ARRAYS:  # a kernel has no arrays
            (body,) = bodies(eqn)
            return self.closed(body, values)
        if name not in _CALLS and any(isinstance(v, Later) for v in values):
            return self._put_off(eqn, values)
        if name == "dynamic_slice" and values[1].known() is None:
            return [self._looked_up(eqn, values)]
        if name not in _CALLS | {"scan"} and any(isinstance(v, Stored) for v in values):
            return [self._of_rows(eqn, values)]
        if name == "iota":
            return [whole(x, False) for x in fold(eqn.primitive, [], eqn.params)]
        if name == "scan":
            return self.scan(eqn, values)
        if name in ("while", "cond"):
            return self._inside(None, lambda: super(InBlock, self).equation(eqn, values))
        if eqn.params.get("name") == "solve_dense" and len(values) == 2:
            return self.with_exchanges(eqn, values)
        return super().equation(eqn, values)

    def with_exchanges(self, eqn: Any, values: list[Value]) -> list[Value]:
        """A dense solve of any size without the library."""
        shapes = [jax.ShapeDtypeStruct(v.shape, v.dtype) for v in values]
        return self.inside(jax.make_jaxpr(by_elimination)(*shapes), values)

    def _looked_up(self, eqn: Any, values: list[Value]) -> Value:
        """A row of a table."""
        table, index = values[:2]
        if eqn.params["slice_sizes"] != (1, *table.shape[1:]):
            raise NotInKernelError("a part of an array is taken that is not one row.")
        i = as_array(index.entries()[()], index.dtype)
        if isinstance(table, Stored) and i.ndim:
            raise NotInKernelError("each lane takes a row of its own of a large input.")
        row = rows_of(table)(jnp.clip(i, 0, table.shape[0] - 1))
        return split(list(row.entries().flat), (1, *table.shape[1:]), table.dtype)

    def _of_rows(self, eqn: Any, values: list[Value]) -> Value:
        """Some rows of a large input, or more of them."""
        name, params, value = eqn.primitive.name, eqn.params, values[0]
        out = eqn.outvars[0].aval
        if name == "concatenate" and params["dimension"] == 0:
            on = any(map(self.has_lanes, values))
            return Stored(out.shape, out.dtype, joined(values), on)
        row = rows_of(value)
        if name == "slice" and value.shape[1:] == out.shape[1:] and not params["strides"]:
            first = params["start_indices"][0]
            if out.shape[0] > 1 or isinstance(row(first), Stored):
                on = self.has_lanes(value)
                return Stored(out.shape, out.dtype, lambda i: row(i + first), on)
            return split(list(row(first).entries().flat), out.shape, out.dtype)
        if name == "squeeze" and params["dimensions"] == (0,):
            return row(0)
        raise NotInKernelError("a large input is used other than row by row.")

    def _put_off(self, eqn: Any, values: list[Any]) -> list[Value]:
        """An equation that needs rows is evaluated after the kernel."""
        if eqn.primitive.name == "slice" and values[0].lead:
            (start, *_), (stop, *_) = eqn.params["start_indices"], eqn.params["limit_indices"]
            if eqn.outvars[0].aval.shape == (stop - start, *values[0].shape[1:]):
                return [values[0].sliced(start, stop)]
        if self.rounds or next(bodies(eqn), None) is not None:
            raise NotInKernelError("what a loop saves is used in another.")
        later = [Later(v.aval.shape, v.aval.dtype) for v in eqn.outvars]
        self.afterwards.append((lambda outside, x: outside.equation(eqn, x), values, later))
        return list(later)

    def _with_axis(self, value: Value) -> Value:
        """What a scan of one step makes of a value that it saves."""
        shape = (1, *value.shape)
        if not isinstance(value, Later):
            return split(list(value.entries().flat), shape, value.dtype)
        if value.lead:
            return value.stacked(1)
        later = Later(shape, value.dtype)
        self.afterwards.append((lambda _, x: [_stacked_alone(x[0])], [value], [later]))
        return later

    def _inside(self, what: "Round | None", evaluate: Callable) -> Any:
        """Evaluate in a round of a loop; None stands for one that may be left out."""
        self.rounds.append(what)
        try:
            return evaluate()
        finally:
            self.rounds.pop()

    def _batched(self, eqn: Any, values: list[Value]) -> list[Value]:
        raise NotInKernelError(f"{eqn.primitive.name} is applied to an array.")

    # --- primitives that Triton takes otherwise than XLA -----------------------------------------

    def _operate(self, eqn: Any, entries: list[Any], dtypes: list[Any]) -> Any:
        if not any(map(is_array, entries)):  # what is made of constants alone trips Triton up
            known = [np.asarray(number(e, d)) for e, d in zip(entries, dtypes, strict=True)]
            structural = algebra(eqn.primitive.name, entries, eqn.params)
            return (
                fold(eqn.primitive, known, eqn.params)[0][()] if structural is None else structural
            )
        own = _OWN.get(eqn.primitive.name)
        if own is not None and np.issubdtype(dtypes[-1], np.floating):
            return apply(own, entries, dtypes)
        return super()._operate(eqn, entries, dtypes)

    def _pairwise(self, operation: Callable, dtype: Any) -> Callable:
        if np.issubdtype(dtype, np.floating):
            operation = {lax.max: _maximum, lax.min: _minimum}.get(operation, operation)
        combined = super()._pairwise(operation, dtype)

        def combine(a: Any, b: Any) -> Any:
            if is_array(a) or is_array(b):
                return combined(a, b)
            with jax.ensure_compile_time_eval():
                result = combined(a, b)
                return np.asarray(result)[()] if is_array(result) else result

        return combine

    def on_any(self, x: jax.Array) -> jax.Array:
        return jnp.max(x.astype(jnp.int32)) > 0 if x.ndim else x

    def select(self, which: jax.Array, cases: Sequence[jax.Array]) -> jax.Array:
        chosen = cases[-1]
        for i, case in reversed(list(enumerate(cases[:-1]))):
            chosen = jnp.where(which == i, case, chosen)
        return chosen

    # --- loops -----------------------------------------------------------------------------------

    def pack(self, value: Value, has_lanes: bool, depth: int | None = 0) -> list[jax.Array]:
        if depth != 0:
            raise NotInKernelError(f"a loop carries an array of {value.size} numbers.")
        arrays = super().pack(value, has_lanes)
        known = [not (has_lanes or is_array(e)) for e in value.entries().flat]
        return [_computed(x) if k else x for x, k in zip(arrays, known, strict=True)]

    def _split_small(self, values: list[Value]) -> None:
        for value in values:
            if value.size <= SPLIT_UP_TO and not isinstance(value, Stored):
                value.entries()

    def has_lanes(self, value: Value) -> bool:
        return value.has_lanes if isinstance(value, Stored) else super().has_lanes(value)

    def scan(self, eqn: Any, values: list[Value]) -> list[Value]:
        body: ClosedJaxpr = eqn.params["jaxpr"]
        length, is_reversed = eqn.params["length"], eqn.params["reverse"]
        consts, carry, xs = _cut(values, *scan_counts(eqn.params))
        first, last = len(consts), len(consts) + len(carry)
        rows = [rows_of(x) for x in xs]
        if length == 0:
            kept = [v.aval for v in body.jaxpr.outvars[len(carry) :]]
            return [*carry, *(split([], (0, *a.shape), a.dtype) for a in kept)]
        if length == 1:
            out = self.closed(body, [*consts, *carry, *(r(0) for r in rows)])
            return [*out[: len(carry)], *(self._with_axis(v) for v in out[len(carry) :])]
        self._split_small([*consts, *carry])
        on = self.varying(body, consts, carry, xs)
        pack, unpack = self.packer(carry, [v.aval for v in body.jaxpr.invars[first:last]], on)
        saved: list[Later] = []

        def step(state, _):
            i, carry = state
            row = length - 1 - i if is_reversed else i

            def evaluate():
                out = self.inside(body, [*consts, *unpack(carry), *(r(row) for r in rows)])
                saved[:] = [self._save(v) for v in out[len(on) :]]
                return out[: len(on)]

            after = self._inside(Round(row, length), evaluate)
            return (i + 1, tuple(pack(after))), None

        state = (jnp.asarray(0, jnp.int32), tuple(pack(carry)))
        (_, end), _ = lax.scan(step, state, None, length)
        return [*unpack(list(end)), *(v.stacked(length) for v in saved)]

    def _save(self, value: Value) -> Later:
        """Write what a round of a loop saves."""
        if isinstance(value, Later):
            return value
        if None in self.rounds:
            raise NotInKernelError("a loop saves rows within a condition or a loop of any length.")
        rounds = [r for r in self.rounds if r is not None]
        row: Any = 0
        for i, length in rounds:
            row = row * length + i
        entries = list(value.entries().flat)
        total = math.prod(r.length for r in rounds)
        places = self.rows.reserve(total, len(entries), value.dtype)
        assert self.lanes is not None
        for place, entry in zip(places, entries, strict=True):
            self.rows.write(place, row, kept(as_array(entry, value.dtype), self.lanes))
        return Later(value.shape, value.dtype, places)


def _computed(x: jax.Array) -> jax.Array:
    """A constant as the result of an operation: Triton takes no other from a loop."""
    return lax.bitwise_or(x, False) if x.dtype == bool else lax.mul(x, jnp.ones_like(x))


def _stacked_alone(value: Value) -> Value:
    array, has_lanes = value.array()
    return whole(jnp.asarray(array)[None], has_lanes, is_bulk=True)


def _maximum(a, b):
    """max(a, b), NaN if one of them is: Triton's would be the other one."""
    return jnp.where((a > b) | (a != a), a, b)


def _minimum(a, b):
    return jnp.where((a < b) | (a != a), a, b)


_OWN: dict[str, Callable] = {
    "max": _maximum,
    "min": _minimum,
    "clamp": lambda low, x, high: _minimum(_maximum(x, low), high),
}
