"""How far a map conserves the energy: why a search for invariants does not find it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.dependence import depends_on

from ...methods import TypeII
from ...methods.step import Equations
from ..functions.basis import BoundBasis
from ..functions.families import raised
from .changes import changes_at
from .judging import CLEARLY
from .search import NullSpaces

_FOUND = 0.05  # Energy differs by so little from an invariant that was found
_EXPRESSED = 1e-6  # … or from a combination of the basis functions
# A search with a tolerance of this share of the change of the energy finds it, and not much more.
_TOLERANCE = 0.12
_ORDERS = 0.5, 20.0  # Orders in h that the change of an energy may have


class Energy(NamedTuple):
    """The energy H_D(t, t, q, p) as a function that the map does not conserve exactly.

    - `order`: r, where it is conserved to O(h^r); `change`: median change in a step, relative to
      what its slopes predict.
    - `tolerance`: with which a search finds it; NaN where the basis does not contain it.
    - `shadow`: whether the map is that of `TypeII()`, which conserves a `ShadowHamiltonian`.
    """

    order: float
    change: float
    tolerance: float
    shadow: bool

    def __str__(self) -> str:
        r = max(1, round(self.order))
        text = (
            f"energy is conserved to O({raised('h', r)}) only by this map: a step changes it by "
            f"{self.change:.1e} of what its slopes predict"
        )
        if np.isnan(self.tolerance):
            tries = "to find it, add it to the basis, which lacks it, and give a tolerance"
        else:
            tries = f"try tolerance={self.tolerance:.1g}"
        shadow = f", or dvi.ShadowHamiltonian({r + 1})" if self.shadow else ""
        return f"{text}; {tries}{shadow}"


class _OfEnergy(eqx.Module):
    equations: Equations

    def __call__(self, q, p, t):
        system, zero = self.equations.system, jnp.zeros(())
        return system.hamiltonian(t, t, q, p, zero, self.equations.args)[None]


@eqx.filter_jit
def _values(energy, q, p, t):
    return jax.vmap(energy)(q, p, t)


def unconserved_energy(null: NullSpaces) -> Energy | None:
    """The energy, if it is neither among the invariants found at order 0 nor conserved
    to rounding by the map, and its change in a step is a power of h."""
    changes, stepped = null.changes, null.changes.stepped
    energy = _OfEnergy(stepped.equations)
    q, p, t = (jnp.asarray(x[0]) for x in changes.samples)
    system = stepped.equations.system
    if system.slow_time or depends_on(lambda t: energy(q, p, t), 0, t):
        return None
    values = np.asarray(_values(energy, *map(jnp.asarray, null.samples)))[:, 0]
    if not np.isfinite(values).all():
        return None
    calm = null.calm
    spread = np.linalg.norm(calm * (values - np.average(values, weights=calm**2)))
    functions = null.values @ null.weighed.orthonormal
    leading = null.spaces[0].leading[: functions.shape[1]]

    def missing(columns):
        columns = np.column_stack([columns, calm])
        c = np.linalg.lstsq(columns, calm * values)[0]
        return np.linalg.norm(columns @ c - calm * values) / max(spread, 1e-300)

    if spread == 0 or (others := missing(functions @ leading)) < _FOUND:
        return None
    basis = BoundBasis(energy, ("energy",), (1,))

    def change(h):
        found = changes_at(stepped._replace(basis=basis, h=np.asarray(h)), 0, changes.samples)
        predicted = np.linalg.norm(found.motion.changes[..., 0], axis=1)[found.good]
        ratio = np.abs(found.terms[found.good, 0, 0]) / np.maximum(predicted, 1e-300)
        return float(np.median(ratio)) if len(ratio) else np.nan

    here, half = change(float(stepped.h)), change(float(stepped.h) / 2)
    order = float(np.log2(here / half)) if half > 0 and here > CLEARLY else np.nan
    if not _ORDERS[0] < order < _ORDERS[1] or here > 1 or others < 3 * here:
        return None
    expressed = missing(functions) < _EXPRESSED
    tolerance = float(f"{_TOLERANCE * here:.0e}") if expressed else np.nan
    return Energy(order, here, tolerance, isinstance(stepped.method, TypeII))
