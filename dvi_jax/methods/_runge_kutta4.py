"""The classical Runge–Kutta method, a non-symplectic reference method."""

from typing import ClassVar

from ._base import Method
from .step import continuous_rates, judge, no_solve


class RungeKutta4(Method):
    r"""The classical fourth-order Runge–Kutta method on the continuous equations.

        q̇ = ∂H/∂p,   ṗ = −∂H/∂q + εW     with H(t, q, p) = H_D(t, t, q, p)

    Neither symplectic nor symmetric: the paper's reference method (Figures 2 and 4). Its inverse
    has no closed form, so it cannot be composed with its adjoint.

    **Source** Kutta 1901; Hairer, Nørsett & Wanner 1993, *Solving ODEs I*, table II.1.2.
    """

    order: ClassVar[int] = 4
    is_symmetric: ClassVar[bool] = False
    is_symplectic: ClassVar[bool] = False
    is_invertible: ClassVar[bool] = False

    def step(self, equations, interval, q0, p0):
        t0, t1, h = interval
        middle, (velocity, force) = t0 + h / 2, continuous_rates(equations, h)

        def field(t, q, p):
            return velocity(t, q, p), force(t, q, p)

        kq1, kp1 = field(t0, q0, p0)
        kq2, kp2 = field(middle, q0 + h / 2 * kq1, p0 + h / 2 * kp1)
        kq3, kp3 = field(middle, q0 + h / 2 * kq2, p0 + h / 2 * kp2)
        kq4, kp4 = field(t1, q0 + h * kq3, p0 + h * kp3)
        q1 = q0 + h / 6 * (kq1 + 2 * kq2 + 2 * kq3 + kq4)
        p1 = p0 + h / 6 * (kp1 + 2 * kp2 + 2 * kp3 + kp4)
        return q1, p1, judge(no_solve(q1), q1, p1)

    def inverse(self, equations, interval, q1, p1):
        # Callers check `is_invertible` first; only code of a user gets here.
        raise TypeError(
            "RungeKutta4 has no inverse step: use another method, or adjoint=dvi.Checkpointed()."
        )

    def needs_no_solve(self, equations, interval, q):
        return True

    def inverse_needs_no_solve(self, equations, interval, q):
        return False
