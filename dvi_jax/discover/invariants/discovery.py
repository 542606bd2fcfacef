"""What discovery returns: the invariants, what is lost, and a report; saved and loaded."""

import dataclasses
import itertools
import os
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base.files import publish_npz, read_npz
from ...base.precision import refuse_double_without_x64
from ...base.printing import printable
from ...base.types import State
from ..functions.basis import AbstractBasis, BoundBasis, bind_basis
from ..functions.sampling import SamplePoints, values_at
from .energy import Energy
from .expansions import Larger, common_warnings
from .obstructions import DriftLaw
from .report import report
from .series import InvariantSeries

_ILL = 1e8  # Condition number of a basis from which on formulas have lost half of their digits
_FORMAT = 2  # Of a file


@printable
class Discovery(eqx.Module):
    """Result of `discover_invariants`.

    The invariants:

    - `coefficients`: shape (count, order + 1, basis size), of the independent invariants: those
      that are conserved to rounding before approximate ones, and those with few terms before
      others; count may be 0. `dependent`: the same for the others in the span, which are functions
      of them (on the samples, as far as differentials show).
    - `errors`: estimated errors of `inner_coefficients`, from the residual and the singular values
      of the conditions; coefficients that are only rounding are exactly zero.
    - `exact`: for each independent invariant, whether it is conserved at ε that are not small, to
      round-off over many steps; not tried (False) at order 0.
    - `leading_parts`: shape (families, basis size): a basis, orthonormal on the samples, of the
      order-0 parts of *all* invariants in the span.
    - `survivors`: for m = 0 … order, how many leading-order terms have an invariant of order m
      (a constant does not count).
    - `reach`: shape (count,): the ε at which corrections are as large as the leading-order term;
      the series is of use far below it. Infinite without corrections.
    - `obstructions`: a `DriftLaw` for each leading-order term that is lost at order 1, 2, …

    How reliable they are:

    - `singular_values`: of the system (for more than 1000 coefficients those of A_0 and of the
      secular terms), descending, relative to the changes that the slopes of the functions predict
      (with a tolerance, to the largest value); `gap`: the ratio at which they were cut (large is
      clear, below 1e3 is not). `refused`: null vectors of the training
      samples that change by more than rounding by their own measure, or that a lower order
      rejects.
    - `residuals`: shape (count, order + 1), on held-out points: the largest change over one
      step at each order in ε · `scale`, relative to what the slopes of the leading-order term
      predict, |∇I|·|Δz|, or to its spread over the samples where that is less.
      `typical_residuals`: their median and 95 % quantile, shape (count, order + 1, 2).
      `dependent_residuals`: as `residuals`.
    - `undecided`: how many combinations of the functions change in the steps by less than 1000
      times their rounding, or are null and change by more than rounding and less than 1e-6 of what
      their slopes predict: whether they are conserved cannot be decided. `impossible`: whether as
      many independent invariants were found as there are coordinates, with a tolerance or as
      expansions, though the map moves; none is then reported.
    - `larger`: how many are conserved at a larger step or on samples that spread wider, where those
      given are so small that expansions are conserved as well; see `Larger`.
    - `powers`: shape (count,), at order 0: the power of the size of the samples by which the
      changes in a step grow. 0 is an exact invariant; an expansion about the middle of the
      samples, cut off, has another power. NaN where it was not tried.
    - `condition`: of `inner` on the samples, each function scaled to one size.

    The functions:

    - `basis`: φ, with `names`. `middle`: m, of z = (q, p, t), shape (2n + 1,). Where it is not
      zero, the samples lie so far from the origin that polynomials lose digits there; they are
      then taken about m: functions `inner` = `to_basis` @ φ + constants, with
      `inner_coefficients` and `inner_dependent`. Formulas, values and laws are of those; values
      differ from those of `coefficients` by a constant.
    - `sizes`: shape (order + 1, basis size): size of a term with coefficient 1 on the samples, of
      `inner`. `scale`: 1 over the ε at which the perturbation changes a step as much as H_D does.
    - `slow_time`: of the system. `tolerance`: None, or that of approximate invariants.
    - `energy`: how far the map conserves the energy, where no invariant found represents it, see
      `Energy`; else None. `seconds`: time of the search.

    On resonant or integrable systems the null space is large; on chaotic ones spurious near-null
    vectors appear. Held-out residuals and `drift_order` on a long run decide.
    """

    inner_coefficients: Array
    inner_dependent: Array
    errors: np.ndarray
    exact: tuple[bool, ...] = eqx.field(static=True)
    leading_parts: np.ndarray
    survivors: tuple[int, ...] = eqx.field(static=True)
    singular_values: np.ndarray
    gap: float = eqx.field(static=True)
    refused: int = eqx.field(static=True)
    residuals: np.ndarray
    typical_residuals: np.ndarray
    dependent_residuals: np.ndarray
    undecided: int = eqx.field(static=True)
    impossible: bool = eqx.field(static=True)
    larger: tuple[Larger, ...] = eqx.field(static=True)
    powers: np.ndarray
    reach: np.ndarray
    obstructions: tuple[DriftLaw, ...]
    basis: BoundBasis
    inner: BoundBasis
    middle: np.ndarray
    to_basis: np.ndarray
    sizes: np.ndarray
    condition: float = eqx.field(static=True)
    scale: float = eqx.field(static=True)
    probe: SamplePoints
    shape: tuple[int, ...] = eqx.field(static=True)
    slow_time: bool = eqx.field(static=True)
    tolerance: float | None = eqx.field(static=True)
    energy: Energy | None = eqx.field(static=True, default=None)
    seconds: float = eqx.field(static=True, default=float("nan"))

    @property
    def count(self) -> int:
        """Number of independent invariants found."""
        return self.inner_coefficients.shape[0]

    @property
    def coefficients(self) -> Array:
        """Of the functions of `basis`, shape (count, order + 1, basis size)."""
        return self._of_basis(self.inner_coefficients)

    @property
    def dependent(self) -> Array:
        """The same for the invariants that are functions of those."""
        return self._of_basis(self.inner_dependent)

    def _of_basis(self, coefficients: Array) -> Array:
        return coefficients @ self.to_basis if self.middle.any() else coefficients

    @property
    def order(self) -> int:
        """z, the requested order."""
        return len(self.survivors) - 1

    @property
    def invariants(self) -> list[InvariantSeries]:
        """The independent invariants as observables."""
        return self._series(self.inner_coefficients, self.errors)

    @property
    def dependent_invariants(self) -> list[InvariantSeries]:
        """Those in the span that are functions of the independent ones."""
        return self._series(self.inner_dependent, [None] * len(self.inner_dependent))

    def _series(self, coefficients: Array, errors: Any) -> list[InvariantSeries]:
        return [
            InvariantSeries(self.inner, series, self.slow_time, sizes=self.sizes, errors=error)
            for series, error in zip(coefficients, errors, strict=True)
        ]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons why the result is not reliable, each with a remedy; empty if it is reliable."""
        reasons = common_warnings(
            self,
            "let drift_order on a long run decide",
            "combinations of the functions change in a step by less than 1000 times their "
            "rounding, or by hardly more than it: whether they are conserved",
        )
        if self.impossible:
            reasons.append(
                "as many independent invariants as coordinates were found, which is impossible "
                "for a map that moves: none is reported; take a smaller tolerance, or samples "
                "where functions change clearly in a step"
            )
        if self.condition > _ILL:
            reasons.append(
                f"the basis is ill-conditioned on the samples ({self.condition:.0e}): formulas "
                "are not reliable; shift and scale the coordinates"
            )
        return tuple(reasons)

    def evaluate(self, q: State, p: State, epsilon: Any, t: Any = 0.0) -> Array:
        """The values of the independent invariants at a point, shape (count,)."""
        powers = jnp.asarray(epsilon) ** jnp.arange(self.order + 1)
        return jnp.einsum("m,kmb,b->k", powers, self.inner_coefficients, self.inner(q, p, t))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything but the basis functions themselves to a file (NumPy's npz)."""
        plain, names = _fields()
        header = {name: getattr(self, name) for name in plain}
        header["names"] = self.basis.names
        header["obstructions"] = [
            {name: np.asarray(value).tolist() for name, value in law._asdict().items()}
            for law in self.obstructions
        ]
        arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in names}
        arrays |= {f"probe_{name}": value for name, value in self.probe._asdict().items()}
        arrays["probe_values"] = values_at(self.basis, self.probe)
        publish_npz(path, _FORMAT, header, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], basis: AbstractBasis) -> "Discovery":
        """Read what `save` wrote; `basis` is the one that was searched (its names are compared).

        **Raises** `FileNotFoundError` where there is no such file, `ValueError` for a file of
        something else, or another basis.
        """
        refuse_double_without_x64("a saved Discovery", np.float64)
        header, arrays = read_npz(path, _FORMAT, "discovery")
        plain, names = _fields()
        probe_names = [f"probe_{name}" for name in SamplePoints._fields]
        entries = [*plain, "names", "obstructions", *names, *probe_names, "probe_values"]
        if gaps := [name for name in entries if name not in header | arrays]:
            raise ValueError(
                f"path must be a file of Discovery.save, but {os.fspath(path)} has no {gaps[0]!r}: "
                "check the path, or repeat the search and save it."
            )
        bound = bind_basis(basis, tuple(header["shape"]))
        inner, to_basis = bound.recentre(arrays["middle"])
        probe = SamplePoints(*(arrays[name] for name in probe_names))
        pairs = itertools.zip_longest(header["names"], bound.names, fillvalue="no function")
        differences = [
            f"the function with index {i}, {name!r} there and {bound_name!r} here"
            for i, (name, bound_name) in enumerate(pairs)
            if name != bound_name
        ]
        if not differences:
            is_close = np.isclose(values_at(bound, probe), arrays["probe_values"], rtol=1e-9)
            places = np.flatnonzero(~is_close.all(axis=0))
            differences = [f"the values of {bound.names[j]!r}" for j in places]
        if differences:
            raise ValueError(
                f"basis must be that of the search in {os.fspath(path)}, of {len(header['names'])} "
                f"functions, got {bound.size} functions, which differ in {differences[0]}."
            )
        fields: dict[str, Any] = {name: arrays[name] for name in names}
        for name in ("inner_coefficients", "inner_dependent"):
            fields[name] = jnp.asarray(fields[name])
        fields |= {name: _convert(header[name], tuple) for name in plain}
        fields["energy"] = Energy(*header["energy"]) if header["energy"] else None
        fields["larger"] = tuple(Larger(*entry) for entry in header["larger"])
        fields["obstructions"] = tuple(
            DriftLaw(**{name: _convert(value, np.array) for name, value in law.items()})
            for law in header["obstructions"]
        )
        return cls(basis=bound, inner=inner, to_basis=to_basis, probe=probe, **fields)

    def __str__(self) -> str:
        return report(self)


def _convert(value: Any, kind: Any) -> Any:
    """A list of a file as a tuple or an array; other values as they are."""
    return kind(value) if isinstance(value, list) else value


def _fields() -> tuple[list[str], list[str]]:
    """Names of the fields that are plain values in a file, and of those that are arrays."""
    special = ("obstructions", "basis", "inner", "to_basis", "probe")
    fields = [field for field in dataclasses.fields(Discovery) if field.name not in special]
    plain = [field.name for field in fields if field.metadata.get("static")]
    return plain, [field.name for field in fields if field.name not in plain]
