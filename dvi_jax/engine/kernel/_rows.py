"""What a kernel reads and writes by rows, and what is done with it afterwards."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..lanes import Value
from ..lanes._evaluate import SPLIT_UP_TO
from ..lanes._value import as_array, on_lanes, split
from ._limits import KEPT_AS, NotInKernelError


def restored(x: Any, dtype: np.dtype) -> Any:
    return x != 0 if dtype == np.bool_ else x


def kept(x: jax.Array, block: int) -> jax.Array:
    """x as it is written: on all lanes, and no truth value."""
    return on_lanes(x, block).astype(KEPT_AS[np.dtype(x.dtype).name])


Row = Callable[[Any], Value]
"""The part of a value of that number along its first axis: a known one, or one of a loop."""


class Stored(Value):
    """A large value in memory, read row by row."""

    def __init__(self, shape: Sequence[int], dtype: Any, row: Row, has_lanes: bool):
        super().__init__(shape, dtype, lead=shape[:1], is_bulk=True, has_lanes=has_lanes)
        self.row, self.has_lanes = row, has_lanes

    def known(self):
        return None

    def entries(self, depth=0):
        raise NotInKernelError("a large input is used other than row by row.")

    def array(self):
        raise NotInKernelError("a large input is used other than row by row.")


def rows_of(value: Value) -> Row:
    if isinstance(value, Stored):
        return value.row
    if isinstance(value, Later) or value.size > SPLIT_UP_TO:
        raise NotInKernelError("a loop takes in rows that another saves, or a large table.")
    shape = value.shape[1:]
    columns = value.entries().reshape(value.shape[0], -1).T

    def row(i):
        if isinstance(i, int):
            return split([column[i] for column in columns], shape, value.dtype)
        cases = [[as_array(e, value.dtype) for e in column] for column in columns]
        return split([_chosen(i, c) for c in cases], shape, value.dtype)

    return row


def _chosen(i: jax.Array, cases: Sequence[Any]) -> Any:
    """The case of that number."""
    chosen = cases[-1]
    for k, case in reversed(list(enumerate(cases[:-1]))):
        chosen = jnp.where(i == k, case, chosen)
    return chosen


def joined(values: Sequence[Value]) -> Row:
    """The rows of the one after those of the other."""
    rows, lengths = [rows_of(v) for v in values], [v.shape[0] for v in values]
    starts = np.cumsum([0, *lengths[:-1]]).tolist()

    def row(i):
        if isinstance(i, int):
            k = int(np.searchsorted(starts, i, side="right")) - 1
            return rows[k](i - starts[k])
        found = [
            r(jnp.clip(i - a, 0, n - 1)) for r, a, n in zip(rows, starts, lengths, strict=True)
        ]
        out = list(found[0].entries().flat)
        for start, mine in zip(starts[1:], found[1:], strict=True):
            pairs = zip(out, mine.entries().flat, strict=True)
            out = [
                jnp.where(i < start, as_array(a, mine.dtype), as_array(b, mine.dtype))
                for a, b in pairs
            ]
        return split(out, found[0].shape, found[0].dtype)

    return row


class Later(Value):
    """A value that there is after the kernel only: rows that a loop saves, or made of them.

    `rows` are where those of its entries are written, `lead` the lengths of the loops, and `cut`
    what of them it is made of.
    """

    def __init__(
        self,
        shape: Sequence[int],
        dtype: Any,
        rows: Sequence[int] = (),
        lead: Sequence[int] = (),
        cut: Sequence[slice] = (),
    ):
        super().__init__(shape, dtype, lead=lead, is_bulk=True)
        self.rows, self.cut = tuple(rows), tuple(cut)

    def known(self):
        return None

    def entries(self, depth=0):
        raise NotInKernelError("what a loop saves is used before the end.")

    def array(self):
        raise NotInKernelError("what a loop saves is used before the end.")

    def stacked(self, length: int) -> "Later":
        """The rows of all rounds of a loop around the one that saves them."""
        lead, cut = (length, *self.lead), (slice(None), *self.cut)
        return Later((length, *self.shape), self.dtype, self.rows, lead, cut)

    def sliced(self, start: int, stop: int) -> "Later":
        """Some of the rows of the last loop."""
        first, *rest = self.cut
        before = first.start or 0
        cut = slice(before + start, before + stop), *rest
        return Later((stop - start, *self.shape[1:]), self.dtype, self.rows, self.lead, cut)


Afterwards = tuple[Callable, list[Value], list[Later]]
"""(of an evaluator and the inputs) -> outputs; its inputs; its outputs."""


class Rows:
    """Where rows are written: one array (length, lanes) for each entry. In a dry run there is none,
    and what it would take is noted."""

    def __init__(self, refs: Sequence[Any] | None = None):
        self.refs, self.kinds = refs, []

    def reserve(self, length: int, count: int, dtype: np.dtype) -> list[int]:
        first = len(self.kinds)
        self.kinds += [(length, dtype)] * count
        return list(range(first, len(self.kinds)))

    def write(self, place: int, i: jax.Array, x: jax.Array) -> None:
        if self.refs is not None:
            self.refs[place][i, :] = x


class Round(NamedTuple):
    """A round of a loop that is being evaluated: its number, of how many."""

    number: Any
    length: int
