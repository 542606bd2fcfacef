"""Loops and branches: scan, while, cond."""

import functools
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..assumed import assumed_number, assumed_value
from ..evaluator import RULES, Evaluator
from ..jaxprs.dependence import cut, fixed_point, reached_outputs
from ..jaxprs.jaxapi import ClosedJaxpr, scan_counts
from ..llvm.ir import TYPES, NotCompilable, Num
from ..llvm.values import Value, Values, objects
from .rounds import Rounds, RowCollector

# Primitives whose result is the same on all trajectories, even if the operands differ.
UNIFORM = frozenset(["least_over_lanes"])


def _numbers_to_carry(evaluator: Evaluator, carry: Sequence[Value], lane_flags: Sequence[bool]):
    """The numbers of a carry in a row, which of them are vectors, and the way back."""
    numbers = _numbers_of(evaluator, carry)
    vec = [lanes for value, lanes in zip(carry, lane_flags, strict=True) for _ in range(value.size)]
    return numbers, vec, functools.partial(_values_of, carry)


def _numbers_of(evaluator: Evaluator, values: Iterable[Value]) -> list[Num]:
    return [x for value in values for x in evaluator.entries(value).flat]


def _values_of(like: Sequence[Any], numbers: Sequence[Num]) -> list[Value]:
    """Values with the shapes and types of `like`, of numbers in a row."""
    values, remaining_numbers = [], iter(numbers)
    for aval in like:
        entries = objects([next(remaining_numbers) for _ in range(aval.size)], aval.shape)
        values.append(Value(aval.shape, aval.dtype, entries))
    return values


