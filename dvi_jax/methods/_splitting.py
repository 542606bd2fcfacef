"""Compositions of the flows of the parts of a Hamiltonian."""

import abc
import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lanewise.jaxprs.dependence import depends_on

from ..base.keywords import user_level
from ..base.types import Interval, State
from ..problem.flows import Flow, Kepler, Known
from ..problem.split import Split
from ..problem.system import System
from ._base import Coordinates, InLoop, Method
from ._gauss_legendre import GaussLegendre
from ._schemes import as_scheme, check_scheme, sequence_of
from ._strang import Strang
from ._type_ii import TypeII
from .step import Equations, StepInfo, judge, no_solve, no_step_yet

_SMALL = 0.1
"""A first part that is smaller than this, relative to the second, causes a warning."""

StateAndInfo = tuple[State, State, StepInfo]


class PartFlow(NamedTuple):
    """The motion of one part, ``advance(interval, q, p)``, and whether it is its exact flow."""

    advance: Callable[[Interval, State, State], StateAndInfo]
    is_exact: bool


class Stage(NamedTuple):
    """One flow of a step: the part, the fractions of the step at its ends, and its length."""

    part: int
    start: float
    end: float
    length: float

    def interval_in(self, interval: Interval) -> Interval:
        # The length is c h, not a difference of times, in which digits cancel.
        return interval.part(self.start, self.end)._replace(h=self.length * interval.h)

    def inverse(self) -> "Stage":
        return Stage(self.part, self.end, self.start, -self.length)


def stages_of(sequence: Sequence[tuple[int, float]], time: float = 0.0) -> list[Stage]:
    # The first part carries the time. The end is no sum of all coefficients, 1 only up to rounding.
    stages, total = [], math.fsum(c for i, c in sequence if i == 0) + time
    for i, c in sequence:
        end = time + c if i == 0 else time
        end = total if i == 0 and abs(end - total) < 1e-12 else end
        stages.append(Stage(i, time, end, c))
        time = end
    return stages


