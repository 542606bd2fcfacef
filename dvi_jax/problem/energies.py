"""The energies at both ends of a step, which the lattice equation (14) balances."""

from typing import Any

import jax
import jax.numpy as jnp

from ..base.types import Args, Scalar, State
from .system import System


def outgoing_energy(
    system: System, t0, t1, q0: State, p1: State, epsilon: Any = 0.0, args: Args = None, h=None
) -> Scalar:
    """E⁺ = H_D − h ∂H_D/∂t0 of the step from t0 to t1 [energy], at its first point.

    `h` is t1 − t0 by default; pass it where that difference has lost digits.
    """
    return _energy(0, system, h, (t0, t1, q0, p1, epsilon, args))


def incoming_energy(
    system: System, t0, t1, q0: State, p1: State, epsilon: Any = 0.0, args: Args = None, h=None
) -> Scalar:
    """E⁻ = H_D + h ∂H_D/∂t1 of the step [energy], at its second point; see `outgoing_energy`."""
    return _energy(1, system, h, (t0, t1, q0, p1, epsilon, args))


def _energy(end: int, system: System, h: Any, point: tuple[Any, ...]) -> Scalar:
    # Value and slope from one evaluation: an H_D may contain a solve.
    value, slope = jax.value_and_grad(system.hamiltonian, argnums=end)(*point)
    h = point[1] - point[0] if h is None else h
    return value + h * slope if end else value - h * slope


def disturbing_work(
    system: System, t0, t1, q0: State, q1: State, p1: State, epsilon: Any = 0.0, args: Args = None
) -> Scalar:
    """εW(t0, t1, q0, p1)·(q1 − q0), the work of the perturbing force on a step [energy]."""
    return jnp.sum(system.disturbing_force(t0, t1, q0, p1, epsilon, args) * (q1 - q0))
