"""Loops and branches of long arrays."""

from collections.abc import Sequence
from typing import Any

from ..jaxprs.jaxapi import ClosedJaxpr, scan_counts
from .boxes import Array
from .equations import ARRAY_RULES, BlockScope, Translation, row_major
from .reductions import reduction_of
from .tree import Branch, Loop, Memory, Number, Place


class Carry:
    """What a loop carries: numbers for arrays that are written out, memories for others.

    `now`: the arrays in a round. They keep their values where `moves` says that no round changes
    them.
    """

    def __init__(self, translation: Translation, loop: Loop, start: Sequence[Array], moves):
        self.translation, self.loop, self.moves = translation, loop, list(moves)
        self.now: list[Array] = []
        self._numbers: list[list[Number]] = []
        self._memories: list[Memory | None] = []
        self._first: list[Any] = []
        for x, is_moving in zip(start, self.moves, strict=True):
            numbers: list[Number] = []
            memory = None
            if not is_moving:
                # Computed before the loop: a round would compute the same again.
                self.now.append(translation.settle(x))
            elif x.is_written_out:
                # A few numbers stay in registers, as `phi` instructions of the loop.
                numbers, array = translation.registers(x.shape, x.dtype)
                self._first += [part.only for part in x.components()[2].values()]
                self.now.append(array)
            else:
                # The loop owns this memory: its first value is copied, unless `places` finds that
                # both may have the same bytes.
                memory = Memory(x.shape, x.dtype)
                self.now.append(translation.store(x, memory.place))
            self._numbers.append(numbers)
            self._memories.append(memory)

    def end_round(self, outs: Sequence[Array]) -> None:
        """Write what the next round gets, at the end of the body."""
        translation, firsts = self.translation, iter(self._first)
        for x, memory, numbers in zip(outs, self._memories, self._numbers, strict=True):
            if numbers:
                for number, part in zip(numbers, x.components()[2].values(), strict=True):
                    self.loop.numbers.append((number, next(firsts), part.only))
            elif memory is not None and x.expression is not memory.load(x.table).expression:
                # A memory of its own, so that the old array can still be read while it is
                # written. Where that is not needed, `places` gives both the same bytes.
                new = Memory(x.shape, x.dtype)
                translation.store(x, new.place)
                self.loop.memories.append((memory, new))


def scan(
    translation: Translation, eqn: Any, args: list[Array], places: list, used: list[bool]
) -> list[Array]:
    params = eqn.params
    num_consts, num_carry = scan_counts(params)
    function: ClosedJaxpr = params["jaxpr"]
    length, reverse = params["length"], params["reverse"]
    consts = args[:num_consts]
    carry, xs = args[num_consts : num_consts + num_carry], args[num_consts + num_carry :]
    avals = [v.aval for v in eqn.outvars[num_carry:]]
    table = translation.table
    if length == 0:
        empty = [Array(table, aval.shape, aval.dtype, []) for aval in avals]
        return [*carry, *empty]
    if length == 1:  # no loop
        slices = [x.along(x.shape[1:], [None, *range(len(x.shape) - 1)]) for x in xs]
        outs = translation.evaluate(function, [*consts, *carry, *slices])
        rows = [x.along((1, *x.shape), range(1, 1 + len(x.shape))) for x in outs[num_carry:]]
        return [*outs[:num_carry], *rows]
    # What all rounds read is computed once.
    consts = [translation.settle(x) for x in consts]
    loop = Loop(length)
    inputs = function.jaxpr.invars[num_consts : num_consts + num_carry]
    pairs = zip(function.jaxpr.outvars[:num_carry], inputs, strict=True)
    state = Carry(translation, loop, carry, [out is not var for out, var in pairs])
    sources = [_readable(translation, x) for x in xs]
    rows = []
    for aval, place, is_used in zip(avals, places[num_carry:], used[num_carry:], strict=True):
        if place is None and is_used:
            # Row by row, as the results of a run are.
            place = Memory(aval.shape, aval.dtype, row_major(aval.shape)).place
        rows.append(place)
        if place is not None:
            loop.rows.append(place.memory)
    with BlockScope(translation, loop.body):
        k = Array.uniform(translation.number(loop.counter), ())
        if reverse:
            k = translation.apply("sub", translation.known(length - 1), k)
        # Each round reads and writes one row, at an address that depends on the round.
        slices = [_slice_at(translation, x, k) for x in sources]
        places_of_rows = [None if r is None else _row_place(translation, r, k) for r in rows]
        outs = translation.evaluate(
            function, [*consts, *state.now, *slices], [*[None] * num_carry, *places_of_rows]
        )
        for x, place in zip(outs[num_carry:], places_of_rows, strict=True):
            if place is not None:
                translation.store(x, place)
        state.end_round(outs[:num_carry])
    translation.add(loop)
    zero = translation.known(0)
    return [*state.now, *(zero if r is None else r.load(table) for r in rows)]


