"""The variational map with multipliers of a constrained system."""

from typing import ClassVar

import jax.numpy as jnp
from jax import lax

from lanewise.jaxprs.dependence import depends_on

from ..engine.newton import find_root
from ._base import Method
from .constraint import Linear, gradient, own_coupling, root_solver, tangent, velocity_at
from .step import judge


class Rattle(Method):
    r"""RATTLE, the symmetric variational map of order 2 for a system with a constraint g(q) = 0.

        p½ = p0 + h/2 [−∂H_D/∂q(t0, t½, q0, p½) + εW] − Gᵀ(q0) Λ
        q1 = q0 + h/2 [∂H_D/∂p(t0, t½, q0, p½) + ∂H_D/∂p(t1, t½, q1, p½)],     g(q1) = 0
        p1 = p½ + h/2 [−∂H_D/∂q(t1, t½, q1, p½) + εW] − Gᵀ(q1) M,     G(q1) ∂H/∂p(q1, p1) = 0

    with G = ∂g/∂q: half a step of the map (12)–(13) with H_D + λ·g and half a step of its adjoint.
    Λ and M are h/2 times multipliers. Positions satisfy g = 0 and velocities G q̇ = 0 to round-off
    in every step. Symplectic on the manifold (ε = 0), symmetric and invertible; a momentum of a
    symmetry of H_D and g is conserved to round-off. The default of a constrained system; for higher
    orders ``dvi.Yoshida(4, base=dvi.Rattle())`` and the other compositions. No other method takes a
    constrained system.

    For a separable H_D the step solves for the m multipliers, otherwise for p½ and q1 too. H_D must
    be defined for t1 = t0, where ∂H/∂p is taken; results of `from_lagrangian` are not.

    **Raises** `ValueError` (in `integrate`) for a system without constraint, an inconsistent start,
    redundant constraints. The status reports a step whose multipliers are not found.

    **Source** Andersen 1983, *J. Comput. Phys.* 52, 24; general H: Jay 1996, *SIAM J. Numer. Anal.*
    33, 368; Hairer, Lubich & Wanner 2006, VII.1.4 (1.26); variational: Leyendecker, Marsden & Ortiz
    2008, *ZAMM* 88, 677.
    """

    order: ClassVar[int] = 2
    is_symmetric: ClassVar[bool] = True
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True

    def needs_constraint(self):
        return True

    def step(self, equations, interval, q0, p0):
        # Both halves as in `Strang`, the second one as the inverse of a step backwards.
        h, m = interval.h, equations.constraint(q0).size
        first, second = interval.part(0.0, 0.5), interval.part(0.5, 1.0).reversed()
        linear = Linear.of_constraint(equations, q0)
        velocity = velocity_at(equations, interval.t0, q0)
        # The unknown is z = −Λ·units, a velocity across the constraint: its scale is known. The
        # result does not depend on the units, so that they are not differentiated.
        G = lax.stop_gradient(gradient(equations, q0))
        units = lax.stop_gradient(own_coupling(G, velocity, p0))

        def half_step(z, p_half, q1):
            """p½ and (q1 − q0)/h for multipliers, and for p½ and q1 on the right sides."""
            push = linear.transpose(z / units)
            p = p0 + h / 2 * equations.momentum_rate(first, q0, p_half) + push
            v = equations.position_rate(first, q0, p) + equations.position_rate(second, q1, p)
            return p, v / 2

        # As at the ends of the curve between two states, where z = 0 is the root.
        is_zero = h == 0
        divisor = jnp.where(is_zero, 1, h)

        def violation(z, v):
            """g(q1)/h."""
            return jnp.where(is_zero, z, equations.constraint(q0 + h * v) / divisor)

        q, p = equations.absolute(q0, p0)
        reach = jnp.where(is_zero, 0, jnp.abs(q / divisor)) + jnp.abs(velocity(p0))
        # Round-off of g(q1)/h: that of the terms of G q1, over h, and that of the velocity itself.
        zero, scale = jnp.zeros(m, q0.dtype), jnp.abs(G) @ reach.ravel()
        if is_separable(equations, first, second, q0, p0):
            root, info = find_root(
                lambda z: violation(z, half_step(z, p0, q0)[1]), zero, scale, root_solver(equations)
            )
            p_half, v = half_step(root, p0, q0)
        else:
            # One iteration for everything. p½ is taken out of the equation for q1, and q1 out of
            # that for z, so that the Jacobian in z is not singular.
            def split(x):
                return x[:m], *(y.reshape(q0.shape) for y in jnp.split(x[m:], 2))

            def residual(x):
                z, p_half, q1 = split(x)
                p, v = half_step(z, p_half, q1)
                defects = (p_half - p).ravel(), (q1 - q0 - h * v).ravel()
                return jnp.concatenate([violation(z, v), *defects])

            p_half, v = half_step(zero, p0, q0)
            guess = jnp.concatenate([zero, p_half.ravel(), (q0 + h * v).ravel()])
            size = jnp.concatenate([scale, p.ravel(), q.ravel()])
            root, info = find_root(residual, guess, size, equations.newton)
            p_half, v = half_step(*split(root))
        # The position after the last correction, for which g has been evaluated.
        q1 = q0 + h * v
        p1 = p_half + h / 2 * equations.momentum_rate(second, q1, p_half)
        p1, of_p = tangent(equations, interval.t1, q1, p1)
        return q1, p1, judge(info, q1, p1).then(judge(of_p, q1, p1))

    def inverse(self, equations, interval, q1, p1):
        return self.step(equations, interval.reversed(), q1, p1)

    def needs_no_solve(self, equations, interval, q):
        return False


def is_separable(equations, first, second, q, p) -> bool:
    """Whether p½ and q1 enter no right side of their own."""
    return not (
        depends_on(lambda p: equations.momentum_rate(first, q, p), 0, p)
        or depends_on(lambda q: equations.position_rate(second, q, p), 0, q)
    )
