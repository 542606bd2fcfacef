"""A jaxpr evaluated in component form."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..._compat import (
    ClosedJaxpr,
    Jaxpr,
    Literal,
    aval,
    bind_parameters,
    bodies,
    one_kernel,
    scan_counts,
)
from ..dependence import fixed_point, reached_by, reached_outputs
from ..together import AGREED
from ._rewrite import Rewrites
from ._rules import (
    CUMULATIVE,
    ELEMENTWISE,
    LABELLED,
    MOVES,
    REDUCTIONS,
    algebra,
    apply,
    fold,
    is_zero,
)
from ._value import (
    ONE,
    ZERO,
    Entry,
    Value,
    as_array,
    is_array,
    is_opaque,
    number,
    on_lanes,
    split,
    whole,
)

IN_ARRAYS = "_in_arrays"


def in_arrays(function: Callable) -> Callable:
    """`function`, to be left in arrays where what calls it is taken apart.

    It is compiled faster so, and runs slower: for what runs rarely.
    """
    function = functools.wraps(function)(functools.partial(function))
    function.__name__ = IN_ARRAYS
    return jax.jit(function)


SPLIT_UP_TO, MADE_UP_TO = 128, 4096
"""Arrays of more elements than the first are not taken apart; of entries that are apart already,
one of up to the second is made (a Jacobian)."""


def evaluate(
    function: ClosedJaxpr,
    arrays: Sequence[Any],
    has_lanes: Sequence[bool],
    lanes: int | None,
    replacements: dict[str, Callable] | None = None,
) -> list[Value]:
    """The outputs of `function` on `lanes` lanes, its small arrays taken apart.

    Where `has_lanes`, the last axis of an array is that of the lanes; the others are the same on
    all of them. `lanes` is None for a single one, without an axis of its own. `replacements` are
    functions to be called in place of primitives of that name: elementwise, and of one entry.
    """
    values = [whole(a, on) for a, on in zip(arrays, has_lanes, strict=True)]
    evaluator = Evaluator(lanes, replacements or {})
    return evaluator.closed(function, values)


def operation_count(jaxpr: Jaxpr) -> int:
    """How many operations on entries the evaluation is made of, loops counted once; roughly."""
    count = 0
    for eqn in jaxpr.eqns:
        inner = [operation_count(b.jaxpr) for b in bodies(eqn)]
        if inner:
            count += sum(inner)
            continue
        size = max((aval(v).size for v in eqn.outvars), default=0)
        if eqn.primitive.name == "dot_general":
            (contracted, _), _ = eqn.params["dimension_numbers"]
            size *= 2 * int(np.prod([aval(eqn.invars[0]).shape[i] for i in contracted]))
        elif eqn.primitive.name in REDUCTIONS:
            size = aval(eqn.invars[0]).size
        elif eqn.primitive.name in MOVES:
            size = 0
        count += size
    return count


class Evaluator:
    """One way to evaluate: on so many lanes, with these replacements for primitives."""

    def __init__(self, lanes: int | None, replacements: dict[str, Callable]):
        self.lanes, self.replacements = lanes, replacements
        self.in_kernel = False
        self._rewrite = Rewrites()

    # --- jaxprs ------------------------------------------------------------------------------

    def closed(self, closed: ClosedJaxpr, values: Sequence[Value]) -> list[Value]:
        return self.jaxpr(closed.jaxpr, [whole(c, False) for c in closed.consts], values)

    def inside(self, closed: ClosedJaxpr, values: Sequence[Value]) -> list[Value]:
        """The outputs within a loop or a branch, of which nothing is known outside."""
        outside, self._rewrite = self._rewrite, Rewrites()
        try:
            return self.closed(closed, values)
        finally:
            self._rewrite = outside

    def jaxpr(self, jaxpr: Jaxpr, consts: Sequence[Value], values: Sequence[Value]) -> list[Value]:
        known: dict[Any, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
        known.update(zip(jaxpr.invars, values, strict=True))

        def read(atom: Any) -> Value:
            if isinstance(atom, Literal):
                return whole(np.asarray(atom.val, aval(atom).dtype), False)
            return known[atom]

        for eqn in jaxpr.eqns:
            inputs = [read(v) for v in eqn.invars]
            outputs = self.equation(eqn, inputs)
            if eqn.primitive.name not in _ENDS and any(v.is_tangent for v in inputs):
                outputs = [_as_tangent(v) for v in outputs]
            known.update(zip(eqn.outvars, outputs, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        name = eqn.primitive.name
        if name in ("scan", "while") and not self.in_kernel and fits_in_a_kernel(eqn):
            return self._in_one_kernel(_SPECIAL[name], eqn, values)
        if name in _SPECIAL:
            return _SPECIAL[name](self, eqn, values)
        if eqn.params.get("name") == IN_ARRAYS:
            return self._batched(eqn, values)
        if name in _CALLS:
            (body,) = bodies(eqn)
            return self.closed(body, values)
        if any(is_opaque(x.dtype) for x in (*values, *(v.aval for v in eqn.outvars))):
            return self._batched(eqn, values)
        numbers = [v.known() for v in values]
        is_small = all(v.aval.size <= MADE_UP_TO for v in eqn.outvars)
        known = [n for n in numbers if n is not None]
        if values and len(known) == len(values) and is_small and not eqn.effects:
            return [whole(x, False) for x in fold(eqn.primitive, known, eqn.params)]
        if self._stays_whole(eqn, values):
            return self._batched(eqn, values)
        if name in ELEMENTWISE:
            return [self._elementwise(eqn, values)]
        if name in REDUCTIONS:
            return [self._reduce(eqn, values[0])]
        if name in CUMULATIVE:
            return [self._accumulate(eqn, values[0])]
        if name in MOVES:
            moved = MOVES[name](*(v.entries() for v in values), **eqn.params)
            return self._outputs(eqn, moved if isinstance(moved, tuple) else [moved])
        if name in LABELLED and all(
            n is not None for i, n in enumerate(numbers) if i not in LABELLED[name]
        ):
            return [self._move_labels(eqn, values, numbers)]
        if name == "scatter-add" and numbers[1] is not None:
            return [self._scatter_add(eqn, values, numbers[1])]
        if name == "dot_general":
            return [self._dot(eqn, *values)]
        return self._batched(eqn, values)

    def _stays_whole(self, eqn: Any, values: list[Value]) -> bool:
        """Whether an array is too large to be taken apart, or has axes of a loop in front."""
        if any(v.is_bulk for v in values):
            return True
        if any(v.size > SPLIT_UP_TO for v in values if not v.is_split):
            return True
        return any(v.aval.size > MADE_UP_TO for v in eqn.outvars)

    def _outputs(self, eqn: Any, entries: Sequence[np.ndarray]) -> list[Value]:
        return [
            Value(v.aval.shape, v.aval.dtype, entries=np.asarray(e, object))
            for v, e in zip(eqn.outvars, entries, strict=True)
        ]

    # --- primitives --------------------------------------------------------------------------

    def _operate(self, eqn: Any, entries: list[Entry], dtypes: list[Any]) -> Entry:
        name = eqn.primitive.name
        result = algebra(name, entries, eqn.params)
        if result is not None:
            return result
        result = self._rewrite(name, entries, dtypes, eqn.params)
        if result is not None:
            return result
        own = self.replacements.get(name)
        if own is not None and np.dtype(dtypes[0]) == np.float64:
            if name == "pow":  # by the exponent, if it is known
                if is_array(entries[1]) or not is_array(entries[0]):
                    own = lax.pow
                else:
                    exponent = number(entries[1], dtypes[1])
                    return apply(lambda x: own(x, exponent), entries[:1], dtypes[:1])
            return apply(own, entries, dtypes)
        return apply(lambda *a: eqn.primitive.bind(*a, **eqn.params), entries, dtypes)

    def _elementwise(self, eqn: Any, values: list[Value]) -> Value:
        (out,) = eqn.outvars
        dtypes = [v.dtype for v in values]
        operands = [np.broadcast_to(v.entries(), out.aval.shape) for v in values]
        results = [
            self._operate(eqn, [x[i] for x in operands], dtypes) for i in np.ndindex(out.aval.shape)
        ]
        return split(results, out.aval.shape, out.aval.dtype)

    def _reduce(self, eqn: Any, value: Value) -> Value:
        (out,) = eqn.outvars
        axes = tuple(eqn.params["axes"])
        rows = np.moveaxis(value.entries(), axes, range(len(axes)))
        if value.size == 0:
            return self._batched(eqn, [value])[0]
        rows = rows.reshape((-1, out.aval.size))
        add = self._pairwise(REDUCTIONS[eqn.primitive.name], value.dtype)
        totals = list(rows[0])
        for row in rows[1:]:
            totals = [add(a, b) for a, b in zip(totals, row, strict=True)]
        return split(totals, out.aval.shape, out.aval.dtype)

    def _accumulate(self, eqn: Any, value: Value) -> Value:
        (out,) = eqn.outvars
        axis, reverse = eqn.params["axis"], eqn.params["reverse"]
        if value.size == 0:
            return value
        front = np.moveaxis(value.entries(), axis, 0)
        rows = front.reshape((front.shape[0], -1))
        rows = rows[::-1] if reverse else rows
        add = self._pairwise(CUMULATIVE[eqn.primitive.name], value.dtype)
        done = [list(rows[0])]
        for row in rows[1:]:
            done.append([add(a, b) for a, b in zip(done[-1], row, strict=True)])
        flat = [entry for row in (done[::-1] if reverse else done) for entry in row]
        entries = np.moveaxis(split(flat, front.shape, value.dtype).entries(), 0, axis)
        return Value(out.aval.shape, out.aval.dtype, entries=entries)

    def _pairwise(self, operation: Callable, dtype: Any) -> Callable[[Entry, Entry], Entry]:
        name = {lax.add: "add", lax.mul: "mul", lax.sub: "sub", lax.div: "div"}.get(operation, "")

        def combine(a: Entry, b: Entry) -> Entry:
            pair, dtypes = [a, b], [dtype, dtype]
            result = algebra(name, pair, {})
            if result is None:
                result = self._rewrite(name, pair, dtypes, {})
            return apply(operation, pair, dtypes) if result is None else result

        return combine

    def _dot(self, eqn: Any, a: Value, b: Value) -> Value:
        (out,) = eqn.outvars
        (of_a, of_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
        dtype = out.aval.dtype
        if a.dtype != dtype or b.dtype != dtype or dtype == np.bool_:
            return self._batched(eqn, [a, b])[0]
        x, shape_a = _as_stack_of_matrices(a.entries(), batch_a, of_a)
        y, shape_b = _as_stack_of_matrices(b.entries(), batch_b, of_b)
        add, multiply = (self._pairwise(f, dtype) for f in (lax.add, lax.mul))
        results = []
        for rows, columns in zip(x, y, strict=True):
            for row in rows:
                for column in columns:
                    total = np.zeros((), dtype)[()]
                    for u, v in zip(row, column, strict=True):
                        total = add(total, multiply(u, v))
                    results.append(total)
        assert out.aval.shape == (*(a.shape[i] for i in batch_a), *shape_a, *shape_b)
        return split(results, out.aval.shape, dtype)

    def _move_labels(self, eqn: Any, values: list[Value], numbers: list) -> Value:
        """The primitive applied to the places of entries instead of the entries."""
        moved, operands, start = LABELLED[eqn.primitive.name], [], 0
        pool: list[Entry] = []
        for i, value in enumerate(values):
            if i in moved:
                operands.append(start + np.arange(value.size).reshape(value.shape))
                pool += list(value.entries().flat)
                start += value.size
            else:
                operands.append(numbers[i])
        params = dict(eqn.params)
        if "fill_value" in params:
            params["fill_value"] = start  # the place of the entry below
            fill = eqn.params["fill_value"]
            fill = (
                (np.nan if np.issubdtype(values[0].dtype, np.floating) else 0)
                if fill is None
                else fill
            )
            pool.append(np.asarray(fill, values[0].dtype)[()])
        (places,) = fold(eqn.primitive, operands, params)
        (out,) = eqn.outvars
        return split([pool[i] for i in places.flat], out.aval.shape, out.aval.dtype)

    def _scatter_add(self, eqn: Any, values: list[Value], indices: np.ndarray) -> Value:
        operand, _, updates = values
        dtype = operand.dtype  # that of the addition which the primitive brings along
        zeros, units = np.zeros(operand.shape, dtype), np.eye(updates.size, dtype=dtype)
        targets = [
            fold(eqn.primitive, [zeros, indices, unit.reshape(updates.shape)], eqn.params)[0]
            for unit in units
        ]
        add = self._pairwise(lax.add, dtype)
        totals = list(operand.entries().flat)
        for update, target in zip(updates.entries().flat, targets, strict=True):
            for place in np.flatnonzero(target):
                totals[place] = add(totals[place], update)
        return split(totals, operand.shape, operand.dtype)

    def _batched(self, eqn: Any, values: list[Value]) -> list[Value]:
        """The primitive on whole arrays."""
        functions, params = bind_parameters(eqn)

        def bind(*arrays):
            out = eqn.primitive.bind(*functions, *arrays, **params)
            return tuple(out) if eqn.primitive.multiple_results else (out,)

        pairs = [v.array() for v in values]
        arrays = [jnp.asarray(a) for a, _ in pairs]
        flags = [on for _, on in pairs]
        bulk = max((v.size for v in values if v.is_bulk), default=None)

        def made(x, on):
            value = whole(x, on)
            value.is_bulk = bulk is not None and 2 * value.size > bulk
            return value

        if not any(flags):
            return [made(x, False) for x in bind(*arrays)]
        axes = [-1 if on else None for on in flags]
        vary = reached_by(eqn, flags, AGREED)
        outputs = jax.vmap(bind, axes, tuple(-1 if on else None for on in vary))(*arrays)
        return [made(x, on) for x, on in zip(outputs, vary, strict=True)]

    def _in_one_kernel(self, rule: Callable, eqn: Any, values: list[Value]) -> list[Value]:
        """What `rule` makes of a loop, to be compiled as one function with all that is in it."""
        self._split_small(values)
        arrays: list[jax.Array] = []
        results: list[Value] = []

        def inner(*arrays):
            into = iter(arrays)
            inputs = [v.with_arrays(lambda _: next(into)) for v in values]
            self.in_kernel = True
            try:
                results[:] = rule(self, eqn, inputs)
            finally:
                self.in_kernel = False
            outputs: list[jax.Array] = []
            for value in results:
                value.with_arrays(outputs.append)
            return outputs

        for value in values:
            value.with_arrays(arrays.append)
        closed = jax.make_jaxpr(inner)(*arrays)
        if not all(map(_is_written_out, closed.jaxpr.eqns)):
            return rule(self, eqn, values)
        outputs = iter(one_kernel.bind(*arrays, closed=closed))
        return [v.with_arrays(lambda _: next(outputs)) for v in results]

    # --- loops -------------------------------------------------------------------------------

    def pack(self, value: Value, has_lanes: bool, depth: int | None = 0) -> list[jax.Array]:
        """The arrays that stand for a value in the carry of a loop, see `depth_of`."""
        if depth is None:
            array, on = value.array()
            array = jnp.asarray(array)
            return [self._with_lanes(array, array.ndim) if has_lanes and not on else array]
        arrays = [as_array(e, value.dtype) for e in value.entries(depth).flat]
        return [self._with_lanes(x, depth) for x in arrays] if has_lanes else arrays

    def _with_lanes(self, x: jax.Array, lead: int = 0) -> jax.Array:
        return x if self.lanes is None else on_lanes(x, self.lanes, lead)

    def packer(
        self, values: Sequence[Value], avals: Sequence[Any], lanes: Sequence[bool]
    ) -> tuple[Callable, Callable]:
        """(values → flat list of arrays, and back) for a carry that starts with these values."""
        depths = [depth_of(v) for v in values]
        counts = [
            1 if d is None else math.prod(a.shape[d:]) for d, a in zip(depths, avals, strict=True)
        ]
        ends = np.cumsum(counts)

        def pack(values):
            return [
                x
                for v, on, depth in zip(values, lanes, depths, strict=True)
                for x in self.pack(v, on, depth)
            ]

        def unpack(arrays):
            return [
                unpacked(arrays[end - count : end], a, on and self.lanes is not None, depth)
                for a, on, depth, count, end in zip(avals, lanes, depths, counts, ends, strict=True)
            ]

        return pack, unpack

    def _split_small(self, values: list[Value]) -> None:
        """Take small values apart before a loop, whose body would else do it each time round."""
        for value in values:
            if depth_of(value) == 0:
                value.entries()

    def on_any(self, x: jax.Array) -> jax.Array:
        """Whether x is true anywhere."""
        return jnp.any(x)

    def select(self, which: jax.Array, cases: Sequence[jax.Array]) -> jax.Array:
        """On each lane the case of that number (int32)."""
        return lax.select_n(jnp.broadcast_to(which, cases[0].shape), *cases)

    def has_lanes(self, value: Value) -> bool:
        if self.lanes is None:
            return False
        if value.is_split:
            return any(is_array(e) and e.ndim for e in value.entries().flat)
        lead = value.lead_entries()
        if lead is not None:
            return any(e.ndim > len(value.lead) for e in lead.flat)
        return value.array()[1]

    def varying(
        self, body: ClosedJaxpr, consts: list[Value], carry: list[Value], xs: list[Value]
    ) -> list[bool]:
        """Which values that a scan carries have lanes, in some round of it."""
        before, after = ([self.has_lanes(v) for v in values] for values in (consts, xs))

        def next_round(on: list[bool]) -> list[bool]:
            return reached_outputs(body.jaxpr, [*before, *on, *after], AGREED)[: len(on)]

        return fixed_point(next_round, [self.has_lanes(v) for v in carry])

    def scan(self, eqn: Any, values: list[Value]) -> list[Value]:
        params = eqn.params
        body: ClosedJaxpr = params["jaxpr"]
        consts, carry, xs = _cut(values, *scan_counts(params))
        self._split_small(consts)
        first, last = len(consts), len(consts) + len(carry)
        on = self.varying(body, consts, carry, xs)
        pack, unpack = self.packer(carry, [v.aval for v in body.jaxpr.invars[first:last]], on)
        slices = [v.aval for v in body.jaxpr.invars[last:]]
        forms: list[tuple[bool, int | None]] = []

        def step(carry, x):
            xs = [
                self._slice(part, v, aval)
                for part, v, aval in zip(x, xs_values, slices, strict=True)
            ]
            out = self.inside(body, [*consts, *unpack(carry), *xs])
            after, ys = out[: len(on)], out[len(on) :]
            forms[:] = [(self.has_lanes(y), depth_of(y)) for y in ys]
            return tuple(pack(after)), tuple(tuple(self.pack(y, False, depth_of(y))) for y in ys)

        xs_values = xs
        scanned = tuple(self._scanned(v) for v in xs)
        end, rows = lax.scan(
            step, tuple(pack(carry)), scanned, params["length"], params["reverse"], params["unroll"]
        )
        avals = [v.aval for v in body.jaxpr.outvars[len(carry) :]]
        length = params["length"]
        outputs = [
            self._stacked(r, a, length, *form)
            for r, a, form in zip(rows, avals, forms, strict=True)
        ]
        return [*unpack(list(end)), *outputs]

    def _stacked(
        self, rows: Sequence[Any], aval: Any, length: int, has_lanes: bool, depth: int | None
    ) -> Value:
        """The value of which each step put out a row, see `depth_of`."""
        like = jax.ShapeDtypeStruct((length, *aval.shape), aval.dtype)
        return unpacked(rows, like, has_lanes, None if depth is None else depth + 1)

    def _scanned(self, value: Value) -> Any:
        """The arrays over which a scan goes, their first axis that of the steps."""
        lead = value.lead_entries()
        if lead is not None:
            return tuple(lead.flat)
        return (jnp.asarray(value.array()[0]),)

    def _slice(self, parts: tuple, value: Value, aval: Any) -> Value:
        """One step's share of a value that is scanned over."""
        lead = value.lead_entries()
        if lead is None:
            return whole(parts[0], value.array()[1])
        return unpacked(parts, aval, False, len(value.lead) - 1)

    def while_loop(self, eqn: Any, values: list[Value]) -> list[Value]:
        params = eqn.params
        test, body = params["cond_jaxpr"], params["body_jaxpr"]
        self._split_small(values)
        of_test, of_body, carry = _cut(values, params["cond_nconsts"], params["body_nconsts"])
        lanes_of_test = [self.has_lanes(v) for v in of_test]
        lanes_of_body = [self.has_lanes(v) for v in of_body]

        def after(on):
            (goes_on,) = reached_outputs(test.jaxpr, [*lanes_of_test, *on], AGREED)
            outs = reached_outputs(body.jaxpr, [*lanes_of_body, *on], AGREED)
            return [goes_on or x for x in outs]

        on = fixed_point(after, [self.has_lanes(v) for v in carry])
        pack, unpack = self.packer(carry, [v.aval for v in body.jaxpr.outvars], on)
        (per_lane,) = reached_outputs(test.jaxpr, [*lanes_of_test, *on], AGREED)

        def goes_on(state) -> Value:
            return self.inside(test, [*of_test, *unpack(state)])[0]

        def step(state):
            return tuple(pack(self.inside(body, [*of_body, *unpack(state)])))

        state = tuple(pack(carry))
        answer = test.jaxpr.outvars[0].aval
        if not (answer.shape or (per_lane and self.lanes)):
            return unpack(
                list(lax.while_loop(lambda s: self.pack(goes_on(s), False)[0], step, state))
            )

        # Each lane, and under a `vmap` further in each place on it, stops by itself.
        depths = [depth_of(v) for v in carry]  # as packed: a value that is used is taken apart
        first = goes_on(state)
        keep, restore = self.packer([first], [answer], [per_lane])

        def masked(state):
            active, before = state
            masks = self._masks(restore(active)[0], carry, depths, on)
            after = tuple(jnp.where(*x) for x in zip(masks, step(before), before, strict=True))
            return tuple(keep([goes_on(after)])), after

        def any_active(state):
            return functools.reduce(jnp.logical_or, map(self.on_any, state[0]))

        _, end = lax.while_loop(any_active, masked, (tuple(keep([first])), state))
        return unpack(list(end))

    def _masks(
        self,
        active: Value,
        carry: Sequence[Value],
        depths: Sequence[int | None],
        on: Sequence[bool],
    ) -> list[Any]:
        """For each array that a carry is packed in, what `active` says of it: its shape is that of
        the leading axes of all values."""
        masks = []
        for value, depth, has_lanes in zip(carry, depths, on, strict=True):
            ndim = len(value.shape) if depth is None else depth
            common = min(ndim, len(active.shape))
            copies = math.prod(value.shape[max(ndim, len(active.shape)) :])
            for entry in active.entries(common).flat:
                mask = jnp.asarray(entry)
                lanes = mask.shape[common:] or (1,) * (has_lanes and self.lanes is not None)
                mask = mask.reshape(active.shape[:common] + (1,) * (ndim - common) + lanes)
                masks += [mask] * copies
        return masks

    def cond(self, eqn: Any, values: list[Value]) -> list[Value]:
        branches = eqn.params["branches"]
        index, operands = values[0], values[1:]
        known = index.known()
        if known is not None:
            return self.closed(branches[int(np.clip(known, 0, len(branches) - 1))], operands)
        self._split_small(operands)
        flags = [self.has_lanes(v) for v in operands]
        per_branch = [reached_outputs(b.jaxpr, flags, AGREED) for b in branches]
        varies = self.has_lanes(index)
        on = [varies or any(x) for x in zip(*per_branch, strict=True)]
        which = index.entries()[()]
        avals = [v.aval for v in eqn.outvars]
        bulk = {v.shape for v in operands if v.is_bulk}
        like = [Value(a.shape, a.dtype, is_bulk=a.shape in bulk) for a in avals]
        pack, unpack = self.packer(like, avals, on)

        def run(branch):
            return lambda: tuple(pack(self.inside(branch, operands)))

        if not varies:
            return unpack(list(lax.switch(which, [run(b) for b in branches])))
        which = jnp.clip(which.astype(jnp.int32), 0, len(branches) - 1)
        results = [run(b)() for b in branches]
        chosen = [self.select(which, cases) for cases in zip(*results, strict=True)]
        return unpack(chosen)

    def with_exchanges(self, eqn: Any, values: list[Value]) -> list[Value]:
        """The solution of a dense system, by elimination that exchanges rows."""
        return self._batched(eqn, values)

    def linear_solve(self, eqn: Any, values: list[Value]) -> list[Value]:
        """custom_linear_solve: what it solves with."""
        lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
        start = lengths.matvec + lengths.vecmat
        consts = values[start : start + lengths.solve]
        b = values[sum(lengths) :]
        return self.closed(jaxprs.solve, [*consts, *b])


