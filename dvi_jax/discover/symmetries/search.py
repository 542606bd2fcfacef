"""The linear algebra of a search for symmetries: null series, their kinds and representatives."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ..algebra.echelon import reduced, reduction
from ..algebra.motion import (
    FieldMotion,
    coefficient_errors,
    conserved,
    relative_changes,
    typical_sizes,
)
from ..algebra.nullspace import (
    HELD_OUT,
    NULL,
    RANK,
    SeriesSpace,
    by_leading,
    compress,
    in_units_of,
    null_space,
    orthonormal_range,
    series_changes,
    series_spaces,
    singular_vectors,
    solve_series,
    toeplitz,
    triangle,
)
from ..algebra.weighing import Weighed, of_orthonormal, weigh, weighted
from ..functions.basis import BoundBasis
from ..functions.families import coordinate_names
from ..functions.generators import Generator
from ..functions.sampling import Samples
from ..invariants.expansions import growth
from ..invariants.judging import CLEARLY
from .conditions import Conditions
from .found import Symmetries, Symmetry
from .gauge import BasisGauge
from .units import Units

_NEARLY = 1e-8  # Noether's identity has to close to this at least
_LEAST = 1e-4  # Terms of a sample are at least this fraction of the median of all samples
_TINY = 1e-12  # Coefficients whose share of a generator is below this are round-off


def weigh_conditions(
    raw: Conditions, samples: Samples, h: float, time: bool, basis, gauge_basis, tolerance
) -> "Search":
    """The conditions without units, in orthonormal functions: what a search looks for is null."""
    shape, held = samples.q.shape[1:], samples.held_out
    units = Units.of(raw, samples, h, time)
    motion, determining = units.determining(raw)
    weighed = weigh(raw.values[:, 0, 0], determining, motion, ~held, in_sizes=False)
    # What rounding hides, as a share of what fields typically change by.
    hidden = np.median(1 / (weighed.weights * weighed.motion.typical()))
    identity, gauge = units.closing(raw)
    size = typical_sizes(rows_of(gauge[:, 0]))[0]
    gauge_units = np.where(size > 0, size, 1.0)
    gauge = gauge / gauge_units
    # Every sample counts alike, however strong its kick.
    parts = [of_orthonormal(identity[:, 0, j], weighed.units, weighed.R) for j in range(2)]
    parts = [x.reshape(*x.shape[:2], 1, -1) for x in parts]
    size = np.sqrt(sum(np.sum(x**2, axis=(1, 2, 3)) for x in parts))
    size = np.hypot(np.where(size > 0, size, 1.0), np.linalg.norm(gauge[:, 0], axis=(1, 2)))
    identity = identity / size.reshape(-1, 1, 1, 1, 1, 1)
    gauge = gauge / size.reshape(-1, 1, 1, 1)
    determining, identity, gauge = (
        in_units_of(weighed.scale, x) for x in (determining, identity, gauge)
    )
    fitted = rows_of(gauge[~held, 0])
    return Search(
        raw=raw,
        basis=basis,
        gauge_basis=gauge_basis,
        shape=shape,
        held=held,
        tolerance=tolerance,
        units=units,
        motion=motion,
        weighed=weighed,
        determining=determining,
        identity=identity.sum(axis=2),
        identity_parts=identity[:, 0],
        gauge=gauge,
        gauge_units=gauge_units,
        R_gauge=triangle(fitted) / np.sqrt(len(fitted)),
        null=tolerance or NULL * max(1.0, float(hidden)),
    )


@dataclass(frozen=True)
class Search:
    """The linear algebra: unknowns are shares of orthonormal functions, rows without units.

    - `raw`, `basis`, `gauge_basis`, `tolerance`: what was sampled. `shape`: of a state. `held`:
      which samples are held out. `units`: see `Units`.
    - `weighed`: the determining equations. `motion`, `determining`: the same in the user's
      functions.
    - `identity`: of Noether, shape (S, z + 1, rows, C, B); `identity_parts`: of each point apart,
      at ε = 0. `gauge`: terms of the gauges in `gauge_units`, (S, z + 1, rows, gauge functions);
      `R_gauge`: of their QR decomposition.
    - `null`: the largest relative singular value of a null vector.
    """

    raw: Conditions
    basis: BoundBasis
    gauge_basis: BoundBasis
    shape: tuple[int, ...]
    held: np.ndarray
    tolerance: float | None
    units: Units
    motion: FieldMotion
    weighed: Weighed[FieldMotion]
    determining: np.ndarray
    identity: np.ndarray
    identity_parts: np.ndarray
    gauge: np.ndarray
    gauge_units: np.ndarray
    R_gauge: np.ndarray
    null: float

    @property
    def order(self) -> int:
        return self.determining.shape[1] - 1

    @property
    def components(self) -> np.ndarray:
        """The units of ξ0, ξ and η."""
        return self.units.components

    @property
    def size(self) -> int:
        """The number of unknowns of each order."""
        return len(self.components) * self.basis.size

    @property
    def names(self) -> tuple[str, ...]:
        return _component_names(self.shape)[self.units.used]

    @property
    def complexity(self) -> np.ndarray:
        return np.tile(self.basis.complexity, len(self.components))

    def spaces(self) -> list[SeriesSpace]:
        """The null spaces of the determining equations, order by order."""
        weighed = self.weighed
        terms = self._orthonormal(self.determining)

        def judge(leading, shifts):
            """Fields that begin at a later order are series of fewer orders."""
            kept, unclear = conserved(leading, terms, weighed.motion, self.tolerance)
            later = shifts[self.size :]
            if not later.size:
                return kept, shifts, unclear
            led, free = by_leading(later[: self.size])
            parts = judge(later @ led, later @ free)
            later = np.hstack(parts[:2])
            return kept, np.vstack([np.zeros((self.size, later.shape[1])), later]), unclear

        rows = np.moveaxis(weighted(terms, weighed.weights), 1, 2)
        fitted = compress(rows_of(rows[~self.held]))
        return series_spaces(fitted, judge, self.tolerance)

    def result(self) -> Symmetries:
        """The symmetries, in as few functions as can be."""
        spaces = self.spaces()
        space = spaces[-1]
        null = np.hstack([space.leading, space.shifts])
        # Null vectors hold a share of 1 / gap of directions that are nearly null.
        limit = max(self.null, min(1 / space.gap, _NEARLY)) if space.gap > 1 else self.null
        closed, gauges = self._variational(null, limit)
        symplectic = self._symplectic(null)
        both = np.hstack([closed, symplectic])
        groups = (
            self._variational_representatives(closed, gauges),
            self._representatives(symplectic, closed, self._symplectic(closed)),
            self._representatives(null, both, both),
        )
        found: list[Symmetry] = []
        refused, unclear = space.refused, 0
        for kind, group in enumerate(groups):
            for vector in group.T:
                symmetry = self._symmetry(vector, kind == 0, kind < 2, found)
                largest = np.max(symmetry.typical_residuals)
                if self.tolerance is None and largest > CLEARLY:
                    refused, unclear = refused + 1, unclear + 1
                else:
                    found.append(symmetry)
        if self.tolerance is None:
            unclear += max(space.unclear for space in spaces)
            unclear += max(self.weighed.motion.undecided() - spaces[0].leading.shape[1], 0)
        return Symmetries(
            found=tuple(found),
            survivors=tuple(space.leading.shape[1] for space in spaces),
            singular_values=space.singular_values,
            gap=space.gap,
            null=self.null,
            refused=refused,
            undecided=int(unclear),
            powers=np.full(len(found), np.nan),
            larger=(),
            basis=self.basis,
            gauge_basis=self.gauge_basis,
        )

    def _unknowns(self, terms: np.ndarray) -> np.ndarray:
        """Terms (S, z + 1, rows, C, B) with one axis of unknowns, (S, z + 1, rows, C · B)."""
        return terms.reshape(*terms.shape[:3], self.size)

    def _orthonormal(self, terms: np.ndarray) -> np.ndarray:
        """The same for unknown shares of the orthonormal functions."""
        return self._unknowns(of_orthonormal(terms, self.weighed.units, self.weighed.R))

    def _judged(self, columns, series, conditions, null) -> np.ndarray:
        """The combinations of null vectors that all samples take for null, held-out ones too.

        A vector can be null only because its leading-order term is small, therefore the
        leading-order terms are made orthonormal first.
        """
        if columns.shape[1] == 0:
            return columns
        columns = columns @ np.hstack(by_leading(series[: self.size]))
        norm = max(np.linalg.norm(conditions, 2), np.finfo(float).tiny)
        singular, V = singular_vectors(conditions @ columns / norm)
        return columns @ V[singular <= HELD_OUT * null].T

    def _variational(self, null: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
        """The series in the null space whose identity closes, and their gauges."""
        orders, size = self.order + 1, self.size
        if null.shape[1] == 0:
            return null, np.zeros((orders * self.gauge_basis.size, 0))
        gauge = np.linalg.solve(self.R_gauge.T, rows_of(rows_of(self.gauge)).T).T
        gauge = np.moveaxis(gauge.reshape(self.gauge.shape), 1, 2)
        terms = np.concatenate(
            [np.moveaxis(self._orthonormal(self.identity), 1, 2), gauge], axis=-1
        )

        def conditions(samples):
            matrix = toeplitz(compress(rows_of(terms[samples])), self.order)
            blocks = matrix.reshape(len(matrix), orders, terms.shape[-1])
            of_series, of_gauge = blocks[:, :, :size], blocks[:, :, size:]
            of_series = of_series.reshape(len(matrix), orders * size) @ null
            return np.hstack([of_series, of_gauge.reshape(len(matrix), -1)])

        fitted, count = conditions(~self.held), null.shape[1]
        both = null_space(fitted, self.tolerance, below=limit).columns
        every = np.vstack([fitted, conditions(self.held)])
        both = self._judged(both, null @ both[:count], every, limit)
        # No gauge closes the identity of X = 0: constants have been left out.
        return null @ both[:count], both[count:]

    def _variational_representatives(self, series, gauges) -> np.ndarray:
        """One series for each leading-order term, the simplest; its gauges below it."""
        blocks = gauges.reshape(self.order + 1, self.gauge_basis.size, gauges.shape[1])
        gauges = np.linalg.solve(self.R_gauge, blocks).reshape(gauges.shape)
        columns = np.vstack([self.weighed.shares(series), gauges])
        led, shifts = by_leading(series[: self.size])
        return self._simplest(columns @ led, columns @ shifts)

    def _representatives(self, space, known, free) -> np.ndarray:
        """One series for each leading-order term of a space that is not known, the simplest up to
        free ones."""
        basis = orthonormal_range(known[: self.size])
        led, _ = by_leading(space[: self.size] - basis @ (basis.T @ space[: self.size]))
        _, shifts = by_leading(space[: self.size])
        free = np.hstack([self.weighed.shares(free), self.weighed.shares(space @ shifts)])
        return self._simplest(self.weighed.shares(space @ led), free)

    def _symplectic(self, series: np.ndarray) -> np.ndarray:
        """The series that are locally Hamiltonian: ξ0 = 0 and ∂(η, −ξ)/∂(q, p) symmetric."""
        if series.shape[1] == 0:
            return series
        n = int(np.prod(self.shape, dtype=int))
        some = slice(None, None, max(1, len(self.held) // 40))
        shape = (self.order + 1, len(self.components), self.basis.size, series.shape[1])
        c = self.weighed.shares(series).reshape(shape) / self.weighed.rms[:, None]
        slopes = self.raw.slopes[some, 0, :, 1:] * self.components[-2 * n :]
        slopes = np.einsum("sbj,mibk->smijk", slopes, c[:, -2 * n :])
        matrix = np.concatenate([slopes[:, :, n:], -slopes[:, :, :n]], axis=2)
        left = [(matrix - matrix.swapaxes(2, 3)).reshape(-1, series.shape[1])]
        if len(self.components) > 2 * n:
            values = self.raw.values[some, 0, 0]
            left.append(np.einsum("sb,mbk->smk", values, c[:, 0]).reshape(-1, series.shape[1]))
        rows = np.concatenate(left) / np.sqrt(len(slopes))
        singular, V = singular_vectors(rows)
        return series @ V[singular <= RANK].T

    def _simplest(self, columns: np.ndarray, free: np.ndarray) -> np.ndarray:
        """The same series up to the free ones, with complex functions as little as can be."""
        if columns.shape[1] == 0:
            return columns
        complexity = np.tile(self.complexity, self.order + 1).astype(float)
        if free.size:  # among equals first where the free series are large, and ξ before η
            share = np.max(np.abs(free[: len(complexity)]), axis=1)
            complexity += 0.5 * (share > 0.5 * np.max(share))
            complexity -= np.linspace(0, 0.1, len(complexity))
        simplify = reduction(free, complexity, self.size)
        columns = np.stack([simplify(c.copy()) for c in columns.T], axis=1)
        columns = reduced(columns, self.complexity)
        return np.stack([simplify(c.copy()) for c in columns.T], axis=1)

    def _symmetry(self, vector, variational, symplectic, before) -> Symmetry:
        orders, components = self.order + 1, len(self.components)
        shares = vector[: orders * self.size].reshape(orders, components, self.basis.size)
        above = (_TINY if self.null <= NULL else self.null) * np.max(np.abs(shares))
        shares = np.where(np.abs(shares) > above, shares, 0.0)
        x = shares / self.weighed.rms  # in units of the components
        sizes = x[0] * self.components[:, None]
        largest = np.argmax(np.round(np.abs(sizes) / np.max(np.abs(sizes)), 6))
        scale = 1 / sizes.ravel()[largest]
        x = x * scale
        identity = self._sums(self.identity, x)
        if variational:
            g = vector[orders * self.size :].reshape(orders, self.gauge_basis.size)
            g = np.where(np.abs(g) > (above if self.null > NULL else 0), g, 0.0) * scale
        else:
            g = self._best_gauge(identity)
        identity = identity + series_changes(self.gauge, g.reshape(-1, 1))[..., 0]
        held = self.held
        residuals = self._residuals(x, self.motion.at(held), self.determining[held])
        identity_residuals = self._relative(identity, self.identity_parts, x)
        c = x * self.components[:, None]
        c, g = (in_units_of(1 / self.weighed.scale, x, axis=0) for x in (c, g))
        generators = tuple(self._generator(x) for x in c)
        gauges = tuple(BasisGauge(self.gauge_basis, jnp.asarray(x / self.gauge_units)) for x in g)
        return Symmetry(
            generators=generators,
            is_variational=variational,
            gauges=gauges if variational else None,
            residuals=np.max(residuals, axis=0),
            typical_residuals=np.quantile(residuals, [0.5, 0.95], axis=0).T,
            identity_residuals=np.max(identity_residuals, axis=0),
            is_dependent=self._depends(c, before),
            is_symplectic=symplectic and all(g.xi0 is None for g in generators),
            coefficients=c,
            names=self.names,
            basis=self.basis,
            scale=self.weighed.scale,
            sizes=self.weighed.rms / self.components[:, None],
            gauge_sizes=self.gauge_units,
        )

    def _generator(self, c: np.ndarray) -> Generator:
        n = int(np.prod(self.shape, dtype=int))
        xi0 = c[0] if len(c) > 2 * n else np.zeros(self.basis.size)
        xi, eta = (x.reshape(*self.shape, -1) for x in (c[-2 * n : -n], c[-n:]))
        parts = (xi0, xi, eta)
        return Generator(
            *(BasisGauge(self.basis, jnp.asarray(x)) if x.any() else None for x in parts)
        )

    def _sums(self, terms, c) -> np.ndarray:
        """Σ_m terms_{k−m} c_m, shape (S, z + 1, rows)."""
        flat = terms.reshape(*terms.shape[:3], -1)
        return series_changes(flat, c.reshape(-1, 1))[..., 0]

    def _best_gauge(self, identity) -> np.ndarray:
        """The gauge that closes the identity best on the fitted samples."""
        fit = ~self.held
        terms = rows_of(np.moveaxis(self.gauge[fit], 1, 2))
        right = -rows_of(np.moveaxis(identity[fit], 1, 2))
        return solve_series(terms, right)[0].reshape(self.order + 1, self.gauge_basis.size)

    def _residuals(self, x, motion: FieldMotion, determining: np.ndarray) -> np.ndarray:
        """What a field leaves of the determining equations, by the measure of `FieldMotion`, at
        each sample and order: shape (S, z + 1)."""
        field = np.einsum("sb,cb->sc", self.motion.values, x[0])
        calm = self.weighed.calm**2 / np.sum(self.weighed.calm**2)
        size = max(float(np.sqrt(calm @ np.sum(field**2, axis=1))), np.finfo(float).tiny)
        digits = size * coefficient_errors(self._orthonormal(determining))
        terms, series = self._unknowns(determining), x.reshape(len(x), -1)
        return relative_changes(terms, series, motion, size, digits)

    def powers(self, found: Symmetries, raw: Conditions, which: np.ndarray) -> np.ndarray:
        """The powers of the samples' size by which residuals grow, see `growth`.

        `raw`: the conditions at the larger samples.
        """
        motion, determining = self.units.determining(raw)
        flat = determining.reshape(len(which), -1), *(x.reshape(len(which), -1) for x in motion)
        good = (raw.good[:, 0] == 1) & np.all([np.isfinite(x).all(axis=1) for x in flat], axis=0)

        def changes(some):
            at, terms = motion.at(some), determining[some]
            left = [
                self._residuals(s.coefficients / self.components[:, None], at, terms) for s in found
            ]
            return np.quantile(np.array(left)[:, :, 0], 0.95, axis=1)

        most = np.array([s.typical_residuals[0, 1] for s in found])
        return growth(most, which, good, changes)

    def _relative(self, left, parts, c) -> np.ndarray:
        """The residual of each held-out sample at each order, relative to the terms of order 0 at
        that sample before they cancel: shape (held-out samples, z + 1)."""
        terms = np.einsum("sjrcb,cb->sjrc", parts[self.held], c[0])
        sizes = np.max(np.sum(np.abs(terms), axis=(1, 3)), axis=1)
        least = _LEAST * float(np.median(sizes))
        sizes = np.maximum(sizes, least) if least > 0 else np.ones(len(sizes))
        return np.max(np.abs(left[self.held]), axis=2) / sizes[:, None]

    def _depends(self, c, before: list[Symmetry]) -> bool:
        """Whether X_0 is a combination of those before it, with invariants for coefficients.

        Invariants have one value at both points of a pair: the vectors at both, as one vector,
        are then dependent.
        """
        some = slice(None, None, max(1, len(self.held) // 40))
        leading = np.stack([*(s.coefficients[0] for s in before if not s.is_dependent), c[0]])
        shares = leading / self.components[:, None]
        vectors = np.einsum("sjb,kcb->skjc", self.raw.values[some, 0], shares)
        vectors = vectors.reshape(*vectors.shape[:2], -1)
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        singular = np.linalg.svd(vectors / np.maximum(length, 1e-300), compute_uv=False)
        return int(np.median(np.sum(singular > 1e-5, axis=-1))) < len(leading)


def rows_of(terms: np.ndarray) -> np.ndarray:
    """The first two axes, samples and rows, as one."""
    return terms.reshape(terms.shape[0] * terms.shape[1], *terms.shape[2:])


def _component_names(shape: tuple[int, ...]) -> tuple[str, ...]:
    names = coordinate_names(shape)
    half = len(names) // 2
    return ("ξ0", *(f"ξ_{v}" for v in names[:half]), *(f"η_{v}" for v in names[half:]))
