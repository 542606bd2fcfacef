"""Which memories share bytes: liveness, interference, and a greedy choice.

A memory may be written over another one if the old array is not read any more, or if each of its
elements is read for the last time where the new one's same element is computed.
"""

from collections.abc import Iterable

import numpy as np

from .boxes import Expression
from .schedule import Group, memory_of, reads
from .tree import Block, Branch, Loop, Memory, Store


class Lives:
    """Which memories must not share bytes, from a walk backwards through the program."""

    def __init__(self, program: Block, dead: set[Memory]):
        self.dead = dead
        self.conflicts: dict[Memory, set[Memory]] = {}
        self.wishes: dict[Memory, list[Memory]] = {}
        """For each memory those whose bytes it should take over, if it may."""
        self.order: list[Memory] = []
        self._block(program, set())
        self.order.reverse()

    def _conflict(self, memory: Memory, others: Iterable[Memory]) -> None:
        for other in others:
            if other is not memory:
                self.conflicts.setdefault(memory, set()).add(other)
                self.conflicts.setdefault(other, set()).add(memory)

    def _wish(self, memory: Memory, other: Memory) -> None:
        self.wishes.setdefault(memory, []).append(other)
        self.wishes.setdefault(other, []).append(memory)

    def _block(self, block: Block, live: set[Memory]) -> set[Memory]:
        """The memories that are live before a block, from those after it."""
        first: dict[Memory, int] = {}
        for i, item in enumerate(block.items):
            if isinstance(item, Group):
                for statement in item.statements:
                    memory = memory_of(statement)
                    # A round of a loop writes a part of its rows: those of other rounds live on.
                    if memory is not None and memory.whole is None:
                        first.setdefault(memory, i)
        # Backwards: what is live before an item is what is live after it, without what it makes,
        # and with what it reads.
        for i, item in reversed(list(enumerate(block.items))):
            if isinstance(item, Loop):
                live = self._loop(item, live)
            elif isinstance(item, Branch):
                # The blocks run one or the other; the results are made in each of them.
                of_results = _roots(e for _, of in item.numbers for e in of)
                befores = [self._block(inner, live | of_results) for inner in item.blocks]
                live = set().union(_roots([item.index]), *befores)
            else:
                live = self._group(item, live, {m for m, k in first.items() if k == i})
        return live

    def _loop(self, loop: Loop, live: set[Memory]) -> set[Memory]:
        rows = {m for m in loop.rows if m.pointer is None and m.whole is None}
        now, new = {m for m, _ in loop.memories}, {m for _, m in loop.memories}
        of_round = _roots(after for _, _, after in loop.numbers)
        of_test = _roots([] if loop.condition is None else [loop.condition])
        # A loop may end after any round, so that all that is read after it is live in it.
        head = live | rows | now
        # What a round reads at its beginning must survive the round before: walk until no memory
        # is added. Conflicts are only added, so that a walk too many does no harm.
        while True:
            end = (head - now) | new | of_round
            for old, after in loop.memories:
                # At the end of a round the new arrays become those of the next one.
                self._conflict(old, head | (new - {after}))
                self._conflict(after, end)
            before = self._block(loop.body, end)
            new_head = head | self._block(loop.test, before | live | of_test)
            if new_head == head:
                break
            head = new_head
        # Without a copy at the end of each round, if they may share bytes.
        for old, after in loop.memories:
            self._wish(after, old)
        return (head - rows) | _roots(first for _, first, _ in loop.numbers)

    def _group(self, group: Group, live: set[Memory], begins: set[Memory]) -> set[Memory]:
        made = _memories_of(group) - self.dead
        old: dict[Memory, list[Expression]] = {}
        # Reads of what the group itself makes come from registers.
        for node in group.memory_reads():
            old.setdefault(node.value.root, []).append(node)
        # The order of the program, for the walk goes backwards.
        for memory in sorted(made, key=lambda m: -m.serial):
            own = [s for s in group.statements if memory_of(s) is memory]
            read = {n.value for s in own for n in reads(s) if n.kind == "load"}
            if memory not in self.order:
                self.order.append(memory)
            # Two arrays that a group makes are written at once.
            self._conflict(memory, live | made)
            for other, nodes in old.items():
                if other is memory:
                    continue
                if _takes_over(group, memory, other, nodes):
                    if other not in live and other in read:
                        self._wish(memory, other)
                else:
                    self._conflict(memory, [other])
        return (live - begins) | set(old)


def _memories_of(group: Group) -> set[Memory]:
    return {m.root for s in group.statements if (m := memory_of(s)) is not None}


def _roots(nodes: Iterable[Expression]) -> set[Memory]:
    """The memories that some expressions read."""
    return {n.value.root for node in nodes for n in node.loads(set()) if n.kind == "load"}


def _takes_over(group: Group, memory: Memory, old: Memory, nodes: list[Expression]) -> bool:
    """Whether a group that makes `memory` reads each element of `old` only where it makes the same
    element."""
    # Only arrays of one layout: element by element, at one address.
    if memory.strides != old.strides or memory.dtype != old.dtype or memory.size != old.size:
        return False
    targets = set()
    for s in group.statements:
        own = memory_of(s)
        if own is None or own.root is not memory:
            continue
        # An axis without a stride writes one element several times.
        if not isinstance(s, Store) or own is not memory or 0 in s.strides:
            return False
        targets.add((s.strides, s.offset))
    return all(
        node.value is old and not node.args and (node.strides, node.offset) in targets
        for node in nodes
    )


def places(
    program: Block, dead: set[Memory], lives: Lives | None = None
) -> tuple[dict[Memory, int], int]:
    """The first byte of each memory without a pointer, and the number of all bytes."""
    lives = Lives(program, dead) if lives is None else lives
    at: dict[Memory, int] = {}
    members: dict[int, list[Memory]] = {}
    sizes: dict[int, int] = {}
    total = 0
    # First come, first served: a wish avoids a copy or a second array, any free bytes of the
    # right size avoid new memory.
    for memory in lives.order:
        if memory.pointer is not None or memory.root is not memory:
            continue
        size = _bytes(memory)
        conflicts = lives.conflicts.get(memory, set())
        wishes = [at[m] for m in lives.wishes.get(memory, []) if m in at]
        free = (
            start
            for start in [*wishes, *members]
            if sizes[start] == size and not conflicts & set(members[start])
        )
        start = next(free, None)
        if start is None:
            start = total
            sizes[start], members[start] = size, []
            total += size
        at[memory] = start
        members[start].append(memory)
    return at, total


def _bytes(memory: Memory) -> int:
    """In whole cache lines."""
    return (memory.size * np.dtype(memory.dtype).itemsize + 63) // 64 * 64
