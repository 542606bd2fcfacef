"""The rounds of a scan: in portions, where rows wait or rounds are first run on assumptions."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

from ..assumed import LONGEST, Assumptions, NotAssumable, may_assume
from ..evaluator import Evaluator
from ..jaxprs.jaxapi import Jaxpr
from ..llvm.ir import Num
from ..llvm.memory import Buffer, contiguous, copy_transposed
from ..llvm.values import Value
from .reuse import carried_over

# Rounds that are run on assumptions before these are checked: a check costs little then, and few
# rounds are repeated if one fails.
_PORTION = 32


class RowCollector:
    """Rows of results that wait in fast memory until several are there, and are then written.

    Trajectory after trajectory a result has rows far apart: writing `count` of them at a time fills
    whole cache lines.
    """

    def __init__(self, evaluator: Evaluator, results: Sequence[Buffer], count: int):
        self.b, self.evaluator, self.results, self.count = evaluator.b, evaluator, results, count
        scratch = evaluator.module.scratch
        self.stages = [scratch((count, *x.shape[1:]), x.dtype, True) for x in results]

    @classmethod
    def for_results(cls, evaluator: Evaluator, results: Sequence[Buffer], length: int):
        """For results of a loop with `length` rounds, None where waiting saves no time."""
        apart = all(result.lane not in (None, 1) and result.dtype != "bool" for result in results)
        in_order = all(result.strides == contiguous(result.shape) for result in results)
        width = sum(math.prod(result.shape[1:]) for result in results)
        # Wide rows fill cache lines by themselves, and the memory for waiting would not stay in the
        # cache.
        if evaluator.b.W == 1 or not (apart and in_order and 0 < width <= 8):
            return None
        count = 32 if width <= 2 else 16 if width <= 4 else 8
        return cls(evaluator, results, count) if length > count else None

    def rows(self, k: Num, start: Num) -> list[Buffer]:
        """Where round k writes, of a portion that begins with round `start`."""
        return [stage.row(self.b, self.b.sub(k, start)) for stage in self.stages]

    def write(self, start: Num, stop: Num) -> None:
        """Write the rows start, …, stop − 1 to where they belong."""
        b = self.b
        count = b.const(self.count, "int64")

        def write_all() -> list[Num]:
            for stage, result in zip(self.stages, self.results, strict=True):
                copy_transposed(b, stage, result.from_row(b, start))
            return []

        def write_row(k: Num) -> list[Num]:
            for stage, result in zip(self.rows(k, start), self.results, strict=True):
                self.evaluator.write(Value.in_memory(stage), result.row(b, k))
            return [b.add(k, b.const(1, "int64"))]

        def write_rows() -> list[Num]:
            b.loop_below(stop, [start], [False], write_row)
            return []

        # The last portion may be shorter; its rows are written one by one.
        is_whole = b.compare("eq", b.sub(stop, start), count)
        b.branch(b.ref(is_whole, 0, False), write_all, write_rows, [], [])


@dataclasses.dataclass
class Rounds:
    """The rounds 0, …, end − 1 of a loop that carries numbers, vectors where `vec` is true;
    ``round_of(numbers, k, start)`` is round k of a portion that begins with round `start`."""

    e: Evaluator
    vec: list[bool]
    length: int
    end: Num
    round_of: Callable[[Sequence[Num], Num, Num], list[Num]]
    collector: RowCollector | None

    def run(self, jaxpr: Jaxpr, numbers: list[Num]) -> list[Num]:
        """The numbers that are carried after all rounds of a loop with this body."""
        e, b = self.e, self.e.b
        with e.assuming(None):
            # The attempt is removed from the text if an assumption turns out to be impossible.
            if self.length > 1 and may_assume(jaxpr):
                mark = b.mark()
                try:
                    return self._on_assumptions(numbers)
                except NotAssumable:
                    b.back_to(mark)
            if self.collector is None:
                return self._with_branches(b.const(0, "int64"), self.end, numbers)
            size = b.const(self.collector.count, "int64")
            return self._portions(numbers, self.vec, size, self._with_branches)

    def _with_branches(self, start: Num, stop: Num, numbers: Sequence[Num]) -> list[Num]:
        """Rounds start, …, stop − 1, with all branches."""
        b = self.e.b

        def body(k: Num, *old: Num) -> list[Num]:
            return [b.add(k, b.const(1, "int64")), *self.round_of(old, k, start)]

        carry, vec = [start, *numbers], [False, *self.vec]
        return b.loop_below(stop, carry, vec, body, carried_over=carried_over)[1:]

    def _portions(
        self, state: Sequence[Num], vec: list[bool], size: Num, portion: Callable[..., list[Num]]
    ) -> list[Num]:
        """All rounds, ``portion(start, stop, state)`` by portion, and the rows of each written."""
        b = self.e.b

        def body(start: Num, *old: Num) -> list[Num]:
            stop = b.add(start, size)
            stop = b.select(b.compare("lt", stop, self.end), stop, self.end)
            new = portion(start, stop, old)
            if self.collector is not None:
                self.collector.write(start, stop)
            return [stop, *new]

        return b.loop_below(self.end, [b.const(0, "int64"), *state], [False, *vec], body)[1:]

    def _on_assumptions(self, numbers: list[Num]) -> list[Num]:
        """The rounds in portions: first without the branches that are rarely taken; if one should
        have been taken by a trajectory of the block, the portion is repeated with all branches.

        After such a portion, from the second on, some are run with all branches at once.
        """
        e, b, vec = self.e, self.e.b, self.vec
        zero, false = b.const(0, "int64"), b.const(False, "bool")
        if self.collector is not None:
            size = b.const(self.collector.count, "int64")
        else:
            # Portions of equal length: a last one of few rounds would be checked as often as a full
            # one.
            size = e.module.parameter(-(-self.length // -(-self.length // _PORTION)))
        # Memory for a copy of the state, from which a portion is repeated.
        aside = [e.module.scratch((), x.dtype, v).base for x, v in zip(numbers, vec, strict=True)]
        changes: list[bool] = []

        def without_branches(start: Num, stop: Num, numbers: Sequence[Num]) -> list[Num]:
            assumptions = Assumptions(b)

            def body(k: Num, failure: Num, *old: Num) -> list[Num]:
                count = b.operations
                with e.assuming(assumptions):
                    new = self.round_of(old, k, start)
                if b.operations - count > LONGEST:
                    raise NotAssumable
                assumptions.defer(old, new)
                changes.extend(x is not y for x, y in zip(old, new, strict=True))
                return [b.add(k, b.const(1, "int64")), assumptions.wrong(failure), *new]

            carry, lanes = [start, false, *numbers], [False, False, *vec]
            _, failure, *new = b.loop_below(stop, carry, lanes, body, carried_over=carried_over)
            return [assumptions.wrong_at_the_end(failure, new), *new]

        def portion(start: Num, stop: Num, state: Sequence[Num]) -> list[Num]:
            retry_at, wait, *numbers = state
            is_attempt = b.compare("ge", start, retry_at)
            copies = b.reserve()
            dtypes = [x.dtype for x in numbers]
            failure, *results = b.branch(
                b.ref(is_attempt, 0, False),
                lambda: without_branches(start, stop, numbers),
                lambda: [b.const(True, "bool"), *numbers],
                [False, *vec],
                ["bool", *dtypes],
            )
            # Which numbers change is known only after the round is written. They are stored in
            # memory before it, so that the rounds have all registers.
            backup = list(zip(numbers, aside, vec, strict=True))
            with b.writing(copies):
                for copy in itertools.compress(backup, changes):
                    e.module.set_aside(*copy)

            def repeat() -> list[Num]:
                pairs = zip(backup, changes, strict=True)
                old = [e.module.taken_back(*copy) if c else copy[0] for copy, c in pairs]
                return self._with_branches(start, stop, old)

            results = b.branch(b.ref(failure, 0, False), repeat, lambda: results, vec, dtypes)
            # After each failure a larger number of rounds is run with all branches: a trajectory
            # that fails in each round costs little more than one that is never assumed.
            has_failed = b.logic("and", is_attempt, failure)
            retry_at = b.select(has_failed, b.add(stop, wait), retry_at)
            wait = b.select(has_failed, b.add(b.add(wait, wait), size), wait)
            return [retry_at, wait, *results]

        return self._portions([zero, zero, *numbers], [False, False, *vec], size, portion)[2:]
