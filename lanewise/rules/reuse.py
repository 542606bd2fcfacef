"""Numbers at the end of a round that the next round computes again at its beginning.

A step ends with the energy, of the new state; the next one begins with the force, of the same
state, and both need 1/r. A loop carries such a number over instead.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from ..llvm.ir import Num

# Operations worth carrying; calls of elementary functions are too.
_COSTLY = frozenset(["sqrt", "div"])

_MOST_PAIRS = 8  # numbers that are carried over
_MOST_NUMBERS = 2000  # of a round: the search in a longer one takes more time than it saves


def carried_over(
    state_before: Sequence[Num], state_after: Sequence[Num], numbers: Iterable[Num]
) -> list[tuple[Num, Num]]:
    """Pairs (x, y) of numbers of a round: x follows from the state before it as y does from the
    state after it, so that y is the next round's x."""
    place = {x.serial: i for i, x in enumerate(state_before)}
    new_place = {x.serial: i for i, x in enumerate(state_after) if x.value is None}
    names: dict[Any, int] = {}
    # The same names for both, so that equal forms have equal keys.
    first, second = _Forms(place, min(place), names), _Forms(new_place, min(place), names)
    numbers = _all_of([*state_after, *numbers])
    if len(numbers) > _MOST_NUMBERS:
        return []
    for x in sorted(numbers, key=lambda x: x.serial):  # operands first, so that no call is deep
        first.key(x)
        second.key(x)
    ends = {}
    for y in numbers:
        form = second.key(y)
        if form is not None and _is_costly(y):
            ends.setdefault(form, y)
    pairs, serials = [], set()
    for x in numbers:
        if x.serial < first.first_serial:  # computed before the loop, for another purpose
            continue
        form = first.key(x)
        # Not what is equal in all rounds: it may be computed before the loop.
        if form == second.key(x):
            continue
        # A number that is the same on all trajectories is cheap.
        if form in ends and _is_costly(x) and x.vec and x.write and ends[form].vec:
            pairs.append((x, ends[form]))
            serials.add(x.serial)
    # A number that only other carried numbers need does not have to be carried.
    operands = {a.serial for z in numbers if z.serial not in serials for a in z.args}
    pairs = [(x, y) for x, y in pairs if x.serial in operands]
    # More of them would need more registers than the state leaves.
    return pairs if len(pairs) <= _MOST_PAIRS else []


def _is_costly(x: Num) -> bool:
    return x.op in _COSTLY or x.op.startswith("call ")


def _all_of(ends: Sequence[Num]) -> list[Num]:
    """The numbers and all that they are made of."""
    result, open_ = {}, list(ends)
    while open_:
        x = open_.pop()
        if x.value is None and x.serial not in result:
            result[x.serial] = x
            open_ += x.args
    return list(result.values())


class _Forms:
    """How numbers are made from a state, as keys: equal keys are equal numbers of equal states.

    A key is a short name of an operation and the keys of its operands. Written out, an expression
    in which one number occurs twice, again and again, is as long as a power of two.
    """

    def __init__(self, place: dict[int, int], first_serial: int, names: dict[Any, int]):
        """`place`: numbers of the state. Those before `first_serial` are equal in all rounds."""
        self.place, self.first_serial, self.names = place, first_serial, names
        self.forms: dict[int, int | None] = {}

    def _key_of(self, *form: Any) -> int:
        return self.names.setdefault(form, len(self.names))

    def key(self, x: Num) -> int | None:
        """The key, None for a number that does not follow from this state alone."""
        if x.value is not None:
            return self._key_of("known", x.key)
        if x.serial in self.place:
            return self._key_of("state", self.place[x.serial])
        if x.serial < self.first_serial:
            return self._key_of("outside", x.serial)
        # A result of a loop or a branch: nothing is known of how it was made.
        if x.write is None and x.op != "same":
            return None
        if x.serial not in self.forms:
            self.forms[x.serial] = None
            parts = [self.key(a) for a in x.args]
            if x.op == "same":
                self.forms[x.serial] = parts[0]
            elif all(part is not None for part in parts):
                self.forms[x.serial] = self._key_of(x.op, x.dtype, *parts)
        return self.forms[x.serial]
