"""Checks for double precision, which only the user can enable in JAX."""

from typing import Any

import numpy as np

from lanewise.jaxprs.jaxapi import x64_enabled


def refuse_double_without_x64(name: str, dtype: Any) -> None:
    """**Raises** `TypeError` for a float64 input in a process that computes in float32, and for one
    of more than double precision."""
    # JAX would round both without a warning, and invariants with them.
    if np.issubdtype(dtype, np.inexact) and np.finfo(dtype).eps < np.finfo(np.float64).eps:
        double = "complex128" if np.dtype(dtype).kind == "c" else "float64"
        raise TypeError(
            f"{name} has the type {np.dtype(dtype)}, but JAX has at most double precision. Round "
            f"the numbers to {double}, for example with np.asarray(x, np.{double})."
        )
    if np.dtype(dtype) in (np.dtype(np.float64), np.dtype(np.complex128)) and not x64_enabled():
        single = "complex64" if np.dtype(dtype).kind == "c" else "float32"
        python = "complex numbers" if single == "complex64" else "floats"
        raise TypeError(
            f"{name} has the type {np.dtype(dtype)} (Python {python} have this type), but this "
            "process computes in float32. Invariants need double precision: put the line\n    "
            'jax.config.update("jax_enable_x64", True)\nbefore the first array is made. Functions '
            f"that also work in single precision accept {single} arrays without this line."
        )


def require_double(what: str) -> None:
    """**Raises** `ValueError` in a process that computes in float32: `what` needs more."""
    if not x64_enabled():
        raise ValueError(
            f"{what} needs double precision, but this process computes in float32: put the line\n"
            '    jax.config.update("jax_enable_x64", True)\nbefore the first array is made.'
        )
