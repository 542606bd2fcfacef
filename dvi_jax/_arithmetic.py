"""How a state is kept from step to step: rounded, with what rounding loses, or on a grid."""

import dataclasses
import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from ._step import Equations, to_grid
from ._types import Interval, State
from .methods import Method


class Arithmetic(eqx.Module):
    """Base of the ways to keep a state from step to step; what is here keeps it as it is."""

    undoes_steps: ClassVar[bool] = False
    """Whether steps are undone bit for bit, so that none may need a solve."""

    def prepare(
        self, method: Method, equations: Equations, interval: Interval, q0: State, p0: State
    ) -> tuple[Equations, State, State]:
        """The equations and the start as this arithmetic has them, or an error: once per run."""
        return equations, q0, p0

    def start(self, q0: State, p0: State) -> Any:
        """What is remembered beside the state, before the first step."""
        return None

    def enter(
        self, equations: Equations, q0: State, p0: State, memory: Any
    ) -> tuple[Equations, State, State]:
        """The equations and the state that a step of the method begins with."""
        return equations, q0, p0

    def leave(self, q0: State, p0: State, x1: State, y1: State) -> tuple[State, State, Any]:
        """The state after the step, which led to (x1, y1), and what is remembered beside it."""
        return x1, y1, None


class FloatingPoint(Arithmetic):
    """Plain floating point: each step rounds the state (default).

    What the map keeps then makes a random walk, of about 1e-16 √N of its size after N steps in
    float64.
    """


class Compensated(Arithmetic):
    r"""Compensated summation: what rounding takes from the state is kept and given back.

    The state is q + e, with q = fl(q + e) and e below round-off of q. A step of the method runs in
    coordinates x relative to q, where no digits of an increment are lost beside a large q,

        x0 = e,   x0 → x1 by the method,   q ← fl(q + x1),   e ← (q_before − q) + x1   exactly,

    and so for p. What is left is the rounding of the increments themselves, h times smaller: still
    a random walk, if h is no short fraction. With h = 0.05 or 0.1 roundings repeat and add up; take
    a power of two. Any method, explicit or not, forced or not.

    What is saved and observed is q without e. Derivatives are those of the map: e has none. The
    rebuilding of `Reversible` leaves e out.

    **Source** Kahan 1965; Møller 1965. The exact sum: Knuth, *The Art of Computer Programming*
    2, 4.2.2. For symplectic methods: Hairer, Lubich & Wanner 2006, VIII.5.
    """

    def start(self, q0, p0):
        return jnp.zeros_like(q0), jnp.zeros_like(p0)

    def enter(self, equations, q0, p0, memory):
        return dataclasses.replace(equations, origin=(q0, p0)), *memory

    def leave(self, q0, p0, x1, y1):
        q1, lost_q = _exact_sum(q0, x1)
        p1, lost_p = _exact_sum(p0, y1)
        return q1, p1, lax.stop_gradient((lost_q, lost_p))


class FixedPoint(Arithmetic):
    r"""Fixed point: the state moves on a grid, by steps that can be undone bit for bit.

    Positions and momenta are whole multiples of `quantum`, and so is each change of them,

        p1 = p0 + [h (−∂H_D/∂q0 + εW)(t0, t1, q0)],    q1 = q0 + [h ∂H_D/∂p1 (t0, t1, p1)],

    [x] being the multiple nearest to x (half to even, so that [−x] = −[x]). Sums are then exact,
    and a step and its inverse undo each other without any rounding; so do steps by h and −h of a
    symmetric method. The map is one to one on the grid.

    What it takes is that a rate has the same bits whenever it is evaluated at one point. So each of
    its operations is rounded by itself: a compiler joins a product and a sum into one operation
    (FMA), or not, by what stands around. (What is left in arrays, sorting or products of large
    matrices, is not covered: run back to see.) Where the force depends on time, the times forth and
    back must be the same numbers: h a power of two, t0 a multiple of it, and parts of a step
    likewise (`TypeII`, `Adjoint`, `Strang`).

    **Arguments**

    - `quantum`: a power of two [unit of q, and of p], 2.0**-40 for instance. In float64 |q| and |p|
      must stay below 2⁵³ quanta, in float32 below 2²⁴; the status is else `out_of_range`.

    The start is rounded to the grid. The system must be separable, so that no step needs a solve,
    and the method made of the map: `TypeII`, `Adjoint`, `Strang` and the compositions.

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
        if not is_number or not 0 < quantum < math.inf:
            raise ValueError(
                f"quantum must be a positive power of two such as 2.0**-40, got {quantum!r}."
            )
        mantissa, exponent = math.frexp(quantum)
        if mantissa != 0.5:
            raise ValueError(
                f"quantum must be a power of two, so that multiples of it are exact; got "
                f"{quantum!r}, which lies between 2.0**{exponent - 1} and 2.0**{exponent}."
            )

    def prepare(self, method, equations, interval, q0, p0):
        if not method.is_made_of_the_map():
            raise ValueError(
                f"FixedPoint needs a method that is made of the map (12)–(13) and its adjoint; "
                f"{method!r} is not. Take dvi.Strang(), dvi.Yoshida(4) or another composition, "
                "or arithmetic=dvi.Compensated(), which works with every method."
            )
        if not (
            method.needs_no_solve(equations, interval, q0)
            and method.inverse_needs_no_solve(equations, interval, q0)
        ):
            raise ValueError(
                "FixedPoint needs steps without a solve, forwards and backwards: here p1 enters "
                "∂H_D/∂q0 or the force, or q0 enters ∂H_D/∂p1. Take a separable H_D = T(p1) + "
                "V(q0) with a force of q0 and t alone, or arithmetic=dvi.Compensated()."
            )
        smallest, largest = jnp.finfo(q0.dtype).tiny, 1 / jnp.finfo(q0.dtype).tiny
        if not smallest <= self.quantum <= largest:
            raise ValueError(
                f"quantum = {self.quantum!r} is no normal number of {q0.dtype}: take one between "
                f"{smallest:.1e} and {largest:.1e}."
            )
        equations = dataclasses.replace(equations, quantum=self.quantum)
        return equations, _start_on_grid(q0, self.quantum), _start_on_grid(p0, self.quantum)


def _exact_sum(a: State, b: State) -> tuple[State, State]:
    """(s, e) with s = fl(a + b) and s + e = a + b exactly, whichever is larger."""
    s = a + b
    b_seen = s - a
    return s, (a - (s - b_seen)) + (b - b_seen)


def _start_on_grid(x: State, quantum: float) -> State:
    x = to_grid(x, quantum)
    return jnp.where(x == 0, jnp.zeros_like(x), x)  # −0 would come back as +0
