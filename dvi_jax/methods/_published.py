"""Symmetric compositions with published coefficients."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import equinox as eqx

from ..base.checks import one_of
from ._base import Method
from ._composition import CompositionMethod, of_strang
from ._type_ii import TypeII

# Twenty digits are printed of some coefficients, which a double cannot hold. They stay as printed,
# so that a reader can compare them with the source digit by digit.

Tables = Mapping[int, tuple[float, ...]]


class TabulatedComposition(CompositionMethod):
    """Base of the symmetric compositions whose coefficients are in a table, by order."""

    order: int = eqx.field(static=True, default=4)
    base: Method = eqx.field(default_factory=TypeII)

    tables: ClassVar[Tables]
    is_symmetric: ClassVar[bool] = True

    def __check_init__(self):
        one_of(f"order of {type(self).__name__}", self.order, self.tables)

    def fractions(self):
        return self.tables[self.order]


class Yoshida(TabulatedComposition):
    r"""Yoshida's compositions of `Strang`, of order 4, 6 and 8.

        Ψ_h = S_{γ₁h} ∘ S_{γ₂h} ∘ … ∘ S_{γ₂h} ∘ S_{γ₁h}    of 3, 7 and 15 S

    Order 4 is the triple jump, γ₁ = 1/(2 − 2^{1/3}); order 6 Yoshida's solution A; order 8 his
    solution D. The substeps are long in both directions (Σ|γ| = 4.4, 5.7, 15), which costs
    accuracy: `BlanesMoan`, `McLachlan` and `KahanLi` have smaller errors for the same work. None of
    the orders suits strong dissipation.

    **Arguments** `order`: 4, 6 or 8, `ValueError` for others. `base`: as for `Strang`.

    **Accuracy** the order conditions hold to round-off, 4e-16.

    **Source** Yoshida 1990, *Phys. Lett. A* 150, 262, (2.11) and tables 1, 2 (15 digits there;
    order 6 with more in Hairer, Lubich & Wanner 2006, V.3 (3.11); those of order 8 were refined
    by Newton's method on the conditions); Suzuki 1990.
    """

    tables: ClassVar[Tables] = {
        # The real root of 2γ³ + (1 − 2γ)³ = 0, by which the leading error vanishes.
        4: of_strang(1.0 / (2.0 - 2.0 ** (1.0 / 3.0))),
        6: of_strang(0.78451361047755726382, 0.23557321335935813368, -1.17767998417887100695),
        8: of_strang(  # refined: the source has 15 digits
            *(0.91484424622979154673, 0.25369333656621134709, -1.44485223686060515469),
            *(-0.15824063536805016428, 1.93813913762252587603, -1.96061023297531078491),
            0.10279984939179644121,
        ),
    }


# So that the leading error, proportional to Σγ³, vanishes: 4γ³ + (1 − 4γ)³ = 0.
_GAMMA = 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))


class Suzuki(TabulatedComposition):
    r"""Suzuki's composition of five steps of `Strang`, of order 4.

        Ψ_h = S_{γh} ∘ S_{γh} ∘ S_{(1−4γ)h} ∘ S_{γh} ∘ S_{γh},    γ = 1/(4 − 4^{1/3}) ≈ 0.41

    One substep goes backwards, by 0.66 h: less than in the triple jump of `Yoshida` (1.70 h), with
    an error some seventy times smaller in the same condition.

    **Arguments** `order`: 4, `ValueError` for others. `base`: as for `Strang`.

    **Source** Suzuki 1990, *Phys. Lett. A* 146, 319; Hairer, Lubich & Wanner 2006, II.4 (4.5).
    """

    tables: ClassVar[Tables] = {4: of_strang(_GAMMA, _GAMMA)}


_ROOT = 19.0**0.5


class McLachlan(TabulatedComposition):
    r"""McLachlan's optimised compositions, of order 4, 6 and 8.

    Order 4 has five pairs of the map with its adjoint of unequal length, coefficients in √19;
    orders 6 and 8 are symmetric compositions of 9 and 15 `Strang`.

    **Arguments** `order`: 4, 6 or 8, `ValueError` for others. `base`: as for `Strang`.

    **Accuracy** the order conditions hold to round-off, 2e-16.

    **Source** McLachlan 1995, *SIAM J. Sci. Comput.* 16, 151, section 4; order 8 also Suzuki &
    Umeno 1993; Hairer, Lubich & Wanner 2006, V.3 (orders 4 and 8).
    """

    tables: ClassVar[Tables] = {
        # Pairs of the map and its adjoint, a pair in each line. The coefficients are algebraic
        # numbers, and given by formulas.
        4: (
            *((14 - _ROOT) / 108, (146 + 5 * _ROOT) / 540),
            *((-23 - 20 * _ROOT) / 270, (-2 + 10 * _ROOT) / 135),
            *(0.2, 0.2),
            *((-2 + 10 * _ROOT) / 135, (-23 - 20 * _ROOT) / 270),
            *((146 + 5 * _ROOT) / 540, (14 - _ROOT) / 108),
        ),
        6: of_strang(
            0.18793069262651671457, 0.5553, 0.12837035888423653774, -0.84315275357471264676
        ),
        8: of_strang(
            *(0.74167036435061295345, -0.40910082580003159400, 0.19075471029623837995),
            *(-0.57386247111608226666, 0.29906418130365592384, 0.33462491824529818378),
            0.31529309239676659663,
        ),
    }


class KahanLi(TabulatedComposition):
    r"""Kahan and Li's compositions of `Strang`, of order 6 and 8.

        Ψ_h = S_{γ₁h} ∘ S_{γ₂h} ∘ … ∘ S_{γ₂h} ∘ S_{γ₁h}    of 9 and 17 S

    Try these first for a high order: no substep is longer than 0.8 h, and Σ|γ| is 3.8 and 5.4.

    **Arguments** `order`: 6 or 8, `ValueError` for others. `base`: as for `Strang`.

    **Accuracy** the order conditions hold to round-off, 4e-16.

    **Source** Kahan & Li 1997, *Math. Comput.* 66, 1089; digits as in Hairer, Lubich & Wanner
    2006, *Geometric Numerical Integration*, V.3 (3.12), (3.14).
    """

    order: int = eqx.field(static=True, default=8)

    tables: ClassVar[Tables] = {
        6: of_strang(
            *(0.39216144400731413927925056, 0.33259913678935943859974864),
            *(-0.70624617255763935980996482, 0.08221359629355080023149045),
        ),
        8: of_strang(
            *(0.13020248308889008087881763, 0.56116298177510838456196441),
            *(-0.38947496264484728640807860, 0.15884190655515560089621075),
            *(-0.39590389413323757733623154, 0.18453964097831570709183254),
            *(0.25837438768632204729397911, 0.29501172360931029887096624),
        ),
    }


def _of_splitting(a: Sequence[float], b: Sequence[float]) -> tuple[float, ...]:
    """The fractions that correspond to a splitting, from the first halves of a and b as printed."""
    # The last b makes the sum 1. The source prints it too, rounded: the sum would be off by that.
    b = (*b, 0.5 - sum(b))
    c = [a[0], b[0] - a[0]]
    for a_i, b_i in zip(a[1:], b[1:], strict=True):
        c.append(a_i - c[-1])
        c.append(b_i - c[-1])
    return (*c, *c[::-1])


class BlanesMoan(TabulatedComposition):
    r"""Blanes and Moan's optimised compositions, S₆ of order 4 and S₁₀ of order 6.

    They were published as splittings, symmetric, with parts e^{a₁hA} e^{b₁hB} e^{a₂hA} …. A
    composition Φ*_{c₂h} ∘ Φ_{c₁h} with Φ_h = e^{hB} after e^{hA} is one with

        a₁ = c₁,    b₁ = c₁ + c₂,    a₂ = c₂ + c₃,    b₂ = c₃ + c₄,    …

    and has, for any map Φ with its adjoint, the order of the splitting: six and ten pairs.

    **Arguments** `order`: 4 or 6, `ValueError` for others. `base`: as for `Strang`.

    **Accuracy** the order conditions hold to round-off, 2e-16, with the 15 printed digits.

    **Source** Blanes & Moan 2002, *J. Comput. Appl. Math.* 142, 313, table 2; McLachlan 1995,
    *SIAM J. Sci. Comput.* 16, 151 (the equivalence); Hairer, Lubich & Wanner 2006, V.3.
    """

    tables: ClassVar[Tables] = {
        4: _of_splitting(
            a=(0.0792036964311957, 0.353172906049774, -0.0420650803577195),
            b=(0.209515106613362, -0.143851773179818),
        ),
        6: _of_splitting(
            a=(
                *(0.0502627644003922, 0.413514300428344, 0.0450798897943977),
                *(-0.188054853819569, 0.541960678450780),
            ),
            b=(0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175),
        ),
    }