class SplittingMethod(Method):
    """Base of the methods that compose flows of parts. A subclass returns the parts, and the
    coordinates in which they are computed."""

    scheme: eqx.AbstractVar[Any]

    has_coordinates: ClassVar[bool] = False
    """Whether the coordinates of the parts are others than (q, p)."""

    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True

    @property
    def has_corrector(self) -> bool:
        """Whether `correct` changes a state."""
        return False

    @abc.abstractmethod
    def parts(self, equations: Equations, interval: Interval, q: State) -> list[PartFlow]:
        """The flow of each part. **Raises** for a system that has no such parts."""

    def enter(self, equations: Equations, interval: Interval, q: State, p: State) -> StateAndInfo:
        """The state in the coordinates of the parts."""
        return q, p, no_step_yet(q)

    def leave(self, equations: Equations, interval: Interval, q: State, p: State) -> StateAndInfo:
        """The inverse of `enter`."""
        return q, p, no_step_yet(q)

    def correct(
        self, equations: Equations, interval: Interval, q: State, p: State, sign: int
    ) -> StateAndInfo:
        """In these coordinates, a map before the first step (`sign` 1), or its inverse (−1)."""
        return q, p, no_step_yet(q)

    # A type checker would require abstract variables as arguments of every subclass.
    if TYPE_CHECKING:
        order: ClassVar[int]
        is_symmetric: ClassVar[bool]
    else:

        @property
        def order(self) -> int:
            """The order; of a scheme for A + εB that of the terms with the highest power of ε."""
            return self.scheme[-1] if isinstance(self.scheme, tuple) else self.scheme.order

        @property
        def is_symmetric(self) -> bool:
            """Whether the map is its own adjoint."""
            return isinstance(self.scheme, tuple) or self.scheme.is_symmetric

    def substeps(self) -> tuple[float, ...]:
        return tuple(c for i, c in sequence_of(self.scheme, 2) if i == 1)

    def step(self, equations, interval, q0, p0):
        middle = _InCoordinates(self).step
        return _in_turn(equations, interval, q0, p0, self.enter, middle, self.leave)

    def inverse(self, equations, interval, q1, p1):
        middle = _InCoordinates(self).inverse
        return _in_turn(equations, interval, q1, p1, self.enter, middle, self.leave)

    def _sequence(self, equations, interval, q):
        return sequence_of(self.scheme, len(self.parts(equations, interval, q)))

    def compose(
        self, equations: Equations, interval: Interval, q: State, p: State, stages: list[Stage],
        parts: list[PartFlow] | None = None,
    ) -> StateAndInfo:  # fmt: skip
        """One flow after another, by default of the `parts` of the method."""
        parts = self.parts(equations, interval, q) if parts is None else parts

        def advance_all(state, pieces, numbers):
            q, p, info = state
            for i, piece in zip(numbers, pieces, strict=True):
                q, p, part_info = parts[i].advance(piece, q, p)
                info = info.then(part_info)
            return q, p, info

        pieces = [stage.interval_in(interval) for stage in stages]
        part_numbers = [stage.part for stage in stages]
        state = q, p, no_step_yet(q)
        # Neighbours differ, so that stages repeat with this period, as in 0 1 2 1 0 1 2 1 0. A
        # loop over periods is compiled faster than all stages.
        period = max(2 * len(parts) - 2, 1)
        count = len(stages) // period if len(stages) > 2 * period else 0
        if count:
            rounds = [tuple(pieces[k * period : (k + 1) * period]) for k in range(count)]
            stack = jax.tree.map(lambda *xs: jnp.stack(xs), *rounds)
            numbers = part_numbers[:period]
            state, _ = lax.scan(lambda s, x: (advance_all(s, x, numbers), None), state, stack)
        return advance_all(state, pieces[count * period :], part_numbers[count * period :])

    def in_loop(self, equations, interval, q):
        parts = self.parts(equations, interval, q)
        sequence = sequence_of(self.scheme, len(parts))
        # Two flows of the first part are one only if they are exact.
        (_, a), *flows = sequence
        return _joined(self, a) if self.is_symmetric and flows and parts[0].is_exact else None

    def in_coordinates(self, equations, interval, q):
        if not self.has_coordinates:
            return None
        return Coordinates(self.enter, _InCoordinates(self), self.leave)

    def in_equal_steps(self, equations, interval, q):
        coordinates = self.in_coordinates(equations, interval, q)
        if coordinates is None or not self.has_corrector:
            return coordinates
        # C⁻¹ S C, n times, is C⁻¹ Sⁿ C.
        first, last = (functools.partial(self.correct, sign=sign) for sign in (1, -1))
        return Coordinates(
            lambda *state: _in_turn(*state, self.enter, first),
            _InCoordinates(self, corrects=False),
            lambda *state: _in_turn(*state, last, self.leave),
        )

    def needs_no_solve(self, equations, interval, q) -> bool:
        return all(part.is_exact for part in self.parts(equations, interval, q))


def _in_turn(equations: Equations, interval: Interval, q: State, p: State, *maps) -> StateAndInfo:
    """The state after one map after the other, and the status of all."""
    q, p, info = maps[0](equations, interval, q, p)
    # A failure of any of them is one of the step.
    for advance in maps[1:]:
        q, p, later = advance(equations, interval, q, p)
        info = info.then(later)
    return q, p, info


def _joined(method: SplittingMethod, a: float) -> InLoop:
    """(A(a) W A(a))ⁿ is A(a) (W A(2a))ⁿ A(−a), which has one flow less per step."""

    def part(stage: Stage) -> Callable:
        return functools.partial(method.compose, stages=[stage])

    def first(*state):
        # A half flow back: the loop then begins in the middle of the first part.
        before = functools.partial(method.correct, sign=1)
        return _in_turn(*state, method.enter, before, part(Stage(0, 0.0, -a, -a)))

    def step(equations, interval, q, p):
        _, *middle, _ = method._sequence(equations, interval, q)
        return method.compose(equations, interval, q, p, stages_of([(0, 2 * a), *middle], -a))

    def last(*state):
        # The half flow that is left, then out of the coordinates of the parts.
        after = functools.partial(method.correct, sign=-1)
        return _in_turn(*state, part(Stage(0, 1 - a, 1.0, a)), after, method.leave)

    return InLoop(first, step, last)


