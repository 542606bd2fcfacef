"""A trajectory in one file, without a function of the user's."""

import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.files import publish_npz, read_npz
from ..base.precision import refuse_double_without_x64
from ..base.results import RESULTS, status_code
from ..base.tables import Table
from ._jump import Jumps
from ._stop import Stopped

_FORMAT = 1
_STATES = ("ts", "qs", "ps", "hs")


def write(solution: Any, path: str | os.PathLike[str]) -> None:
    """`Solution.save`, which see."""
    if solution.result.is_traced():
        raise TypeError("a solution with JAX tracers cannot be saved: call save outside of jit.")
    # Text and arrays alone, no pickle: loading one would run code from the file.
    arrays = {name: np.asarray(getattr(solution, name)) for name in _STATES}
    arrays["status"] = np.asarray(status_code(solution.result))
    header = {
        "stats": _pack("stats", solution.stats, arrays),
        "observed": _pack("observed", solution.observed, arrays),
        "stop": _pack("stop", solution.stop and tuple(solution.stop), arrays),
        "jumps": _pack("jumps", solution.jumps and vars(solution.jumps), arrays),
    }
    publish_npz(path, _FORMAT, header, arrays)


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The fields of the `Solution` in a file of `write`."""
    header, arrays = read_npz(path, _FORMAT, "solution")
    gaps = [name for name in (*_STATES, "status") if name not in arrays]
    if gaps := [*gaps, *(name for name in ("stats", "observed", "stop") if name not in header)]:
        raise ValueError(f"'{path}' is not the file of a solution: {gaps[0]!r} is missing in it.")
    refuse_double_without_x64("a saved Solution", arrays["ts"].dtype)
    fields: dict[str, Any] = {name: jnp.asarray(arrays[name]) for name in _STATES}
    # A status is made from its index: an Enumeration has one leaf.
    (index,) = jax.tree.leaves(RESULTS.successful)
    code = jnp.asarray(arrays["status"], index.dtype)
    fields["result"] = eqx.tree_at(lambda r: jax.tree.leaves(r)[0], RESULTS.successful, code)
    fields |= {name: _unpack(header[name], arrays) for name in ("stats", "observed", "stop")}
    fields["stop"] = fields["stop"] and Stopped(*fields["stop"])
    jumps = _unpack(header.get("jumps"), arrays)  # older files have none
    fields["jumps"] = jumps and Jumps(**jumps)
    return fields


def _pack(name: str, tree: Any, arrays: dict[str, np.ndarray]) -> Any:
    """A pytree in terms of JSON, in which names stand for the arrays."""
    if tree is None or type(tree) in (bool, int, float):
        return tree
    if type(tree) in (dict, Table) and all(isinstance(key, str) for key in tree):
        return {"dict": {key: _pack(f"{name}.{key}", x, arrays) for key, x in tree.items()}}
    if type(tree) in (list, tuple):
        parts = [_pack(f"{name}.{i}", x, arrays) for i, x in enumerate(tree)]
        return {type(tree).__name__: parts}
    if not eqx.is_array_like(tree):
        raise TypeError(
            f"{name} must be made of arrays in dicts with text as keys, lists and tuples to be "
            f"saved, got {type(tree).__name__}. Give observe as such a pytree."
        )
    arrays[name] = np.asarray(tree)
    return name


def _unpack(tree: Any, arrays: dict[str, np.ndarray]) -> Any:
    match tree:
        case None | bool() | int() | float():
            return tree
        case str():
            return jnp.asarray(arrays[tree])
        case {"dict": entries}:
            return {key: _unpack(x, arrays) for key, x in entries.items()}
        case {"list": parts}:
            return [_unpack(x, arrays) for x in parts]
        case _:
            return tuple(_unpack(x, arrays) for x in tree["tuple"])
