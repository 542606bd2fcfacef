"""Samples and functions on the manifold of a constraint."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...base.results import RESULTS
from ...methods.constraint import start_status
from ...methods.step import Equations
from .basis import BoundBasis
from .sampling import Samples, check_finite

_DEPENDENT = 1e-10  # A function that differs by less from a combination of others depends on them


def on_manifold(equations: Equations, basis: BoundBasis, samples: Samples) -> BoundBasis:
    """The functions that are independent on the samples of a constrained system, the simpler ones
    first: on a unit vector γ the function |γ|² γ₁ is γ₁. **Raises** `ValueError` for samples off
    the manifold."""
    if equations.system.constraint is None:
        return basis
    good, values = map(np.asarray, _at_samples(equations, basis, samples))
    if not good.all():
        i = int(np.argmin(good))
        raise ValueError(
            f"samples must satisfy the constraint, and their velocities too, but {np.sum(~good)} "
            f"of {len(good)} do not. The first of these has the index {i}: q = "
            f"{samples.q[i].tolist()!s:.80}. Use dvi.project for each."
        )
    check_finite(basis, values)
    kept, space = [], np.zeros((len(values), 0))
    for j in np.argsort(basis.complexity, kind="stable"):
        left = values[:, j] / max(np.linalg.norm(values[:, j]), 1e-300)
        for _ in range(2):  # the second time removes the rounding of the first
            left = left - space @ (space.T @ left)
        if (size := np.linalg.norm(left)) > _DEPENDENT:
            kept.append(j)
            space = np.column_stack([space, left / size])
    if len(kept) == basis.size:
        return basis
    kept = np.sort(kept)
    names, complexity = (tuple(x[j] for j in kept) for x in (basis.names, basis.complexity))
    return dataclasses.replace(
        basis, function=_Some(basis, kept), names=names, complexity=complexity
    )


class _Some(eqx.Module):
    basis: BoundBasis
    which: np.ndarray

    def __call__(self, q, p, t):
        return self.basis(q, p, t)[self.which]


@eqx.filter_jit
def _at_samples(equations, basis, samples):
    """Whether each sample is consistent, and the functions there."""

    def at_point(q, p, t):
        return start_status(equations, t, q, p) == RESULTS.successful, basis(q, p, t)

    return jax.vmap(at_point)(*map(jnp.asarray, samples))
