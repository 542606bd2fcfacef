"""The linear algebra of a search for symmetries: null series, their kinds and representatives."""

import jax.numpy as jnp
import numpy as np

from ..algebra import nullspace
from ..algebra.echelon import reduced_echelon, reduction
from ..algebra.motion import FieldMotion, coefficient_errors, conserved_series, relative_changes
from ..algebra.nullspace import NULL, by_leading, compress, in_units_of, singular_vectors
from ..algebra.weighing import of_orthonormal, times_weights, typical_sizes, weigh
from ..functions.basis import BoundBasis
from ..functions.families import coordinate_names
from ..functions.generators import Generator
from ..functions.sampling import SamplePoints
from ..invariants.expansions import growth
from ..invariants.judging import CLEARLY
from .conditions import Conditions
from .gauge import BasisGauge
from .symmetry import Symmetries, Symmetry
from .units import Units

Bases = tuple[BoundBasis, BoundBasis]  # Of the components of fields, and of the gauges

_NEARLY = 1e-8  # Noether's identity has to close to this at least
_SMALLEST = 1e-4  # Terms of a sample are at least this fraction of the median of all samples
_TINY = 1e-12  # Coefficients whose share of a generator is below this are round-off


class SymmetrySearch:
    """The linear algebra: unknowns are shares of orthonormal functions, rows without units.

    - `raw`, `basis`, `gauge_basis`, `tolerance`: what was sampled. `shape`: of a state.
      `held_out`: which samples are not fitted. `units`: see `Units`.
    - `conditions`: the determining equations. `motion`, `determining`: the same in the user's
      functions.
    - `identity`: of Noether, shape (S, z + 1, rows, C, B); `identity_parts`: of each point apart,
      at ε = 0; `identity_terms`: as `identity`, of the orthonormal functions. `gauge`: terms of the
      gauges in `gauge_units`, (S, z + 1, rows, gauge functions); `R_gauge`: of their QR
      decomposition.
    - `null`: the largest relative singular value of a null vector.
    """

    def __init__(
        self, raw: Conditions, samples: SamplePoints, h: float, time: bool, bases: Bases, tolerance
    ):
        self.raw, self.shape, self.tolerance = raw, samples.q.shape[1:], tolerance
        self.basis, self.gauge_basis = bases
        self.held_out, self.units = samples.held_out, Units.from_samples(raw, samples, h, time)
        self.motion, determining = self.units.determining(raw)
        values, fit = raw.values[:, 0, 0], ~self.held_out
        self.conditions = weigh(values, determining, self.motion, fit, in_sizes=False)
        # What rounding hides, as a share of what fields typically change by.
        rounding = np.median(1 / (self.conditions.weights * self.conditions.motion.typical()))
        self.null = self.tolerance or NULL * max(1.0, float(rounding))
        identity, gauge = self.units.closing(raw)
        size = typical_sizes(rows_of(gauge[:, 0]))[0]
        self.gauge_units = np.where(size > 0, size, 1.0)
        gauge = gauge / self.gauge_units
        # Every sample counts alike, however strong its kick.
        terms = of_orthonormal(identity, self.conditions.units, self.conditions.R)
        size = np.sqrt(np.sum(terms[:, 0] ** 2, axis=(1, 2, 3, 4)))
        size = np.hypot(np.where(size > 0, size, 1.0), np.linalg.norm(gauge[:, 0], axis=(1, 2)))
        scale = self.conditions.scale
        identity, terms, self.gauge = (
            in_units_of(scale, times_weights(x, 1 / size)) for x in (identity, terms, gauge)
        )
        self.determining = in_units_of(scale, determining)
        self.identity, self.identity_parts = identity.sum(axis=2), identity[:, 0]
        self.identity_terms = terms.sum(axis=2)
        gauge_rows = rows_of(self.gauge[fit, 0])
        self.R_gauge = nullspace.triangle(gauge_rows) / np.sqrt(len(gauge_rows))

    @property
    def order(self) -> int:
        return self.determining.shape[1] - 1

    @property
    def size(self) -> int:
        """The number of unknowns of each order."""
        return len(self.units.components) * self.basis.size

    @property
    def n(self) -> int:
        """The number of coordinates q."""
        return len(self.units.rows) // 2

    def spaces(self) -> list[nullspace.SeriesSpace]:
        """The null spaces of the determining equations, order by order."""
        motion, terms = self.conditions.motion, self._unknowns(self.conditions.terms)

        def judge(leading, shifts):
            """Fields that begin at a later order are series of fewer orders."""
            leading, unclear = conserved_series(leading, terms, motion, self.tolerance)
            later = shifts[self.size :]
            if not later.size:
                return leading, shifts, unclear
            first, free = by_leading(later[: self.size])
            later = np.hstack(judge(later @ first, later @ free)[:2])
            return leading, np.vstack([np.zeros((self.size, later.shape[1])), later]), unclear

        rows = np.moveaxis(times_weights(terms, self.conditions.weights), 1, 2)[~self.held_out]
        return nullspace.series_spaces(compress(rows_of(rows)), judge, self.tolerance)

    @property
    def count(self) -> int:
        """How many fields are symmetries of order 0."""
        return self.spaces()[0].leading.shape[1]

    def result(self) -> Symmetries:
        """The symmetries, in as few functions as can be."""
        spaces = self.spaces()
        space = spaces[-1]
        null = np.hstack([space.leading, space.shifts])
        # Null vectors hold a share of 1 / gap of directions that are nearly null.
        limit = max(self.null, min(1 / space.gap, _NEARLY)) if space.gap > 1 else self.null
        variational, gauges = self._variational(null, limit)
        symplectic = self._symplectic(null)
        union = np.hstack([variational, symplectic])
        groups = (
            self._variational_representatives(variational, gauges),
            self._representatives(symplectic, variational, self._symplectic(variational)),
            self._representatives(null, union, union),
        )
        symmetries: list[Symmetry] = []
        rejections = unclear = 0
        for kind, group in enumerate(groups):
            for vector in group.T:
                symmetry = self._symmetry(vector, kind == 0, kind < 2, symmetries)
                if self.tolerance is None and np.max(symmetry.typical_residuals) > CLEARLY:
                    rejections += 1
                else:
                    symmetries.append(symmetry)
        if self.tolerance is None:
            count = self.conditions.motion.unclear_count() - spaces[0].leading.shape[1]
            unclear = rejections + max(space.unclear for space in spaces) + max(count, 0)
        return Symmetries(
            found=tuple(symmetries),
            survivors=tuple(space.leading.shape[1] for space in spaces),
            singular_values=space.singular_values,
            gap=space.gap,
            null=self.null,
            refused=space.rejections + rejections,
            undecided=int(unclear),
            powers=np.full(len(symmetries), np.nan),
            larger=(),
            basis=self.basis,
            gauge_basis=self.gauge_basis,
        )

    def _unknowns(self, terms: np.ndarray) -> np.ndarray:
        """Terms (S, z + 1, rows, C, B) with one axis of unknowns, (S, z + 1, rows, C · B)."""
        return terms.reshape(*terms.shape[:3], self.size)

    def _variational(self, null: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
        """The series in the null space whose identity closes, and their gauges."""
        orders, size, count = self.order + 1, self.size, null.shape[1]
        if count == 0:
            return null, np.zeros((orders * self.gauge_basis.size, 0))
        gauge = of_orthonormal(self.gauge, np.ones(len(self.R_gauge)), self.R_gauge)
        terms = np.concatenate([self._unknowns(self.identity_terms), gauge], axis=-1)
        terms = np.moveaxis(terms, 1, 2)

        def conditions(index):
            matrix = nullspace.toeplitz(compress(rows_of(terms[index])), self.order)
            blocks = matrix.reshape(len(matrix), orders, terms.shape[-1])
            of_series, of_gauge = blocks[:, :, :size], blocks[:, :, size:]
            of_series = of_series.reshape(len(matrix), orders * size) @ null
            return np.hstack([of_series, of_gauge.reshape(len(matrix), -1)])

        fit = conditions(~self.held_out)
        columns = nullspace.null_space(fit, self.tolerance, limit=limit).columns
        if columns.shape[1]:
            # A vector can be null only because its leading-order term is small, therefore the
            # leading-order terms are made orthonormal; then all samples have to take it for null.
            columns = columns @ np.hstack(by_leading((null @ columns[:count])[:size]))
            rows = np.vstack([fit, conditions(self.held_out)])
            norm = max(np.linalg.norm(rows, 2), np.finfo(float).tiny)
            singular, V = singular_vectors(rows @ columns / norm)
            columns = columns @ V[singular <= nullspace.HELD_OUT * limit].T
        # No gauge closes the identity of X = 0: constants have been left out.
        return null @ columns[:count], columns[count:]

    def _variational_representatives(self, series, gauges) -> np.ndarray:
        """One series for each leading-order term, the simplest; its gauges below it."""
        blocks = gauges.reshape(self.order + 1, self.gauge_basis.size, gauges.shape[1])
        gauges = np.linalg.solve(self.R_gauge, blocks).reshape(gauges.shape)
        columns = np.vstack([self.conditions.shares(series), gauges])
        first, shifts = by_leading(series[: self.size])
        return self._simplest(columns @ first, columns @ shifts)

    def _representatives(self, space, excluded_series, free) -> np.ndarray:
        """The simplest series, up to free ones, for each leading-order term of a space, without
        those of excluded series."""
        basis = nullspace.orthonormal_range(excluded_series[: self.size])
        leading = space[: self.size]
        first, _ = by_leading(leading - basis @ (basis.T @ leading))
        _, shifts = by_leading(leading)
        free = np.hstack([self.conditions.shares(free), self.conditions.shares(space @ shifts)])
        return self._simplest(self.conditions.shares(space @ first), free)

    def _symplectic(self, series: np.ndarray) -> np.ndarray:
        """The series that are locally Hamiltonian: ξ0 = 0 and ∂(η, −ξ)/∂(q, p) symmetric."""
        if series.shape[1] == 0:
            return series
        n, shape = self.n, (self.order + 1, len(self.units.components), self.basis.size, -1)
        c = self.conditions.shares(series).reshape(shape) / self.conditions.rms[:, None]
        slopes = self.raw.slopes[self._sparse, 0, :, 1:] * self.units.components[-2 * n :]
        slopes = np.einsum("sbj,mibk->smijk", slopes, c[:, -2 * n :])
        matrix = np.concatenate([slopes[:, :, n:], -slopes[:, :, :n]], axis=2)
        rows = [(matrix - matrix.swapaxes(2, 3)).reshape(-1, series.shape[1])]
        if len(self.units.components) > 2 * n:
            values = self.raw.values[self._sparse, 0, 0]
            rows.append(np.einsum("sb,mbk->smk", values, c[:, 0]).reshape(-1, series.shape[1]))
        singular, V = singular_vectors(np.concatenate(rows) / np.sqrt(len(slopes)))
        return series @ V[singular <= nullspace.RANK].T

    @property
    def _sparse(self) -> slice:
        """About forty of the samples."""
        return slice(None, None, max(1, len(self.held_out) // 40))

    def _simplest(self, columns: np.ndarray, free: np.ndarray) -> np.ndarray:
        """The same series up to the free ones, with complex functions as little as can be."""
        if columns.shape[1] == 0:
            return columns
        of_fields = np.tile(self.basis.complexity, len(self.units.components))
        complexity = np.tile(of_fields, self.order + 1).astype(float)
        if free.size:  # among equals first where the free series are large, and ξ before η
            share = np.max(np.abs(free[: len(complexity)]), axis=1)
            complexity += 0.5 * (share > 0.5 * np.max(share))
            complexity -= np.linspace(0, 0.1, len(complexity))
        simplify = reduction(free, complexity, self.size)
        columns = np.stack([simplify(c.copy()) for c in columns.T], axis=1)
        columns = reduced_echelon(columns, of_fields)
        return np.stack([simplify(c.copy()) for c in columns.T], axis=1)

    def _symmetry(self, vector, variational, symplectic, simpler: list[Symmetry]) -> Symmetry:
        orders, held_out = self.order + 1, self.held_out
        shares = vector[: orders * self.size].reshape(orders, len(self.units.components), -1)
        smallest = (_TINY if self.null <= NULL else self.null) * np.max(np.abs(shares))
        shares = np.where(np.abs(shares) > smallest, shares, 0.0)
        x = shares / self.conditions.rms  # in units of the components
        sizes = x[0] * self.units.components[:, None]
        largest = np.argmax(np.round(np.abs(sizes) / np.max(np.abs(sizes)), 6))
        scale = 1 / sizes.ravel()[largest]
        x = x * scale
        identity = nullspace.series_changes(self._unknowns(self.identity), x.reshape(-1, 1))[..., 0]
        if variational:
            g = vector[orders * self.size :].reshape(orders, self.gauge_basis.size)
            g = np.where(np.abs(g) > (smallest if self.null > NULL else 0), g, 0.0) * scale
        else:
            g = self._best_gauge(identity)
        identity = identity + nullspace.series_changes(self.gauge, g.reshape(-1, 1))[..., 0]
        motion, determining = self.motion.subset(held_out), self.determining[held_out]
        errors = coefficient_errors(self.conditions.terms[held_out])
        residuals = self._residuals(x, motion, determining, errors)
        identity_residuals = self._relative(identity, x[0])
        c = x * self.units.components[:, None]
        c, g = (in_units_of(1 / self.conditions.scale, x, axis=0) for x in (c, g))
        generators = tuple(map(self._generator, c))
        gauges = tuple(BasisGauge(self.gauge_basis, jnp.asarray(x / self.gauge_units)) for x in g)
        return Symmetry(
            generators=generators,
            is_variational=variational,
            gauges=gauges if variational else None,
            residuals=np.max(residuals, axis=0),
            typical_residuals=np.quantile(residuals, [0.5, 0.95], axis=0).T,
            identity_residuals=np.max(identity_residuals, axis=0),
            is_dependent=self._depends(c, simpler),
            is_symplectic=symplectic and all(g.xi0 is None for g in generators),
            coefficients=c,
            names=_component_names(self.shape)[self.units.columns],
            basis=self.basis,
            scale=self.conditions.scale,
            sizes=self.conditions.rms / self.units.components[:, None],
            gauge_sizes=self.gauge_units,
        )

    def _generator(self, c: np.ndarray) -> Generator:
        n, shape = self.n, (*self.shape, -1)
        xi0 = c[0] if len(c) > 2 * n else np.zeros(self.basis.size)
        parts = xi0, c[-2 * n : -n].reshape(shape), c[-n:].reshape(shape)
        fields = (BasisGauge(self.basis, jnp.asarray(x)) if x.any() else None for x in parts)
        return Generator(*fields)

    def _best_gauge(self, identity) -> np.ndarray:
        """The gauge that closes the identity best on the fitted samples."""
        arrays = (x[~self.held_out] for x in (self.gauge, -identity))
        series, _ = nullspace.solve_series(*(rows_of(np.moveaxis(x, 1, 2)) for x in arrays))
        return series.reshape(self.order + 1, self.gauge_basis.size)

    def _residuals(self, x, motion: FieldMotion, determining, errors) -> np.ndarray:
        """The residuals of a field in the determining equations, by the measure of `FieldMotion`,
        at each sample and order: shape (S, z + 1). `errors`: see `coefficient_errors`."""
        field = np.einsum("sb,cb->sc", self.motion.values, x[0])
        calm = self.conditions.calm**2 / np.sum(self.conditions.calm**2)
        size = max(float(np.sqrt(calm @ np.sum(field**2, axis=1))), np.finfo(float).tiny)
        terms, series = self._unknowns(determining), x.reshape(len(x), -1)
        return relative_changes(terms, series, motion, size, size * errors)

    def powers(self, symmetries: Symmetries, raw: Conditions, factors: np.ndarray) -> np.ndarray:
        """The powers of the samples' size by which residuals grow, see `growth`; `raw`: the
        conditions at the larger samples; `factors`: by what these are larger."""
        motion, determining = self.units.determining(raw)
        finite = [np.isfinite(x.reshape(len(x), -1)).all(axis=1) for x in (determining, *motion)]
        good = (raw.good[:, 0] == 1) & np.all(finite, axis=0)

        def changes(index):
            terms = determining[index]
            errors = coefficient_errors(terms @ self.conditions.orthonormal)
            units, data = self.units.components[:, None], (motion.subset(index), terms, errors)
            residuals = [self._residuals(s.coefficients / units, *data) for s in symmetries]
            return np.quantile(np.array(residuals)[:, :, 0], 0.95, axis=1)

        typical = np.array([s.typical_residuals[0, 1] for s in symmetries])
        return growth(typical, factors, good, changes)

    def _relative(self, identity, leading) -> np.ndarray:
        """The residual of each held-out sample at each order, relative to the terms of order 0 at
        that sample before they cancel: shape (held-out samples, z + 1)."""
        terms = np.einsum("sjrcb,cb->sjrc", self.identity_parts[self.held_out], leading)
        sizes = np.max(np.sum(np.abs(terms), axis=(1, 3)), axis=1)
        smallest = _SMALLEST * float(np.median(sizes))
        sizes = np.maximum(sizes, smallest) if smallest > 0 else np.ones(len(sizes))
        return np.max(np.abs(identity[self.held_out]), axis=2) / sizes[:, None]

    def _depends(self, c, simpler: list[Symmetry]) -> bool:
        """Whether X_0 is a combination of simpler ones, with invariants for coefficients: the
        vectors at both points of a pair, as one vector, are then dependent."""
        leading = np.stack([*(s.coefficients[0] for s in simpler if not s.is_dependent), c[0]])
        shares = leading / self.units.components[:, None]
        vectors = np.einsum("sjb,kcb->skjc", self.raw.values[self._sparse, 0], shares)
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
    return ("ξ0", *(f"ξ_{name}" for name in names[:half]), *(f"η_{name}" for name in names[half:]))
