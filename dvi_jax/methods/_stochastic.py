"""Methods for systems with noise."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._step import Equations, inverse_step, step
from .._system import System
from .._types import Args, Interval, Scalar, State
from ._base import Method, check_invertible
from ._gauss_legendre import GaussLegendre
from ._type_ii import TypeII

_LARGEST = 6.0
"""Largest increment in an implicit step, in standard deviations."""


class Driven(eqx.Module):
    r"""A system with the noise of one step as constant rates Ḃ = ΔB/h.

    With G = Σ h_m Ḃ_m its Hamiltonian is H_D + G, and that of the map (12)–(13) has one term more,

        H_D + G + (h/2) ∂G/∂q0·∂G/∂p1,

    the next one of the type II generating function p1·q0 + h H_D + ΔB h₁ + … of the flow of G.
    """

    system: System
    rates: Array
    h: Scalar
    is_map: bool = eqx.field(static=True)

    # What a method reads of a system, besides its functions; with noise none has another form.
    H_D: ClassVar[None] = None
    perturbation: ClassVar[None] = None
    force: ClassVar[str] = "also of noise"

    @property
    def noise(self) -> Any:
        return self.system.noise

    def times(self, t0: Scalar, t1: Scalar, epsilon: Scalar) -> tuple[Scalar, Scalar]:
        return self.system.times(t0, t1, epsilon)

    def hamiltonian(
        self, t0: Scalar, t1: Scalar, q0: State, p1: State, epsilon: Scalar, args: Args
    ) -> Scalar:
        H = self.system.hamiltonian(t0, t1, q0, p1, epsilon, args)
        if self.noise.is_on_momenta:
            return H
        s, _ = self.times(t0, t1, epsilon)

        def G(q, p):
            return jnp.asarray(self.noise.energy(s, q, p, args, self.rates), p.dtype)

        if not self.is_map:
            return H + G(q0, p1)
        along_q, along_p = jax.grad(G, (0, 1))(q0, p1)
        return H + G(q0, p1) + self.h / 2 * jnp.sum(along_q * along_p)

    def disturbing_force(
        self, t0: Scalar, t1: Scalar, q0: State, p1: State, epsilon: Scalar, args: Args
    ) -> State:
        s, _ = self.times(t0, t1, epsilon)
        force = self.noise.force(s, q0, p1, args, self.rates)
        return self.system.disturbing_force(t0, t1, q0, p1, epsilon, args) + force


def _driven(equations: Equations, interval: Interval, q: State, p: State, is_map: bool) -> Any:
    """The equations of a step from its increments."""
    system, noise = equations.system, equations.system.noise
    if noise is None:
        return equations
    s, _ = system.times(*interval[:2], equations.epsilon)
    at = (s, *equations.absolute(q, p), equations.args)
    if is_map and noise.depends_on_momentum(*at):
        raise ValueError(_FACTOR.format("dvi.StochasticEuler()"))
    dB = equations.increments
    # Without increments: the equations are only examined, for whether they need a solve.
    dB = jnp.zeros(noise.count(*at), q.dtype) if dB is None else jnp.sum(dB, 0)
    # Arbitrarily large increments, which are arbitrarily rare, would have no solution.
    most = _LARGEST * jnp.sqrt(jnp.abs(interval.h))
    rates = jnp.clip(dB, -most, most) / interval.h
    driven: Any = Driven(system, rates, interval.h, is_map)
    return dataclasses.replace(equations, system=driven, increments=None)


_FACTOR = (
    "the noise of the system has a factor that depends on p, which {} cannot integrate in the "
    "sense of Stratonovich. Use method=dvi.StochasticMidpoint()."
)


class StochasticEuler(Method):
    r"""The symplectic Euler method with noise: the map (12)–(13) of a noisy discrete Hamiltonian.

        q1 = q0 + h ∂S/∂p1,    p1 = p0 − h ∂S/∂q0 + h εW + σ(t0, q0) ΔB
        S  = H_D + G + (h/2) ∂G/∂q0·∂G/∂p1,    G = Σ_m h_m(t0, q0, p1) ΔB_m/h

    Symplectic for each path if W = 0 and without momentum noise that does not derive from noise
    Hamiltonians. Explicit for separable H_D and noise that depends on t and q only.

    **Accuracy** strong and weak order 1 for momentum noise, for one noise Hamiltonian and for ones
    whose Poisson brackets vanish; otherwise strong order 1/2. Increments are limited to six
    standard deviations, which 2 of 10⁹ exceed.

    **Raises** `ValueError` for momentum noise σ that depends on p.

    **Source** Milstein, Repin & Tretyakov 2002, *SIAM J. Numer. Anal.* 39, 2066, and 40, 1583;
    generating functions: Deng, Anton & Wong 2014, *Commun. Comput. Phys.* 16, 1.
    """

    order: ClassVar[int] = 1
    is_symmetric: ClassVar[bool] = False
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True
    noises: ClassVar[int] = 1

    def step(self, equations, interval, q0, p0):
        return step(_driven(equations, interval, q0, p0, True), interval, q0, p0)

    def inverse(self, equations, interval, q1, p1):
        return inverse_step(_driven(equations, interval, q1, p1, True), interval, q1, p1)

    def needs_no_solve(self, equations, interval, q):
        return _driven(equations, interval, q, q, True).step_is_explicit(interval, q)

    def inverse_needs_no_solve(self, equations, interval, q):
        return _driven(equations, interval, q, q, True).inverse_is_explicit(interval, q)


class StochasticMidpoint(Method):
    r"""The implicit midpoint rule with noise, for Stratonovich's equations of every form.

        q1 = q0 + h ∂H/∂p + Σ_m ∂h_m/∂p ΔB_m,    p1 = p0 − h (∂H/∂q − εW) − Σ_m ∂h_m/∂q ΔB_m + σ ΔB

    all at ((q0 + q1)/2, (p0 + p1)/2) and the time in the middle, with H(t, q, p) = H_D(t, t, q, p).
    Symplectic for each path for noise Hamiltonians without W; quadratic invariants of H and of all
    h_m are conserved to round-off.

    **Accuracy** strong order 1 for one noise and for noises that commute, otherwise 1/2; weak order
    1. Increments are limited to six standard deviations.

    **Source** Milstein, Repin & Tretyakov 2002, *SIAM J. Numer. Anal.* 39, 2066, (4.15).
    """

    order: ClassVar[int] = 2
    is_symmetric: ClassVar[bool] = True
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True
    noises: ClassVar[int] = 1

    def step(self, equations, interval, q0, p0):
        return _MIDPOINT.step(_driven(equations, interval, q0, p0, False), interval, q0, p0)

    # The rates are those of the step forwards: back along the same increments.
    def inverse(self, equations, interval, q1, p1):
        return _MIDPOINT.inverse(_driven(equations, interval, q1, p1, False), interval, q1, p1)

    def needs_no_solve(self, equations, interval, q):
        return False

    def inverse_needs_no_solve(self, equations, interval, q):
        return False


_MIDPOINT = GaussLegendre(1)


class _Splitting(Method):
    """Base of the splittings with an exact part of friction and momentum noise."""

    base: Method = eqx.field(default_factory=TypeII)

    order: ClassVar[int] = 2
    is_symmetric: ClassVar[bool] = True
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True

    def __check_init__(self):
        check_invertible("base", self.base)

    def needs_no_solve(self, equations, interval, q):
        forwards = self.base.needs_no_solve(equations, interval, q)
        return forwards and self.base.inverse_needs_no_solve(equations, interval, q)

    def inverse_needs_no_solve(self, equations, interval, q):
        return self.needs_no_solve(equations, interval, q)

    def _kicked(
        self, equations: Equations, interval: Interval, part: int, q: State, p: State, sign: int
    ) -> State:
        """p after the exact flow (`sign` −1: its inverse) of noise and friction at constant q."""
        system, noise, dB = equations.system, equations.system.noise, equations.increments
        if noise is None or dB is None:
            return p
        middle, _ = system.times(interval.part(0.5, 1.0).t0, interval.t1, equations.epsilon)
        at = (middle, *equations.absolute(q, p), equations.args)
        if not noise.is_on_momenta:
            raise ValueError(
                f"dvi.{type(self).__name__}() requires noise on the momenta, but the system has "
                "noise Hamiltonians. Use method=dvi.StochasticMidpoint() or dvi.StochasticEuler()."
            )
        if noise.depends_on_momentum(*at):
            raise ValueError(_FACTOR.format(f"dvi.{type(self).__name__}()"))
        # The inverse of the flow is the flow by −h along −dB.
        return p + noise.kick(*at, sign * interval.h, sign * dB[part])


class BAOAB(_Splitting):
    r"""The splitting B(h/2) A(h/2) O(h) A(h/2) B(h/2) for Langevin's equation.

        B: p ← p + (h/2)(−∂H_D/∂q + εW),    A: q ← q + (h/2) ∂H_D/∂p
        O: p ← e^{−γh} p + √(T m (1 − e^{−2γh})) ΔB/√h          exact; or p ← p + σ(t, q) ΔB

    A B-step and an A-step are the map (12)–(13) over h/2, and after O its adjoint, also for an H_D
    that is not separable, whose halves need a solve. At T = 0 the step contracts areas by e^{−γh}
    exactly: it is conformally symplectic.

    **Arguments** `base`: the map of the halves, any method with an inverse.

    **Accuracy** weak order 2, strong order 1. For separable H_D with p²/(2m) the error of averages
    of q is O(h²); it vanishes for harmonic V, and is O(h⁴) for large γ.

    **Raises** `ValueError` for noise that is not on the momenta, or whose factor depends on p.

    **Source** Leimkuhler & Matthews 2013, *Appl. Math. Res. Express* 2013, 34. Conformally
    symplectic: McLachlan & Perlmutter 2001, *J. Geom. Phys.* 39, 276.
    """

    noises: ClassVar[int] = 1

    def step(self, equations, interval, q0, p0):
        first, second = interval.part(0.0, 0.5), interval.part(0.5, 1.0)
        q, p, info = self.base.step(equations, first, q0, p0)
        p = self._kicked(equations, interval, 0, q, p, 1)
        q, p, later = self.base.inverse(equations, second.reversed(), q, p)
        return q, p, info.then(later)

    def inverse(self, equations, interval, q1, p1):
        first, second = interval.part(0.0, 0.5), interval.part(0.5, 1.0)
        q, p, info = self.base.step(equations, second.reversed(), q1, p1)
        p = self._kicked(equations, interval, 0, q, p, -1)
        q, p, later = self.base.inverse(equations, first, q, p)
        return q, p, info.then(later)


class OBABO(_Splitting):
    r"""The splitting O(h/2) B(h/2) A(h) B(h/2) O(h/2): one Verlet step between two half steps of
    friction and noise; see `BAOAB` for the parts.

    A step takes the increments of both halves, so that its path for a key is that of `BAOAB` with
    two substeps.

    **Arguments** `base`: the map of the halves of the Verlet step, any method with an inverse.

    **Accuracy** weak order 2, strong order 1. The error of averages of q is O(h²) for all γ.

    **Raises** `ValueError` as `BAOAB`.

    **Source** Bussi & Parrinello 2007, *Phys. Rev. E* 75, 056707; Bou-Rabee & Owhadi 2010, *SIAM
    J. Numer. Anal.* 48, 278 (from a variational integrator).
    """

    noises: ClassVar[int] = 2

    def step(self, equations, interval, q0, p0):
        first, second = interval.part(0.0, 0.5), interval.part(0.5, 1.0)
        p = self._kicked(equations, first, 0, q0, p0, 1)
        q, p, info = self.base.step(equations, first, q0, p)
        q, p, later = self.base.inverse(equations, second.reversed(), q, p)
        return q, self._kicked(equations, second, 1, q, p, 1), info.then(later)

    def inverse(self, equations, interval, q1, p1):
        first, second = interval.part(0.0, 0.5), interval.part(0.5, 1.0)
        p = self._kicked(equations, second, 1, q1, p1, -1)
        q, p, info = self.base.step(equations, second.reversed(), q1, p)
        q, p, later = self.base.inverse(equations, first, q, p)
        return q, self._kicked(equations, first, 0, q, p, -1), info.then(later)
