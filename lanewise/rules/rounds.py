"""The rounds of a scan: in portions, where rows wait or rounds are first run on assumptions."""

import dataclasses
import math
from collections.abc import Callable, Sequence

from ..assumed import Assumed, NotAssumable, may_assume
from ..evaluator import Evaluator
from ..jaxprs.jaxapi import Jaxpr
from ..llvm.ir import Num
from ..llvm.memory import Buffer, contiguous, transposed
from ..llvm.values import Value
from .reuse import carried_over

# Rounds that are run on assumptions before these are checked: a check costs little then, and few
# rounds are repeated if one fails.
_PORTION = 32


class Waiting:
    """Rows of results that wait in fast memory until several are there, and are then written.

    Trajectory after trajectory a result has rows far apart: writing `count` of them at a time fills
    whole cache lines.
    """

    def __init__(self, evaluator: Evaluator, results: Sequence[Buffer], count: int):
        self.b, self.evaluator, self.results, self.count = evaluator.b, evaluator, results, count
        self.stages = [
            evaluator.module.scratch((count, *r.shape[1:]), r.dtype, True) for r in results
        ]

    @classmethod
    def of(cls, evaluator: Evaluator, results: Sequence[Buffer], length: int) -> "Waiting | None":
        """For results of a loop with `length` rounds, None where waiting saves no time."""
        apart = all(r.lane not in (None, 1) and r.dtype != "bool" for r in results)
        in_order = all(r.strides == contiguous(r.shape) for r in results)
        width = sum(math.prod(r.shape[1:]) for r in results)
        # Wide rows fill cache lines by themselves, and the memory for waiting would not stay in the
        # cache.
        if evaluator.b.W == 1 or not (apart and in_order and 0 < width <= 8):
            return None
        count = 32 if width <= 2 else 16 if width <= 4 else 8
        return cls(evaluator, results, count) if length > count else None

    def rows(self, k: Num, start: Num) -> list[Buffer]:
        """Where round k writes, of a portion that begins with round `start`."""
        return [s.row(self.b, self.b.sub(k, start)) for s in self.stages]

    def write(self, start: Num, stop: Num) -> None:
        """Write the rows start, …, stop − 1 to where they belong."""
        b = self.b
        count = b.known(self.count, "int64")

        def whole() -> list[Num]:
            for stage, result in zip(self.stages, self.results, strict=True):
                transposed(b, stage, result.from_row(b, start))
            return []

        def row(state, _) -> list[Num]:
            (k,) = state
            for to, result in zip(self.rows(k, start), self.results, strict=True):
                self.evaluator.write(Value.in_memory(to), result.row(b, k))
            return [b.add(k, b.known(1, "int64"))]

        def some() -> list[Num]:
            b.loop([start], [False], lambda state, _: b.less(state[0], stop), row)
            return []

        # The last portion may be shorter; its rows are written one by one.
        is_whole = b.compare("eq", b.sub(stop, start), count)
        b.branch(b.ref(is_whole, 0, False), whole, some, [], [])


