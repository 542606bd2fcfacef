"""Taylor coefficients of a function of one number."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array


def taylor_coefficients(function: Callable[[Array], Array], at: Array, order: int) -> Array:
    """f(a), f'(a), f''(a)/2, …, stacked in front: shape (order + 1, *f(a).shape).

    By nested forward mode, so it goes through whatever has a forward derivative (a Newton solve
    by its implicit one); the cost doubles with each order.
    """
    derivatives = [function]
    for _ in range(order):
        last = derivatives[-1]
        derivatives.append(lambda x, g=last: jax.jvp(g, (x,), (jnp.ones_like(x),))[1])
    return jnp.stack([g(at) / math.factorial(m) for m, g in enumerate(derivatives)])
