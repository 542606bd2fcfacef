"""Steps that adapt by a transformation of the time."""

from collections.abc import Callable
from typing import Any

from ..engine.signature import accepts
from ._uniform import Uniform


class TimeTransformed(Uniform):
    r"""Equal steps in a fictitious time σ with dt = g(t, q, p) dσ: small steps where g is small.

    The trajectory is one of the Hamiltonian (Poincaré, Sundman)

        K(q, t; p, p_t) = g(t, q, p) (H(t, q, p) + p_t),    p_t = −H at the start,

    with t as a position and p_t its momentum, and on K = 0 it is that of H in other steps. So
    the method, whatever it is, keeps its structure in the extended phase space, which choosing
    the step at every step would destroy. H is H_D at t1 = t0; a force W becomes g W for p and
    −g W·∂H/∂p for p_t.

    **Arguments** `speed`: g, function ``(t, q, p, args)`` → positive scalar; with Kepler's problem
    for example |q|, or |q|^{3/2}.

    `integrate` then takes `h` as the step of σ [time / unit of g], and num_steps of them;
    ``solution.hs`` are the steps of t. Observables see t. K couples q and p even where H_D
    is separable: every step needs a solve. On the map K is kept up to O(h^order), not exactly.

    **Raises** `TypeError` for a speed that is no function, and in `integrate` `ValueError` for
    one that is not a positive scalar at the start, and for a `Trend`, whose times are the method's.

    **Source** Hairer 1997, *Appl. Numer. Math.* 25, 219; Reich 1999, *SIAM J. Numer. Anal.* 36,
    1549; Hairer, Lubich & Wanner 2006, VIII.2.1.

    **Example**

    ```python
    kepler = systems.kepler()
    slow_near_the_sun = dvi.TimeTransformed(lambda t, q, p, args: jnp.sqrt(q @ q))
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1, num_steps=100,
                        lattice=slow_near_the_sun, method=dvi.Strang())
    print(round(float(sol.hs.min()), 3), round(float(sol.hs.max()), 3))
    # 0.083 0.57
    ```
    """

    speed: Callable[..., Any]

    def __check_init__(self):
        if not callable(self.speed) or not accepts(self.speed, 4):
            raise TypeError(
                f"the speed of TimeTransformed must be a function (t, q, p, args) → positive "
                f"scalar, got {self.speed!r}."
            )
