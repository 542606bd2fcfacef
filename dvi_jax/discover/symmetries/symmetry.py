"""Symmetries as they are found: generators in a basis, their kind, and a report."""

from collections.abc import Iterator

import equinox as eqx
import numpy as np

from ...base.printing import printable
from ..algebra.nullspace import in_units_of
from ..functions.basis import BoundBasis
from ..functions.generators import Generator
from ..invariants.expansions import Larger, common_warnings, growth_note
from ..invariants.series import in_powers_of_epsilon
from .gauge import BasisGauge
from .noether import AdiabaticInvariant

_COARSE = 1e-5  # A search that cannot see terms of this relative size says so
_ROUND_OFF = 1e-9  # Terms of a formula below this share of the largest are left out


@printable
class Symmetry(eqx.Module):
    r"""A symmetry Σ_m ε^m X_m that `find_symmetries` found; as formulas: `str`.

    - `generators`: X_m, one for each order: for `prolong`, `determining_residual`, …
    - `is_variational`: whether Noether's identity closes with a gauge; else it is a conformal
      symmetry only, within this gauge basis.
    - `gauges`: G_m, one for each order; None where it is not variational.
    - `residuals`: shape (z + 1,): the largest residual of the determining equations at each order
      in ε on held-out samples, relative to what a vector field with these slopes typically leaves
      of them at the same sample.
      `typical_residuals`: median and 95 % quantile, shape (z + 1, 2).
    - `identity_residuals`: shape (z + 1,): the same of Noether's identity and of its derivatives
      off the solutions; where it is not variational, with the best gauge in the basis.
    - `is_dependent`: whether X_0 is a combination of those listed before it with invariants of
      the unperturbed map for coefficients.
    - `is_symplectic`: whether every order is locally a Hamiltonian vector field (and ξ0 = 0).
      If it is symplectic but not variational, a larger gauge basis may close the identity.
    - `coefficients`: shape (z + 1, components, basis size), components ξ0 (if sought), those
      of ξ, those of η, named in `names`.
    - `scale`: 1 over the ε at which the perturbation is as large as the rest.
    - `sizes`: shape (components, basis size): size of a term with coefficient 1 on the samples;
      `gauge_sizes`: the same for the gauges. Formulas leave out terms below 1e-9 of the largest.
    """

    generators: tuple[Generator, ...]
    is_variational: bool = eqx.field(static=True)
    gauges: tuple[BasisGauge, ...] | None
    residuals: np.ndarray
    typical_residuals: np.ndarray
    identity_residuals: np.ndarray
    is_dependent: bool = eqx.field(static=True)
    is_symplectic: bool = eqx.field(static=True)
    coefficients: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    basis: BoundBasis
    scale: float = eqx.field(static=True, default=1.0)
    sizes: np.ndarray | None = None
    gauge_sizes: np.ndarray | None = None

    @property
    def order(self) -> int:
        """z, the order up to which the series goes."""
        return len(self.generators) - 1

    @property
    def moves_time(self) -> bool:
        """Whether ξ0 is not zero; its invariant may then oscillate by O(h) on a fixed time grid."""
        return any(generator.xi0 is not None for generator in self.generators)

    @property
    def invariant(self) -> AdiabaticInvariant | None:
        """Its adiabatic invariant of order z; None if the symmetry is not variational."""
        if self.gauges is None:
            return None
        return AdiabaticInvariant(list(self.generators), list(self.gauges))

    def __str__(self) -> str:
        shares = _shares(self.coefficients, self.scale, self.sizes)
        c = np.where(shares > _ROUND_OFF * np.max(shares, initial=0.0), self.coefficients, 0.0)
        parts = (
            f"{n} = {_series(self.basis, x)}"
            for n, x in zip(self.names, c.swapaxes(0, 1), strict=True)
            if x.any()
        )
        return ", ".join(parts) or "0"

    def report(self) -> list[str]:
        """The symmetry, its kind, residuals and gauge, as lines of text."""
        kind = "variational" if self.is_variational else "conformal only"
        mark = ", dependent" if self.is_dependent else ""
        half, nearly_all = np.max(self.typical_residuals, axis=0)
        lines = [
            f"  {self}",
            f"      {kind}{mark}; residuals on held-out samples: median {half:.1e}, 95 % below "
            f"{nearly_all:.1e}, largest {np.max(self.residuals):.1e}; of Noether's identity "
            f"{np.max(self.identity_residuals):.1e}",
        ]
        if self.gauges is not None:
            gauges = np.stack([np.asarray(g.coefficients) for g in self.gauges])
            shares = _shares(gauges, self.scale, self.gauge_sizes)
            field_shares = _shares(self.coefficients, self.scale, self.sizes)
            largest = max(np.max(shares, initial=0.0), np.max(field_shares))
            gauges = np.where(shares > _ROUND_OFF * largest, gauges, 0.0)
            lines.append(f"      gauge G = {_series(self.gauges[0].basis, gauges)}")
            if self.moves_time:
                lines.append("      ξ0 is not zero: on a fixed mesh its invariant may move by O(h)")
        elif self.is_symplectic:
            lines.append("      its flow is symplectic: the gauge basis may be too small")
        return lines


