"""The map of a constrained system for splittings: a kick, then free motion on the manifold."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
from jax import lax

from ..base.types import Scalar
from ._base import Method
from ._composition import Composition
from ._rattle import Rattle, is_separable
from .constraint import tangent
from .step import Equations, judge


class _FreeMotion(eqx.Module):
    """A separable system without its potential and force, with its constraint."""

    system: Any

    force: ClassVar[None] = None

    @property
    def constraint(self):
        return self.system.constraint

    def hamiltonian(self, t0, t1, q0, p1, epsilon, args) -> Scalar:
        # The potential is a constant, of which all derivatives are 0.
        return self.system.hamiltonian(t0, t1, lax.stop_gradient(q0), p1, epsilon, args)


class Geodesic(Method):
    r"""The map (12)–(13) of a separable H_D with multipliers, symplectic on the manifold g = 0:

        B: p ← Π [p0 + h (−∂H_D/∂q(q0) + εW)],    Π p = p − Gᵀ (G M⁻¹ Gᵀ)⁻¹ G M⁻¹ p
        A: the motion with H = K(p) and g = 0 over h, by `steps` steps of `Rattle`

    For K = pᵀM⁻¹p/2 the part A is the geodesic in the metric M. For H_D that are not separable it
    is a step of `Rattle`.

    **Source** Hairer, Lubich & Wanner 2006, VII.1.3 (1.19)–(1.20); Leimkuhler & Matthews 2016,
    *Proc. R. Soc. A* 472, 20160138.
    """

    steps: int = eqx.field(static=True, default=1)

    order: ClassVar[int] = 1
    is_symmetric: ClassVar[bool] = False
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True

    def needs_constraint(self):
        return True

    def step(self, equations, interval, q0, p0):
        free, motion = self._motion(equations, interval, q0, p0)
        # The method takes the whole step: no kick is left.
        if free is equations:
            return motion.step(equations, interval, q0, p0)
        p, before = self._kick(equations, interval, interval.h, q0, p0)
        q1, p1, info = motion.step(free, interval, q0, p)
        return q1, p1, before.then(info)

    def inverse(self, equations, interval, q1, p1):
        free, motion = self._motion(equations, interval, q1, p1)
        if free is equations:
            return motion.inverse(equations, interval, q1, p1)
        q0, p, info = motion.inverse(free, interval, q1, p1)
        p0, after = self._kick(equations, interval, -interval.h, q0, p)
        return q0, p0, info.then(after)

    def needs_no_solve(self, equations, interval, q):
        return False

    def _motion(self, equations, interval, q, p) -> tuple[Equations, Method]:
        """The equations of A and its method; those of the whole step if H_D is not separable."""
        # The motion with H = K(p, q) has no flow with steps of its own: the kick depends on p.
        if not is_separable(equations, interval, interval, q, p):
            return equations, Rattle()
        free = dataclasses.replace(equations, system=_FreeMotion(equations.system))
        equal = (1 / self.steps,) * self.steps
        return free, Composition(equal, base=Rattle())  # pyright: ignore[reportCallIssue]

    def _kick(self, equations, interval, h, q, p):
        p, info = tangent(
            equations, interval.t0, q, p + h * equations.momentum_rate(interval, q, p)
        )
        return p, judge(info, q, p)
