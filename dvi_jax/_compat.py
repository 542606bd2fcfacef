"""The few names of JAX that have moved between releases, or are not public: all of them, here."""

import jax
from jax.core import Tracer
from jax.extend.core import Jaxpr, Literal, jaxprs_in_params

__all__ = ["Jaxpr", "Literal", "is_traced", "jaxprs_in_params", "x64_enabled"]


def is_traced(x: object) -> bool:
    """Whether `x` stands for a value that is not known yet (inside jit, vmap, grad, …)."""
    return isinstance(x, Tracer)


def x64_enabled() -> bool:
    """Whether arrays made now are in double precision (the flag, or a context that sets it)."""
    return bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]
