"""A method with the programs compiled for it, which several checks share."""

import copy
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.systems import Problem
from dvi_jax.systems.kepler import angular_momentum

from . import problems
from .problems import CENTRAL, COUPLED, SINGLE, inputs, state

STEPS = 4
"""Steps of the runs that are differentiated and batched."""

LONG, LONG_H = 100_000, 0.2
"""Number and size of the steps over which energy and angular momentum are observed."""

ADJOINTS = {
    "Direct": dvi.Direct(),
    "Checkpointed": dvi.Checkpointed(segments=2),
    # With a smaller defect the states from checkpoints would hide a wrong inverse.
    "Reversible": dvi.Reversible(checkpoint_every=STEPS, max_defect=1.0),
}


class Candidate:
    """One method under test. A program is compiled when the first check needs it.

    - `problem`: takes the place of the coupled problem, for checks of structure.
    """

    def __init__(self, method: dvi.Method, problem: Problem | None = None):
        self.method = method
        self.problem = COUPLED if problem is None else problem
        self.small = SINGLE if problem is None else problem

    @functools.cached_property
    def flow(self):
        """Inputs and n → (q, p) after n steps."""
        return problems.flow(self.problem, self.method)

    def run(self, x, adjoint=ADJOINTS["Direct"], method=None):
        """(q, p) as one vector after `STEPS` steps from x, and whether they succeeded."""
        solution = problems.run(self.small, method or self.method, x, STEPS, adjoint=adjoint)
        return state(solution), solution.result == dvi.RESULTS.successful

    @functools.cached_property
    def program(self):
        """`run`, compiled."""
        return jax.jit(self.run)

    @functools.cached_property
    def batch(self):
        """`run` of a batch of inputs, compiled."""
        return jax.jit(jax.vmap(self.run))

    @functools.cached_property
    def gradients(self) -> tuple[dict[str, dict[str, float]], float]:
        """Derivatives of `loss` along (1, …, 1).

        In reverse mode, for each adjoint and each input; in forward mode, of all inputs together.
        """

        def derivatives(x):
            def loss_of_run(x, adjoint=ADJOINTS["Direct"]):
                return loss(self.run(x, adjoint)[0])

            slope = jax.grad(loss_of_run)
            backward = {name: slope(x, adjoint) for name, adjoint in ADJOINTS.items()}
            return backward, jax.jvp(loss_of_run, (x,), (jax.tree.map(jnp.ones_like, x),))[1]

        backward, forward = jax.jit(derivatives)(inputs(self.small))
        total = jax.tree.map(lambda slope: float(jnp.sum(slope)), backward)
        return total, float(forward)

    def one_step(self, scale: float = 1.0, observe: Any = None) -> np.ndarray:
        """(q, p) after one step of `CENTRAL`: inputs times `scale`, a copy of the method."""
        x = {name: scale * value for name, value in inputs(CENTRAL).items()}
        method = copy.deepcopy(self.method)
        return np.asarray(state(problems.run(CENTRAL, method, x, observe=observe)))

    @functools.cached_property
    def long_run(self) -> dvi.Solution:
        """`LONG` steps of `CENTRAL`: slope and range of the energy, drift of q × p."""
        energy = problems.central_energy
        observe: dict[str, Any] = {"slope": dvi.Trend(energy), "range": dvi.Range(energy)}
        observe["momentum"] = dvi.MaxDrift(angular_momentum)
        x = inputs(CENTRAL, 0.0) | {"h": LONG_H, "epsilon": 0.0}
        return problems.run(CENTRAL, self.method, x, LONG, observe)


def loss(z):
    """A number that depends on all components of the final state."""
    return jnp.sum(z**2) + z[0] - z[1]
