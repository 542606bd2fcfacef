"""Loops that are first run on the assumption that no rare branch is needed.

A step that tests each time whether something has failed spends much of its time on tests. So some
steps are run without branches, and their conditions are collected. If one trajectory of the block
should have taken a branch, these steps are repeated with all branches from the same state. The
numbers are the same to the bit in both.
"""

from collections.abc import Sequence
from typing import Any

from .jaxprs.extent import operation_count
from .jaxprs.jaxapi import Jaxpr, bodies
from .llvm.builder import Builder
from .llvm.ir import Num


class NotAssumable(Exception):
    """A loop that cannot be run without its branches."""


def assumed_number(b: Builder, value: int, dtype: str) -> Num:
    """A number whose assumed value decides a branch while the code is written."""
    # Not a known number: the results of the branch are marked as results of a branch, so that they
    # have the same bits as in the version with all branches.
    return b.number([str(int(value))], dtype, False, "taken for", (b.const(value, dtype),))


def assumed_value(x: Num) -> Any:
    """The value of a number that comes from one of `assumed_number`; else None."""
    if x.value is not None:
        return x.value
    if x.op == "taken for":
        return x.args[0].value
    if x.op not in ("eq", "ne", "not", "to zext", "to sext", "to trunc"):
        return None
    parts = [assumed_value(operand) for operand in x.args]
    if any(part is None for part in parts):
        return None
    if x.op in ("eq", "ne"):
        return (parts[0] == parts[1]) == (x.op == "eq")
    return not parts[0] if x.op == "not" else int(parts[0])


class Assumptions:
    """The assumptions of a loop, collected while the code of one round is written."""

    def __init__(self, b: Builder):
        self.b = b
        self.failures: list[Num] = []
        self.finite: list[Num] = []
        self.at_the_end: list[int] = []

    def assume_false(self, x: Num) -> None:
        """Assume that a truth value is false on all trajectories."""
        b = self.b
        if x.value is not None:
            # It is true on every trajectory: the round without branches would always be repeated.
            if x.value:
                raise NotAssumable
        elif x.op == "or" and x.dtype == "bool":
            # Part by part, so that a test of finiteness among them joins the others in one sum.
            for part in x.args:
                self.assume_false(part)
        elif x.op == "not" and x.args[0].op == "and":
            # not (a and b) = not a or not b.
            for part in x.args[0].args:
                self.assume_false(b.invert(part))
        elif x.op == "not" and x.args[0].op == "finite":
            # Not tested in the round: often the state after the last round shows that they were
            # finite.
            self.finite += b.finite_terms(x.args[0])
        # The same test may decide several branches; once is enough.
        elif all(x.serial != other.serial for other in self.failures):
            self.failures.append(x)

    def minimum(self, x: Num) -> Num:
        """The least over all trajectories of ``where(flag, 0, 1)``, the flag taken for false."""
        if x.value is not None:
            return x
        # Only the form that `on_any` writes; another integer could decide anything.
        if x.op != "select" or not all(operand.value is not None for operand in x.args[1:]):
            raise NotAssumable
        flag, yes, no = x.args
        if yes.value < no.value:
            self.assume_false(flag)
        else:
            self.assume_false(self.b.invert(flag))
        return assumed_number(self.b, max(yes.value, no.value), x.dtype)

    def defer(self, state_before: Sequence[Num], state_after: Sequence[Num]) -> None:
        """Find numbers that need a check after the last round only.

        If such a number is finite after a round, then so are all numbers that must be finite in
        that round, and the number itself before it. By induction this covers all rounds.
        """
        b, terms = self.b, frozenset(x.serial for x in self.finite)
        if not terms:
            return

        def is_enough(indices: Sequence[int]) -> bool:
            targets = terms | {state_before[i].serial for i in indices}
            return targets <= b.finite_where(targets, [state_after[i] for i in indices])

        # A number that is known while the code is written cannot become infinite.
        deferred_indices = [i for i, x in enumerate(state_after) if x.is_float and x.value is None]
        deferred_indices = [i for i in deferred_indices if b.finite_where(terms, [state_after[i]])]
        for i in tuple(deferred_indices):  # as few as possible
            fewer = [j for j in deferred_indices if j != i]
            if is_enough(fewer):
                deferred_indices = fewer
        # If they are not enough, the state may be finite at the end although a number was not.
        if is_enough(deferred_indices):
            self.at_the_end = deferred_indices
        else:
            for dtype in sorted({x.dtype for x in self.finite}):
                numbers = [x for x in self.finite if x.dtype == dtype]
                self.failures.append(b.invert(b.all_finite(numbers)))

    def wrong(self, failed_before: Num) -> Num:
        """Whether an assumption has failed on a trajectory of the block, in a round up to now."""
        b = self.b
        if not self.failures:
            return failed_before
        # One reduction over the trajectories of the block for all failures of a round.
        total = self.failures[0]
        for x in self.failures[1:]:
            total = b.logic("or", total, x)
        return b.logic("or", failed_before, b.number([b.any_lane(total)], "bool", False))

    def wrong_at_the_end(self, failed_before: Num, numbers: Sequence[Num]) -> Num:
        """The same after the last round, with the checks that were deferred to it."""
        b = self.b
        for dtype in ("float32", "float64"):
            deferred_numbers = [numbers[i] for i in self.at_the_end if numbers[i].dtype == dtype]
            if deferred_numbers:
                bad = b.any_lane(b.invert(b.all_finite(deferred_numbers)))
                failed_before = b.logic("or", failed_before, b.number([bad], "bool", False))
        return failed_before


# Two versions of a long round cost more time to compile, and more of the instruction cache, than
# the branches take.
LONGEST = 300  # a round with more operations is written once, with all branches


def may_assume(jaxpr: Jaxpr) -> bool:
    """Whether a round of a loop is short and calls `on_any` outside of inner loops."""
    # Derivatives have many products with 0 and 1, which are not written.
    return _asks(jaxpr) and operation_count(jaxpr) <= 2 * LONGEST


def _asks(jaxpr: Jaxpr) -> bool:
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        # Branches that are often taken would make the round be repeated nearly always.
        if name == "least_over_lanes" and eqn.params["rare"]:
            return True
        if name not in ("scan", "while", "cond") and any(_asks(body.jaxpr) for body in bodies(eqn)):
            return True
    return False
