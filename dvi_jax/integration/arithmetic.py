"""Representations of a state: rounded, with the rounding error, or on a grid."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from lanewise.rules.exact import two_sum

from ..base.types import State
from ..engine.in_pairs import in_pairs
from ..engine.pairs import Pair
from ..methods import Method
from ..methods.step import Equations, to_grid


class Arithmetic(eqx.Module):
    """Base of the representations of a state between steps. The defaults change nothing."""

    undoes_steps: ClassVar[bool] = False
    """Whether steps are undone bit for bit, so that none may need a solve."""

    is_plain: ClassVar[bool] = False
    """Whether a step of the method begins and ends with the state itself."""

    def prepare(
        self, method: Method, equations: Equations, first_interval: Callable, q0: State, p0: State
    ) -> tuple[Equations, State, State]:
        """The equations and the start in this representation, once per run. **Raises**
        `ValueError` for a method or equations that it does not support."""
        return equations, q0, p0

    def start(self, q0: State, p0: State) -> Any:
        """The memory next to the state, before the first step."""
        return None

    def enter(
        self, equations: Equations, q0: State, p0: State, memory: Any
    ) -> tuple[Equations, State, State]:
        """The equations and the state with which a step of the method begins."""
        return equations, q0, p0

    def leave(self, q0: State, p0: State, x1: State, y1: State) -> tuple[State, State, Any]:
        """The state after a step from (q0, p0), whose result is (x1, y1), and the memory."""
        return x1, y1, None

    def full_state(self, q: State, p: State, memory: Any) -> tuple[Any, Any]:
        """The state as arguments of a function for `interpret`."""
        return q, p

    def interpret(self, function: Callable) -> Callable:
        """A function, the step of a method or a part of an observable, in this representation."""
        return function


class FloatingPoint(Arithmetic):
    """Plain floating point: each step rounds the state (default).

    Invariants of the map perform a random walk, of relative size 1e-16 √N in N steps in float64.
    """

    is_plain: ClassVar[bool] = True


class Compensated(Arithmetic):
    r"""Compensated summation: the rounding error of each step is stored and added in the next.

    The state is q + e, with q = fl(q + e) and e below round-off of q. A step of the method runs in
    coordinates x relative to q, where no digits of an increment are lost next to a large q,

        x0 = e,   x0 → x1 by the method,   q ← fl(q + x1),   e ← (q_before − q) + x1   exactly,

    and likewise for p. The rounding of the increments remains, h times smaller: still a random
    walk, unless h is a short decimal fraction. With h = 0.05 or 0.1 rounding errors repeat and add
    up; choose a power of two. Works with every method, explicit or implicit, forced or not.

    Saved and observed values are q without e. Derivatives are those of the map; e has none. The
    reconstruction of `Reversible` omits e.

    **Source** Kahan 1965; Møller 1965. The exact sum: Knuth, *The Art of Computer Programming*
    2, 4.2.2. For symplectic methods: Hairer, Lubich & Wanner 2006, VIII.5.
    """

    def start(self, q0, p0):
        return jnp.zeros_like(q0), jnp.zeros_like(p0)

    # The origin changes in every step: the increments stay small next to it all along.
    def enter(self, equations, q0, p0, memory):
        return dataclasses.replace(equations, origin=(q0, p0)), *memory

    def leave(self, q0, p0, x1, y1):
        # Of values that need not be ordered: an increment may be larger than a coordinate.
        q1, lost_q = two_sum(q0, x1)
        p1, lost_p = two_sum(p0, y1)
        # In exact arithmetic the errors are zero, and so are their derivatives.
        return q1, p1, lax.stop_gradient((lost_q, lost_p))


class DoubleDouble(Arithmetic):
    r"""Pairs of float64 numbers: steps and observables with about 31 digits.

    The state is q + e, with q = fl(q + e), as in `Compensated`; but each operation of a step is on
    pairs, with relative errors of about 1e-32 (elementary functions below 5e-31, powers and
    atan2 below 1e-30). Implicit solves and the observables in reductions are computed in pairs,
    too: with ``observe=dvi.MaxDrift(f)`` a drift of 1e-25 is measured, and not the rounding of f.
    sin, cos and tan are NaN for |x| > 2⁴⁵, and numbers below 1e-290 have fewer digits.
    It works with every method.

    The map is that of the numbers in float64 that define it: initial conditions, h, times of the
    grid, args, ε, and constants in your functions. Coefficients of the collocation methods are
    pairs, so that quadratic invariants hold to 31 digits too.

    Saved states are q without e; observables without a reduction, `Stop`, `Section` and deviation
    vectors are evaluated at them in float64. Derivatives are those of the map in float64.

    In a batch a step takes 8 to 32 times as long as with `FloatingPoint`, in machine code.

    **Raises** `ValueError` for a state that is not float64, `NotImplementedError` for a function
    with an operation that has no rule (`jax.scipy.special.erf`, factorisations of matrices, sorts).

    **Source** Dekker 1971, *Numer. Math.* 18, 224; Joldes et al. 2017, *ACM TOMS* 44, 15.
    """

    def prepare(self, method, equations, first_interval, q0, p0):
        if q0.dtype != jnp.float64:
            raise ValueError(
                f"arithmetic=dvi.DoubleDouble() requires q0 and p0 in float64, got {q0.dtype}: "
                'call jax.config.update("jax_enable_x64", True) first and convert them.'
            )
        if method.is_double_only(equations):
            raise ValueError(
                f"arithmetic=dvi.DoubleDouble() cannot be used with method={method!r:.100}, whose "
                "Kepler flow has the accuracy of float64: use another, such as dvi.KahanLi(8)."
            )
        return equations, q0, p0

    start = Compensated.start

    def enter(self, equations: Equations, q0: State, p0: State, memory: Any) -> tuple:
        return equations, *self.full_state(q0, p0, memory)

    def leave(self, q0: State, p0: State, x1: Any, y1: Any) -> tuple[State, State, Any]:
        return x1.hi, y1.hi, lax.stop_gradient((x1.lo, y1.lo))

    def full_state(self, q, p, memory):
        return Pair(q, memory[0]), Pair(p, memory[1])

    # The whole step is interpreted, so that no method needs code of its own for pairs.
    def interpret(self, function):
        return functools.partial(in_pairs, function)


class FixedPoint(Arithmetic):
    r"""Fixed-point arithmetic: the state is on a grid, and steps can be inverted bit for bit.

    Positions and momenta are integer multiples of `quantum`, and so is each change of them,

        p1 = p0 + [h (−∂H_D/∂q0 + εW)(t0, t1, q0)],    q1 = q0 + [h ∂H_D/∂p1 (t0, t1, p1)],

    [x] is the multiple nearest to x (half to even, so that [−x] = −[x]). Sums are then exact, and a
    step and its inverse undo each other without rounding; so do steps by h and −h of a symmetric
    method. The map is one to one on the grid.

    A rate must have the same bits in every evaluation at the same point. Therefore each of its
    operations is rounded separately: a compiler may contract a product and a sum into one operation
    (FMA), or not, depending on the surrounding code. (Operations that stay in arrays, sorting or
    products of large matrices, are not covered: integrate backwards to check.) Where the force
    depends on time, the times in both directions must be the same numbers: h a power of two, t0 a
    multiple of it, and substeps likewise (`TypeII`, `Adjoint`, `Strang`).

    **Arguments**

    - `quantum`: a power of two [unit of q, and of p], 2.0**-40 for instance. In float64 |q| and |p|
      must stay below 2⁵³ quanta, in float32 below 2²⁴; otherwise the status is `out_of_range`.

    The start is rounded to the grid. The system must be separable, so that no step needs a solve,
    and the method composed of the map: `TypeII`, `Adjoint`, `Strang` and the compositions.

    Derivatives are those of the map without rounding: [·] has slope 1.

    **Raises** `ValueError` for another `quantum`, method or system.

    **Source** Earn & Tremaine 1992, *Physica D* 56, 1; Levesque & Verlet 1993, *J. Stat. Phys.*
    72, 519.
    """

    quantum: float = eqx.field(static=True)

    undoes_steps: ClassVar[bool] = True

    def __check_init__(self):
        quantum = self.quantum
        is_number = isinstance(quantum, int | float) and not isinstance(quantum, bool)
        # A power of two: multiplication by it and by its reciprocal is exact, and so are sums.
        if not is_number or not 0 < quantum < math.inf or math.frexp(quantum)[0] != 0.5:
            raise ValueError(
                f"quantum must be a power of two, such as 2.0**-40, got {quantum!r} (type "
                f"{type(quantum).__name__})."
            )

    def prepare(self, method, equations, first_interval, q0, p0):
        if not method.is_made_of_the_map():
            raise ValueError(
                "arithmetic=dvi.FixedPoint(...) requires a method composed of dvi.TypeII() and its "
                f"adjoint, such as dvi.Strang() or dvi.Yoshida(4), got {method!r}."
            )
        interval = first_interval()
        if not (
            method.needs_no_solve(equations, interval, q0)
            and method.inverse_needs_no_solve(equations, interval, q0)
        ):
            raise ValueError(
                "arithmetic=dvi.FixedPoint(...) requires explicit steps, also backwards: H_D and "
                "the perturbation must be separable, T(p1) + V(q0), and the force independent of "
                "p1."
            )
        # Both the quantum and its reciprocal, by which a state is multiplied, must be normal.
        smallest, largest = jnp.finfo(q0.dtype).tiny, 1 / jnp.finfo(q0.dtype).tiny
        if not smallest <= self.quantum <= largest:
            raise ValueError(
                f"quantum = {self.quantum!r} is too small or too large for a state in {q0.dtype}: "
                f"it must be from {smallest:.1e} to {largest:.1e}."
            )
        equations = dataclasses.replace(equations, quantum=self.quantum)
        return equations, _start_on_grid(q0, self.quantum), _start_on_grid(p0, self.quantum)


def _start_on_grid(x: State, quantum: float) -> State:
    x = to_grid(x, quantum)
    return jnp.where(x == 0, jnp.zeros_like(x), x)  # the inverse step would return −0 as +0