class _InCoordinates(Method):
    """A method without the conversions to the coordinates of its parts and back."""

    method: SplittingMethod
    corrects: bool = eqx.field(static=True, default=True)

    is_invertible: ClassVar[bool] = True

    is_symplectic: ClassVar[bool] = True
    if TYPE_CHECKING:
        order: ClassVar[int]
        is_symmetric: ClassVar[bool]
    else:

        @property
        def order(self) -> int:
            return self.method.order

        @property
        def is_symmetric(self) -> bool:
            return self.method.is_symmetric

    def needs_no_solve(self, equations, interval, q) -> bool:
        return self.method.needs_no_solve(equations, interval, q)

    def step(self, equations, interval, q0, p0):
        stages = stages_of(self.method._sequence(equations, interval, q0))
        return self._corrected(equations, interval, stages, q0, p0)

    def inverse(self, equations, interval, q1, p1):
        stages = stages_of(self.method._sequence(equations, interval, q1))
        reverse = [stage.inverse() for stage in reversed(stages)]
        return self._corrected(equations, interval, reverse, q1, p1)

    def _corrected(self, equations, interval, stages, q, p) -> StateAndInfo:
        compose = functools.partial(self.method.compose, stages=stages)
        if not self.corrects:
            return compose(equations, interval, q, p)
        before, after = (functools.partial(self.method.correct, sign=sign) for sign in (1, -1))
        return _in_turn(equations, interval, q, p, before, compose, after)


