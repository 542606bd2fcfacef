"""A ball that bounces on a floor in uniform gravity."""

import jax.numpy as jnp
import numpy as np

from ..observe import Jump
from ._problem import Parameter, Problem, Start, library_problem


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = p1²/2 + g q0: mass 1, height q."""
    return jnp.sum(p1**2) / 2 + args["gravity"] * jnp.sum(q0)


def below_floor(t, q, p, args):
    """Positive below q = 0."""
    return -q[0]


def at_floor(t, q, p, args):
    return q, -args["restitution"] * p


def bouncing_ball(restitution: float = 1.0, gravity: float = 1.0, max_jumps: int = 100) -> Problem:
    """A ball above the floor q = 0 in uniform gravity; dimensionless, at rest at height 1 first.

    `integrate` makes the bounces, its `jumps`: each multiplies the speed by the coefficient of
    restitution e. With e < 1 they accumulate at a finite time, √(2/g) (1 + e)/(1 − e), where a run
    ends with the status `too_many_jumps`.

    **Arguments** `restitution`: e > 0. `gravity`: g > 0. `max_jumps`: bounces stored in a run.

    **Example**

    ```python
    sol = dvi.integrate(systems.bouncing_ball(0.8), num_steps=60, method="strang")
    print(int(sol.jumps.count), np.round(sol.jumps.ts[:3], 4))
    # 3 [1.4142 3.677  5.4871]
    ```
    """
    return library_problem(
        hamiltonian,
        Start("a ball above a floor", (1,)),
        {
            "gravity": Parameter(gravity, "acceleration of gravity [height/time²]"),
            "restitution": Parameter(restitution, "coefficient of restitution [1]"),
        },
        q0_p0_h=(np.array([1.0]), np.array([0.0]), 0.1),
        name="bouncing_ball",
        source="elementary",
        jumps=(Jump(below_floor, at_floor, max_jumps=max_jumps),),
    )
