"""The elements of a ring in pieces, of which a derivative is compiled."""

import functools
from typing import Any, NamedTuple

import numpy as np

from ._maps import KICKS, RingPart, distinct
from ._ring import RingStructure

SLICED_PARTS = "straight", "bend", "exact_straight", "exact_bend", "at_exact_bend"
_KICKS = 12
"""Most kicks in a piece of a magnet, so that its phase advance is less than 2π."""


def _kick_shares(part: RingPart) -> list[np.ndarray]:
    """The pieces of a part, as kicks over its length: their sums are shares of its length."""
    if part.name in SLICED_PARTS:
        kicks, n = KICKS[part.scheme], part.slices
        limit = max(1, _KICKS // len(kicks))
        return [np.array([0.0, *kicks * min(limit, n - i)]) / n for i in range(0, n, limit)]
    count = {"solenoid": 8, "second_order_bend": part.slices}.get(part.name, 1)
    return [np.array([1 / count])] * count


class Pieces(NamedTuple):
    """The pieces of the elements of a ring, in the order of passage: their `kinds`; and for each
    piece the `number` of its kind, its `steps`, and its `row` in `ring.program.rows`."""

    kinds: tuple[RingPart, ...]
    number: np.ndarray
    steps: np.ndarray
    row: np.ndarray


@functools.lru_cache(maxsize=16)
def pieces_in(program: RingStructure) -> Pieces:
    """Less code is compiled for these than for tracking: magnets in slices of any number and scheme
    are one sequence of kicks, with drifts between them."""
    parts, thick = program.parts, {"scheme": 2, "slices": 1}
    order = max(p.order for p in parts)
    changes = {**dict.fromkeys(SLICED_PARTS, thick), "second_order_bend": {"slices": 1}}
    kinds = [p._replace(order=order, **changes.get(p.name, {})) for p in parts]
    all_kinds = distinct(kinds)
    number = np.asarray([all_kinds.index(kind) for kind in kinds], np.int32)
    shares = [_kick_shares(p) for p in parts]
    counts, width = np.asarray([len(x) for x in shares]), max(len(k) for p in shares for k in p)
    table = np.stack([np.pad(k, (0, width + 1 - len(k))) for p in shares for k in p])
    part = np.asarray(program.rows, np.int32)[:, 0]
    row = np.repeat(np.arange(len(part)), counts[part])
    # The first piece of each part in the table, and then those after it.
    place = np.arange(len(row)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
    steps = table[(np.cumsum(counts) - counts)[part[row]] + place]
    return Pieces(tuple(all_kinds), number[part][row], steps, row)


def padded(rows: Any, kinds: int, count: int) -> Any:
    """`rows` of a table, with more that do nothing: rings of nearly equal numbers of pieces share
    compiled code."""
    step = 2 ** max((count - 1).bit_length() - 3, 4)
    extra = -count % step

    def longer(column, value=0):
        return np.pad(column, ((0, extra), *[(0, 0)] * (column.ndim - 1)), constant_values=value)

    par, number, steps = rows
    return (
        {name: longer(column) for name, column in par.items()},
        longer(number, kinds),
        longer(steps),
    )