class Splitting(SplittingMethod):
    r"""A composition of the flows of the parts of `Split`; the default of such systems.

        Ψ_h = … φ^B_{b₂h} ∘ φ^A_{a₂h} ∘ φ^B_{b₁h} ∘ φ^A_{a₁h}        (a₁ acts first)

    **Arguments** `scheme`: one of

    - a composition, such as `Strang`, `Yoshida`, `BlanesMoan` or `KahanLi`, for any number of
      parts: its map is one part after the other, its adjoint the opposite order. Neighbouring
      flows of one part are joined, so that ``Strang()`` is A(h/2) B(h) A(h/2).
    - generalised orders (n₁, n₂, …) for two parts A + εB, with an error O(ε h^n₁ + ε² h^n₂ + …):
      (2, 2), (4, 2), … (10, 2) of Laskar & Robutel, (8, 4) of McLachlan, (10, 4), (8, 6, 4) and
      (10, 6, 4) of Blanes et al. They need a small second part, not a small h: a run whose
      initial state is known warns if the first part is the smaller one there.

    A step is explicit where all flows are known or exact. Parts with both q0 and p1 are advanced by
    `GaussLegendre`, of the order of the scheme.

    **Raises** `TypeError` for another scheme and, in a run, for a system whose H_D is not a
    `Split`; `ValueError` for unknown orders, and for generalised orders with more than two parts.

    **Accuracy** order conditions hold to round-off.

    **Source** McLachlan & Quispel 2002, *Acta Numerica* 11, 341; Laskar & Robutel 2001, *Celest.
    Mech. Dyn. Astron.* 80, 39; McLachlan 1995, *BIT* 35, 258; Blanes et al. 2013, *Appl. Numer.
    Math.* 68, 58, tables 3 and 4.
    """

    scheme: Any = eqx.field(static=True, default_factory=Strang, converter=as_scheme)

    def __check_init__(self):
        check_scheme(self.scheme)

    def check(self, equations, first_interval, q, p):
        """**Raises** `ValueError` if a flow of the user is not that of its Hamiltonian there.
        Warns where generalised orders are used with the smaller part first."""
        interval, part_equations = first_interval(), self._part_equations(equations)
        if isinstance(self.scheme, tuple):
            self._check_sizes(part_equations, interval, q, p)
        t, zero = interval.t0, jnp.zeros_like(interval.h)
        for i, equations_i in enumerate(part_equations):
            if isinstance(H_i := equations_i.system.H_D, Known):
                flow = functools.partial(H_i.change, q=q, p=p, args=equations.args)
                change, slope = (jnp.stack(x[:2]) for x in jax.jvp(flow, (zero,), (zero + 1,)))
                rates = jnp.stack(equations_i.rates(Interval(t, t, zero), q, p))
                size = jnp.max(jnp.abs(jnp.stack([q, p, *rates, *slope])))
                defect = jnp.max(jnp.abs(jnp.stack([change, slope - rates])))
                if not defect <= 1e-5 * size:
                    raise ValueError(
                        f"the flow of part {i} of Split must be that of its Hamiltonian: the "
                        "identity at h = 0, with the derivative (∂H/∂p, −∂H/∂q); at the initial "
                        f"state the difference is {defect:.3g}."
                    )

    def _check_sizes(self, part_equations, interval, q, p):
        rates = np.array([equations_i.rates(interval, q, p) for equations_i in part_equations])
        # Positions and momenta have different units: each is relative to the largest one.
        rates = np.abs(rates).reshape(len(rates), 2, -1).max(axis=-1)
        largest = np.maximum(rates.max(axis=0), np.finfo(rates.dtype).tiny)
        first, *others = (rates / largest).max(axis=1)
        # A first part that is at rest, as T(p) at p = 0, is not known to be small.
        if len(others) == 1 and 0 < first < _SMALL * others[0]:
            warnings.warn(
                f"the first part of dvi.Split is the smaller one: at the initial state it changes "
                f"the state {others[0] / first:.2g} times less than the second. The orders "
                f"{self.scheme} hold for A + εB with a small second part: write the larger part "
                "first.",
                stacklevel=user_level(),
            )

    def is_double_only(self, equations) -> bool:
        return any(isinstance(part, Kepler) for part in getattr(equations.system.H_D, "parts", ()))

    def _part_equations(self, equations: Equations) -> list[Equations]:
        """The equations of each part, to one of which the perturbations belong."""
        system = equations.system
        H = system.H_D
        if not isinstance(H, Split):
            raise TypeError(
                f"dvi.Splitting requires dvi.System(dvi.Split([H_A, H_B])), got {H!r:.100}."
            )
        perturbations = system.force, system.perturbation
        parts: list[Any] = [(H_i, None, None) for H_i in H.parts]
        if H.perturbed is not None:
            parts[H.perturbed] = (H.parts[H.perturbed], *perturbations)
        elif perturbations != (None, None):
            parts.append((_no_energy, *perturbations))
        systems = [System(*terms, slow_time=system.slow_time) for terms in parts]
        return [dataclasses.replace(equations, system=system) for system in systems]

    def parts(self, equations, interval, q):
        def part(i, part_equations):
            if isinstance(H_i := part_equations.system.H_D, Flow):
                return _flow_part(equations, H_i)
            is_exact = _is_exact(part_equations, interval, q, has_time=i == 0)
            method = TypeII() if is_exact else GaussLegendre(-(-self.order // 2))
            return PartFlow(functools.partial(method.step, part_equations), is_exact)

        return [part(i, of_part) for i, of_part in enumerate(self._part_equations(equations))]


def _no_energy(t0, t1, q0, p1, args):
    return jnp.zeros((), q0.dtype)


def _flow_part(equations: Equations, flow: Flow) -> PartFlow:
    def advance(interval, q, p):
        dq, dp, converged = flow.change(interval.h, *equations.absolute(q, p), equations.args)
        q, p = q + dq, p + dp
        return q, p, judge(no_solve(q)._replace(converged=converged), q, p)

    return PartFlow(advance, True)


def _is_exact(equations: Equations, interval: Interval, like: State, has_time: bool) -> bool:
    """Whether the map (12)–(13) of this part is its flow: a function of q0 or of p1 alone."""
    t0, t1, _ = interval

    def energy(t, q, p):
        return equations.system.hamiltonian(t, t1, q, p, equations.epsilon, equations.args)

    def rate(t, p):
        return equations.momentum_rate(Interval(t, t1, t0), like, p)

    # At a fixed time its value is that of a constant; the first part is advanced in time.
    if has_time and (
        depends_on(lambda t: energy(t, like, like), 0, t0)
        or depends_on(lambda t: rate(t, like), 0, t0)
    ):
        return False
    of_p = depends_on(lambda p: energy(t0, like, p), 0, like)
    if not of_p:
        return not depends_on(lambda p: rate(t0, p), 0, like)
    return equations.system.force is None and not depends_on(lambda q: energy(t0, q, like), 0, like)
