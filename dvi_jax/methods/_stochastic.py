"""Methods for systems with noise."""

import dataclasses
import functools
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..base.checks import whole
from ..base.types import Scalar, State
from ..problem.noise import NoiseHamiltonians
from ..problem.system import System
from ._base import Method
from ._composition import CompositionMethod
from ._gauss_legendre import GaussLegendre
from ._geodesic import Geodesic
from ._type_ii import TypeII
from .constraint import tangent
from .step import Equations, StepInfo, judge


class NoisySystem(eqx.Module):
    r"""A system with the noise of one step as constant rates Ḃ = ΔB/h.

    With G = Σ h_m Ḃ_m its Hamiltonian is H_D + G. That of the map (12)–(13) has one term more,

        H_D + G + (h/2) ∂G/∂q0·∂G/∂p1,

    the next one of the type II generating function p1·q0 + h H_D + ΔB h₁ + … of the flow of G.
    """

    system: System
    rates: Array
    h: Scalar
    is_map: bool = eqx.field(static=True)

    # What a method reads of a system to see its form: that of a system with noise is general.
    H_D: ClassVar[None] = None
    perturbation: ClassVar[None] = None
    force: ClassVar[str] = "that of noise"

    def hamiltonian(self, t0, t1, q0, p1, epsilon, args) -> Scalar:
        # By this path derivatives of every method contain the noise, and the inverse exists.
        H, noise = self.system.hamiltonian(t0, t1, q0, p1, epsilon, args), self.system.noise
        if not isinstance(noise, NoiseHamiltonians):
            return H
        s, _ = self.system.times(t0, t1, epsilon)
        G, slopes = jax.value_and_grad(noise.energy, (1, 2))(s, q0, p1, args, self.rates)
        return H + G + (self.h / 2 * jnp.sum(slopes[0] * slopes[1]) if self.is_map else 0)

    def disturbing_force(self, t0, t1, q0, p1, epsilon, args) -> State:
        # Not multiplied by ε, as the force of the user is.
        force = self.system.disturbing_force(t0, t1, q0, p1, epsilon, args)
        s, _ = self.system.times(t0, t1, epsilon)
        return force + self.system.noise.force(s, q0, p1, args, self.rates)  # pyright: ignore


def _place(equations: Equations, t: Scalar, q: State, p: State) -> tuple[Any, ...]:
    """(t, q, p, args), the arguments of the functions of noise."""
    s, _ = equations.system.times(t, t, equations.epsilon)
    return s, *equations.absolute(q, p), equations.args


class _WithNoise(Method):
    """Base of the methods that are those of a system without noise with a `NoisySystem`."""

    plain: ClassVar[Method]

    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True
    increments: ClassVar[int] = 1
    # Arbitrarily large increments, which are arbitrarily rare, would have no solution.
    largest_increment: ClassVar[float | None] = 6.0

    # Both with the rates of the step forwards, so that the inverse goes back along the same path.
    def step(self, equations, interval, q0, p0):
        return self.plain.step(self._with_noise(equations, interval, q0, p0), interval, q0, p0)

    def inverse(self, equations, interval, q1, p1):
        return self.plain.inverse(self._with_noise(equations, interval, q1, p1), interval, q1, p1)

    def needs_no_solve(self, equations, interval, q):
        return self.plain.needs_no_solve(self._with_noise(equations, interval, q, q), interval, q)

    def inverse_needs_no_solve(self, equations, interval, q):
        noisy = self._with_noise(equations, interval, q, q)
        return self.plain.inverse_needs_no_solve(noisy, interval, q)

    def _with_noise(self, equations, interval, q, p) -> Equations:
        noise, dB = equations.system.noise, equations.increments
        if noise is None:
            return equations
        place, is_map = _place(equations, interval.t0, q, p), self.plain.is_the_map
        # The midpoint rule needs no such test: it evaluates σ in the middle of the step.
        if is_map:
            noise.check_fixed_momentum(type(self).__name__, *place)
        # Without increments the equations are only examined, for whether they need a solve.
        dB = jnp.zeros(noise.count(*place), q.dtype) if dB is None else dB[0]
        system = NoisySystem(equations.system, dB / interval.h, interval.h, is_map)
        return dataclasses.replace(equations, system=system, increments=None)


