"""Half a step of the map, half a step of its adjoint."""

from typing import ClassVar

from ._composition import CompositionMethod


class Strang(CompositionMethod):
    r"""The symmetric second-order composition Φ*_{h/2} ∘ Φ_{h/2}.

    For a separable H_D this is velocity Verlet (kick–drift–kick); in general the map solves
    for p and the adjoint for q.

    **Source** Strang 1968; Hairer, Lubich & Wanner 2006, II.4 (4.5).
    """

    order: ClassVar[int] = 2
    is_symmetric: ClassVar[bool] = True
    is_symplectic: ClassVar[bool] = True

    def fractions(self):
        return (0.5, 0.5)