def _unit_vectors(evaluator: Evaluator, eqn: Any, values: list[Value]) -> list[Value]:
    n = eqn.params["n"]
    entries = [ONE if i == j else ZERO for i in range(n) for j in range(n)]
    return [_as_tangent(split(entries, (n, n), eqn.params["dtype"]))]


def _as_tangent(value: Value) -> Value:
    """A value that is linear in unit vectors: its zeros are zeros by structure."""
    if value.is_bulk or not (value.is_split or value.known() is not None):
        return value
    entries = [ZERO if is_zero(e) else e for e in value.entries().flat]
    value = split(entries, value.shape, value.dtype)
    value.is_tangent = True
    return value


def _least_over_lanes(evaluator: Evaluator, eqn: Any, values: list[Value]) -> list[Value]:
    (value,) = values
    entry = as_array(value.entries()[()], value.dtype)
    return [split([jnp.min(entry)], (), value.dtype)]


def _eliminate(evaluator: Evaluator, eqn: Any, values: list[Value]) -> list[Value]:
    """Gaussian elimination without exchanges, by which structural zeros stay zeros."""
    matrix, vector = values
    dtype, n = matrix.dtype, vector.size
    multiply, subtract, divide = (
        evaluator._pairwise(f, dtype) for f in (lax.mul, lax.sub, lax.div)
    )
    rows = [[*row, b] for row, b in zip(matrix.entries(), vector.entries(), strict=True)]
    for c in range(n):
        one_over = divide(ONE, rows[c][c])
        for i in range(c + 1, n):
            if is_zero(rows[i][c]):
                continue
            factor = multiply(rows[i][c], one_over)
            for j in range(c + 1, n + 1):
                rows[i][j] = subtract(rows[i][j], multiply(factor, rows[c][j]))
        rows[c][c] = one_over
    x: list[Entry] = [None] * n
    for i in reversed(range(n)):
        total = rows[i][n]
        for j in range(i + 1, n):
            total = subtract(total, multiply(rows[i][j], x[j]))
        x[i] = multiply(total, rows[i][i])
    solution = split(x, (n,), dtype)
    return [_mended(evaluator, eqn, values, solution) if eqn.params["checked"] else solution]


