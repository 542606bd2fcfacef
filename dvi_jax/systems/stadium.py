"""Bunimovich's stadium: a billiard between two straight lines and two half circles."""

import jax.numpy as jnp
import numpy as np

from ..observe import Jump
from ._billiard import billiard, reflection
from ._problem import Parameter, Problem, positive


def _from_middle(q, args):
    """The vector from the nearest point of the line between the centres of the half circles."""
    half = args["half_length"]
    return q - jnp.stack([jnp.clip(q[0], -half, half), jnp.zeros_like(q[1])])


def beyond_wall(t, q, p, args):
    """Positive outside of the stadium."""
    return jnp.sum(_from_middle(q, args) ** 2) - 1


def at_wall(t, q, p, args):
    return q, reflection(p, _from_middle(q, args))


def stadium(half_length: float = 1.0, max_jumps: int = 1000) -> Problem:
    """The stadium: unit speed and mass between half circles of radius 1 and two straight lines.

    The lines have the length 2 a, `half_length` is a. `integrate` makes the reflections, its
    `jumps`. Almost all orbits are chaotic, although no wall is dispersing. Initial conditions and
    step are ours.

    **Arguments** `half_length`: a > 0 [radius]. `max_jumps`: reflections stored in a run.

    **Source** Bunimovich 1979, *Commun. Math. Phys.* 65, 295; Benettin & Strelcyn 1978,
    *Phys. Rev. A* 17, 773.

    **Example**

    ```python
    sol = dvi.integrate(systems.stadium(), num_steps=20)
    print(int(sol.jumps.count), np.round(sol.jumps.ts[:3], 4))
    # 4 [1.366  3.0981 6.7617]
    ```
    """
    return billiard(
        (Jump(beyond_wall, at_wall, max_jumps=max_jumps),),
        {"half_length": Parameter(half_length, "half of the straight lines [radius]", positive)},
        (np.array([0.3, 0.1]), np.array([0.8, 0.6]), 0.5),
        name="stadium",
        source="Bunimovich 1979, Commun. Math. Phys. 65, 295",
    )
