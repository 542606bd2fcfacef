"""A function of one lane on many lanes as one GPU kernel, its loops with the state in registers.

In component form every number of a lane is a variable of its own, and a block of lanes goes through
all loops of the function within one call of a Pallas kernel (Triton backend): one lane a thread,
nothing in memory but inputs, outputs and the rows that a loop saves. Rows are written from within
the loop; what is made of them afterwards (reshaping, joining) is left to XLA. A function that does
not go into a kernel is found out by looking at its program before anything is compiled.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._compat import ClosedJaxpr, Jaxpr, Literal, aval, bodies, scan_counts, with_outputs
from .dependence import fixed_point, reached_outputs
from .elementary import pow
from .lanes import Evaluator, Value
from .lanes._evaluate import _CALLS, IN_ARRAYS, SPLIT_UP_TO, _cut
from .lanes._rules import algebra, apply, fold
from .lanes._value import as_array, is_array, number, on_lanes, split, whole
from .linear import by_elimination
from .together import AGREED

BLOCK = 128
"""Lanes of a block: four warps, one lane a thread."""

LANES_OF_A_WARP = 32

ROW_UP_TO = 32
"""Entries of a row of an input, if there is an axis to cut it by."""


class NotInKernelError(Exception):
    """The function does not go into a kernel; the message says why."""


def run_in_kernel(
    jaxpr: Jaxpr,
    arrays: Sequence[Any],
    has_lanes: Sequence[bool | None],
    lanes: int,
    *,
    block: int | None = None,
    interpret: bool = False,
) -> list[jax.Array]:
    """The outputs of `jaxpr` on `lanes` lanes, first axis the lanes, from one kernel.

    `arrays` are its constants and its inputs. Where `has_lanes`, the first axis of an array is that
    of the lanes; where that is None, the array is known while tracing. `block` lanes (rounded up
    to a power of two) make a block. With `interpret` the kernel is evaluated operation by operation
    on any device, slowly: for tests.

    **Raises** `NotInKernelError`, before anything is compiled.
    """
    jaxpr, used = with_outputs(jaxpr, [True] * len(jaxpr.outvars))
    inputs = [_Input(x, on) for x, on, u in zip(arrays, has_lanes, used, strict=True) if u]
    block = _power_of_two(min(block or BLOCK, lanes))
    count = -(-lanes // block)
    operands = [x for i in inputs for x in i.operands(count * block - lanes)]
    program = _Program(jaxpr, inputs, block)
    written, rows = program.inspect()
    outputs = _call(program, operands, written, rows, count, interpret)
    return program.finish(outputs[: len(written)], outputs[len(written) :], lanes)


def _power_of_two(n: int) -> int:
    return 1 << max(n - 1, 0).bit_length()


class _Input:
    """An array as a kernel reads it.

    A small one entry by entry, where lanes share it from one operand. A large one row by row, when
    a loop comes to it: `lead` are the axes of the rows. None of it if it is known.
    """

    def __init__(self, array: Any, has_lanes: bool | None):
        self.array, self.has_lanes = array, has_lanes
        self.shape = tuple(array.shape[1:] if has_lanes else array.shape)
        self.dtype = np.dtype(array.dtype)
        size = 0 if has_lanes is None else math.prod(self.shape)
        self.lead = _lead(self.shape) if size > SPLIT_UP_TO else ()
        self.rows = math.prod(self.lead) if self.lead else None
        self.entries = math.prod(self.shape[len(self.lead) :]) if size else 0
        if has_lanes is not None and self.dtype.name not in _KEPT_AS:
            raise NotInKernelError(f"an input is {self.dtype}.")
        if self.entries > SPLIT_UP_TO:
            raise NotInKernelError(f"an input has {size} entries.")

    def operands(self, missing: int) -> list[jax.Array]:
        """The arrays handed over, lanes last, filled up by copies of the last of them."""
        if self.entries == 0:
            return []
        x = jnp.asarray(self.array).astype(_KEPT_AS[self.dtype.name])
        if not self.has_lanes:
            columns = x.reshape(self.rows or 1, self.entries)
            return [columns.ravel()] if self.rows is None else list(columns.T)
        if missing:
            x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (missing, *x.shape[1:]))])
        columns = x.reshape(x.shape[0], self.rows or 1, self.entries)
        columns = [columns[:, :, i].T for i in range(self.entries)]
        return [c[0] for c in columns] if self.rows is None else columns

    def shapes(self, block: int) -> list[jax.ShapeDtypeStruct]:
        """What a block reads: entries, of one row."""
        shape = (block,) if self.has_lanes else ()
        return [jax.ShapeDtypeStruct(shape, _KEPT_AS[self.dtype.name])] * self.entries

    def value(self, reads: Sequence[Callable]) -> Value:
        """The value in a block. `reads` give an entry, in the row of that number."""
        if self.has_lanes is None:
            return whole(np.asarray(self.array), False)

        def part(depth: int, i: Any) -> Value:
            """That which is left of the value behind `depth` axes, in the row of that number."""
            shape = self.shape[depth:]
            if depth == len(self.lead):
                return split([_restored(r(i), self.dtype) for r in reads], shape, self.dtype)
            return _Stored(
                shape, self.dtype, lambda k: part(depth + 1, i * shape[0] + k), bool(self.has_lanes)
            )

        return part(0, 0)


def _lead(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The leading axes whose rows are read one by one."""
    depth = 1
    while depth < len(shape) - 1 and math.prod(shape[depth:]) > ROW_UP_TO:
        depth += 1
    return shape[:depth]


