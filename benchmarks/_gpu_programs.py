"""The programs of the GPU's benchmarks and tests: batches of trajectories of five systems.

Each function takes the number of trajectories, the number of steps and a `dvi.Layout`, and returns
(the function of one trajectory, the inputs of the batch).
"""

import jax
import jax.numpy as jnp
import numpy as np
from _workloads import WORKLOADS, pendulum as double_pendulum

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.systems import boozer


def _final(sol):
    return sol.qs[-1], sol.ps[-1], sol.result


def kepler(lanes, steps, layout, save=None, dtype=float):
    problem = systems.kepler()
    r = np.linspace(0.8, 1.2, lanes)[:, None]
    q, p = r * np.asarray(problem.q0), np.broadcast_to(problem.p0, (lanes, 2)) / np.sqrt(r)

    def one(q, p):
        sol = dvi.integrate(
            problem.system, q, p, h=0.05, num_steps=steps, args=problem.args, layout=layout,
            method=dvi.Yoshida(4), save=save or dvi.Save(final=True), throw=False,
        )  # fmt: skip
        return (sol.qs, sol.ps, sol.result) if save else _final(sol)

    return one, (q.astype(dtype), p.astype(dtype))


def kepler_saved(lanes, steps, layout, every=10):
    return kepler(lanes, steps, layout, dvi.Save(every=every))


def kepler_float32(lanes, steps, layout):
    return kepler(lanes, steps, layout, dtype=np.float32)


def pendulum(lanes, steps, layout, **options):
    def one(q, p):
        return _final(dvi.integrate(
            dvi.System(double_pendulum), q, p, h=0.02, num_steps=steps, save=dvi.Save(final=True),
            throw=False, layout=layout, **options,
        ))  # fmt: skip

    return one, tuple(np.random.default_rng(5).uniform(-0.5, 0.5, (2, lanes, 2)))


def pendulum_gradient(lanes, steps, layout):
    one, inputs = pendulum(lanes, steps, layout, adjoint=dvi.Reversible())

    def loss(q, p):
        q, p, _ = one(q, p)
        return (jnp.sum(q**2) + jnp.sum(p**2)) / 2

    return jax.grad(loss, argnums=(0, 1)), inputs


def bodies(lanes, steps, layout):
    case = WORKLOADS["bodies"]

    def one(q, p):
        return _final(dvi.integrate(
            case.system, q, p, h=case.h, num_steps=steps, args=case.args,
            save=dvi.Save(final=True), throw=False, layout=layout,
        ))  # fmt: skip

    spread = np.random.default_rng(5).uniform(-1, 1, (2, lanes, 8, 3))
    return one, (case.q0 + case.spread[0] * spread[0], case.p0 + case.spread[1] * spread[1])


def alphas(lanes, steps, layout):
    particles = boozer.GuidingCentres(boozer.precise_qa())
    x = np.linspace(0, 1, lanes)
    q, p, args = particles.start(0.1 + 0.3 * x, 40 * x, 7 * x, 0.9 * np.sin(50 * x))

    def one(q, p, mu):
        return _final(dvi.integrate(
            particles.system, q, p, h=particles.h, num_steps=steps, args={**args, "mu": mu},
            method=dvi.GaussLegendre(2), save=dvi.Save(final=True), throw=False, layout=layout,
        ))  # fmt: skip

    return one, tuple(map(np.asarray, (q, p, args["mu"])))
