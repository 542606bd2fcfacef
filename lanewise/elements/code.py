"""The kernel of a program on long arrays: one trajectory after the other."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..evaluator import Evaluator
from ..frame import kernel_text, pointers
from ..jaxprs.jaxapi import ClosedJaxpr
from ..llvm.ir import Num, check_size, check_type
from ..llvm.memory import stored_type
from ..module import Module
from .equations import Translation, row_major
from .nests import Nests
from .places import places
from .schedule import Group, dead_memories, schedule
from .tree import Block, Branch, Loop, Memory


class Kernel:
    """The text of a kernel, and what it needs: bytes of memory and constants."""

    def __init__(self, module: Module, function: ClosedJaxpr, lane_flags: Sequence[bool]):
        self.module, self.b = module, module.b
        jaxpr = function.jaxpr
        for v in (*jaxpr.invars, *jaxpr.outvars):
            check_type(v.aval.dtype, "arguments and results")
        translation = Translation()
        inputs = [_argument(v.aval, "operand") for v in jaxpr.invars]
        results = [_argument(v.aval, "result") for v in jaxpr.outvars]
        # Results are written where XLA wants them as soon as they are computed.
        arrays = [memory.load(translation.table) for memory in inputs]
        outs = translation.evaluate(function, arrays, [memory.place for memory in results])
        for x, memory in zip(outs, results, strict=True):
            if x.size:
                translation.store(x, memory.place)
        program = translation.block
        # The whole tree exists before a line is written: only then is it known what is read
        # later.
        schedule(program)
        dead = dead_memories(program)
        at, self.scratch = places(program, dead)
        self.operands = tuple(array for _, array in translation.operands)
        self.nests = Nests(Evaluator(module), at, dead)
        bases = pointers(self.b, "%args", "a", len(inputs) + len(self.operands))
        ends = pointers(self.b, "%rets", "r", len(results))
        constants = [memory for memory, _ in translation.operands]
        # Constants follow the operands of the program.
        self.nests.pointers |= dict(zip(constants, bases[len(inputs) :], strict=True))

        def trajectory(i: str) -> None:
            # One trajectory: its arrays lie one after the other.
            lane = self.b.new(f"add i64 %first, {i}")
            for memory, base, has_lanes in zip(inputs, bases, lane_flags, strict=False):
                self.nests.pointers[memory] = self._lane(base, memory, lane) if has_lanes else base
            for memory, base in zip(results, ends, strict=True):
                self.nests.pointers[memory] = self._lane(base, memory, lane)
            self.block(program)

        self.b.repeat("%count", trajectory)
        self.text = kernel_text(module, len(results), self.nests.head)

    def _lane(self, base: str, memory: Memory, lane: str) -> str:
        distance = self.b.new(f"mul i64 {lane}, {memory.size}")
        return self.b.pointer(stored_type(memory.dtype), base, distance)

    # --- loops and branches ----------------------------------------------------------------------

    def block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, Group):
                self.nests.group(item)
                check_size(self.b.operations, self.b.limit, "the number of operations")
            elif isinstance(item, Loop):
                self.loop(item)
            else:
                self.branch(item)

    def numbers(self, expressions: Sequence[Any]) -> list[Num]:
        with self.nests.scalars():
            return [self.b.opaque(self.nests.number(node, [])) for node in expressions]

    def loop(self, loop: Loop) -> None:
        b, nests = self.b, self.nests
        carried = [number for number, _, _ in loop.numbers]
        # Computed before the loop, in the order of the carry.
        start = self.numbers([first for _, first, _ in loop.numbers])
        end = "" if loop.length is None else self.module.parameter(loop.length).names[0]

        def begin(state: Sequence[Num], counter: str) -> None:
            nests.numbers.update(zip(carried, state, strict=True))
            nests.numbers[loop.counter] = b.number([counter], "int64", False)

        def test(state: list[Num], counter: str) -> str:
            begin(state, counter)
            if end:
                return b.new(f"icmp slt i64 {counter}, {end}")
            self.block(loop.test)
            (goes_on,) = self.numbers([loop.condition])
            return b.ref(goes_on, 0, False)

        def body(state: list[Num], counter: str) -> list[Num]:
            self.block(loop.body)
            after = self.numbers([after for _, _, after in loop.numbers])
            # Where they share bytes nothing is copied.
            for now, new in loop.memories:
                self.copy(new, now)
            return after

        with nests.scalars():
            flags = [False] * len(start)
        final = b.loop(start, flags, test, body, count=True)
        nests.numbers.update(zip(carried, final, strict=True))

    def copy(self, source: Memory, target: Memory) -> None:
        nests = self.nests
        if nests.places[source] == nests.places[target]:
            return
        size = source.size * np.dtype(source.dtype).itemsize
        self.b.declare("void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
        target_pointer, source_pointer = nests.pointer(target), nests.pointer(source)
        self.b.emit(
            f"call void @llvm.memcpy.p0.p0.i64(ptr {target_pointer}, ptr {source_pointer}, "
            f"i64 {size}, i1 false)"
        )

    def branch(self, branch: Branch) -> None:
        (index,) = self.numbers([branch.index])
        dtypes = [number.dtype for number, _ in branch.numbers]

        def run(i: int) -> list[Num]:
            self.block(branch.blocks[i])
            return self.numbers([of[i] for _, of in branch.numbers])

        def from_block(i: int) -> list[Num]:
            if i == len(branch.blocks) - 1:
                return run(i)
            b = self.b
            # The index is cut: all that is less than 1 is the first block. Blocks in their order;
            # the last one is taken for all that is larger.
            takes = b.compare("le", index, b.const(i, index.dtype))
            if takes.value is not None:
                return run(i) if takes.value else from_block(i + 1)
            vec = [False] * len(dtypes)
            return b.branch(
                b.ref(takes, 0, False), lambda: run(i), lambda: from_block(i + 1), vec, dtypes
            )

        results = from_block(0)
        self.nests.numbers.update(zip((n for n, _ in branch.numbers), results, strict=True))


def _argument(aval: Any, pointer: str) -> Memory:
    """An operand or a result: its place is known when the code runs."""
    return Memory(aval.shape, aval.dtype, row_major(aval.shape), pointer)
