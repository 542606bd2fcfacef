"""The linear algebra of a search for symmetries: null series, their kinds and representatives."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..engine.echelon import reduced, reduction
from ..engine.nullspace import (
    HELD_OUT,
    NULL,
    RANK,
    by_leading,
    compress,
    epsilon_scale,
    in_units_of,
    null_space,
    orthonormal_range,
    rank,
    series_changes,
    singular_vectors,
    toeplitz,
    triangle,
    typical_sizes,
)
from .families import coordinate_names
from .gauge import BasisGauge
from .generators import Generator
from .sampling import rounding, spread
from .symmetries import BasisComponent, Symmetries, Symmetry

_ROUNDINGS = 100.0
"""Conditions below so many times the rounding of the samples count as fulfilled."""

_CLEARLY = 1e-5
"""A vector field with a larger residual at more than 5 % of the held-out samples is no symmetry."""

_NEARLY = 1e-8
"""Noether's identity has to close to this at least."""

_LEAST = 1e-4
"""Terms of a sample are at least this fraction of the median of all samples."""

_TINY = 1e-12
"""Coefficients whose share of a generator is below this are round-off."""


class Search:
    """The linear algebra: unknowns are shares of orthonormal functions, rows without units."""

    def __init__(self, raw, samples, h, time, basis, gauge_basis, tolerance):
        self.raw, self.basis, self.gauge_basis = raw, basis, gauge_basis
        self.shape = samples.q.shape[1:]
        self.names = _component_names(self.shape)[0 if time else 1 :]
        self.held, self.tolerance = samples.held_out, tolerance
        self.null = tolerance or max(NULL, _ROUNDINGS * rounding(samples))
        self.order = raw.determining.shape[1] - 1
        fit, n = ~self.held, raw.slopes.shape[3] // 2
        q, p = spread(samples.q), spread(samples.p)
        rows = h / np.repeat([q, p], n)
        t = _inverse(np.median(np.sqrt(np.mean((raw.clock[fit, 0] * rows) ** 2, axis=1))))
        used = slice(0 if time else 1, None)
        self.units = np.repeat([t, q, p], [1, n, n])[used]
        self.size = len(self.units) * basis.size  # unknowns of each order
        values = raw.values[:, 0, 0]
        self.rms, calm = typical_sizes(values)
        self.R = triangle((calm[:, None] * values)[fit]) / np.sqrt(np.sum(fit))
        actions = h / (q * p) * np.repeat([1, q, p], [1, n, n])

        determining = raw.determining[..., used, :] * rows[:, None, None]
        identity = raw.identity[..., used, :] * actions[:, None, None]
        gauge = raw.gauge * actions[:, None]
        size = typical_sizes(rows_of(gauge[:, 0]))[0]
        self.gauge_units = np.where(size > 0, size, 1.0)
        gauge = gauge / self.gauge_units
        # Every sample counts alike, however strong its kick.
        determining = determining / self._size(determining).reshape(-1, 1, 1, 1, 1, 1)
        of_identity = np.hypot(self._size(identity), np.linalg.norm(gauge[:, 0], axis=(1, 2)))
        identity = identity / of_identity.reshape(-1, 1, 1, 1, 1, 1)
        gauge = gauge / of_identity.reshape(-1, 1, 1, 1)
        # ε in the unit in which the disturbance is as large as the rest
        sums = rows_of(self._orthonormal(determining.sum(axis=2))[fit])
        self.scale = epsilon_scale(sums)
        determining, identity = (in_units_of(self.scale, x) for x in (determining, identity))
        self.determining, self.identity = determining.sum(axis=2), identity.sum(axis=2)
        self.parts = determining[:, 0], identity[:, 0]  # of each point, at ε = 0
        self.gauge = in_units_of(self.scale, gauge)
        of_fit = rows_of(self.gauge[fit, 0])
        self.R_gauge = triangle(of_fit) / np.sqrt(len(of_fit))
        self.complexity = np.tile(basis.complexity, len(self.units))

    def result(self) -> Symmetries:
        terms = self._orthonormal(self.determining)
        fitted, judged = compress(rows_of(terms[~self.held])), compress(rows_of(terms[self.held]))
        spaces = []
        for m in range(self.order + 1):
            matrix = toeplitz(fitted, m)
            space = null_space(matrix, self.tolerance, below=self.null)
            conditions = np.vstack([matrix, toeplitz(judged, m)])
            kept = self._judged(space.columns, space.columns, conditions, self.null)
            spaces.append((kept, space))
        null, space = spaces[-1]
        # Null vectors hold a share of 1 / gap of directions that are nearly null.
        self.closing = max(self.null, min(1 / space.gap, _NEARLY)) if space.gap > 1 else self.null
        closed, gauges = self._variational(null)
        symplectic = self._symplectic(null)
        both = np.hstack([closed, symplectic])
        groups = (
            self._variational_representatives(closed, gauges),
            self._representatives(symplectic, closed, self._symplectic(closed)),
            self._representatives(null, both, both),
        )
        found: list[Symmetry] = []
        refused = space.columns.shape[1] - null.shape[1]
        for kind, group in enumerate(groups):
            for vector in group.T:
                symmetry = self._symmetry(vector, kind == 0, kind < 2, found)
                if self.tolerance is None and np.max(symmetry.typical_residuals) > _CLEARLY:
                    refused += 1
                else:
                    found.append(symmetry)
        return Symmetries(
            found=tuple(found),
            survivors=tuple(rank(kept[: self.size]) for kept, _ in spaces),
            singular_values=space.singular_values,
            gap=space.gap,
            null=self.null,
            refused=refused,
            basis=self.basis,
            gauge_basis=self.gauge_basis,
        )

    def _size(self, terms: np.ndarray) -> np.ndarray:
        """How large the terms of each sample are at ε = 0, of both points apart; 1 for none."""
        parts = [self._orthonormal(terms[:, :1, j]) for j in range(2)]
        size = np.sqrt(sum(np.sum(x**2, axis=(1, 2, 3)) for x in parts))
        return np.where(size > 0, size, 1.0)

    def _orthonormal(self, terms: np.ndarray) -> np.ndarray:
        """Terms (S, z + 1, rows, C, B) for unknown shares, (S, rows, z + 1, unknowns)."""
        flat = np.linalg.solve(self.R.T, terms.reshape(-1, self.basis.size).T).T
        scaled = flat.reshape(terms.shape) * self.units[:, None]
        return np.moveaxis(scaled.reshape(*terms.shape[:3], self.size), 1, 2)

    def _judged(self, columns, series, conditions, null) -> np.ndarray:
        """The combinations of null vectors that all samples take for null, held-out ones too.

        A vector with a small leading part is null for no better reason: leading parts are made
        orthonormal first.
        """
        if columns.shape[1] == 0:
            return columns
        columns = columns @ np.hstack(by_leading(series[: self.size]))
        norm = max(np.linalg.norm(conditions, 2), np.finfo(float).tiny)
        singular, V = singular_vectors(conditions @ columns / norm)
        return columns @ V[singular <= HELD_OUT * null].T

    def _variational(self, null: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The series in the null space whose identity closes, and their gauges."""
        orders, size = self.order + 1, self.size
        if null.shape[1] == 0:
            return null, np.zeros((orders * self.gauge_basis.size, 0))
        gauge = np.linalg.solve(self.R_gauge.T, rows_of(rows_of(self.gauge)).T).T
        gauge = np.moveaxis(gauge.reshape(self.gauge.shape), 1, 2)
        terms = np.concatenate([self._orthonormal(self.identity), gauge], axis=-1)

        def conditions(samples):
            matrix = toeplitz(compress(rows_of(terms[samples])), self.order)
            blocks = matrix.reshape(len(matrix), orders, terms.shape[-1])
            of_series, of_gauge = blocks[:, :, :size], blocks[:, :, size:]
            of_series = of_series.reshape(len(matrix), orders * size) @ null
            return np.hstack([of_series, of_gauge.reshape(len(matrix), -1)])

        fitted, count = conditions(~self.held), null.shape[1]
        both = null_space(fitted, self.tolerance, below=self.closing).columns
        every = np.vstack([fitted, conditions(self.held)])
        both = self._judged(both, null @ both[:count], every, self.closing)
        # No gauge closes the identity of X = 0: constants have been left out.
        return null @ both[:count], both[count:]

    def _shares(self, columns: np.ndarray) -> np.ndarray:
        """Coefficients of the user's functions, in units of what they amount to on the samples."""
        size, count = self.basis.size, columns.shape[1]
        blocks = columns.reshape(len(columns) // size, size, count)
        return (np.linalg.solve(self.R, blocks) * self.rms[:, None]).reshape(columns.shape)

    def _variational_representatives(self, series, gauges) -> np.ndarray:
        """One series for each leading part, the simplest; its gauges below it."""
        blocks = gauges.reshape(self.order + 1, self.gauge_basis.size, gauges.shape[1])
        gauges = np.linalg.solve(self.R_gauge, blocks).reshape(gauges.shape)
        columns = np.vstack([self._shares(series), gauges])
        led, shifts = by_leading(series[: self.size])
        return self._simplest(columns @ led, columns @ shifts)

    def _representatives(self, space, known, free) -> np.ndarray:
        """One series of a space for each leading part not known, the simplest up to free ones."""
        basis = orthonormal_range(known[: self.size])
        led, _ = by_leading(space[: self.size] - basis @ (basis.T @ space[: self.size]))
        _, shifts = by_leading(space[: self.size])
        free = np.hstack([self._shares(free), self._shares(space @ shifts)])
        return self._simplest(self._shares(space @ led), free)

    def _symplectic(self, series: np.ndarray) -> np.ndarray:
        """The series that are locally Hamiltonian: ξ0 = 0 and ∂(η, −ξ)/∂(q, p) symmetric."""
        if series.shape[1] == 0:
            return series
        n = self.raw.slopes.shape[3] // 2
        some = slice(None, None, max(1, len(self.held) // 40))
        shape = (self.order + 1, len(self.units), self.basis.size, series.shape[1])
        c = self._shares(series).reshape(shape) / self.rms[:, None]
        slopes = self.raw.slopes[some, 0] * self.units[-2 * n :]
        slopes = np.einsum("sbj,mibk->smijk", slopes, c[:, -2 * n :])
        matrix = np.concatenate([slopes[:, :, n:], -slopes[:, :, :n]], axis=2)
        left = [(matrix - matrix.swapaxes(2, 3)).reshape(-1, series.shape[1])]
        if len(self.units) > 2 * n:
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
        orders, components = self.order + 1, len(self.units)
        shares = vector[: orders * self.size].reshape(orders, components, self.basis.size)
        above = (_TINY if self.null <= NULL else self.null) * np.max(np.abs(shares))
        shares = np.where(np.abs(shares) > above, shares, 0.0)
        c = shares * self.units[:, None] / self.rms
        largest = np.argmax(np.round(np.abs(c[0]) / np.max(np.abs(c[0])), 6))
        scale = 1 / c[0].ravel()[largest]
        c = c * scale
        identity = self._sums(self.identity, c)
        if variational:
            g = vector[orders * self.size :].reshape(orders, self.gauge_basis.size)
            g = np.where(np.abs(g) > (above if self.null > NULL else 0), g, 0.0) * scale
        else:
            g = self._best_gauge(identity)
        identity = identity + series_changes(self.gauge, g.reshape(-1, 1))[..., 0]
        residuals = self._relative(self._sums(self.determining, c), self.parts[0], c)
        identity_residuals = self._relative(identity, self.parts[1], c)
        c, g = (in_units_of(1 / self.scale, x, axis=0) for x in (c, g))
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
            scale=self.scale,
            sizes=self.rms / self.units[:, None],
            gauge_sizes=self.gauge_units,
        )

    def _generator(self, c: np.ndarray) -> Generator:
        n = self.raw.slopes.shape[3] // 2
        xi0 = c[0] if len(c) > 2 * n else np.zeros(self.basis.size)
        xi, eta = (x.reshape(*self.shape, -1) for x in (c[-2 * n : -n], c[-n:]))
        parts = (BasisComponent(self.basis, jnp.asarray(x)) if x.any() else None
                 for x in (xi0, xi, eta))  # fmt: skip
        return Generator(*parts)

    def _sums(self, terms, c) -> np.ndarray:
        """Σ_m terms_{k−m} c_m, shape (S, z + 1, rows)."""
        flat = terms.reshape(*terms.shape[:3], -1)
        return series_changes(flat, c.reshape(-1, 1))[..., 0]

    def _best_gauge(self, identity) -> np.ndarray:
        """The gauge that closes the identity best on the fitted samples."""
        orders, fit = self.order + 1, ~self.held
        matrix = toeplitz(rows_of(np.moveaxis(self.gauge[fit], 1, 2)), self.order)
        right = np.moveaxis(identity[fit], 1, 0).ravel()
        return np.linalg.lstsq(matrix, -right)[0].reshape(orders, self.gauge_basis.size)

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
        shares = leading / self.units[:, None]
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


def _inverse(value: Any) -> float:
    return 1 / float(value) if value > 0 else 1.0
