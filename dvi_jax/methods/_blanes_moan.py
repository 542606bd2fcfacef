"""Blanes and Moan's optimised compositions of the map with its adjoint."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx

from ._base import Method
from ._composition import CompositionMethod
from ._type_ii import TypeII

_A = {
    4: (0.0792036964311957, 0.353172906049774, -0.0420650803577195),
    6: (
        0.0502627644003922,
        0.413514300428344,
        0.0450798897943977,
        -0.188054853819569,
        0.541960678450780,
    ),
}
_B = {
    4: (0.209515106613362, -0.143851773179818),
    6: (0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175),
}
"""The first halves of a and b as printed; what is left out makes the sums 1."""


class BlanesMoan(CompositionMethod):
    r"""Blanes and Moan's optimised compositions, S₆ of order 4 and S₁₀ of order 6.

    They were published as splittings, symmetric, with parts e^{a₁hA} e^{b₁hB} e^{a₂hA} …. A
    composition Φ*_{c₂h} ∘ Φ_{c₁h} with Φ_h = e^{hB} after e^{hA} is one with

        a₁ = c₁,    b₁ = c₁ + c₂,    a₂ = c₂ + c₃,    b₂ = c₃ + c₄,    …

    and has, for any map Φ with its adjoint, the order of the splitting: 12 and 20 coefficients,
    six and ten pairs.

    **Arguments** `order`: 4 or 6. `base`: Φ, any method with an inverse.

    **Raises** `ValueError` for an order other than 4 or 6.

    **Accuracy** the conditions of order hold to round-off, 2e-16, with the 15 printed digits.

    **Source** Blanes & Moan 2002, *J. Comput. Appl. Math.* 142, 313, table 2; McLachlan 1995,
    *SIAM J. Sci. Comput.* 16, 151 (the equivalence); Hairer, Lubich & Wanner 2006, V.3.
    """

    order: int = eqx.field(static=True, default=4)
    base: Method = eqx.field(default_factory=TypeII)

    orders: ClassVar[Sequence[int]] = tuple(_A)
    is_symmetric: ClassVar[bool] = True

    def fractions(self):
        a, b = _A[self.order], _B[self.order]
        b = (*b, 0.5 - sum(b))
        c = [a[0], b[0] - a[0]]
        for a_i, b_i in zip(a[1:], b[1:], strict=True):
            c.append(a_i - c[-1])
            c.append(b_i - c[-1])
        return (*c, *c[::-1])