class StochasticEuler(_WithNoise):
    r"""The symplectic Euler method with noise: the map (12)–(13) of a noisy discrete Hamiltonian.

        q1 = q0 + h ∂S/∂p1,    p1 = p0 − h ∂S/∂q0 + h εW + σ(t0, q0) ΔB
        S  = H_D + G + (h/2) ∂G/∂q0·∂G/∂p1,    G = Σ_m h_m(t0, q0, p1) ΔB_m/h

    Symplectic for each path for noise Hamiltonians and W = 0. Explicit for separable H_D and noise
    that depends on t and q only.

    **Accuracy** strong and weak order 1 for momentum noise, for one noise Hamiltonian and for
    several whose Poisson brackets vanish; otherwise strong order 1/2. The increments of
    `Brownian` are limited to six standard deviations, which 2 of 10⁹ exceed.

    **Raises** `ValueError` for momentum noise σ that depends on p.

    **Source** Milstein, Repin & Tretyakov 2002, *SIAM J. Numer. Anal.* 39, 2066, and 40, 1583;
    generating functions: Deng, Anton & Wong 2014, *Commun. Comput. Phys.* 16, 1.
    """

    order: ClassVar[int] = 1
    is_symmetric: ClassVar[bool] = False
    plain: ClassVar[Method] = TypeII()


class StochasticMidpoint(_WithNoise):
    r"""The implicit midpoint rule with noise, for Stratonovich's equations of every form.

        q1 = q0 + h ∂H/∂p + Σ_m ∂h_m/∂p ΔB_m,    p1 = p0 − h (∂H/∂q − εW) − Σ_m ∂h_m/∂q ΔB_m + σ ΔB

    all at ((q0 + q1)/2, (p0 + p1)/2) and the time in the middle, with H(t, q, p) = H_D(t, t, q, p).
    Symplectic for each path for noise Hamiltonians and W = 0; quadratic invariants of H and of all
    h_m are conserved to round-off.

    **Accuracy** weak order 1, and strong order 1 for one noise and for several that commute,
    otherwise 1/2. The increments of `Brownian` are limited to six standard deviations.

    **Source** Milstein, Repin & Tretyakov 2002, *SIAM J. Numer. Anal.* 39, 2066, (4.15).
    """

    order: ClassVar[int] = 2
    is_symmetric: ClassVar[bool] = True
    plain: ClassVar[Method] = GaussLegendre(1)


