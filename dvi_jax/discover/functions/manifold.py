"""Samples and functions on the manifold of a constraint."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...base.results import RESULTS
from ...methods.constraint import start_status
from ...methods.step import Equations
from ..algebra.nullspace import independent_columns
from .basis import BoundBasis
from .sampling import SamplePoints, check_finite

_DEPENDENT = 1e-10  # A function that differs by less from a combination of others depends on them


def on_manifold(equations: Equations, basis: BoundBasis, samples: SamplePoints) -> BoundBasis:
    """The functions that do not depend on simpler ones on the samples of a constrained system: for
    a unit vector γ, |γ|² γ₁ is γ₁. **Raises** `ValueError` for samples off the manifold."""
    if equations.system.constraint is None:
        return basis
    good, values = map(np.asarray, _at_samples(equations, basis, samples))
    if not good.all():
        i = int(np.argmin(good))
        raise ValueError(
            f"samples must satisfy the constraint, also by their velocities, but {np.sum(~good)} "
            f"of {len(good)} do not, first {samples.text(i)}: use dvi.project for each."
        )
    check_finite(basis, values)
    places = independent_columns(values, basis.complexity, _DEPENDENT)
    return basis if len(places) == basis.size else basis.select(places)


@eqx.filter_jit
def _at_samples(equations, basis, samples):
    """Whether each sample is consistent, and the functions there."""

    def at_point(q, p, t):
        return start_status(equations, t, q, p) == RESULTS.successful, basis(q, p, t)

    return jax.vmap(at_point)(*map(jnp.asarray, samples))