def _mended(evaluator: Evaluator, eqn: Any, values: list[Value], solution: Value) -> Value:
    """The solution, with exchanges of rows on lanes where it lost digits without them."""
    matrix, vector = values
    dtype = matrix.dtype
    multiply, subtract = (evaluator._pairwise(f, dtype) for f in (lax.mul, lax.sub))
    remainder = list(vector.entries())
    for i, row in enumerate(matrix.entries()):
        for a, x in zip(row, solution.entries(), strict=True):
            remainder[i] = subtract(remainder[i], multiply(a, x))

    def size(entries):  # a sum, which passes on what is not finite
        return sum((jnp.abs(as_array(e, dtype)) for e in entries if e is not ZERO), start=0.0)

    of_matrix = size(matrix.entries().flat) / vector.size  # about that of a row
    bound = 256 * jnp.finfo(dtype).eps * of_matrix * size(solution.entries())
    is_given = jnp.isfinite(of_matrix) & jnp.isfinite(size(vector.entries()))
    lost = is_given & ~(size(remainder) <= bound)
    on = any(map(evaluator.has_lanes, (*values, solution)))
    found = evaluator.pack(solution, on)

    def with_exchanges():
        (other,) = evaluator.with_exchanges(eqn, values)
        return [
            jnp.where(lost, a, b) for a, b in zip(evaluator.pack(other, on), found, strict=True)
        ]

    return split(
        lax.cond(evaluator.on_any(lost), with_exchanges, lambda: found), solution.shape, dtype
    )