def _shares(coefficients: np.ndarray, scale: float, sizes: np.ndarray | None) -> np.ndarray:
    shares = np.abs(in_units_of(scale, coefficients, axis=0))
    return shares if sizes is None else shares * sizes


def _series(basis: BoundBasis, coefficients: np.ndarray) -> str:
    """c_0·φ + ε (c_1·φ) + … as text; orders that are zero are left out."""
    texts = (basis.formula(block, drop=0.0) if block.any() else "" for block in coefficients)
    return in_powers_of_epsilon(texts)


@printable
class Symmetries(eqx.Module):
    """Result of `find_symmetries`; print it for a report. A sequence of `Symmetry`.

    - `found`: the variational ones first, the simplest first in each kind; there may be none.
    - `survivors`: for m = 0 … order, how many leading-order fields X_0 have a symmetry of order m.
    - `singular_values`: of all conditions, descending, relative to the largest; `gap`: the ratio
      at which they were cut (large is clear, below 1e3 is not).
    - `null`: below this relative size a singular value is zero, within rounding.
    - `refused`: null vectors of the training samples that failed on the held-out ones.
    - `undecided`: how many vector fields change in the steps by hardly more than rounding, so that
      whether they are symmetries cannot be decided in double precision.
    - `powers`: shape (count,), at order 0: the power of the size of the samples by which the
      residuals grow; 0 for an exact symmetry, another one for an expansion about the middle of the
      samples, NaN where it was not tried. `larger`: how many there are at a larger step or on
      samples that spread wider, where those given are so small that expansions fulfil the equations
      as well; see `Larger`.
    - `basis`: of the components of the generators; where the samples lie far from the origin,
      polynomials about their middle, as the names say. `gauge_basis`: of the gauges, functions left
      out that are constant or depend on others.

    On resonant or integrable systems the null space is large: a symmetry times an invariant is a
    symmetry, which is marked as dependent. On chaotic systems near-null vectors appear that are
    none. Held-out residuals decide.
    """

    found: tuple[Symmetry, ...]
    survivors: tuple[int, ...] = eqx.field(static=True)
    singular_values: np.ndarray
    gap: float = eqx.field(static=True)
    null: float = eqx.field(static=True)
    refused: int = eqx.field(static=True)
    undecided: int = eqx.field(static=True)
    powers: np.ndarray
    larger: tuple[Larger, ...] = eqx.field(static=True)
    basis: BoundBasis
    gauge_basis: BoundBasis

    @property
    def variational(self) -> tuple[Symmetry, ...]:
        """Those whose Noether identity closes."""
        return tuple(symmetry for symmetry in self.found if symmetry.is_variational)

    @property
    def conformal(self) -> tuple[Symmetry, ...]:
        """Those that are conformal only."""
        return tuple(symmetry for symmetry in self.found if not symmetry.is_variational)

    @property
    def order(self) -> int:
        """z, the requested order."""
        return len(self.survivors) - 1

    @property
    def count(self) -> int:
        """Number of symmetries found, dependent ones included."""
        return len(self.found)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons why the result is not reliable, each with a remedy; empty if it is reliable."""
        reasons = common_warnings(
            self,
            "take more samples, or others",
            "vector fields change in a step by hardly more than rounding: whether they are "
            "symmetries",
        )
        if self.null > _COARSE:
            reasons.append(
                f"what breaks a symmetry by less than {self.null:.0e} cannot be decided in this "
                "arithmetic: the step is small, the samples lie far from the origin, or the "
                "tolerance is large"
            )
        return tuple(reasons)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> Symmetry:
        return self.found[i]

    def __iter__(self) -> Iterator[Symmetry]:
        return iter(self.found)

    def __str__(self) -> str:
        count = len(self.found)
        numbers = ", ".join(f"{m}: {n}" for m, n in enumerate(self.survivors))
        lines = [
            f"{count} symmetr{'y' if count == 1 else 'ies'} of order {self.order} in "
            f"{self.basis.size} functions for each component: {len(self.variational)} variational, "
            f"{len(self.conformal)} conformal only; number at order {numbers}; the smallest "
            f"singular value of all other fields is {self.gap:.1e} times as large"
        ]
        lines += [f"  {warning}" for warning in self.warnings]
        if not count and self.survivors[0]:
            lines.append("  what order 0 has does not go on: a lower order, or a larger basis?")
        for symmetry, power in zip(self.found, self.powers, strict=True):
            lines += [*symmetry.report(), *growth_note("residuals grow", power)]
        dependent = sum(s.is_dependent for s in self.found)
        if dependent:
            lines.append(
                f"  {dependent} of them depend on the others, with invariants of the map for "
                "coefficients: the null space is large, as on resonant and integrable systems"
            )
        if self.refused:
            lines.append(
                f"  {self.refused} null vectors of the fitted samples rejected: their residual on "
                "the held-out samples is too large (chaos, too few samples, or too large a "
                "tolerance)"
            )
        return "\n".join(lines)
