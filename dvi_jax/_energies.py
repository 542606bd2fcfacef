"""The energies that a step takes in and gives out: what the lattice equation (14) balances."""

from typing import Any

import jax
import jax.numpy as jnp

from ._system import System
from ._types import Args, Scalar, State


def outgoing_energy(
    system: System,
    t0: Any,
    t1: Any,
    q0: State,
    p1: State,
    epsilon: Any = 0.0,
    args: Args = None,
    h: Any = None,
) -> Scalar:
    """E⁺ = H_D − h ∂H_D/∂t0 of the step from t0 to t1 [energy], as it leaves its first point.

    `h` is t1 − t0 when left out; give it where that difference has lost digits.
    """
    value, slope = jax.value_and_grad(system.hamiltonian)(t0, t1, q0, p1, epsilon, args)
    return value - (t1 - t0 if h is None else h) * slope


def incoming_energy(
    system: System,
    t0: Any,
    t1: Any,
    q0: State,
    p1: State,
    epsilon: Any = 0.0,
    args: Args = None,
    h: Any = None,
) -> Scalar:
    """E⁻ = H_D + h ∂H_D/∂t1 of the step from t0 to t1 [energy], as it reaches its second point.

    `h` is t1 − t0 when left out; give it where that difference has lost digits.
    """
    value, slope = jax.value_and_grad(system.hamiltonian, argnums=1)(t0, t1, q0, p1, epsilon, args)
    return value + (t1 - t0 if h is None else h) * slope


def disturbing_work(
    system: System,
    t0: Any,
    t1: Any,
    q0: State,
    q1: State,
    p1: State,
    epsilon: Any = 0.0,
    args: Args = None,
) -> Scalar:
    """εW(t0, t1, q0, p1)·(q1 − q0), the work of the disturbance on a step [energy]."""
    return jnp.sum(system.disturbing_force(t0, t1, q0, p1, epsilon, args) * (q1 - q0))
