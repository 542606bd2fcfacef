"""Half a step of the map, half a step of its adjoint."""

from typing import ClassVar

import equinox as eqx

from ._base import Method
from ._composition import CompositionMethod
from ._type_ii import TypeII


class Strang(CompositionMethod):
    r"""The symmetric second-order composition Φ*_{h/2} ∘ Φ_{h/2}.

    For a separable H_D this is velocity Verlet (kick–drift–kick); in general the map solves for p
    and the adjoint for q. ``Strang(base=Adjoint())`` is the opposite order, position Verlet
    (drift–kick–drift): on planetary orbits its energy error is half as large.

    **Arguments** `base`: Φ, any method with an inverse, here and in the other compositions.

    **Source** Strang 1968; Hairer, Lubich & Wanner 2006, II.4 (4.5).
    """

    base: Method = eqx.field(default_factory=TypeII)

    order: ClassVar[int] = 2
    is_symmetric: ClassVar[bool] = True

    def fractions(self):
        return (0.5, 0.5)
