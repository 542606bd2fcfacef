"""The arguments of `integrate` as arrays of one precision."""

from typing import Any, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from .checks import all_finite, array, finite, known
from .precision import refuse_double_without_x64


def start_state(q0: Any, p0: Any) -> tuple[Array, Array]:
    """Initial conditions, of one shape and precision. **Raises** `ValueError` or `TypeError`."""
    q, p = _real_array("q0", q0), _real_array("p0", p0)
    if q.shape != p.shape:
        raise ValueError(f"q0 and p0 must have the same shape, got {q.shape} and {p.shape}.")
    if q.size == 0:
        raise ValueError(f"q0 must not be empty, got shape {q.shape}.")
    if q.dtype != p.dtype:
        dtype = jnp.result_type(q.dtype, p.dtype)
        q, p = q.astype(dtype), p.astype(dtype)
    # Half precision has at most three digits: neither a solve nor an invariant can be checked.
    if q.dtype.itemsize < 4:
        raise TypeError(f"q0 and p0 must be float32 or float64, got {q.dtype}.")
    return q, p


def as_times(call: str, ts: Any) -> Array:
    """Times as a one-dimensional array of real numbers; `call`: its name in messages."""
    ts = _join(ts)
    if not is_traced(ts):
        ts = _as_numpy("ts", ts)
        refuse_double_without_x64("ts", ts.dtype)
    if jnp.issubdtype(ts.dtype, jnp.integer):
        ts = ts.astype(jnp.result_type(float))
    _require_real(f"ts in {call}", ts)
    return jnp.asarray(array(f"ts in {call}", ts, ("times",)))


def _join(value: Any) -> Any:
    """A list with traced numbers as one array, which NumPy cannot make."""
    is_list = isinstance(value, list | tuple)
    return jnp.asarray(value) if is_list and any(map(is_traced, jax.tree.leaves(value))) else value


def real_numbers(name: str, value: Any) -> Array:
    """Real numbers as an array of floats. **Raises** `TypeError` for anything else."""
    # Text first becomes an array of text in NumPy, of which JAX does not say the name.
    value = _join(value)
    value = value if is_traced(value) else _as_numpy(name, value)
    _require_real(name, value)
    return jnp.asarray(value, float)


def _require_real(name: str, value: Any) -> None:
    if not _is_real(value.dtype):
        text = f": {value!s:.80}" if isinstance(value, np.ndarray) else ""
        raise TypeError(f"{name} must be an array of real numbers, got dtype {value.dtype}{text}.")


def _real_array(name: str, value: Any) -> Array:
    value = original = _join(value)
    if not (isinstance(value, jax.Array) and is_traced(value)):
        # In NumPy: under jit, jax.numpy would give tracers even for values that are known.
        value = _as_numpy(name, value)
        refuse_double_without_x64(name, value.dtype)
    kind = value.dtype
    if kind.kind == "c":
        raise TypeError(
            f"{name} must be real, got {kind}: for ψ = (q0 + i p0)/√2 give √2 Re ψ and √2 Im ψ."
        )
    _require_real(name, value)
    # A traced value that is not finite becomes the status of its trajectory.
    if isinstance(value, np.ndarray):
        all_finite(name, value)
    # A copy would take some ten microseconds, and the transfer of a long array longer.
    array = original if _is_strong(original, kind) else jnp.asarray(value)
    return array.astype(jnp.result_type(float)) if kind.kind in "iu" else array


def _is_strong(value: Any, dtype: Any) -> TypeGuard[Array]:
    """Whether a value is an array of JAX of this type, which needs no copy."""
    return isinstance(value, jax.Array) and value.dtype == dtype and not value.weak_type


def _is_real(dtype: Any) -> bool:
    return dtype.kind in "fiu" or jnp.issubdtype(dtype, jnp.floating)  # bfloat16 has the kind "V"


def as_scalar(name: str, value: Any, dtype: Any, zero_allowed: bool = True) -> Array:
    """A number of this precision. **Raises** `ValueError` or `TypeError` with its name."""
    value = _join(value)
    number = None if is_traced(value) else _as_numpy(name, value)
    # Not for a Python float, which has no precision of its own and takes that of the state.
    if isinstance(value, np.ndarray | np.generic) and value.dtype == np.float64:
        refuse_double_without_x64(name, value.dtype)
    kind, shape = (value.dtype, value.shape) if number is None else (number.dtype, number.shape)
    if not _is_real(kind):
        raise TypeError(
            f"{name} must be an integer or a floating-point number, got {value!r:.200} of type "
            f"{type(value).__name__}."
        )
    if shape != ():
        raise ValueError(
            f"{name} must be one number, got an array of shape {shape}. For several values use "
            f"jax.vmap over {name}"
            + (", for steps of several sizes lattice=dvi.Given(ts)." if name == "h" else ".")
        )
    # In one expression of NumPy: every run has three such numbers, and most are right.
    if number is not None and not (np.isfinite(number) and (zero_allowed or number != 0)):
        finite(name, number.item())
        raise ValueError(f"{name} must not be zero; a negative h runs backwards in time.")
    # Cast in NumPy: each operation of JAX on a known number would cost some ten microseconds.
    if number is None:
        return jnp.asarray(value, dtype)
    return value if _is_strong(value, dtype) else jnp.asarray(number.astype(dtype))


def _as_numpy(name: str, value: Any) -> np.ndarray:
    refuse_unit_or_mask(name, value)
    return known(name, value)


def as_parameter(leaf: Any) -> Any:
    """A leaf of args as an argument of a compiled program."""
    if isinstance(leaf, np.ndarray | np.generic):
        refuse_unit_or_mask("args", leaf)
        leaf = np.asarray(leaf)
        refuse_double_without_x64("args", leaf.dtype)
        if leaf.dtype.kind in "OMm":
            raise TypeError(f"args must be arrays of numbers, got dtype {leaf.dtype}: {leaf!s:.80}")
        return jnp.asarray(leaf)
    if not isinstance(leaf, jax.Array):
        # Everything but arrays is static: compiled programs are looked up by its hash.
        try:
            hash(leaf)
        except TypeError:
            raise TypeError(
                "args must contain arrays, numbers or hashable objects in dicts, lists and tuples, "
                f"got {leaf!r:.80} of type {type(leaf).__name__}."
            ) from None
    # A float becomes an array: a new value needs no new compilation, and has a derivative.
    return jnp.asarray(leaf) if isinstance(leaf, float) else leaf


def refuse_unit_or_mask(name: str, value: Any) -> None:
    """**Raises** `TypeError` for a quantity of astropy or pint, `ValueError` for masked numbers."""
    # Both are accepted by np.asarray, which drops the unit or the mask without a warning.
    if np.ma.is_masked(value):
        where = np.argwhere(np.ma.getmaskarray(value))[0].tolist()
        raise ValueError(
            f"{name} must not have masked numbers, got one{f' at index {where}' if where else ''}."
        )
    unit = None
    if hasattr(value, "to_value"):
        unit = getattr(value, "unit", None)
    elif hasattr(value, "magnitude"):
        unit = getattr(value, "units", None)
    if unit is not None:
        raise TypeError(
            f"{name} has the unit {str(unit) or '1'!r}, but must be without one: use "
            "x.to_value(unit), x.m_as(unit), or dvi_jax.interop.integrate(..., units=...)."
        )
