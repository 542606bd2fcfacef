"""Kahan and Li's optimised compositions of Strang's method."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx

from ._base import Method
from ._composition import CompositionMethod, of_strang
from ._type_ii import TypeII

_OUTER = {
    6: (
        0.39216144400731413927925056,
        0.33259913678935943859974864,
        -0.70624617255763935980996482,
        0.08221359629355080023149045,
    ),
    8: (
        0.13020248308889008087881763,
        0.56116298177510838456196441,
        -0.38947496264484728640807860,
        0.15884190655515560089621075,
        -0.39590389413323757733623154,
        0.18453964097831570709183254,
        0.25837438768632204729397911,
        0.29501172360931029887096624,
    ),
}
"""γ₁, γ₂, … up to the middle one."""


class KahanLi(CompositionMethod):
    r"""Kahan and Li's compositions of `Strang`, of order 6 and 8.

        Ψ_h = S_{γ₁h} ∘ S_{γ₂h} ∘ … ∘ S_{γ₂h} ∘ S_{γ₁h}    of 9 and 17 S

    The ones to begin with when a high order is wanted: no part is longer than 0.8 h, and Σ|γ| is
    3.8 and 5.4.

    **Arguments** `order`: 6 or 8. `base`: the map that `Strang` is made of, any with an inverse.

    **Raises** `ValueError` for an order other than 6 or 8.

    **Accuracy** the conditions of order hold to round-off, 4e-16.

    **Source** Kahan & Li 1997, *Math. Comput.* 66, 1089; digits as in Hairer, Lubich & Wanner
    2006, *Geometric Numerical Integration*, V.3 (3.12), (3.14).
    """

    order: int = eqx.field(static=True, default=8)
    base: Method = eqx.field(default_factory=TypeII)

    orders: ClassVar[Sequence[int]] = tuple(_OUTER)
    is_symmetric: ClassVar[bool] = True

    def fractions(self):
        return of_strang(_OUTER[self.order])
