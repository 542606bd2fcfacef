"""The systems of baseline.c as a user of the package writes them."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

EPSILON = 1e-4
A, B, C = 0.5, 0.25, 0.3


def linear_force(t0, t1, q0, p1, args):
    """W = −q0."""
    return -q0


def product(t0, t1, q0, p1, args):
    """H = (q² + 1)(p² + 1)/2."""
    return jnp.sum((q0**2 + 1) * (p1**2 + 1)) / 2


def pendulum(t0, t1, q0, p1, args):
    """Two unit masses on unit rods, unit gravity; canonical angles and momenta."""
    difference = q0[0] - q0[1]
    kinetic = (p1[0] ** 2 + 2 * p1[1] ** 2 - 2 * p1[0] * p1[1] * jnp.cos(difference)) / (
        2 * (1 + jnp.sin(difference) ** 2)
    )
    return kinetic - 2 * jnp.cos(q0[0]) - jnp.cos(q0[1])


def _masses_on_springs(q0, p1):
    d = jnp.diff(jnp.pad(q0, 1))
    return jnp.sum((1 + A * q0**2) * p1**2) / 2 + jnp.sum(d**2 / 2 + C * d**4 / 4)


def chain(t0, t1, q0, p1, args):
    """Σ (1 + A q_i²) p_i²/2 + B Σ q_i q_{i+1} p_i p_{i+1} + Σ (d_i²/2 + C d_i⁴/4), ends fixed."""
    w = q0 * p1
    return _masses_on_springs(q0, p1) + B * jnp.sum(w[1:] * w[:-1])


def web(t0, t1, q0, p1, args):
    """The chain with B over all pairs: ∂²H/∂q∂p is full."""
    w = q0 * p1
    return _masses_on_springs(q0, p1) + B * (jnp.sum(w) ** 2 - jnp.sum(w**2)) / 2


class Workload(NamedTuple):
    """A system of n degrees of freedom, its step, and the kernel of baseline.c that does the same.

    The starts are uniform in a box around `q0`, `p0`, of half width `spread` (for q and p).
    """

    kernel: str
    system: dvi.System
    n: int
    h: float
    q0: Any
    p0: Any
    spread: tuple[float, float]
    is_explicit: bool = False
    energy: Any = None
    args: Any = None

    def start(self, lanes: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """q0 and p0 of shape (n, lanes); (n,) for None. The same every time."""
        rng = np.random.default_rng(5)
        shape = (2, self.n, 1 if lanes is None else lanes)
        box = rng.uniform(-1, 1, shape) * np.reshape(self.spread, (2, 1, 1))
        q0 = np.reshape(self.q0, (-1, 1)) + box[0]
        p0 = np.reshape(self.p0, (-1, 1)) + box[1]
        return (q0[:, 0], p0[:, 0]) if lanes is None else (q0, p0)


def _explicit(problem: systems.Problem, q0, p0, spread) -> Workload:
    energy = problem.observables["energy"]
    return Workload(
        problem.name, problem.system, len(q0), problem.h, q0, p0, spread, True, energy, problem.args
    )


def _implicit(kernel: str, H_D, n: int, half_width: float) -> Workload:
    system = dvi.System(H_D, force=linear_force)
    return Workload(kernel, system, n, 0.02, 0.0, 0.0, (half_width, half_width))


WORKLOADS = {
    "oscillator": _explicit(systems.oscillator(), [1.0], [0.5], (0.1, 0.1)),
    "kepler": _explicit(systems.kepler(), [0.0, 1.2], [-1.0, -0.6], (0.01, 0.01)),
    "product": _implicit("product", product, 1, 0.5),
    "pendulum": _implicit("pendulum", pendulum, 2, 0.5),
    "chain2": _implicit("chain2", chain, 2, 0.5),
    "chain4": _implicit("chain4", chain, 4, 0.5),
    "chain10": _implicit("chain10_tridiagonal", chain, 10, 0.3),
    "web10": _implicit("web10", web, 10, 0.3),
}
"""By name; that of the kernel is the same where there is one alone."""