def _readable(translation: Translation, x: Array) -> Array:
    """An array whose rows can be read by an index that is a number of the code."""
    node = x.expression
    if not x.size or (node is not None and node.kind in ("known", "number")):
        return x
    return translation.in_memory(x)


def _slice_at(translation: Translation, x: Array, k: Array) -> Array:
    if not x.size:
        return Array(x.table, x.shape[1:], x.dtype, [])
    node = x.only
    if node.kind in ("known", "number"):
        return Array.uniform(node, x.shape[1:])
    distance = translation.apply("mul", k, translation.known(node.strides[0])).expression
    assert distance is not None
    row = x.table.expression(
        "load", x.dtype, (distance,), "", node.strides[1:], node.offset, node.value
    )
    return Array.uniform(row, x.shape[1:])


def _row_place(translation: Translation, rows: Place, k: Array) -> Place:
    distance = translation.apply("mul", k, translation.known(rows.strides[0]))
    distance = translation.apply("add", distance, translation.known(rows.offset)).expression
    shape, strides = rows.shape[1:], rows.strides[1:]
    return Memory(shape, rows.memory.dtype, strides, None, rows.memory, distance).place


def while_loop(
    translation: Translation, eqn: Any, args: list[Array], places: list, used: list[bool]
) -> list[Array]:
    params = eqn.params
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    shape = test.jaxpr.outvars[0].aval.shape
    first, second = params["cond_nconsts"], params["body_nconsts"]
    # What all rounds read is computed once.
    fixed = [translation.settle(x) for x in args[: first + second]]
    loop = Loop()
    inputs = body.jaxpr.invars[second:]
    moves = [out is not var for out, var in zip(body.jaxpr.outvars, inputs, strict=True)]
    state = Carry(translation, loop, args[first + second :], moves)
    with BlockScope(translation, loop.test):
        (goes_on,) = translation.evaluate(test, [*fixed[:first], *state.now])
        goes_on = (
            reduction_of(translation, goes_on, "or", range(len(shape)), ()) if shape else goes_on
        )
        loop.condition = goes_on.expression
    with BlockScope(translation, loop.body):
        outs = translation.evaluate(body, [*fixed[first:], *state.now])
        if shape:  # a condition for each element: those that have ended keep their values
            (is_going,) = translation.evaluate(test, [*fixed[:first], *state.now])
            pairs = zip(state.now, outs, strict=True)
            outs = [
                translation.apply("select_n", is_going, old, new, dtype=new.dtype)
                for old, new in pairs
            ]
        state.end_round(outs)
    translation.add(loop)
    return state.now


def cond(
    translation: Translation, eqn: Any, args: list[Array], places: list, used: list[bool]
) -> list[Array]:
    index, *operands = args
    branches, table = eqn.params["branches"], translation.table
    if len(branches) == 1:
        return translation.evaluate(branches[0], operands)
    node = index.expression
    assert node is not None
    if node.kind == "known":
        choice = min(max(int(node.value), 0), len(branches) - 1)
        return translation.evaluate(branches[choice], operands)
    if index.dtype == "bool":
        node = translation.convert(index, "int32").expression
        assert node is not None
    # An expression would be computed in each branch that uses it, and again outside.
    operands = [x if x.is_written_out else translation.settle(x) for x in operands]
    branch = Branch(node, len(branches))
    avals = [v.aval for v in eqn.outvars]
    results, numbers = [], []
    for aval, is_used in zip(avals, used, strict=True):
        members: list[Number] = []
        if not is_used:
            result = translation.known(0)
        elif Array(table, aval.shape, aval.dtype, []).is_written_out:
            members, result = translation.registers(aval.shape, aval.dtype)
        else:
            result = Memory(aval.shape, aval.dtype).load(table)
        results.append(result)
        numbers.append(members)
    expressions: dict[Number, list] = {n: [] for of in numbers for n in of}
    translation.branches += 1
    for block, function in zip(branch.blocks, branches, strict=True):
        with BlockScope(translation, block):
            outs = translation.evaluate(function, operands)
            for x, result, of, is_used in zip(outs, results, numbers, used, strict=True):
                if of:
                    parts = x.components()[2].values()
                    for number, part in zip(of, parts, strict=True):
                        expressions[number].append(part.only)
                elif is_used and x.size:
                    translation.store(x, result.expression.value.place)
    translation.branches -= 1
    branch.numbers = list(expressions.items())
    translation.add(branch)
    return results


ARRAY_RULES |= {"scan": scan, "while": while_loop, "cond": cond}
