"""Statements joined into groups: those of one group share their loops over elements."""

from collections.abc import Iterable, Sequence

from .boxes import Array, Expression
from .tree import Block, Branch, Let, Loop, Memory, Number, Reduce, Statement, Store, Update


class Group:
    """Statements on arrays of one shape, computed element by element, one statement after the other
    for each element (for each vector of them)."""

    def __init__(self, shape: tuple[int, ...], statements: Sequence[Statement]):
        self.shape, self.statements = shape, list(statements)
        self.targets = {s.target for s in self.statements if isinstance(s, Store)}

    def is_handed_on(self, node: Expression) -> bool:
        """Whether a load reads what the group writes at the same element: from a register."""
        return node in self.targets

    def memory_reads(self) -> Iterable[Expression]:
        """The loads that read memory."""
        for statement in self.statements:
            for node in reads(statement):
                if node.kind == "load" and not self.is_handed_on(node):
                    yield node


def arrays(statement: Statement) -> list[Array]:
    if isinstance(statement, Update):
        return [statement.distance, statement.array]
    return [statement.array] if isinstance(statement, Store | Reduce | Let) else []


def reads(statement: Statement) -> list[Expression]:
    """The loads and numbers that a statement without blocks reads, with those of which the places
    of rows are made."""
    nodes = [node for array in arrays(statement) for node in array.loads()]
    return nodes + [n for node in _distances(statement, nodes) for n in node.loads(set())]


def _distances(statement: Statement, nodes: Iterable[Expression]) -> list[Expression]:
    memories = [node.value for node in nodes if node.kind == "load"]
    if (memory := memory_of(statement)) is not None:
        memories.append(memory)
    return [m.distance for m in memories if m.distance is not None]


def memory_of(statement: Statement) -> Memory | None:
    if isinstance(statement, Store | Update):
        return statement.memory
    return statement.memory if isinstance(statement, Reduce) else None


def expressions(statement: Loop | Branch) -> list[Expression]:
    """What a loop or a branch itself reads: numbers of the carry, conditions."""
    if isinstance(statement, Branch):
        return [statement.index, *(e for _, of in statement.numbers for e in of)]
    of_carry = [e for _, first, after in statement.numbers for e in (first, after)]
    return [*of_carry, *([] if statement.condition is None else [statement.condition])]


def roots_read(statement: Statement) -> set[Memory]:
    """The memories that a statement reads, with all that is in it."""
    if isinstance(statement, Loop | Branch):
        blocks = (
            statement.blocks if isinstance(statement, Branch) else [statement.test, statement.body]
        )
        roots = {root for block in blocks for s in block.statements for root in roots_read(s)}
        nodes = [node for e in expressions(statement) for node in e.loads(set())]
    else:
        roots, nodes = set(), reads(statement)
    return roots | {node.value.root for node in nodes if node.kind == "load"}


def schedule(block: Block, carried: frozenset[Memory] = frozenset()) -> None:
    """Fill `items` of a block and of all within it. `carried`: memories of the loop around it that
    are written in each round."""
    # The last statement of the block that reads a memory: after it the bytes are free.
    last_read: dict[Memory, int] = {}
    for i, statement in enumerate(block.statements):
        last_read.update(dict.fromkeys(roots_read(statement), i))
    first, segment = 0, []
    # A memory from outside of the block may be read in the next round of a loop, but for those
    # that get a new value at its end.
    own = set(carried)

    def close(end: int) -> None:
        own.update(m for s in segment if (m := memory_of(s)) is not None and m.pointer is None)
        dying = {m for m in own if first <= last_read.get(m, -1) < end}
        block.items += groups(segment, dying)

    for i, statement in enumerate(block.statements):
        if not isinstance(statement, Loop | Branch):
            segment.append(statement)
            continue
        close(i)
        if isinstance(statement, Loop):
            schedule(statement.test)
            schedule(statement.body, frozenset(now for now, _ in statement.memories))
        else:
            for inner in statement.blocks:
                schedule(inner)
        block.items.append(statement)
        first, segment = i + 1, []
    close(len(block.statements))


def groups(segment: Sequence[Statement], dying: set[Memory]) -> list[Group]:
    """The groups of statements without loops and branches, in the order of their levels."""
    at = levels(segment, in_place(segment, dying))
    by_level: dict[tuple, list[Statement]] = {}
    for i, statement in enumerate(segment):
        shape = arrays(statement)[-1].shape
        # An update reads what it writes, in an order: nothing shares its loops.
        alone = i if isinstance(statement, Update) else -1
        by_level.setdefault((at[i], shape != (), alone, shape), []).append(statement)
    return [
        Group(shape, statements)
        for (*_, shape), statements in sorted(by_level.items(), key=lambda item: item[0][:3])
    ]


