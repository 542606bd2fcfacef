"""What a variable of a jaxpr holds in component form: one entry for each array element."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._compat import is_traced


class Structural:
    """An entry that is 0 or 1 by the structure of the problem, whatever the numbers are."""

    def __init__(self, number: int):
        self.number = number

    def __repr__(self):
        return f"Structural({self.number})"


ZERO, ONE = Structural(0), Structural(1)

Entry = Any
"""`ZERO`, `ONE`, a NumPy scalar that is known while tracing, or a JAX array: of shape () if it is
the same on all lanes, of shape (lanes,) if not. Entries of a `Value` with `lead` have those axes
in front."""


class Value:
    """An array of shape `shape` on every lane: its entries, or one array with the lane axis last.

    Whichever form is missing is made when it is asked for. `lead` are leading axes of `shape` that
    the entries keep as axes of their own: the steps of a loop. Such a value, and what is made of
    it in about its size, `is_bulk`: it is not to be taken apart.
    """

    def __init__(
        self,
        shape: Sequence[int],
        dtype: Any,
        *,
        entries: np.ndarray | None = None,
        array: Any = None,
        has_lanes: bool = False,
        lead: Sequence[int] = (),
        is_bulk: bool = False,
    ):
        self.shape = tuple(shape)
        self.dtype = dtype if is_opaque(dtype) else np.dtype(dtype)
        self.lead = tuple(lead)
        self.is_bulk = is_bulk or bool(self.lead)
        self.is_tangent = False
        self._entries, self._array, self._has_lanes = entries, array, has_lanes

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def is_split(self) -> bool:
        return self._entries is not None and not self.lead

    @property
    def is_known(self) -> bool:
        """Whether it is given by numbers that are known while tracing."""
        return self._array is not None and self.known() is not None

    def known(self) -> np.ndarray | None:
        """The numbers, if all of them are known while tracing."""
        if is_opaque(self.dtype):
            return None
        if self._array is not None:
            is_known = isinstance(self._array, np.ndarray | np.generic) or (
                not self._has_lanes and not is_traced(self._array) and self.size <= 4096
            )
            return np.asarray(self._array) if is_known else None
        if self.lead:
            return None
        entries = self.entries()
        if any(is_array(e) for e in entries.flat):
            return None
        numbers = np.empty(self.shape, self.dtype)
        for i in np.ndindex(self.shape):
            numbers[i] = number(entries[i], self.dtype)
        return numbers

    def entries(self, depth: int = 0) -> np.ndarray:
        """The entries as an object array of shape `shape`; less of its first `depth` axes, which
        each entry then has in front."""
        if depth:
            return self._entries_behind(depth)
        if self.is_split:
            assert self._entries is not None
            return self._entries
        known = None if self.lead else self.known()
        source = self.array()[0] if known is None else known
        entries = objects([source[i] for i in np.ndindex(self.shape)], self.shape)
        if not self.is_bulk:
            self._entries = entries
        return entries

    def _entries_behind(self, depth: int) -> np.ndarray:
        if depth == len(self.lead):
            assert self._entries is not None
            return self._entries
        source, rest, front = self.array()[0], self.shape[depth:], (slice(None),) * depth
        return objects([source[front + i] for i in np.ndindex(rest)], rest)

    def lead_entries(self) -> np.ndarray | None:
        """The entries with the axes `lead` in front of each, or None if it is in another form."""
        return self._entries if self.lead else None

    def with_arrays(self, function: Callable[[jax.Array], Any]) -> "Value":
        """The value with `function` of its JAX arrays in their places."""

        def of(x):
            return function(x) if is_array(x) else x

        value = Value(self.shape, self.dtype, lead=self.lead, is_bulk=self.is_bulk)
        value.is_tangent, value._has_lanes = self.is_tangent, self._has_lanes
        if self._entries is None:
            value._array = of(self._array)
        else:
            entries = [of(e) for e in self._entries.flat]
            value._entries = objects(entries, self._entries.shape)
        return value

    def array(self) -> tuple[Any, bool]:
        """(array, whether its last axis is that of the lanes)."""
        if self._array is None:
            return self._joined()  # not kept: it may belong to the body of a loop
        return self._array, self._has_lanes

    def _joined(self) -> tuple[Any, bool]:
        known = self.known()
        if known is not None:
            return known, False
        assert self._entries is not None
        depth = len(self.lead)
        parts = [as_array(e, self.dtype) for e in self._entries.flat]
        ndim = max((x.ndim for x in parts), default=depth)
        has_lanes = ndim > depth
        if has_lanes:
            (lanes,) = {x.shape[-1] for x in parts if x.ndim == ndim}
            parts = [on_lanes(x, lanes, depth) for x in parts]
        if not parts:
            return jnp.zeros(self.shape, self.dtype), False
        joined = jnp.stack(parts, axis=depth) if self._entries.ndim else parts[0]
        lanes_shape = joined.shape[-1:] if has_lanes else ()
        return joined.reshape(self.shape + lanes_shape), has_lanes


def is_opaque(dtype: Any) -> bool:
    """Whether it is a type that NumPy does not have, and no number: keys of random numbers."""
    return jnp.issubdtype(dtype, jax.dtypes.extended)


def is_array(entry: Entry) -> bool:
    return isinstance(entry, jax.Array)


def number(entry: Entry, dtype: Any) -> Any:
    """A known entry as a NumPy scalar."""
    value = entry.number if isinstance(entry, Structural) else entry
    return np.asarray(value, dtype)[()]


def as_array(entry: Entry, dtype: Any) -> jax.Array:
    return entry if is_array(entry) else jnp.asarray(number(entry, dtype))


def on_lanes(x: jax.Array, lanes: int, lead: int = 0) -> jax.Array:
    """x with a lane axis last, if it has none yet."""
    if x.ndim > lead:
        return x
    if x.ndim == 0:
        return jnp.broadcast_to(x, (lanes,))
    return jnp.broadcast_to(x[..., None], (*x.shape, lanes))


def whole(x: Any, has_lanes: bool, is_bulk: bool = False) -> Value:
    """The value of an array whose last axis is that of the lanes, or of one that has none."""
    shape = x.shape[:-1] if has_lanes else x.shape
    return Value(shape, x.dtype, array=x, has_lanes=has_lanes, is_bulk=is_bulk)


def objects(entries: Sequence[Entry], shape: Sequence[int]) -> np.ndarray:
    """An object array of these entries, in row-major order."""
    flat = np.empty(len(entries), object)
    for i, entry in enumerate(entries):
        flat[i] = entry
    return flat.reshape(tuple(shape))


def split(entries: Any, shape: Sequence[int], dtype: Any) -> Value:
    """The value with these entries: an object array, or a sequence in row-major order."""
    if not isinstance(entries, np.ndarray):
        entries = objects(entries, shape)
    return Value(shape, dtype, entries=entries)