_CALLS = frozenset(
    [
        "jit",
        "pjit",
        "closed_call",
        "core_call",
        "call_hi_primitive",
        "eval_jaxpr",
        "custom_jvp_call",
        "custom_vjp_call",
        "custom_vjp_call_jaxpr",
        "custom_vmap_call",
        "checkpoint",
        "remat",
        "remat2",
    ]
)

_ENDS = frozenset(["custom_linear_solve", "eliminate"])
"""What uses a Jacobian up: its result is no tangent any more."""

_SPECIAL: dict[str, Callable[[Evaluator, Any, list[Value]], list[Value]]] = {
    "scan": Evaluator.scan,
    "while": Evaluator.while_loop,
    "cond": Evaluator.cond,
    "custom_linear_solve": Evaluator.linear_solve,
    "unit_vectors": _unit_vectors,
    "least_over_lanes": _least_over_lanes,
    "eliminate": _eliminate,
}


_IN_KERNELS = frozenset(
    [
        *(*ELEMENTWISE, *REDUCTIONS, *CUMULATIVE, *MOVES, *LABELLED, *_CALLS, *_SPECIAL),
        *("argmax", "argmin", "bitcast_convert_type", "dot_general", "iota", "scatter-add"),
        "optimization_barrier",
    ]
)


