"""Yoshida's compositions of Strang's method."""

from typing import ClassVar

import equinox as eqx

from ._composition import CompositionMethod


class Yoshida(CompositionMethod):
    r"""Yoshida's composition of `Strang` of order 4 (the triple jump).

        Ψ_h = S_{γh} ∘ S_{(1−2γ)h} ∘ S_{γh},    γ = 1/(2 − 2^{1/3})

    The middle step goes backwards (1 − 2γ ≈ −1.70), so strong dissipation is not for it.

    **Raises** `ValueError` for an order other than 4.

    **Source** Yoshida 1990, *Phys. Lett. A* 150, 262, (2.11); Suzuki 1990.
    """

    order: int = eqx.field(static=True, default=4)
    is_symmetric: ClassVar[bool] = True
    is_symplectic: ClassVar[bool] = True

    def __check_init__(self):
        if self.order != 4:
            raise ValueError(
                f"Yoshida knows order 4, got {self.order!r}. For order 2 use dvi.Strang(); for "
                "coefficients of your own, dvi.Composition(coefficients, order=...)."
            )

    def fractions(self):
        outer = 1.0 / (2.0 - 2.0 ** (1.0 / 3.0))
        inner = 1.0 - 2.0 * outer
        return tuple(c / 2 for c in (outer, outer, inner, inner, outer, outer))