class _Splitting(CompositionMethod):
    """Base of the splittings with an exact part O of friction and momentum noise: one in the middle
    of the step, or two over h/2 at its ends. Without noise they are `Strang`."""

    base: Method = eqx.field(default_factory=TypeII)
    geodesic_steps: int = eqx.field(static=True, default=1)

    order: ClassVar[int] = 2
    is_symmetric: ClassVar[bool] = True

    def __check_init__(self):
        whole("geodesic_steps", self.geodesic_steps)

    def fractions(self) -> tuple[float, ...]:
        return (0.5, 0.5)

    def takes(self, has_constraint):
        return isinstance(self.base, TypeII) or self.base.takes(has_constraint)

    def needs_no_solve(self, equations, interval, q):
        return equations.system.constraint is None and super().needs_no_solve(
            equations, interval, q
        )

    def map_of(self, equations: Equations) -> Method:
        """The map of the halves: with a constraint that on the manifold."""
        if equations.system.constraint is None or self.base.needs_constraint():
            return self.base
        return Geodesic(self.geodesic_steps)

    def project(self, equations, time, q, p, duration, infos) -> State:
        """p in the tangent space after a part O at this time; its status is appended."""
        if equations.system.constraint is None:
            return p
        # In the metric of the masses: p has the distribution of Maxwell of the tangent momenta.
        weight = equations.system.noise.reaction(equations.args, p, duration)
        p, info = tangent(equations, time, q, p, weight)
        infos.append(judge(info, q, p))
        return p

    def step(self, equations, interval, q0, p0):
        count, base, infos = self.increments, self.map_of(equations), []

        def kick(number, q, p):
            """p after an O at constant q."""
            noise, dB, h = equations.system.noise, equations.increments, interval.h / count
            if noise is None or dB is None:
                return p
            t = interval.part((number + 0.5) / count, 1.0).t0
            place = _place(equations, t, q, p)
            noise.check_fixed_momentum(type(self).__name__, *place)
            return self.project(equations, t, q, p + noise.kick(*place, h, dB[number]), h, infos)

        p = kick(0, q0, p0) if count == 2 else p0
        q, p, info = base.step(equations, interval.part(0.0, 0.5), q0, p)
        infos.append(info)
        p = kick(0, q, p) if count == 1 else p
        # The adjoint of the map is the inverse of the map by −h.
        q, p, info = base.inverse(equations, interval.part(0.5, 1.0).reversed(), q, p)
        infos.append(info)
        p = kick(1, q, p) if count == 2 else p
        return q, p, functools.reduce(StepInfo.then, infos)

    def inverse(self, equations, interval, q1, p1):
        # The parts are symmetric: back along the path, they are the step by −h with −dB.
        if (dB := equations.increments) is not None:
            reversal = jnp.stack([-dB[0], dB[1]]) if self.needs_areas else -dB[::-1]
            equations = dataclasses.replace(equations, increments=reversal)
        return self.step(equations, interval.reversed(), q1, p1)


class BAOAB(_Splitting):
    r"""The splitting B(h/2) A(h/2) O(h) A(h/2) B(h/2) for Langevin's equation.

        B: p ← p + (h/2)(−∂H_D/∂q + εW),    A: q ← q + (h/2) ∂H_D/∂p
        O: p ← e^{−γh} p + √(T m (1 − e^{−2γh})) ΔB/√h          exact; or p ← p + σ(t, q) ΔB

    B and A are together the map (12)–(13) over h/2, and after O its adjoint, also for H_D that are
    not separable. At T = 0 areas shrink by e^{−γh} exactly: the step is conformally symplectic.

    With a constraint g(q) = 0 every part ends in the tangent space, p ← p − Gᵀμ with G ∂H/∂p = 0,
    and A is the motion along geodesics of the manifold (g-BAOAB). The distribution exp(−H/T) on the
    manifold is stationary, with the measure of its surface in the metric of the masses.

    **Arguments**

    - `base`: the method of the half steps B and A, any method with an inverse; with a constraint
      `Rattle`, or nothing.
    - `geodesic_steps`: with a constraint, number of steps of `Rattle` in each A; they evaluate no
      force. More of them when the status reports that one has no solution.

    **Accuracy** weak order 2, strong order 1. For H_D = Σ p²/(2m) + V the error of averages of q is
    O(h²); it vanishes for harmonic V, and is O(h⁴) for large γ.

    **Raises** `ValueError` for noise that is not on the momenta, or whose factor depends on p.

    **Source** Leimkuhler & Matthews 2013, *Appl. Math. Res. Express* 2013, 34; conformally
    symplectic maps: McLachlan & Perlmutter 2001, *J. Geom. Phys.* 39, 276; constraints: Leimkuhler
    & Matthews 2016, *Proc. R. Soc. A* 472, 20160138; Lelièvre, Rousset & Stoltz 2012, *Math. Comp.*
    81, 2071.
    """

    increments: ClassVar[int] = 1