def fits_in_a_kernel(eqn: Any) -> bool:
    """Whether all that an equation does is arithmetic that the compiler writes out itself."""
    if eqn.primitive.name not in _IN_KERNELS or eqn.params.get("name") == IN_ARRAYS:
        return False
    return all(fits_in_a_kernel(e) for body in bodies(eqn) for e in body.jaxpr.eqns)


def _is_written_out(eqn: Any) -> bool:
    """Whether the compiler writes an equation out in place, and has no library for it; what is
    left in arrays may have one."""
    name = eqn.primitive.name
    if name not in _IN_KERNELS or name in _NOT_IN_PLACE:
        return False
    return all(_is_written_out(e) for body in bodies(eqn) for e in body.jaxpr.eqns)


_NOT_IN_PLACE = frozenset(
    [
        *(set(REDUCTIONS) - {"reduce_and", "reduce_or"}),
        *(*CUMULATIVE, "argmax", "argmin", "dot_general", "scatter", "scatter-add"),
    ]
)


def depth_of(value: Value) -> int | None:
    """How a value goes through a loop: as its entries, each with so many axes of `lead` in front;
    or, told by None, as one array, because it is one and not small."""
    if value.lead or value.is_split:
        return len(value.lead)
    is_small = not value.is_bulk and value.size <= (8 if value.is_known else SPLIT_UP_TO)
    return 0 if is_small else None


def unpacked(arrays: Sequence[Any], aval: Any, has_lanes: bool, depth: int | None) -> Value:
    """The value of shape and type `aval` that goes through a loop as these arrays."""
    if depth is None:
        return whole(arrays[0], has_lanes, is_bulk=True)
    entries = split(list(arrays), aval.shape[depth:], aval.dtype).entries()
    return Value(aval.shape, aval.dtype, entries=entries, lead=aval.shape[:depth])


def _cut(values: list[Value], first: int, second: int) -> tuple[list, list, list]:
    return values[:first], values[first : first + second], values[first + second :]


def _as_stack_of_matrices(
    x: np.ndarray, batch: Sequence[int], contracted: Sequence[int]
) -> tuple[np.ndarray, tuple[int, ...]]:
    """x as (batch, free, contracted), and the shape of its free axes."""
    free = [i for i in range(x.ndim) if i not in (*batch, *contracted)]
    shape = tuple(x.shape[i] for i in free)
    sizes = [int(np.prod([x.shape[i] for i in axes])) for axes in (batch, free, contracted)]
    return np.transpose(x, (*batch, *free, *contracted)).reshape(sizes), shape
