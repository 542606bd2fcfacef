"""Forces of constraint, as observables."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

import lanewise

from ..base.checks import require_system
from ..base.types import Interval
from ..methods.constraint import Linear, velocity_at
from ..methods.step import Equations
from ..problem.system import require_constraint


class ConstraintForce(eqx.Module):
    r"""The force of constraint −Gᵀλ at the end of a step, shape of q [force]; or the multipliers λ.

    λ(t, q, p) follows from the second derivative of the constraint, which is zero as well:

        q̇ = v = ∂H/∂p,   ṗ = −∂H/∂q + εW − Gᵀλ,   d²g/dt² = 0
        ⟹  (G ∂²H/∂p² Gᵀ) λ = d(G v)/dt at λ = 0,   G = ∂g/∂q

    by autodiff. It is the force of the differential equations, not an average over a step.

    **Arguments** `multipliers`: return λ, shape (m,) [energy / unit of g].

    **Raises** `ValueError` for a system without constraint.

    **Source** Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, VII.1.2 (1.12).
    """

    multipliers: bool = eqx.field(static=True, default=False)
    system: Any = None
    epsilon: Any = None

    is_of_state: ClassVar[bool] = True

    def bind(self, system: Any, epsilon: Any) -> "ConstraintForce":
        """The same observable for a system and ε."""
        return ConstraintForce(self.multipliers, system, epsilon)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        require_system("ConstraintForce", self.system)
        require_constraint("ConstraintForce", self.system)
        equations = Equations(self.system, jnp.asarray(self.epsilon, q1.dtype), args)

        # Its derivative along the motion is linear in λ: the part at λ = 0 is the right side.
        def rate(t, q, p):  # dg/dt
            return jax.jvp(equations.constraint, (q,), (velocity_at(equations, t, q)(p),))[1]

        linear, velocity = Linear.of_constraint(equations, q1), velocity_at(equations, t1, q1)
        # The unconstrained motion, of which H is taken on the diagonal t0 = t1.
        v, f = equations.rates(Interval(t1, t1, jnp.zeros_like(t1)), q1, p1)
        _, growth = jax.jvp(rate, (t1, q1, p1), (jnp.ones_like(t1), v, f))
        multipliers = lanewise.solve(linear.coupling(velocity, p1, growth.size), growth)
        return multipliers if self.multipliers else -linear.transpose(multipliers)
