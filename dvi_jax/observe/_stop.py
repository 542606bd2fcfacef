"""Conditions that end a trajectory before its last step."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array

from ..base.signature import with_time


class Stop(eqx.Module):
    r"""Ends a trajectory where g(t, q, p, args) reaches zero from below: a collision, an escape.

    ``dvi.Stop(lambda q, p: 0.1 - jnp.linalg.norm(q))``, for example, ends at |q| = 0.1.
    The run ends with the first step at whose end g ≥ 0, or before it where g ≥ 0 at the start. The
    point where g = 0 inside of that step is computed as for `Section`, and returned in
    ``solution.stop``. The status is `stopped`, which is not a failure. States after it are NaN,
    reductions cover the steps before. A g that becomes positive and negative again within one step
    is not detected. To continue from where a run stopped, use a g that is negative there.

    **Arguments** `g`: function ``(q, p)`` or ``(t, q, p, args)`` → scalar.

    **Raises** `TypeError` for another g, and in `integrate` `ValueError` if it is not scalar.

    **Example**

    ```python
    kepler = systems.kepler()
    near = dvi.Stop(lambda q, p: 1.0 - jnp.linalg.norm(q))
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.05,
                        num_steps=400, stop=near, method=dvi.Yoshida(4))
    print(sol.status, round(float(sol.stop.t), 4))
    # stopped 0.3568
    ```
    """

    g: Callable[..., Any]

    def __init__(self, g: Callable[..., Any]):
        self.g = with_time("g of Stop", g)


class Stopped(NamedTuple):
    """Time and state at which a trajectory stopped, NaN if it did not."""

    t: Array
    q: Array
    p: Array
