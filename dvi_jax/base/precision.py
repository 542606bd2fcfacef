"""Checks for double precision, which only the user can enable in JAX."""

from typing import Any

import numpy as np

from lanewise.jaxprs.jaxapi import x64_enabled

_ENABLE = (
    'Put the line\n    jax.config.update("jax_enable_x64", True)\nbefore the first array is made.'
)


def refuse_double_without_x64(name: str, dtype: Any) -> None:
    """**Raises** `TypeError` for a float64 input in a process that computes in float32, and for one
    of more than double precision."""
    # JAX would round both without a warning, and invariants with them.
    if np.issubdtype(dtype, np.inexact) and np.finfo(dtype).eps < np.finfo(np.float64).eps:
        double = "complex128" if np.dtype(dtype).kind == "c" else "float64"
        raise TypeError(
            f"{name} has the type {np.dtype(dtype)}, but JAX has at most double precision: use "
            f"np.asarray(x, np.{double})."
        )
    if np.dtype(dtype) in (np.dtype(np.float64), np.dtype(np.complex128)) and not x64_enabled():
        single = "complex64" if np.dtype(dtype).kind == "c" else "float32"
        raise TypeError(
            f"{name} has the type {np.dtype(dtype)}, but this process computes in float32. "
            f"{_ENABLE} Or give {single} arrays, where these suffice."
        )


def require_double(subject: str) -> None:
    """**Raises** `ValueError` in a process that computes in float32: `subject` needs more."""
    if not x64_enabled():
        raise ValueError(
            f"{subject} needs double precision, but this process computes in float32. {_ENABLE}"
        )