class OBABO(_Splitting):
    r"""The splitting O(h/2) B(h/2) A(h) B(h/2) O(h/2), with the parts of `BAOAB`.

    A step takes two increments: its path for a key is that of `BAOAB` with two substeps.

    **Arguments** as for `BAOAB`. `base` is the map of the halves of the Verlet step.

    **Accuracy** weak order 2, strong order 1. The error of averages of q is O(h²).

    **Raises** `ValueError` as `BAOAB`.

    **Source** Bussi & Parrinello 2007, *Phys. Rev. E* 75, 056707; from variational integrators:
    Bou-Rabee & Owhadi 2010, *SIAM J. Numer. Anal.* 48, 278.
    """

    increments: ClassVar[int] = 2


class StrongSplitting(_Splitting):
    r"""A splitting of strong order 3/2 for noise on the momenta, with the area of the path.

        K(a₁) S(h/2) K(a₂) S(h/2) K(a₃),      K(a): p ← p + σ(t, q) a

    S is a step of `Strang` between two parts of exact friction, p ← e^{−γh/4} p. With the area
    A = (1/h) ∫ B dt − ΔB/2 of the path from the start of the step, normal with the variance h/12,

        a₁ = c − d,   a₂ = 2d,   a₃ = ΔB − c − d,      c = ΔB/2 + A,   d = ΔB/√6

    The path of these kicks has the increment and the integral over time of B, and its square has
    the mean integral h²/2 of B²; this is the choice of d.

    **Arguments** as for `BAOAB`; `base` is the map of which S is composed.

    **Accuracy** strong order 3/2 for σ(t, q) and for `Langevin`; 2 for H_D = Σ p²/(2m) + V(q) if σ
    does not depend on q. Weak order 2. One step needs two evaluations of the force.

    **Raises** `ValueError` as `BAOAB`, and for a path without areas.

    **Source** splitting of paths: Foster, dos Reis & Strange 2024, *SIAM J. Numer. Anal.* 62, 500;
    this path is our own, derived in docs/noise.md.
    """

    increments: ClassVar[int] = 1
    needs_areas: ClassVar[bool] = True

    def fractions(self):
        return (0.25, 0.25, 0.25, 0.25)

    def step(self, equations, interval, q0, p0):
        noise, rows, base = equations.system.noise, equations.increments, self.map_of(equations)
        infos, quarter = [], interval.h / 4
        kicks = (None, None, None)
        if noise is not None and rows is not None:
            middle, width = rows[0] / 2 + rows[1], rows[0] / np.sqrt(6)
            kicks = middle - width, 2 * width, rows[0] - middle - width

        def part(number, q, p):
            """p after the friction and the kick between two S, or at an end of the step."""
            kick = kicks[number]
            if noise is None or kick is None:
                return p
            t = interval.part(number / 2, 1.0).t0
            place = _place(equations, t, q, p)
            noise.check_fixed_momentum(type(self).__name__, *place)
            # At p = 0 the friction vanishes: this is the force of the noise alone.
            place_of_noise = *place[:2], jnp.zeros_like(p), place[3]

            def friction(p, noise=noise):
                damping = noise.kick(*place[:2], p, place[3], quarter, jnp.zeros_like(kick))
                return self.project(equations, t, q, p + damping, quarter, infos)

            p = friction(p) if number > 0 else p
            p = self.project(
                equations, t, q, p + noise.force(*place_of_noise, kick), 0 * quarter, infos
            )
            return friction(p) if number < 2 else p

        q, p = q0, part(0, q0, p0)
        for half in (0, 1):
            ends = half / 2, half / 2 + 0.25, half / 2 + 0.5
            q, p, info = base.step(equations, interval.part(*ends[:2]), q, p)
            infos.append(info)
            q, p, info = base.inverse(equations, interval.part(*ends[1:]).reversed(), q, p)
            infos.append(info)
            p = part(half + 1, q, p)
        return q, p, functools.reduce(StepInfo.then, infos)
