"""Burrau's problem of three bodies, which fall from rest and meet again and again."""

from dataclasses import replace

import numpy as np

from ._problem import Problem
from .n_body import n_body


def pythagorean() -> Problem:
    """The Pythagorean three-body problem: masses 3, 4, 5 at rest at the vertices of a 3–4–5
    triangle, each opposite to the side of its own length; G = 1.

    Close encounters, the closest at t = 15.83 with a distance of 4e-4, deflect the bodies until the
    lightest one escapes at t ≈ 60 and the others remain as a binary. Steps must be adapted:
    `AdaptiveReversible` with the speed `dvi_jax.systems.n_body.encounter_time`. The motion is
    chaotic: an error of 1e-16 at the closest encounter is about 1e-4 at t = 60, so that states
    after t ≈ 45 need ``arithmetic=dvi.DoubleDouble()``.

    **Example**

    ```python
    from dvi_jax.systems.n_body import encounter_time
    problem, close = systems.pythagorean(), dvi.AdaptiveReversible(encounter_time)
    sol = dvi.integrate(problem, h=0.1, num_steps=3000, method=dvi.KahanLi(8), lattice=close,
                        save=dvi.Save(ts=[20.0]))
    print(sol.qs[0, 0].round(5))
    # [3.00429 0.51193]
    ```

    **Source** Burrau 1913, *Astron. Nachr.* 195, 113; Szebehely & Peters 1967, *Astron. J.* 72,
    876 (the escape).
    """
    positions = [[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]]
    problem = n_body([3.0, 4.0, 5.0], positions, np.zeros((3, 2)), h=5e-4)
    return replace(
        problem,
        name="pythagorean",
        source="Burrau 1913, Astron. Nachr. 195, 113; Szebehely & Peters 1967, Astron. J. 72, 876",
    )
