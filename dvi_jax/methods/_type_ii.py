"""The paper's map itself."""

from typing import ClassVar

from ._base import Method
from .step import inverse_step, step


class TypeII(Method):
    r"""The type II variational map, equations (12)–(13), of order 1 for the paper's rule.

        q1 = q0 + h ∂H_D/∂p1,    p1 = p0 − h ∂H_D/∂q0 + h ε W(t0, t1, q0, p1)

    It is symplectic for ε = 0 (generating function p1·q0 + h H_D) for every H_D, and explicit when
    p1 enters neither ∂H_D/∂q0 nor W (symplectic Euler for separable H).

    **Source** the paper, (12)–(13); Hairer, Lubich & Wanner 2006, *Geometric Numerical
    Integration*, VI.5 (generating function of the second kind).
    """

    order: ClassVar[int] = 1
    is_symmetric: ClassVar[bool] = False
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True

    is_the_map: ClassVar[bool] = True

    # The functions themselves, not methods that call them: one frame less in every traceback.
    step = staticmethod(step)  # pyright: ignore[reportAssignmentType]
    inverse = staticmethod(inverse_step)  # pyright: ignore[reportAssignmentType]

    def is_made_of_the_map(self) -> bool:
        return True

    def needs_no_solve(self, equations, interval, q):
        return equations.step_is_explicit(interval, q)

    def inverse_needs_no_solve(self, equations, interval, q):
        return equations.inverse_is_explicit(interval, q)
