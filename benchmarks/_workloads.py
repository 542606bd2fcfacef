"""The systems of the speed benchmark, and their runs as a user of the package writes them."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.systems.magnetic_mirror import hamiltonian as charged_particle

EPSILON = 1e-4
A, B, C = 0.5, 0.25, 0.3
SAVE_EVERY = 10


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

    The initial conditions are uniform in a box around `q0`, `p0`, of half width `spread` (for q
    and p). `is_explicit`: the kernel makes no iterations. `method` None: the package's default.
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
    method: Any = None

    def start(self, lanes: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """q0 and p0 of shape (n, lanes); (n,) for None. The same every time."""
        rng = np.random.default_rng(5)
        shape = np.shape(self.q0) or (self.n,)
        box = rng.uniform(-1, 1, (2, *shape, 1 if lanes is None else lanes))
        q0, p0 = (
            np.broadcast_to(middle, shape)[..., None] + half_width * x
            for middle, half_width, x in zip((self.q0, self.p0), self.spread, box, strict=True)
        )
        return (q0[..., 0], p0[..., 0]) if lanes is None else (q0, p0)

    def inputs(self, lanes: int, axis: int) -> tuple[jax.Array, jax.Array]:
        """The same as arrays of JAX, with the trajectories along `axis`."""
        q0, p0 = (np.moveaxis(x, -1, axis) for x in self.start(lanes))
        return jnp.asarray(np.ascontiguousarray(q0)), jnp.asarray(np.ascontiguousarray(p0))


def _explicit(problem: systems.Problem, q0, p0, spread) -> Workload:
    energy = problem.observables["energy"]
    return Workload(
        problem.name, problem.system, len(q0), problem.h, q0, p0, spread, True, energy, problem.args
    )


def _implicit(kernel: str, H_D, n: int, half_width: float, method=None) -> Workload:
    system = dvi.System(H_D, force=linear_force)
    spread = (half_width, half_width)
    return Workload(kernel, system, n, 0.02, 0.0, 0.0, spread, method=method)


def _mirror(kernel: str, method=None) -> Workload:
    """The magnetic mirror with W = −q0; the kernel solves the linear equation for p1 directly."""
    problem = systems.magnetic_mirror()
    return Workload(
        kernel,
        dvi.System(charged_particle, force=linear_force),
        3,
        problem.h,
        problem.q0,
        problem.p0,
        (0.1, 0.1),
        is_explicit=True,
        args=problem.args,
        method=method,
    )


def _bodies() -> Workload:
    """A star and seven planets on nearly circular orbits, for which there is no kernel of C."""
    radius, angle, mass = 1 + np.arange(7) / 2, 2.4 * np.arange(7), 1e-4
    outwards = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    q0 = np.concatenate([np.zeros((1, 3)), radius[:, None] * outwards])
    p0 = mass * np.concatenate([np.zeros((1, 3)), along / np.sqrt(radius)[:, None]])
    problem = systems.n_body([1.0] + [mass] * 7, q0, p0)
    return Workload(
        "", problem.system, 24, problem.h, q0, p0, (1e-3, 1e-6), True, args=problem.args
    )


WORKLOADS = {
    "oscillator": _explicit(systems.oscillator(), [1.0], [0.5], (0.1, 0.1)),
    "kepler": _explicit(systems.kepler(), [0.0, 1.2], [-1.0, -0.6], (0.01, 0.01)),
    "product": _implicit("product", product, 1, 0.5),
    "pendulum": _implicit("pendulum", pendulum, 2, 0.5),
    "pendulum_gauss": _implicit("pendulum_gauss", pendulum, 2, 0.5, dvi.GaussLegendre(2)),
    "pendulum_yoshida": _implicit("pendulum_yoshida", pendulum, 2, 0.5, dvi.Yoshida(4)),
    "pendulum_kahan_li": _implicit("", pendulum, 2, 0.5, dvi.KahanLi(8)),
    "mirror": _mirror("mirror"),
    "boris": _mirror("boris", dvi.Boris()),
    "chain2": _implicit("chain2", chain, 2, 0.5),
    "chain4": _implicit("chain4", chain, 4, 0.5),
    "chain10": _implicit("chain10_tridiagonal", chain, 10, 0.3),
    "chain1000": _implicit("", chain, 1000, 0.3),
    "web10": _implicit("web10", web, 10, 0.3),
    "bodies": _bodies(),
}
"""Workloads by name. `kernel` is the name of the C kernel, empty for workloads without one."""


def run_of(w: Workload, steps: int, *, save=None, observe=None, epsilon=EPSILON, **settings):
    """(q0, p0) → solution: what a user writes for one trajectory."""
    if w.method is not None:
        settings["method"] = w.method

    def one(q0, p0, epsilon=epsilon):
        return dvi.integrate(
            w.system,
            q0,
            p0,
            h=w.h,
            num_steps=steps,
            epsilon=epsilon,
            args=w.args,
            save=dvi.Save(final=True) if save is None else save,
            observe=observe,
            throw=False,
            **settings,
        )

    return one


def last_state(w: Workload, steps: int, **settings):
    """(q0, p0) → state after the last step, and status."""
    one = run_of(w, steps, **settings)

    def final(*inputs):
        sol = one(*inputs)
        return sol.qs[-1], sol.ps[-1], sol.result

    return final


def last_and_invariants(w: Workload, steps: int):
    """(q0, p0) → state after the last step, drift and trend of the energy, status."""
    one = run_of(w, steps, observe=(dvi.MaxDrift(w.energy), dvi.Trend(w.energy)))

    def final(*inputs):
        sol = one(*inputs)
        return sol.qs[-1], sol.ps[-1], sol.observed, sol.result

    return final


def saved_states(w: Workload, steps: int):
    """(q0, p0) → every tenth state, and status."""
    one = run_of(w, steps, save=dvi.Save(every=SAVE_EVERY))

    def final(*inputs):
        sol = one(*inputs)
        return sol.qs, sol.ps, sol.result

    return final


def batched(one, axis: int = -1):
    """`one` for many trajectories along an axis of its inputs and outputs."""
    return jax.vmap(one, in_axes=axis, out_axes=axis)


def loss_of(w: Workload, steps: int, adjoint=None, axis: int = -1):
    """(q0, p0) → Σ over trajectories of (|q|² + |p|²)/2 after the last step."""
    f = batched(last_state(w, steps, adjoint=adjoint or dvi.Reversible()), axis)

    def loss(q0, p0):
        q1, p1, _ = f(q0, p0)
        return (jnp.sum(q1**2) + jnp.sum(p1**2)) / 2

    return loss
