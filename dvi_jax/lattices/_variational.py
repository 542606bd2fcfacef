"""Steps that solve the lattice equation (14)."""

from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

import lanewise

from ..base.checks import one_of, require_system
from ..base.results import RESULTS
from ..base.types import Interval, Scalar, State
from ..engine.bracket import bracketed_root, divide
from ..methods.step import Equations, step
from ..problem.energies import disturbing_work, incoming_energy, outgoing_energy
from ..problem.system import System
from ._base import StepSizes, check_rounding

Policy = Literal["stop", "hold", "minimise"]

_CELLS = 16
"""Cells on each side of the last h that are searched for a change of sign."""

_GOLDEN = 0.6180339887498949
# Each step shortens the interval by that factor, 40 of them to 4e-9 ≈ √ε: the values near a minimum
# are equal to rounding within that distance, so that more steps would find nothing better.
_GOLDEN_STEPS = 40


class BalanceState(NamedTuple):
    """State of the lattice equation between steps."""

    t: Scalar  # where the next step begins
    h: Scalar  # size of the last step
    energy: Scalar  # E⁻ of the last step [energy]
    misses: Int[Array, ""]  # steps without a root
    defect: Scalar  # largest |E⁺ − E⁻ − εW·Δq| so far [energy]


class Variational(StepSizes):
    r"""The lattice of the discrete variational principle: h solves equation (14), corrected,

        E⁺_k − E⁻_k = εW_k·(q_{k+1} − q_k),      E⁺ = H_D − h ∂H_D/∂t0,   E⁻ = H_D + h ∂H_D/∂t1

    together with (12) and (13): stationarity of the discrete action in t_k. Where it holds, the
    energy is in exact balance with the discrete work of the perturbing force: for an autonomous H_D
    without a force H_D(q_k, p_{k+1}) is the same number on every step. The first step is the h
    given to `integrate`; each further one is the root nearest to the step before it, of the same
    sign and within `reach` and `bounds`.

    **Arguments**

    - `on_no_root`: the policy where no h in reach balances the energy. ``"stop"``: end with the
      status `no_root`. ``"hold"``: repeat the last h. ``"minimise"``: use the h in reach with the
      smallest defect. The balance then restarts from the energy of that step.
    - `reach`: largest ratio between a step and the one before it, in both directions.
    - `bounds`: the smallest and the largest step allowed, as multiples of the first. Without them
      steps may tend to 0, where time stops, or to infinity.

    ``solution.stats`` has ``lattice_misses``, the number of steps without a root, and
    ``lattice_defect``, the largest |E⁺ − E⁻ − εW·Δq| [energy], those steps included. For `TypeII`
    only, since these are its equations; of higher order with ``dvi.discretise(H, order=r)``.
    Gradients are those of the equations, by the implicit function theorem; `Reversible` works as
    `Checkpointed`, because a step cannot be undone without the one before it.

    **Limits** For an H_D of first order there is no root near turning points and apsides. The
    higher the order, the flatter is E⁺ as a function of h: its condition number
    (`LatticeCondition`) scales as h^{−order}, and h is uncertain by as many units of round-off.
    Where E⁺ does not depend on h (free motion) the last h is repeated. The map is not symplectic on
    a fixed grid, since steps depend on the state. `TimeTransformed` has none of these limits.

    **Raises** `ValueError` for another policy or a reach not above 1.

    **Source** the paper's (5), (11) and (14), with the signs of (11); Kane, Marsden & Ortiz 1999,
    *J. Math. Phys.* 40, 3353 (symplectic-energy-momentum integrators, and their failures).
    """

    on_no_root: Policy = eqx.field(static=True, default="stop")
    reach: float = eqx.field(static=True, default=10.0)
    bounds: tuple[float, float] = eqx.field(static=True, default=(1e-3, 1e3))

    has_memory: ClassVar[bool] = True

    def __check_init__(self):
        one_of("on_no_root", self.on_no_root, get_args(Policy))
        if not (isinstance(self.reach, int | float) and 1 < self.reach < float("inf")):
            raise ValueError(
                f"reach of Variational must be finite and above 1, got {self.reach!r}."
            )
        try:
            smallest, largest = map(float, self.bounds)
        except (TypeError, ValueError):
            smallest, largest = 1.0, 0.0
        if not 0 < smallest <= 1 <= largest < float("inf"):
            raise ValueError(
                "bounds of Variational must be finite numbers (smallest, largest) with 0 < "
                f"smallest ≤ 1 ≤ largest, ratios to the first step, got {self.bounds!r}."
            )

    def check(self, method, arithmetic):
        if not method.is_the_map:
            raise ValueError(
                f"lattice=dvi.Variational() requires method=dvi.TypeII(), got {method!r}. For a "
                "higher order use dvi.discretise(H, order=2)."
            )
        check_rounding(type(self).__name__, arithmetic)

    def interval(self, t0, h, k):
        return Interval(t0, t0 + h, h)

    def begin(self, t0, h):
        zero = jnp.zeros_like(h)
        return BalanceState(t0, h, zero, jnp.asarray(0, jnp.int32), zero)

    def next(self, memory, equations, place):
        def energies(h):
            return _energies(equations, memory.t, h, place.q, place.p)

        def residual(h):
            return energies(h).imbalance(memory.energy)

        # The first step has no energy to balance. It is chosen by `where`, after the search: a
        # branch would be evaluated for every trajectory of a batch anyway.
        first = place.k == 0
        scale = jnp.abs(memory.energy) + energies(memory.h).size
        candidates = memory.h * self._factors(memory.h / place.h)
        h, is_root = self._choose(residual, candidates, lax.stop_gradient(scale))
        h, is_root = jnp.where(first, place.h, h), first | is_root
        balance = energies(h)
        defect = jnp.where(first, 0.0, jnp.abs(balance.imbalance(memory.energy)))
        interval = Interval(memory.t, memory.t + h, h)
        misses = memory.misses + jnp.where(is_root, 0, 1)
        defect = jnp.maximum(memory.defect, lax.stop_gradient(defect))
        memory = BalanceState(interval.t1, h, balance.incoming, misses, defect)
        if self.on_no_root != "stop":
            return interval, memory, None
        return interval, memory, RESULTS.where(is_root, RESULTS.successful, RESULTS.no_root)

    def report(self, memory, equations, place):
        misses, defect = memory.misses, memory.defect
        return {"last_h": memory.h, "lattice_misses": misses, "lattice_defect": defect}

    def _factors(self, growth: Scalar) -> Array:
        """Candidate ratios to the last step, which is `growth` times the first; 1 in the middle."""
        smallest, largest = (jnp.asarray(b, growth.dtype) / growth for b in self.bounds)
        # The last step stays in the range, also if rounding has moved it beyond a bound.
        low = jnp.clip(smallest, 1 / self.reach, 1)
        high = jnp.clip(largest, 1, self.reach)
        # A geometric grid: cells are narrow near the last step, where the root usually is.
        powers = jnp.linspace(0.0, 1.0, _CELLS + 1, dtype=growth.dtype)
        factors = jnp.concatenate([(low**powers)[:0:-1], high**powers])
        return lax.stop_gradient(factors)

    def _choose(self, residual: Callable, hs: Array, scale: Scalar) -> tuple[Scalar, Array]:
        """The root nearest to the middle one of `hs`, or the h of the policy; is it a root?"""
        last = hs[_CELLS]
        fixed = lax.stop_gradient(hs)
        # One candidate after the other: each may need a solve of its own, of another length.
        values = lax.stop_gradient(lax.map(residual, fixed))
        # The energy does not depend on h beyond round-off: every h is a root.
        flat = jnp.all(jnp.abs(values) <= 8 * jnp.finfo(hs.dtype).eps * scale)

        # Cell i is [hs[i], hs[i + 1]]. NaN, where (13) has no solution, is not a change of sign.
        changes = (jnp.sign(values[:-1]) * jnp.sign(values[1:]) <= 0) & (jnp.diff(fixed) != 0)
        # If equal values at both ends change sign, both are zero: the left end is a root.
        slopes = jnp.diff(values) / jnp.diff(fixed)
        crossing = fixed[:-1] - jnp.where(slopes == 0, 0, values[:-1] / slopes)
        nearest = jnp.argmin(jnp.where(changes, jnp.abs(crossing - fixed[_CELLS]), jnp.inf))
        has_root = jnp.any(changes) & ~flat
        left, right = ((fixed[i], values[i]) for i in (nearest, nearest + 1))
        root = bracketed_root(residual, *left, *right, has_root)
        h = jnp.where(has_root, root, last)
        if self.on_no_root == "minimise":
            is_minimum = ~flat & ~has_root
            h = jnp.where(is_minimum, _minimum(residual, hs, values, is_minimum), h)
        is_root = has_root | flat
        # A step of NaN ends the run, also with a policy that would go on.
        is_invalid = jnp.all(jnp.isnan(values)) | (~is_root & (self.on_no_root == "stop"))
        return jnp.where(is_invalid, jnp.nan, h), is_root