def scan(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    params, b = eqn.params, evaluator.b
    body: ClosedJaxpr = params["jaxpr"]
    num_consts, num_carry = scan_counts(params)
    length, reverse = params["length"], params["reverse"]
    consts, carry, xs = cut(values, num_consts, num_carry)
    jaxpr, row_avals = body.jaxpr, [var.aval for var in eqn.outvars[num_carry:]]
    if length == 0:
        return [*carry, *(Value(a.shape, a.dtype, np.empty(a.shape, object)) for a in row_avals)]
    # A carry that no round changes is not carried: it stays a constant, or a scalar.
    carry_in = jaxpr.invars[num_consts : num_consts + num_carry]
    moves = [o is not i for o, i in zip(jaxpr.outvars[:num_carry], carry_in, strict=True)]

    # Which values differ between trajectories, in some round of the loop.
    lanes_of_consts, lanes_of_xs = [v.has_lanes() for v in consts], [v.has_lanes() for v in xs]

    def outputs(carry_flags: list[bool]) -> list[bool]:
        return reached_outputs(jaxpr, [*lanes_of_consts, *carry_flags, *lanes_of_xs], UNIFORM)

    carry_lanes = [value.has_lanes() for value in carry]
    carry_lanes = fixed_point(lambda flags: outputs(flags)[:num_carry], carry_lanes)
    row_lanes = outputs(carry_lanes)[num_carry:]
    numbers, vec, to_values = _numbers_to_carry(
        evaluator,
        list(itertools.compress(carry, moves)),
        list(itertools.compress(carry_lanes, moves)),
    )
    sources = [evaluator.in_memory(x) for x in xs]
    rows = [
        place or evaluator.module.scratch(aval.shape, str(aval.dtype), o)
        for aval, place, o in zip(row_avals, places[num_carry:], row_lanes, strict=True)
    ]
    end = evaluator.module.parameter(length)
    collector = None if reverse else RowCollector.for_results(evaluator, rows, length)

    def full_carry(numbers: Sequence[Num]) -> list[Value]:
        moving_values = iter(to_values(numbers))
        pairs = zip(carry, moves, strict=True)
        return [next(moving_values) if is_moving else value for value, is_moving in pairs]

    def round_of(numbers: Sequence[Num], k: Num, start: Num) -> list[Num]:
        if reverse:
            k = b.sub(b.sub(end, b.const(1, "int64")), k)
        slices = [Value.in_memory(source.row(b, k)) for source in sources]
        targets = [r.row(b, k) for r in rows] if collector is None else collector.rows(k, start)
        outs = evaluator.jaxpr(
            jaxpr,
            [evaluator.constant(c) for c in body.consts],
            [*consts, *full_carry(numbers), *slices],
            [*[None] * num_carry, *targets],
        )
        for y, target in zip(outs[num_carry:], targets, strict=True):
            evaluator.write(y, target)
        return _numbers_of(evaluator, itertools.compress(outs, moves))

    rounds = Rounds(evaluator, vec, length, end, round_of, collector)
    return [*full_carry(rounds.run(jaxpr, numbers)), *map(Value.in_memory, rows)]


def while_loop(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """`while`; an array as condition says which entries of the carry, by leading axes, go on."""
    params = eqn.params
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    of_test, of_body, carry = cut(values, params["cond_nconsts"], params["body_nconsts"])
    shape = test.jaxpr.outvars[0].aval.shape
    lanes_of_test = [v.has_lanes() for v in of_test]
    lanes_of_body = [v.has_lanes() for v in of_body]

    def next_flags(carry_flags):
        (goes_on,) = reached_outputs(test.jaxpr, [*lanes_of_test, *carry_flags], UNIFORM)
        outs = reached_outputs(body.jaxpr, [*lanes_of_body, *carry_flags], UNIFORM)
        return [goes_on or x for x in outs]

    carry_lanes = fixed_point(next_flags, [v.has_lanes() for v in carry])
    (per_lane,) = reached_outputs(test.jaxpr, [*lanes_of_test, *carry_lanes], UNIFORM)
    numbers, vec, to_values = _numbers_to_carry(evaluator, carry, carry_lanes)
    parts = math.prod(shape)
    # The condition has the leading axes of each array of the carry.
    part = [i * parts // v.size for v in carry for i in range(v.size)]  # of which a number is

    def goes_on(numbers: Sequence[Num]) -> list[Num]:
        return _numbers_of(evaluator, evaluator.evaluate(test, [*of_test, *to_values(numbers)]))

    def step(numbers: Sequence[Num]) -> list[Num]:
        return _numbers_of(evaluator, evaluator.evaluate(body, [*of_body, *to_values(numbers)]))

    # In a round on assumptions: a loop that starts at all is the rare case.
    if per_lane and evaluator.assumptions is not None:
        for condition in goes_on(numbers):
            evaluator.assumptions.assume_false(condition)
        return to_values([evaluator.b.without_origin(x) for x in numbers])
    with evaluator.assuming(None):
        # Trajectories that have finished keep their values, and the block goes on.
        if per_lane or shape:
            return to_values(_masked_loop(evaluator, numbers, vec, per_lane, part, goes_on, step))

        def proceeds(state, _):
            return evaluator.b.ref(goes_on(state)[0], 0, False)

        return to_values(evaluator.b.loop(numbers, vec, proceeds, lambda state, _: step(state)))


def _masked_loop(evaluator: Evaluator, numbers, vec, per_lane, part, goes_on, step) -> list[Num]:
    """A loop of which every trajectory, or every part of the carry, stops by itself; the block goes
    on while one of them does. `part[i]` is the condition of number i."""
    b = evaluator.b
    first = goes_on(numbers)
    count = len(first)

    def any_goes_on(state, _):
        is_active = functools.reduce(lambda x, y: b.logic("or", x, y), state[:count])
        return b.any_lane(is_active) if per_lane else b.ref(is_active, 0, False)

    def masked_step(state, _):
        active, numbers = state[:count], state[count:]
        news = step(numbers)
        triples = zip(part, news, numbers, strict=True)
        selection = [b.select(active[i], new, old) for i, new, old in triples]
        # A trajectory or a part that has stopped has no influence on whether the loop continues.
        news = goes_on(selection if count > 1 else news)
        return [*(b.logic("and", x, y) for x, y in zip(active, news, strict=True)), *selection]

    end = b.loop([*first, *numbers], [*[per_lane] * count, *vec], any_goes_on, masked_step)
    return end[count:]


def cond(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    branches = eqn.params["branches"]
    choice, operands = evaluator.entries(values[0])[()], values[1:]
    index = assumed_value(choice)  # the value, if it is known
    if index is not None:
        outs = evaluator.evaluate(branches[int(np.clip(index, 0, len(branches) - 1))], operands)
        return (
            outs
            if choice.value is not None
            else [evaluator.without_origin(value) for value in outs]
        )
    with evaluator.assuming(None):
        return _branches(evaluator, eqn, choice, operands)


def _branches(evaluator: Evaluator, eqn: Any, choice: Num, operands: list[Value]) -> list[Value]:
    branches, b = eqn.params["branches"], evaluator.b
    if choice.dtype == "bool":
        choice = b.convert(choice, "int32")
    flags = [v.has_lanes() for v in operands]
    # A result varies if the choice does, or if it does in one of the branches.
    per_branch = [reached_outputs(x.jaxpr, flags, UNIFORM) for x in branches]
    lane_flags = [choice.vec or any(x) for x in zip(*per_branch, strict=True)]
    avals = [v.aval for v in eqn.outvars]
    vec = [o for o, a in zip(lane_flags, avals, strict=True) for _ in range(a.size)]
    dtypes = [str(a.dtype) for a in avals for _ in range(a.size)]

    def run(branch):
        return lambda: _numbers_of(evaluator, evaluator.evaluate(branch, operands))

    # XLA clamps the index to the branches that exist: the first and the last are taken beyond it.
    ops = ["le", *["eq"] * (len(branches) - 2), "ge"][: len(branches)]
    takes = [b.compare(op, choice, b.const(i, choice.dtype)) for i, op in enumerate(ops)]
    # The same branch on all trajectories: jump. Otherwise run all branches that some trajectory
    # takes, and let each trajectory select its own result.
    if not choice.vec:
        return _values_of(avals, _one_of(evaluator, takes, [run(x) for x in branches], vec, dtypes))
    results: list[Num] = []
    for take, branch in zip(takes, branches, strict=True):
        zeros = [b.const(0, d) for d in dtypes]
        mine = b.branch(b.any_lane(take), run(branch), lambda z=zeros: z, vec, dtypes)
        pairs = zip(mine, results or mine, strict=True)
        results = [b.select(take, x, y) for x, y in pairs] if results else mine
    return _values_of(avals, results)


def _one_of(evaluator: Evaluator, takes, runs, vec, dtypes) -> list[Num]:
    if len(runs) == 1:
        return runs[0]()
    b = evaluator.b
    others_of = functools.partial(_one_of, evaluator, takes[1:], runs[1:], vec, dtypes)
    return b.branch(b.ref(takes[0], 0, False), runs[0], others_of, vec, dtypes)


def minimum_over_lanes(evaluator: Evaluator, eqn: Any, values: Values, places: list) -> Values:
    """The least of an integer over the trajectories of a block."""
    b, x = evaluator.b, evaluator.entries(values[0])[()]
    # Not reduced over the block: the assumption is checked after some rounds.
    if evaluator.assumptions is not None and eqn.params["rare"]:
        return [evaluator.value([evaluator.assumptions.minimum(x)], eqn.outvars[0].aval)]
    if not x.vec:
        return values
    # The block runs a branch that some trajectory nearly always needs. Results do not depend on
    # it, because each trajectory selects its own.
    if not eqn.params["rare"]:  # one of several trajectories nearly always needs it
        return [evaluator.value([assumed_number(b, 0, x.dtype)], eqn.outvars[0].aval)]
    kind, bits, total = b.type(x.dtype, True), b.type("bool", True), x.names[0]
    for other in x.names[1:]:
        is_less = b.new(f"icmp slt {kind} {total}, {other}")
        total = b.new(f"select {bits} {is_less}, {kind} {total}, {kind} {other}")
    if b.W > 1:
        result = f"{TYPES[x.dtype]} @llvm.vector.reduce.smin.{b.suffix(x.dtype, True)}"
        b.declare(f"{result}({kind})")
        total = b.new(f"call {result}({kind} {total})")
    return [evaluator.value([b.number([total], x.dtype, False)], eqn.outvars[0].aval)]


def by_itself(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """A call within a call: no product in it is contracted with a sum outside, nor the other
    way round, so that its numbers have the same bits wherever it is called."""
    program = eqn.params["program"]
    if eqn.params["lanes"] is not None:
        raise NotCompilable("the function contains a batch of another function of lanewise")
    outs = evaluator.evaluate(
        program.trace.all_inputs, [evaluator.opaque(value) for value in values]
    )
    return [evaluator.opaque(value) for value in outs]


def barrier(evaluator: Evaluator, eqn: Any, values: list[Value], places: list) -> list[Value]:
    """The values as they are, in no operation that is contracted with those after them."""
    return [evaluator.opaque(value) for value in values]


RULES |= {"scan": scan, "while": while_loop, "cond": cond, "lanewise": by_itself}
RULES |= {"least_over_lanes": minimum_over_lanes, "optimization_barrier": barrier}