_KEPT_AS = {
    "float32": np.dtype("float32"),
    "float64": np.dtype("float64"),
    "int32": np.dtype("int32"),
    "int64": np.dtype("int64"),
    "bool": np.dtype("int32"),
}
"""The types of numbers that go into a kernel, and the type by which memory holds them."""


def _restored(x: Any, dtype: np.dtype) -> Any:
    return x != 0 if dtype == np.bool_ else x


def _kept(x: jax.Array, block: int) -> jax.Array:
    """x as it is written: on all lanes, and no truth value."""
    return on_lanes(x, block).astype(_KEPT_AS[np.dtype(x.dtype).name])


# --- in a block -------------------------------------------------------------------------------


class _Program:
    """What a kernel computes, and what is left to do after it."""

    def __init__(self, jaxpr: Jaxpr, inputs: list[_Input], block: int):
        self.jaxpr, self.inputs, self.block = jaxpr, inputs, block
        self.afterwards: list[_Afterwards] = []
        self.outputs: list[Value] = []
        self.exported: list[Value] = []

    def inspect(self) -> tuple[list[np.dtype], list[tuple[int, np.dtype]]]:
        """Types of the entries that the kernel writes; lengths and types of the rows."""
        shapes = [s for i in self.inputs for s in i.shapes(self.block)]
        rows = _Rows()

        def dry(*parts):
            return self.in_block([lambda i, x=x: x for x in parts], rows)

        body = jax.make_jaxpr(dry)(*shapes)
        _inspect(body.jaxpr, self.block)
        return [a.dtype for a in body.out_avals], rows.kinds

    def in_block(self, reads: Sequence[Callable], rows: "_Rows") -> list[jax.Array]:
        """The entries to be written, of one block; rows are written as they come."""
        rest = iter(reads)
        values = [i.value([next(rest) for _ in range(i.entries)]) for i in self.inputs]
        evaluator = _InBlock(self.block, rows)
        consts = len(self.jaxpr.constvars)
        outputs = evaluator.jaxpr(self.jaxpr, values[:consts], values[consts:])
        self.outputs, self.afterwards = outputs, evaluator.afterwards
        needed = [v for _, inputs, _ in evaluator.afterwards for v in inputs]
        once = {id(v): v for v in [*outputs, *needed] if not isinstance(v, _Later)}
        self.exported = list(once.values())
        return [_kept(e, self.block) for v in self.exported for e in _traced(v)]

    def finish(self, written: Sequence[Any], rows: Sequence[Any], lanes: int) -> list[jax.Array]:
        """The outputs, of what was written."""
        outside = Evaluator(-(-lanes // self.block) * self.block, {})
        left, known = iter(written), {}
        for value in self.exported:
            entries = [
                _restored(next(left), value.dtype) if is_array(e) else e
                for e in value.entries().flat
            ]
            known[id(value)] = split(entries, value.shape, value.dtype)

        def read(value: Value) -> Value:
            if not (isinstance(value, _Later) and value.lead):
                return known[id(value)]
            parts = [rows[i].reshape(*value.lead, -1)[value.cut] for i in value.rows]
            parts = [_restored(x, value.dtype) for x in parts]
            depth = len(value.lead)
            entries = split(parts, value.shape[depth:], value.dtype).entries()
            return Value(value.shape, value.dtype, entries=entries, lead=value.shape[:depth])

        for operation, inputs, outputs in self.afterwards:
            results = operation(outside, [read(v) for v in inputs])
            known.update(zip(map(id, outputs), results, strict=True))
        return [_lanes_first(read(v), lanes) for v in self.outputs]


def _traced(value: Value) -> list[Any]:
    return [e for e in value.entries().flat if is_array(e)]


def _lanes_first(value: Value, lanes: int) -> jax.Array:
    array, has_lanes = value.array()
    array = jnp.asarray(array)
    if has_lanes:
        return jnp.moveaxis(array, -1, 0)[:lanes]
    return jnp.broadcast_to(array[None], (lanes, *array.shape))


Row = Callable[[Any], Value]
"""The part of a value of that number along its first axis: a known one, or one of a loop."""


class _Stored(Value):
    """A large value in memory, read row by row."""

    def __init__(self, shape: Sequence[int], dtype: Any, row: Row, has_lanes: bool):
        super().__init__(shape, dtype, lead=shape[:1], is_bulk=True, has_lanes=has_lanes)
        self.row, self.has_lanes = row, has_lanes

    def known(self):
        return None

    def entries(self):
        raise NotInKernelError("a large input is used other than row by row.")

    def array(self):
        raise NotInKernelError("a large input is used other than row by row.")


def _rows_of(value: Value) -> Row:
    if isinstance(value, _Stored):
        return value.row
    if isinstance(value, _Later) or value.size > SPLIT_UP_TO:
        raise NotInKernelError("a loop takes in rows that another saves, or a large table.")
    shape = value.shape[1:]
    columns = value.entries().reshape(value.shape[0], -1).T

    def row(i):
        if isinstance(i, int):
            return split([column[i] for column in columns], shape, value.dtype)
        cases = [[as_array(e, value.dtype) for e in column] for column in columns]
        return split([_chosen(i, c) for c in cases], shape, value.dtype)

    return row


def _chosen(i: jax.Array, cases: Sequence[Any]) -> Any:
    """The case of that number."""
    chosen = cases[-1]
    for k, case in reversed(list(enumerate(cases[:-1]))):
        chosen = jnp.where(i == k, case, chosen)
    return chosen


def _joined(values: Sequence[Value]) -> Row:
    """The rows of the one after those of the other."""
    rows, lengths = [_rows_of(v) for v in values], [v.shape[0] for v in values]
    starts = np.cumsum([0, *lengths[:-1]]).tolist()

    def row(i):
        if isinstance(i, int):
            k = int(np.searchsorted(starts, i, side="right")) - 1
            return rows[k](i - starts[k])
        found = [
            r(jnp.clip(i - a, 0, n - 1)) for r, a, n in zip(rows, starts, lengths, strict=True)
        ]
        out = list(found[0].entries().flat)
        for start, mine in zip(starts[1:], found[1:], strict=True):
            pairs = zip(out, mine.entries().flat, strict=True)
            out = [
                jnp.where(i < start, as_array(a, mine.dtype), as_array(b, mine.dtype))
                for a, b in pairs
            ]
        return split(out, found[0].shape, found[0].dtype)

    return row


class _Later(Value):
    """A value that there is after the kernel only: rows that a loop saves, or made of them.

    `rows` are where those of its entries are written, `lead` the lengths of the loops, and `cut`
    what of them it is made of.
    """

    def __init__(
        self,
        shape: Sequence[int],
        dtype: Any,
        rows: Sequence[int] = (),
        lead: Sequence[int] = (),
        cut: Sequence[slice] = (),
    ):
        super().__init__(shape, dtype, lead=lead, is_bulk=True)
        self.rows, self.cut = tuple(rows), tuple(cut)

    def known(self):
        return None

    def entries(self):
        raise NotInKernelError("what a loop saves is used before the end.")

    def array(self):
        raise NotInKernelError("what a loop saves is used before the end.")

    def stacked(self, length: int) -> "_Later":
        """The rows of all rounds of a loop around the one that saves them."""
        lead, cut = (length, *self.lead), (slice(None), *self.cut)
        return _Later((length, *self.shape), self.dtype, self.rows, lead, cut)

    def sliced(self, start: int, stop: int) -> "_Later":
        """Some of the rows of the last loop."""
        first, *rest = self.cut
        before = first.start or 0
        cut = slice(before + start, before + stop), *rest
        return _Later((stop - start, *self.shape[1:]), self.dtype, self.rows, self.lead, cut)


_Afterwards = tuple[Callable, list[Value], list[_Later]]
"""(of an evaluator and the inputs) -> outputs; its inputs; its outputs."""


class _Rows:
    """Where rows are written: one array (length, lanes) for each entry. In a dry run there is none,
    and what it would take is noted."""

    def __init__(self, refs: Sequence[Any] | None = None):
        self.refs, self.kinds = refs, []

    def reserve(self, length: int, count: int, dtype: np.dtype) -> list[int]:
        first = len(self.kinds)
        self.kinds += [(length, dtype)] * count
        return list(range(first, len(self.kinds)))

    def write(self, place: int, i: jax.Array, x: jax.Array) -> None:
        if self.refs is not None:
            self.refs[place][i, :] = x


class _Round(NamedTuple):
    """A round of a loop that is being evaluated: its number, of how many."""

    number: Any
    length: int


class _InBlock(Evaluator):
    """Component form within a kernel: no arrays, rows written as they come."""

    def __init__(self, lanes: int, rows: _Rows):
        super().__init__(lanes, {"pow": pow})
        self.in_kernel = True
        self.rows = rows
        self.rounds: list[_Round | None] = []
        self.afterwards: list[_Afterwards] = []

    def equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        name = eqn.primitive.name
        if eqn.params.get("name") == IN_ARRAYS:  # a kernel has no arrays
            (body,) = bodies(eqn)
            return self.closed(body, values)
        if name not in _CALLS and any(isinstance(v, _Later) for v in values):
            return self._put_off(eqn, values)
        if name == "dynamic_slice" and values[1].known() is None:
            return [self._looked_up(eqn, values)]
        if name not in _CALLS | {"scan"} and any(isinstance(v, _Stored) for v in values):
            return [self._of_rows(eqn, values)]
        if name == "iota":
            return [whole(x, False) for x in fold(eqn.primitive, [], eqn.params)]
        if name == "scan":
            return self.scan(eqn, values)
        if name in ("while", "cond"):
            return self._inside(None, lambda: super(_InBlock, self).equation(eqn, values))
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
        if isinstance(table, _Stored) and i.ndim:
            raise NotInKernelError("each lane takes a row of its own of a large input.")
        row = _rows_of(table)(jnp.clip(i, 0, table.shape[0] - 1))
        return split(list(row.entries().flat), (1, *table.shape[1:]), table.dtype)

    def _of_rows(self, eqn: Any, values: list[Value]) -> Value:
        """Some rows of a large input, or more of them."""
        name, params, value = eqn.primitive.name, eqn.params, values[0]
        out = eqn.outvars[0].aval
        if name == "concatenate" and params["dimension"] == 0:
            on = any(map(self.has_lanes, values))
            return _Stored(out.shape, out.dtype, _joined(values), on)
        row = _rows_of(value)
        if name == "slice" and value.shape[1:] == out.shape[1:] and not params["strides"]:
            first = params["start_indices"][0]
            if out.shape[0] > 1 or isinstance(row(first), _Stored):
                on = self.has_lanes(value)
                return _Stored(out.shape, out.dtype, lambda i: row(i + first), on)
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
        later = [_Later(v.aval.shape, v.aval.dtype) for v in eqn.outvars]
        self.afterwards.append((lambda outside, x: outside.equation(eqn, x), values, later))
        return list(later)

    def _with_axis(self, value: Value) -> Value:
        """What a scan of one step makes of a value that it saves."""
        shape = (1, *value.shape)
        if not isinstance(value, _Later):
            return split(list(value.entries().flat), shape, value.dtype)
        if value.lead:
            return value.stacked(1)
        later = _Later(shape, value.dtype)
        self.afterwards.append((lambda _, x: [_stacked_alone(x[0])], [value], [later]))
        return later

    def _inside(self, what: "_Round | None", evaluate: Callable) -> Any:
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

    def pack(self, value: Value, has_lanes: bool, as_whole: bool = False) -> list[jax.Array]:
        if as_whole:
            raise NotInKernelError(f"a loop carries an array of {value.size} numbers.")
        arrays = super().pack(value, has_lanes)
        known = [not (has_lanes or is_array(e)) for e in value.entries().flat]
        return [_computed(x) if k else x for x, k in zip(arrays, known, strict=True)]

    def _split_small(self, values: list[Value]) -> None:
        for value in values:
            if value.size <= SPLIT_UP_TO and not isinstance(value, _Stored):
                value.entries()

    def has_lanes(self, value: Value) -> bool:
        return value.has_lanes if isinstance(value, _Stored) else super().has_lanes(value)

    def scan(self, eqn: Any, values: list[Value]) -> list[Value]:
        body: ClosedJaxpr = eqn.params["jaxpr"]
        length, is_reversed = eqn.params["length"], eqn.params["reverse"]
        consts, carry, xs = _cut(values, *scan_counts(eqn.params))
        first, last = len(consts), len(consts) + len(carry)
        rows = [_rows_of(x) for x in xs]
        if length == 0:
            kept = [v.aval for v in body.jaxpr.outvars[len(carry) :]]
            return [*carry, *(split([], (0, *a.shape), a.dtype) for a in kept)]
        if length == 1:
            out = self.closed(body, [*consts, *carry, *(r(0) for r in rows)])
            return [*out[: len(carry)], *(self._with_axis(v) for v in out[len(carry) :])]
        self._split_small([*consts, *carry])
        on = fixed_point(
            lambda on: reached_outputs(
                body.jaxpr, [*map(self.has_lanes, consts), *on, *map(self.has_lanes, xs)], AGREED
            )[: len(carry)],
            [self.has_lanes(v) for v in carry],
        )
        pack, unpack = self.packer(carry, [v.aval for v in body.jaxpr.invars[first:last]], on)
        saved: list[_Later] = []

        def step(state, _):
            i, carry = state
            row = length - 1 - i if is_reversed else i

            def evaluate():
                out = self.inside(body, [*consts, *unpack(carry), *(r(row) for r in rows)])
                saved[:] = [self._save(v) for v in out[len(on) :]]
                return out[: len(on)]

            after = self._inside(_Round(row, length), evaluate)
            return (i + 1, tuple(pack(after))), None

        state = (jnp.asarray(0, jnp.int32), tuple(pack(carry)))
        (_, end), _ = lax.scan(step, state, None, length)
        return [*unpack(list(end)), *(v.stacked(length) for v in saved)]

    def _save(self, value: Value) -> _Later:
        """Write what a round of a loop saves."""
        if isinstance(value, _Later):
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
            self.rows.write(place, row, _kept(as_array(entry, value.dtype), self.lanes))
        return _Later(value.shape, value.dtype, places)


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


# --- what a kernel may be made of -----------------------------------------------------------------

_FLOATS = """
abs acos acosh add add_any asin asinh atan atan2 atanh cbrt ceil cos cosh div exp exp2 expm1 floor
integer_pow is_finite log log1p logistic mul neg pow rsqrt sign sin sinh sqrt square sub tan tanh
eq ge gt le lt ne
"""
_INTEGERS = """
abs add add_any and clamp div integer_pow max min mul neg not or rem shift_left
shift_right_arithmetic shift_right_logical sign square sub xor eq ge gt le lt ne
reduce_max reduce_min
"""
_TRUTHS = "and not or xor eq ne"
_MOVES = ("broadcast_in_dim", "convert_element_type", "select_n")

LOWERED: dict[str, frozenset[str]] = {
    kind: frozenset((*names.split(), *_MOVES))
    for kind, names in {"f": _FLOATS, "i": _INTEGERS, "b": _TRUTHS}.items()
}
"""Primitives that Triton lowers and that give the numbers XLA gives, by the kind of their first
operand. Not max and min of real numbers: they lose NaN."""


_OF_CONSTANTS = ("mul", "or", "broadcast_in_dim", "convert_element_type", "select_n")


def _inspect(jaxpr: Jaxpr, block: int) -> None:
    """Raise an error if the program of a block is not made of what goes into a kernel."""
    for eqn in jaxpr.eqns:
        name, dtypes = eqn.primitive.name, [aval(v).dtype for v in eqn.invars]
        if name in _CALLS | {"scan", "while", "cond"}:
            for body in bodies(eqn):
                if name not in _CALLS and any(isinstance(v, Literal) for v in body.jaxpr.outvars):
                    raise NotInKernelError(f"{name} gives a constant.")
                _inspect(body.jaxpr, block)
            continue
        kinds = [d.kind for d in dtypes]
        of = kinds[1] if name == "select_n" and kinds[0] == "b" else kinds[0] if kinds else ""
        if name not in LOWERED.get(of, ()) or (name == "select_n" and kinds[0] != "b"):
            raise NotInKernelError(f"{name} of {dtypes[0] if dtypes else 'nothing'}.")
        if name not in _OF_CONSTANTS and all(isinstance(v, Literal) for v in eqn.invars):
            raise NotInKernelError(f"{name} of constants.")
        for out in eqn.outvars:
            if aval(out).shape not in ((), (block,)):
                raise NotInKernelError(f"{name} makes an array of shape {aval(out).shape}.")
            if aval(out).dtype.name not in _KEPT_AS:
                raise NotInKernelError(f"{name} makes numbers of type {aval(out).dtype}.")


# --- the call -------------------------------------------------------------------------------------


def _call(
    program: _Program,
    operands: Sequence[jax.Array],
    written: Sequence[np.dtype],
    rows: Sequence[tuple[int, np.dtype]],
    count: int,
    interpret: bool,
) -> list[jax.Array]:
    """The arrays (lanes,) and rows (length, lanes) that the kernel writes, block by block."""
    try:  # slow to import, and announced to go
        from jax.experimental import pallas as pl
        from jax.experimental.pallas import triton
    except ImportError as error:
        raise NotInKernelError(f"this JAX has no Pallas for Triton ({error}).") from None

    block, lanes = program.block, count * program.block
    inputs = [i for i in program.inputs if i.entries]
    of = [i for i in inputs for _ in range(i.entries if i.has_lanes or i.rows else 1)]

    def lanewise(length: int | None = None):
        if length is None:
            return pl.BlockSpec((block,), lambda b: (b,))
        return pl.BlockSpec((length, block), lambda b: (0, b))

    def spec(x, of):
        return lanewise(of.rows) if of.has_lanes else pl.BlockSpec(x.shape, lambda b: (0,))

    def reads(ref, of):
        """What gives an entry, in the row of that number."""
        if of.rows is None:
            if of.has_lanes:
                return [lambda i: ref[...]]
            return [lambda i, k=k: ref[k] for k in range(of.entries)]
        return [(lambda i: ref[i, :]) if of.has_lanes else (lambda i: ref[i])]

    def kernel(*refs):
        first = [r for ref, o in zip(refs, of, strict=False) for r in reads(ref, o)]
        outs = refs[len(of) :]
        entries = program.in_block(first, _Rows(outs[len(written) :]))
        for ref, entry in zip(outs, entries, strict=False):
            ref[...] = entry

    kinds = [(length, _KEPT_AS[np.dtype(dtype).name]) for length, dtype in rows]
    shapes = [jax.ShapeDtypeStruct((lanes,), dtype) for dtype in written]
    shapes += [jax.ShapeDtypeStruct((length, lanes), dtype) for length, dtype in kinds]
    if not shapes:
        return []
    return pl.pallas_call(
        kernel,
        grid=(count,),
        in_specs=[spec(x, o) for x, o in zip(operands, of, strict=True)],
        out_specs=[lanewise()] * len(written) + [lanewise(length) for length, _ in kinds],
        out_shape=shapes,
        interpret=interpret,
        compiler_params=triton.CompilerParams(num_warps=max(block // LANES_OF_A_WARP, 1)),
        name="lanes",
    )(*operands)