class LatticeCondition(eqx.Module):
    r"""Observable: the condition number of the lattice equation (14) in h, for each step.

        κ = (|E⁺| + |E⁻| + |εW·Δq|) / |h ∂(E⁺ − εW·Δq)/∂h|        along (12)–(13) from (q0, p0)

    A relative error δ in the energies changes h by the relative amount κδ: at κ = 1e13 the step
    sizes of `Variational` have three digits in float64. Infinite where the energy has zero slope,
    at the folds beyond which there is no root.

    **Arguments** `system`, `epsilon`: those of the run, which sets them where they are left out.
    """

    system: System | None = None
    epsilon: Any = 0.0

    def bind(self, system: System, epsilon: Any) -> "LatticeCondition":
        """The same observable for this system and strength ε."""
        return LatticeCondition(system, epsilon)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        require_system("LatticeCondition", self.system)
        equations = Equations(self.system, self.epsilon, args)

        def balance(h):
            energies = _energies(equations, t0, h, q0, p0)
            return energies.outgoing - energies.work, energies.size

        h = t1 - t0
        slope, size = jax.grad(balance, has_aux=True)(h)
        return size / jnp.abs(h * slope)


class _Energies(NamedTuple):
    """E⁺, E⁻ and εW·Δq of one step, and the sum of their magnitudes [energy]."""

    outgoing: Scalar
    incoming: Scalar
    work: Scalar
    size: Scalar

    def imbalance(self, energy: Scalar) -> Scalar:
        """E⁺ − E⁻ − εW·Δq with E⁻ = `energy` of the step before."""
        return self.outgoing - energy - self.work


