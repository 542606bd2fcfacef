"""A function of one lane on many lanes as one call of a kernel."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._compat import Jaxpr, with_outputs
from ..lanes import Evaluator, Value
from ..lanes._evaluate import SPLIT_UP_TO
from ..lanes._value import is_array, split, whole
from ._block import InBlock
from ._limits import KEPT_AS, NotInKernelError, refuse_what_does_not_go_in
from ._rows import Afterwards, Later, Rows, Stored, kept, restored

BLOCK = 128
"""Lanes of a block: four warps, one lane a thread."""

LANES_OF_A_WARP = 32

ROW_UP_TO = 32
"""Entries of a row of an input, if there is an axis to cut it by."""


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
        if has_lanes is not None and self.dtype.name not in KEPT_AS:
            raise NotInKernelError(f"an input is {self.dtype}.")
        if self.entries > SPLIT_UP_TO:
            raise NotInKernelError(f"an input has {size} entries.")

    def operands(self, missing: int) -> list[jax.Array]:
        """The arrays handed over, lanes last, filled up by copies of the last of them."""
        if self.entries == 0:
            return []
        x = jnp.asarray(self.array).astype(KEPT_AS[self.dtype.name])
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
        return [jax.ShapeDtypeStruct(shape, KEPT_AS[self.dtype.name])] * self.entries

    def value(self, reads: Sequence[Callable]) -> Value:
        """The value in a block. `reads` give an entry, in the row of that number."""
        if self.has_lanes is None:
            return whole(np.asarray(self.array), False)

        def part(depth: int, i: Any) -> Value:
            """That which is left of the value behind `depth` axes, in the row of that number."""
            shape = self.shape[depth:]
            if depth == len(self.lead):
                return split([restored(r(i), self.dtype) for r in reads], shape, self.dtype)
            return Stored(
                shape, self.dtype, lambda k: part(depth + 1, i * shape[0] + k), bool(self.has_lanes)
            )

        return part(0, 0)


def _lead(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The leading axes whose rows are read one by one."""
    depth = 1
    while depth < len(shape) - 1 and math.prod(shape[depth:]) > ROW_UP_TO:
        depth += 1
    return shape[:depth]


class _Program:
    """What a kernel computes, and what is left to do after it."""

    def __init__(self, jaxpr: Jaxpr, inputs: list[_Input], block: int):
        self.jaxpr, self.inputs, self.block = jaxpr, inputs, block
        self.afterwards: list[Afterwards] = []
        self.outputs: list[Value] = []
        self.exported: list[Value] = []

    def inspect(self) -> tuple[list[np.dtype], list[tuple[int, np.dtype]]]:
        """Types of the entries that the kernel writes; lengths and types of the rows."""
        shapes = [s for i in self.inputs for s in i.shapes(self.block)]
        rows = Rows()

        def dry(*parts):
            return self.in_block([lambda i, x=x: x for x in parts], rows)

        body = jax.make_jaxpr(dry)(*shapes)
        refuse_what_does_not_go_in(body.jaxpr, self.block)
        return [a.dtype for a in body.out_avals], rows.kinds

    def in_block(self, reads: Sequence[Callable], rows: "Rows") -> list[jax.Array]:
        """The entries to be written, of one block; rows are written as they come."""
        rest = iter(reads)
        values = [i.value([next(rest) for _ in range(i.entries)]) for i in self.inputs]
        evaluator = InBlock(self.block, rows)
        consts = len(self.jaxpr.constvars)
        outputs = evaluator.jaxpr(self.jaxpr, values[:consts], values[consts:])
        self.outputs, self.afterwards = outputs, evaluator.afterwards
        needed = [v for _, inputs, _ in evaluator.afterwards for v in inputs]
        once = {id(v): v for v in [*outputs, *needed] if not isinstance(v, Later)}
        self.exported = list(once.values())
        return [kept(e, self.block) for v in self.exported for e in _traced(v)]

    def finish(self, written: Sequence[Any], rows: Sequence[Any], lanes: int) -> list[jax.Array]:
        """The outputs, of what was written."""
        outside = Evaluator(-(-lanes // self.block) * self.block, {})
        left, known = iter(written), {}
        for value in self.exported:
            entries = [
                restored(next(left), value.dtype) if is_array(e) else e
                for e in value.entries().flat
            ]
            known[id(value)] = split(entries, value.shape, value.dtype)

        def read(value: Value) -> Value:
            if not (isinstance(value, Later) and value.lead):
                return known[id(value)]
            parts = [rows[i].reshape(*value.lead, -1)[value.cut] for i in value.rows]
            parts = [restored(x, value.dtype) for x in parts]
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
        entries = program.in_block(first, Rows(outs[len(written) :]))
        for ref, entry in zip(outs, entries, strict=False):
            ref[...] = entry

    kinds = [(length, KEPT_AS[np.dtype(dtype).name]) for length, dtype in rows]
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