def levels(segment: Sequence[Statement], lower: dict[int, int]) -> list[int]:
    """For each statement the smallest level (at least that in `lower`) at which all that it reads
    has been made: at a lower level, or at the same element in the same loops."""
    makers: dict[Memory | Number, list[int]] = {}
    at: list[int] = []
    for i, statement in enumerate(segment):
        level = lower.get(i, 0)
        shape = arrays(statement)[-1].shape
        for node in reads(statement):
            # Rows of one memory are not distinguished: a part counts as the whole.
            key = node.value.root if node.kind == "load" else node.value
            makers_of = makers.get(key, [])
            # What one statement has written, at the same element, no other one has written.
            in_loops = [m for m in makers_of if _is_same(segment[m], statement, node, shape)]
            if in_loops and not any(isinstance(segment[m], Update) for m in makers_of):
                level = max([level, *(at[m] for m in in_loops)])
            else:
                level = max([level, *(at[m] + 1 for m in makers_of)])
        own = memory_of(statement)
        # It changes elements that have to be there.
        if isinstance(statement, Update):
            for m in makers.get(own.root, ()):  # pyright: ignore[reportOptionalMemberAccess]
                level = max(level, at[m] + 1)
        at.append(level)
        made = statement.number if isinstance(statement, Let) else None
        if isinstance(statement, Reduce) and isinstance(statement.result, Number):
            made = statement.result
        makers.setdefault(own.root if own is not None else made, []).append(i)  # pyright: ignore[reportArgumentType]
    return at


def _is_same(maker: Statement, reader: Statement, node: Expression, shape: tuple) -> bool:
    """Whether what is read has been made when the reader's element is computed, if the two are at
    the same level."""
    if isinstance(maker, Let):  # numbers come before the loops of a level
        return True
    if not isinstance(maker, Store) or isinstance(reader, Update):
        return False
    return maker.target is node and maker.array.shape == shape


def in_place(segment: Sequence[Statement], dying: set[Memory]) -> dict[int, int]:
    """Lower bounds of levels that let a statement write over an array that is read for the last
    time in the segment.

    Statement s reads element i of the array where it makes its own element i; others read it at
    other elements. If s comes in a later loop, it needs no memory of its own.
    """
    lower: dict[int, int] = {}
    at = levels(segment, lower)
    readers: dict[Memory, list[tuple[int, Expression]]] = {}
    for i, statement in enumerate(segment):
        for node in reads(statement):
            if node.kind == "load" and node.value.root in dying:
                readers.setdefault(node.value.root, []).append((i, node))
    for i, statement in enumerate(segment):
        if not isinstance(statement, Store) or not statement.array.shape:
            continue
        memory = statement.memory
        own = {
            node.value
            for node in reads(statement)
            if node.kind == "load" and is_own(statement, node) and node.value in dying
        }
        for old in sorted(own, key=lambda m: m.serial):
            if old.strides != memory.strides or old.dtype != memory.dtype:
                continue
            if any(k == i and not is_own(statement, node) for k, node in readers[old]):
                continue  # it reads other elements of the array itself
            # Those that read the array at other elements, or later: it must stay until they are
            # done.
            others = [
                k
                for k, node in readers[old]
                if k != i and not (at[k] < at[i] or (at[k] == at[i] and is_own(statement, node)))
            ]
            if not others:
                break
            # The statement moves behind them, with all that reads its result. If one of them
            # needs that result, nothing has been gained.
            trial = {**lower, i: 1 + max(at[k] for k in others)}
            new = levels(segment, trial)
            if all(new[k] < new[i] for k in others):
                lower, at = trial, new
                break
    return lower


def is_own(statement: Store, node: Expression) -> bool:
    """Whether a load reads the element that the statement writes, in another memory of the same
    layout."""
    return not node.args and (node.strides, node.offset) == (statement.strides, statement.offset)


def dead_memories(block: Block) -> set[Memory]:
    """The memories that are read only in the group that makes them, at the same element: nothing
    is written to them."""
    # A memory is needed if it is read in another group, or at another element, or by a loop.
    needed: set[Memory] = set()
    made: set[Memory] = set()
    for inner in block.blocks():
        for item in inner.items:
            if isinstance(item, Group):
                needed |= {node.value.root for node in item.memory_reads()}
                for statement in item.statements:
                    memory = memory_of(statement)
                    if memory is None:
                        continue
                    made.add(memory)
                    if memory.root.pointer is not None or not isinstance(statement, Store):
                        needed.add(memory.root)
                continue
            if isinstance(item, Loop):
                needed |= {memory for pair in item.memories for memory in pair}
            needed |= {
                node.value.root
                for e in expressions(item)
                for node in e.loads(set())
                if node.kind == "load"
            }
    return {memory for memory in made if memory.root not in needed}