def _energies(equations: Equations, t: Scalar, h: Scalar, q: State, p: State) -> _Energies:
    """The energies of the step (12)–(13) of size h from (q, p) at t; NaN without a solution."""
    interval = Interval(t, t + h, h)
    q1, p1, info = step(equations, interval, q, p)
    # The energy of a p1 that does not solve (13) could change sign where there is no root.
    p1 = jnp.where(info.result == RESULTS.successful, p1, jnp.nan)
    start = equations.system, *interval[:2], q
    parameters = p1, equations.epsilon, equations.args
    outgoing = outgoing_energy(*start, *parameters, h)
    incoming = incoming_energy(*start, *parameters, h)
    work = disturbing_work(*start, q1, *parameters)
    size = jnp.abs(outgoing) + jnp.abs(incoming) + jnp.abs(work)
    return _Energies(outgoing, incoming, work, size)


def _minimum(residual: Callable, hs: Array, values: Array, is_minimum: Array) -> Scalar:
    """The h with the smallest |residual| near the best of `hs`; an end of `hs` if that is it."""
    fixed = lax.stop_gradient(hs)
    best = jnp.argmin(jnp.where(jnp.isnan(values), jnp.inf, jnp.abs(values)))
    in_interior = is_minimum & (best > 0) & (best + 1 < hs.size)

    def search(_, h):
        a, b = fixed[jnp.maximum(best - 1, 0)], fixed[jnp.minimum(best + 1, hs.size - 1)]
        return jnp.where(in_interior, _golden_section(lambda h: jnp.abs(residual(h)), a, b), h), ()

    # The derivative of a minimum is that of the root of the slope; of an end, that of the end.
    def stationary(h):
        return jnp.where(in_interior, jax.grad(residual)(h), h - hs[best])

    return lanewise.implicit_root(stationary, fixed[best], search, divide)[0]


def _golden_section(f: Callable, a: Scalar, b: Scalar) -> Scalar:
    """The minimum of f between a and b, to the square root of round-off."""

    def narrow(_, state):
        a, b = state
        left, right = b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)
        keeps_left = f(left) <= f(right)
        return jnp.where(keeps_left, a, left), jnp.where(keeps_left, right, b)

    a, b = lax.fori_loop(0, _GOLDEN_STEPS, narrow, (a, b))
    return (a + b) / 2
