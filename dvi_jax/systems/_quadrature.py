"""Integrals along known functions, which have no closed form of their own."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def integral_from_zero(rate: Callable[[Any], Any], t: Any, panels: int = 64) -> Any:
    """∫_0^t rate(s) ds by Gauss' 12 nodes in each of `panels`.

    - `rate`: function of times, shape (nodes,) → the same shape. `t`: a time, a number.

    Round-off for an analytic rate with fewer than about `panels` periods between 0 and t.
    """
    fractions = (np.arange(panels)[:, None] + (1 + _NODES[None]) / 2).ravel() / panels
    weights = np.tile(_WEIGHTS / (2 * panels), panels)
    return t * jnp.dot(rate(t * jnp.asarray(fractions)), jnp.asarray(weights))
