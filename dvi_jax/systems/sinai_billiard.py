"""Sinai's billiard: a square with a disc."""

import jax.numpy as jnp
import numpy as np

from ..base.checks import fraction
from ..observe import Jump
from ._billiard import billiard, reflection
from ._problem import Parameter, Problem


def beyond_disc(t, q, p, args):
    """Positive inside of the disc."""
    return args["radius"] ** 2 - jnp.sum(q**2)


def at_disc(t, q, p, args):
    return q, reflection(p, q / args["radius"])


def beyond_x(t, q, p, args):
    """Positive beyond the walls at x = ±1."""
    return jnp.abs(q[0]) - 1


def at_x(t, q, p, args):
    return q, p * jnp.array([-1.0, 1.0], p.dtype)


def beyond_y(t, q, p, args):
    """Positive beyond the walls at y = ±1."""
    return jnp.abs(q[1]) - 1


def at_y(t, q, p, args):
    return q, p * jnp.array([1.0, -1.0], p.dtype)


def sinai_billiard(radius: float = 0.5, max_jumps: int = 1000) -> Problem:
    """Sinai's billiard: unit speed and mass in |x|, |y| ≤ 1 outside of a disc at the origin.

    `integrate` makes the reflections, its `jumps`: index 0 at the disc, 1 and 2 at the walls in x
    and y. The motion is hyperbolic, and its Lyapunov exponent that of Sinai's curvatures, the mean
    of ln(1 + κτ) over flights of length τ. Initial conditions and step are ours.

    **Arguments** `radius`: of the disc, between 0 and 1. `max_jumps`: of them stored in a run.

    **Source** Sinai 1970, *Russ. Math. Surv.* 25, 137; Chernov & Markarian 2006, *Chaotic
    Billiards*, 3–4.

    **Example**

    ```python
    sol = dvi.integrate(systems.sinai_billiard(), num_steps=20)
    print(int(sol.jumps.count), np.round(sol.jumps.ts[:3], 4), sol.jumps.index[:3])
    # 15 [0.3333 1.125  1.7735] [1 2 0]
    ```
    """
    walls = ((beyond_disc, at_disc), (beyond_x, at_x), (beyond_y, at_y))
    shares = (max_jumps, 0, 0)
    return billiard(
        tuple(Jump(g, image, max_jumps=n) for (g, image), n in zip(walls, shares, strict=True)),
        {"radius": Parameter(radius, "of the disc [side/2]", fraction)},
        (np.array([0.8, 0.1]), np.array([0.6, 0.8]), 0.5),
        name="sinai_billiard",
        source="Sinai 1970, Russ. Math. Surv. 25, 137",
    )
