"""How far a map conserves the energy: why a search for invariants does not find it."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.dependence import depends_on

from ...methods import TypeII
from ...methods.step import Equations
from ..functions.basis import BoundBasis
from ..functions.families import power_text
from ..functions.sampling import values_at
from .changes import changes_at
from .judging import CLEARLY
from .search import NullSpaces

_SAME_AS_INVARIANT = 0.05  # Energy differs by so little from an invariant that was found
_IN_BASIS = 1e-6  # … or from a combination of the basis functions
_TOLERANCE = 0.12  # Share of the energy's change with which a search finds it, and not much more
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
            f"energy is conserved to O({power_text('h', r)}) only by this map: a step changes it "
            f"by {self.change:.1e} of what its slopes predict"
        )
        if np.isnan(self.tolerance):
            tries = "to find it, add it to the basis, which lacks it, and give a tolerance"
        else:
            tries = f"try tolerance={self.tolerance:.1g}"
        shadow = f", or dvi.ShadowHamiltonian({r + 1})" if self.shadow else ""
        return f"{text}; {tries}{shadow}"


class _EnergyFunction(eqx.Module):
    equations: Equations

    def __call__(self, q, p, t):
        system, zero = self.equations.system, jnp.zeros(())
        return system.hamiltonian(t, t, q, p, zero, self.equations.args)[None]


def unconserved_energy(null: NullSpaces) -> Energy | None:
    """The energy, if it is not among the invariants of order 0 nor conserved to rounding, and its
    change in a step is a power of h."""
    changes, step_map = null.changes, null.changes.step_map
    energy = _EnergyFunction(step_map.equations)
    q, p, t = (jnp.asarray(x[0]) for x in changes.samples)
    system = step_map.equations.system
    if system.slow_time or depends_on(lambda t: energy(q, p, t), 0, t):
        return None
    basis = BoundBasis(energy, ("energy",), (1,))
    values = values_at(basis, null.of_fit.samples)[:, 0]
    if not np.isfinite(values).all():
        return None
    calm = null.calm
    spread = np.linalg.norm(calm * (values - np.average(values, weights=calm**2)))
    functions = null.values @ null.conditions.orthonormal
    leading = null.spaces[0].leading[: functions.shape[1]]

    def distance(columns):
        columns = np.column_stack([columns, calm])
        c = np.linalg.lstsq(columns, calm * values)[0]
        return np.linalg.norm(columns @ c - calm * values) / max(spread, 1e-300)

    if spread == 0 or (from_invariants := distance(functions @ leading)) < _SAME_AS_INVARIANT:
        return None

    def change(h):
        of_step = changes_at(step_map._replace(basis=basis, h=np.asarray(h)), 0, changes.samples)
        of_step = of_step.subset(of_step.good)
        predictions = np.linalg.norm(of_step.motion.changes[..., 0], axis=1)
        ratio = np.abs(of_step.terms[:, 0, 0]) / np.maximum(predictions, 1e-300)
        return float(np.median(ratio)) if len(ratio) else np.nan

    h = float(step_map.h)
    ratio, half = change(h), change(h / 2)
    order = float(np.log2(ratio / half)) if half > 0 and ratio > CLEARLY else np.nan
    if not _ORDERS[0] < order < _ORDERS[1] or ratio > 1 or from_invariants < 3 * ratio:
        return None
    tolerance = float(f"{_TOLERANCE * ratio:.0e}") if distance(functions) < _IN_BASIS else np.nan
    return Energy(order, ratio, tolerance, isinstance(step_map.method, TypeII))