@dataclasses.dataclass
class Rounds:
    """The rounds 0, …, end − 1 of a loop that carries numbers, of which `vec` says whether they
    differ between trajectories. ``round_of(numbers, k, start)`` is round k of a portion that begins
    with round `start`."""

    e: Evaluator
    vec: list[bool]
    length: int
    end: Num
    round_of: Callable[[Sequence[Num], Num, Num], list[Num]]
    waiting: Waiting | None

    def all(self, jaxpr: Jaxpr, numbers: list[Num]) -> list[Num]:
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
            if self.waiting is None:
                return self._some(b.known(0, "int64"), self.end, numbers)
            size = b.known(self.waiting.count, "int64")
            return self._portions(numbers, self.vec, size, self._some)

    def _some(self, start: Num, stop: Num, numbers: Sequence[Num]) -> list[Num]:
        """Rounds start, …, stop − 1, with all branches."""
        b = self.e.b

        def body(state, _):
            k, *before = state
            return [b.add(k, b.known(1, "int64")), *self.round_of(before, k, start)]

        vec = [False, *self.vec]
        return b.loop([start, *numbers], vec, lambda state, _: b.less(state[0], stop), body)[1:]

    def _portions(
        self, state: Sequence[Num], vec: list[bool], size: Num, portion: Callable[..., list[Num]]
    ) -> list[Num]:
        """All rounds, ``portion(start, stop, state)`` by portion, and the rows of each written."""
        b = self.e.b

        def body(state, _):
            start, *before = state
            stop = b.add(start, size)
            stop = b.select(b.compare("lt", stop, self.end), stop, self.end)
            after = portion(start, stop, before)
            if self.waiting is not None:
                self.waiting.write(start, stop)
            return [stop, *after]

        first, vec = [b.known(0, "int64"), *state], [False, *vec]
        return b.loop(first, vec, lambda state, _: b.less(state[0], self.end), body)[1:]

    def _on_assumptions(self, numbers: list[Num]) -> list[Num]:
        """The rounds in portions: first without the branches that are rarely taken; if one should
        have been taken by a trajectory of the block, the portion is repeated with all branches.

        After such a portion, from the second on, some are run with all branches at once.
        """
        e, b, vec = self.e, self.e.b, self.vec
        zero, false = b.known(0, "int64"), b.known(False, "bool")
        if self.waiting is not None:
            size = b.known(self.waiting.count, "int64")
        else:
            # Portions of equal length: a last one of few rounds would be checked as often as a full
            # one.
            size = e.module.parameter(-(-self.length // -(-self.length // _PORTION)))
        # Memory for a copy of the state, from which a portion is repeated.
        aside = [e.module.scratch((), x.dtype, v).base for x, v in zip(numbers, vec, strict=True)]
        changed: list[bool] = []

        def without_branches(start: Num, stop: Num, numbers: Sequence[Num]) -> list[Num]:
            found = Assumed(b)

            def body(state, _):
                k, failed, *before = state
                with e.assuming(found):
                    after = self.round_of(before, k, start)
                found.defer(before, after)
                changed.extend(x is not y for x, y in zip(before, after, strict=True))
                return [b.add(k, b.known(1, "int64")), found.wrong(failed), *after]

            _, failed, *after = b.loop(
                [start, false, *numbers],
                [False, False, *vec],
                lambda state, _: b.less(state[0], stop),
                body,
                carried_over=carried_over,
            )
            return [found.wrong_at_the_end(failed, after), *after]

        def portion(start: Num, stop: Num, state: Sequence[Num]) -> list[Num]:
            until, wait, *numbers = state
            tried = b.compare("ge", start, until)
            copies = b.reserved()
            dtypes = [x.dtype for x in numbers]
            failed, *found = b.branch(
                b.ref(tried, 0, False),
                lambda: without_branches(start, stop, numbers),
                lambda: [b.known(True, "bool"), *numbers],
                [False, *vec],
                ["bool", *dtypes],
            )
            # Which numbers change is known only after the round is written. They are stored in
            # memory before it, so that the rounds have all registers.
            kept = list(zip(changed, numbers, aside, vec, strict=True))
            with b.writing(copies):
                for is_changed, x, pointers, v in kept:
                    if is_changed:
                        e.module.set_aside(x, pointers, v)

            def again() -> list[Num]:
                old = [e.module.taken_back(x, at, v) if c else x for c, x, at, v in kept]
                return self._some(start, stop, old)

            found = b.branch(b.ref(failed, 0, False), again, lambda: found, vec, dtypes)
            # After each failure a larger number of rounds is run with all branches: a trajectory
            # that fails in each round costs little more than one that is never assumed.
            has_failed = b.logic("and", tried, failed)
            until = b.select(has_failed, b.add(stop, wait), until)
            wait = b.select(has_failed, b.add(b.add(wait, wait), size), wait)
            return [until, wait, *found]

        return self._portions([zero, zero, *numbers], [False, False, *vec], size, portion)[2:]
