"""The adjoint of another method."""

from typing import ClassVar

import equinox as eqx

from ._base import Method, check_invertible
from ._type_ii import TypeII


class Adjoint(Method):
    r"""The adjoint method Φ*_h = (Φ_{−h})⁻¹ of `method`.

    Same order and symplecticity; a symmetric method is its own adjoint. The adjoint of `TypeII`
    solves for q1 instead of p1, and is explicit when q0 does not enter ∂H_D/∂p1.

    **Source** Hairer, Lubich & Wanner 2006, II.3.
    """

    method: Method = eqx.field(default_factory=TypeII)

    is_invertible: ClassVar[bool] = True

    def __check_init__(self):
        check_invertible("method", self.method)

    @property
    def order(self) -> int:
        """The order of the method."""
        return self.method.order

    @property
    def is_symmetric(self) -> bool:
        """Whether the method is symmetric, and so its own adjoint."""
        return self.method.is_symmetric

    @property
    def is_symplectic(self) -> bool:
        """Whether the method is symplectic."""
        return self.method.is_symplectic

    def substeps(self) -> tuple[float, ...]:
        return self.method.substeps()

    def check(self, equations, first_interval, q, p):
        self.method.check(equations, first_interval, q, p)

    def is_double_only(self, equations) -> bool:
        return self.method.is_double_only(equations)

    def is_made_of_the_map(self) -> bool:
        return self.method.is_made_of_the_map()

    def needs_constraint(self) -> bool:
        return self.method.needs_constraint()

    def step(self, equations, interval, q0, p0):
        # (Φ_{−h})⁻¹: the inverse of the step that goes from t1 to t0. H_D and W are evaluated at
        # (t1, t0, q1, p0), which matters where they depend on the times.
        return self.method.inverse(equations, interval.reversed(), q0, p0)

    def inverse(self, equations, interval, q1, p1):
        return self.method.step(equations, interval.reversed(), q1, p1)

    def in_coordinates(self, equations, interval, q):
        inner = self.method.in_coordinates(equations, interval, q)
        return inner and inner.of_part(self, "method")

    def needs_no_solve(self, equations, interval, q) -> bool:
        # A step of the adjoint is an inverse step of the method: the two answers are exchanged.
        return self.method.inverse_needs_no_solve(equations, interval, q)

    def inverse_needs_no_solve(self, equations, interval, q) -> bool:
        return self.method.needs_no_solve(equations, interval, q)
