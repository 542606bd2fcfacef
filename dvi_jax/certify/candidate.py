"""A method with the programs compiled for it, which several checks share."""

import copy
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import problems

STEPS = 4
"""Steps of the runs that are differentiated and batched."""

POINT = {"q0": 0.4, "p0": 0.3, "t0": 0.3, "h": 0.1, "epsilon": 0.2, "args": problems.A}
"""Inputs of those runs: of `COUPLED` with one degree of freedom, force on."""

LONG = 100_000
LONG_H = 0.2
"""Steps of the run that energy and angular momentum are watched over, and their size."""

ADJOINTS = {
    "Direct": dvi.Direct(),
    "Checkpointed": dvi.Checkpointed(segments=2),
    "Reversible": dvi.Reversible(checkpoint_every=STEPS),
}


def final(method: dvi.Method, x: dict[str, Any], adjoint: Any = ADJOINTS["Direct"]):
    """(q, p) after `STEPS` steps from the inputs x, and whether they succeeded."""
    solution = dvi.integrate(
        problems.COUPLED,
        x["q0"][None],
        x["p0"][None],
        h=x["h"],
        num_steps=STEPS,
        t0=x["t0"],
        epsilon=x["epsilon"],
        args=x["args"],
        method=method,
        save=dvi.Save(final=True),
        adjoint=adjoint,
        throw=False,
    )
    good = solution.result == dvi.RESULTS.successful
    return jnp.concatenate([solution.qs[-1], solution.ps[-1]]), good


def loss(method: dvi.Method, x: dict[str, Any], adjoint: Any = ADJOINTS["Direct"]):
    """A number that all of the final state enters."""
    z, _ = final(method, x, adjoint)
    return jnp.sum(z**2) + z[0] - z[1]


def one_step_of_central(method: dvi.Method, scale: float, observe: Any = None) -> np.ndarray:
    """(q, p) after one step, all inputs in proportion to `scale`."""
    q, p = problems.ROSETTE
    solution = dvi.integrate(
        problems.CENTRAL,
        scale * q,
        scale * p,
        h=0.1 * scale,
        num_steps=1,
        t0=0.3 * scale,
        epsilon=0.2 * scale,
        args=problems.A * scale,
        method=method,
        save=dvi.Save(final=True),
        observe=observe,
        throw=False,
    )
    return np.concatenate([solution.qs[-1], solution.ps[-1]])


class Candidate:
    """One method under test. Programs are compiled when a check first asks for them."""

    def __init__(self, method: dvi.Method):
        self.method = method

    @functools.cached_property
    def flow(self):
        """``(q, p, t0, h, epsilon, args, n)`` → (q, p) of `COUPLED` after n steps."""
        return problems.flow(problems.COUPLED, self.method)

    @functools.cached_property
    def jacobian(self):
        """``(z, h)`` → ∂Φ_h/∂z of one step of `COUPLED` at ε = 0, z = (q, p), by forward mode."""

        def step(z, h):
            q, p = jnp.split(z, 2)
            zero = jnp.zeros_like(h)
            after = problems.one_step(
                problems.COUPLED, self.method, q, p, zero, h, zero, jnp.asarray(problems.A)
            )
            return jnp.concatenate(after)

        return jax.jit(jax.jacfwd(step))

    @functools.cached_property
    def final(self):
        """Inputs → (q, p) at the end, and whether all went well."""
        return jax.jit(lambda x: final(self.method, x))

    @functools.cached_property
    def batch(self):
        """`final` of a batch of inputs."""
        return jax.jit(jax.vmap(lambda x: final(self.method, x)))

    @functools.cached_property
    def undone(self):
        """Inputs → (q, p) at the end of `STEPS` steps of Φ⁻¹, and whether all went well.

        The adjoint Φ*_h = (Φ_{−h})⁻¹ taken over −h is the inverse.
        """
        adjoint = dvi.Adjoint(self.method)  # pyright: ignore[reportCallIssue]
        return jax.jit(lambda x: final(adjoint, x))

    @functools.cached_property
    def gradients(self) -> tuple[dict[str, np.ndarray], float]:
        """∂loss/∂x at `POINT` by reverse mode with every adjoint, and its sum by forward mode."""

        def of(x):
            backward = {
                name: jax.grad(lambda x, a=a: loss(self.method, x, a))(x)
                for name, a in ADJOINTS.items()
            }
            ones = jax.tree.map(jnp.ones_like, x)
            return backward, jax.jvp(lambda x: loss(self.method, x), (x,), (ones,))[1]

        backward, forward = jax.jit(of)(point())
        rows = {name: np.array([float(g[i]) for i in POINT]) for name, g in backward.items()}
        return rows, float(forward)

    @functools.cached_property
    def counted_step(self) -> tuple[np.ndarray, list[int]]:
        """(q, p) after one step of `CENTRAL`, and how often the run was traced for it.

        Once more for two others with all inputs changed and the method made anew, equal but not
        the same object.
        """
        calls = 0

        def counted(t0, t1, q0, p0, q1, p1, args):
            nonlocal calls
            calls += 1
            return q1

        states, seen = [], []
        for scale in (1.0, 1.1, 1.2):
            calls = 0
            states.append(one_step_of_central(copy.deepcopy(self.method), scale, counted))
            # One call is the check of shapes that `integrate` makes before it has a program.
            seen.append(calls - 1)
        return states[0], seen

    @functools.cached_property
    def long_run(self) -> dvi.Solution:
        """`LONG` steps on `CENTRAL`: slope and range of the energy, drift of q × p."""
        energy, momentum = problems.central_energy, problems.angular_momentum
        return dvi.integrate(
            problems.CENTRAL,
            *problems.ROSETTE,
            h=LONG_H,
            num_steps=LONG,
            args=problems.A,
            method=self.method,
            save=dvi.Save(final=True),
            observe={
                "slope": dvi.Trend(energy),
                "range": dvi.Range(energy),
                "momentum": dvi.MaxDrift(momentum),
            },
            throw=False,
        )


def point() -> dict[str, jax.Array]:
    """`POINT` as arrays."""
    return {name: jnp.asarray(value, jnp.float64) for name, value in POINT.items()}
