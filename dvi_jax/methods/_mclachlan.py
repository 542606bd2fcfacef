"""McLachlan's optimised compositions."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx

from ._base import Method
from ._composition import CompositionMethod, of_strang
from ._type_ii import TypeII

_ROOT = 19.0**0.5
_PAIRS = (
    ((14 - _ROOT) / 108, (146 + 5 * _ROOT) / 540),
    ((-23 - 20 * _ROOT) / 270, (-2 + 10 * _ROOT) / 135),
    (0.2, 0.2),
    ((-2 + 10 * _ROOT) / 135, (-23 - 20 * _ROOT) / 270),
    ((146 + 5 * _ROOT) / 540, (14 - _ROOT) / 108),
)
"""Order 4: the map, its adjoint, …."""

_OUTER = {
    6: (0.18793069262651671457, 0.5553, 0.12837035888423653774, -0.84315275357471264676),
    8: (
        0.74167036435061295345,
        -0.40910082580003159400,
        0.19075471029623837995,
        -0.57386247111608226666,
        0.29906418130365592384,
        0.33462491824529818378,
        0.31529309239676659663,
    ),
}
"""γ₁, γ₂, … of compositions of `Strang` up to the middle one."""


class McLachlan(CompositionMethod):
    r"""McLachlan's optimised compositions, of order 4, 6 and 8.

    Order 4 has five pairs of the map with its adjoint of unequal length, coefficients in √19;
    orders 6 and 8 are symmetric compositions of 9 and 15 `Strang`.

    **Arguments** `order`: 4, 6 or 8. `base`: Φ, any method with an inverse.

    **Raises** `ValueError` for another order.

    **Accuracy** the conditions of order hold to round-off, 2e-16.

    **Source** McLachlan 1995, *SIAM J. Sci. Comput.* 16, 151, section 4; order 8 also Suzuki &
    Umeno 1993; Hairer, Lubich & Wanner 2006, V.3 (orders 4 and 8).
    """

    order: int = eqx.field(static=True, default=4)
    base: Method = eqx.field(default_factory=TypeII)

    orders: ClassVar[Sequence[int]] = (4, *_OUTER)
    is_symmetric: ClassVar[bool] = True

    def fractions(self):
        if self.order == 4:
            return tuple(c for pair in _PAIRS for c in pair)
        return of_strang(_OUTER[self.order])
