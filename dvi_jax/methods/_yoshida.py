"""Yoshida's compositions of Strang's method."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx

from ._base import Method
from ._composition import CompositionMethod, of_strang
from ._type_ii import TypeII

_OUTER = {
    4: (1.0 / (2.0 - 2.0 ** (1.0 / 3.0)),),
    6: (0.78451361047755726382, 0.23557321335935813368, -1.17767998417887100695),
    8: (
        0.91484424622979154673,
        0.25369333656621134709,
        -1.44485223686060515469,
        -0.15824063536805016428,
        1.93813913762252587603,
        -1.96061023297531078491,
        0.10279984939179644121,
    ),
}
"""γ₁, γ₂, … up to the middle one, in the order in which they act."""


class Yoshida(CompositionMethod):
    r"""Yoshida's compositions of `Strang`, of order 4, 6 and 8.

        Ψ_h = S_{γ₁h} ∘ S_{γ₂h} ∘ … ∘ S_{γ₂h} ∘ S_{γ₁h}    of 3, 7 and 15 S

    Order 4 is the triple jump, γ₁ = 1/(2 − 2^{1/3}); order 6 Yoshida's solution A; order 8 his
    solution D. The parts go far back and forth (Σ|γ| = 4.4, 5.7, 15), which costs accuracy:
    `BlanesMoan`, `McLachlan` and `KahanLi` have smaller errors for the same work. Strong
    dissipation is not for any of them.

    **Arguments** `order`: 4, 6 or 8. `base`: the map that `Strang` is made of, any with an inverse.

    **Raises** `ValueError` for another order.

    **Accuracy** the conditions of order hold to round-off, 4e-16.

    **Source** Yoshida 1990, *Phys. Lett. A* 150, 262, (2.11) and tables 1, 2 (15 digits there;
    order 6 with more in Hairer, Lubich & Wanner 2006, V.3 (3.11); those of order 8 were refined
    by Newton's method on the conditions); Suzuki 1990.
    """

    order: int = eqx.field(static=True, default=4)
    base: Method = eqx.field(default_factory=TypeII)

    orders: ClassVar[Sequence[int]] = tuple(_OUTER)
    is_symmetric: ClassVar[bool] = True

    def fractions(self):
        return of_strang(_OUTER[self.order])
