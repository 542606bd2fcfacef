"""The linear algebra of a search for symmetries: null series, their kinds and representatives."""

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
    epsilon_scale,
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
from ..functions.families import coordinate_names
from ..functions.generators import Generator
from ..functions.sampling import rounding, spread
from ..invariants.expansions import growth
from ..invariants.judging import CLEARLY
from .conditions import Conditions
from .found import Symmetries, Symmetry
from .gauge import BasisGauge

_NEARLY = 1e-8  # Noether's identity has to close to this at least
_LEAST = 1e-4  # Terms of a sample are at least this fraction of the median of all samples
_TINY = 1e-12  # Coefficients whose share of a generator is below this are round-off


class Search:
    """The linear algebra: unknowns are shares of orthonormal functions, rows without units."""

    def __init__(self, raw, samples, h, time, basis, gauge_basis, tolerance):
        self.raw, self.basis, self.gauge_basis = raw, basis, gauge_basis
        self.shape = samples.q.shape[1:]
        self.names = _component_names(self.shape)[0 if time else 1 :]
        self.held, self.tolerance = samples.held_out, tolerance
        self.order = raw.determining.shape[1] - 1
        fit, n = ~self.held, samples.q[0].size
        q, p = spread(samples.q), spread(samples.p)
        rows = h / np.repeat([q, p], n)
        rate = float(np.median(np.sqrt(np.mean((raw.clock[fit, 0] * rows) ** 2, axis=1))))
        t = 1 / rate if rate > 0 else 1.0
        used = slice(0 if time else 1, None)
        self.units = np.repeat([t, q, p], [1, n, n])[used]
        self.size = len(self.units) * basis.size  # unknowns of each order
        values = raw.values[:, 0, 0]
        self.rms, self.calm = typical_sizes(values)
        self.R = triangle((self.calm[:, None] * values)[fit]) / np.sqrt(np.sum(fit))
        actions = h / (q * p) * np.repeat([1, q, p], [1, n, n])

        self.used, self.rows, self.lost = used, rows, rounding(samples)
        self.motion, determining = self._without_units(raw)
        motion = self.motion.of_functions(np.linalg.inv(self.R))
        weights = motion.weights()
        self.weights = weights.reshape(-1, 1, 1, 1)
        # What rounding hides, as a share of what fields typically change by.
        hidden = np.median(1 / (weights * motion.typical()))
        self.null = tolerance or NULL * max(1.0, float(hidden))
        self.undecided = 0 if tolerance else motion.undecided()
        identity = raw.identity[..., used, :] * actions[:, None, None] * self.units[:, None]
        gauge = raw.gauge * actions[:, None]
        size = typical_sizes(rows_of(gauge[:, 0]))[0]
        self.gauge_units = np.where(size > 0, size, 1.0)
        gauge = gauge / self.gauge_units
        # Every sample counts alike, however strong its kick.
        of_identity = np.hypot(self._size(identity), np.linalg.norm(gauge[:, 0], axis=(1, 2)))
        identity = identity / of_identity.reshape(-1, 1, 1, 1, 1, 1)
        gauge = gauge / of_identity.reshape(-1, 1, 1, 1)
        # ε in the unit in which the perturbation is as large as the rest
        sums = self.weights * self._orthonormal(determining)
        self.scale = epsilon_scale(rows_of(sums[fit]))
        determining, identity = (in_units_of(self.scale, x) for x in (determining, identity))
        self.determining, self.identity = determining, identity.sum(axis=2)
        self.identity_parts = identity[:, 0]  # of each point, at ε = 0
        self.gauge = in_units_of(self.scale, gauge)
        of_fit = rows_of(self.gauge[fit, 0])
        self.R_gauge = triangle(of_fit) / np.sqrt(len(of_fit))
        self.complexity = np.tile(basis.complexity, len(self.units))

    def _without_units(self, raw: Conditions) -> tuple[FieldMotion, np.ndarray]:
        """`FieldMotion` of the user's functions, and the determining equations, (S, z + 1, rows, C,
        B). All samples count alike, also where the derivatives of F are large."""
        jacobian = raw.jacobian[:, 0][..., self.used] * self.rows[:, None, None] * self.units
        motion = _motion(raw, jacobian, self.lost)
        size = np.max(motion.second, axis=1)
        size = np.where(size > 0, size, 1.0)
        terms = raw.determining.sum(axis=2)[..., self.used, :]
        terms = terms * self.rows[:, None, None] * self.units[:, None]
        return motion.over(size), terms / size.reshape(-1, 1, 1, 1, 1)

    def spaces(self) -> list[SeriesSpace]:
        """The null spaces of the determining equations, order by order."""
        rows = self._orthonormal(self.determining)
        terms = np.moveaxis(rows, 2, 1)
        motion = self.motion.of_functions(np.linalg.inv(self.R))

        def judge(leading, shifts):
            """Fields that begin at a later order are series of fewer orders."""
            kept, unclear = conserved(leading, terms, motion, self.tolerance)
            later = shifts[self.size :]
            if not later.size:
                return kept, shifts, unclear
            led, free = by_leading(later[: self.size])
            parts = judge(later @ led, later @ free)
            later = np.hstack(parts[:2])
            return kept, np.vstack([np.zeros((self.size, later.shape[1])), later]), unclear

        fitted = compress(rows_of((self.weights * rows)[~self.held]))
        return series_spaces(fitted, judge, self.tolerance)

    def result(self) -> Symmetries:
        """The symmetries, in as few functions as can be."""
        spaces = self.spaces()
        space = spaces[-1]
        null = np.hstack([space.leading, space.shifts])
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
            unclear += max(self.undecided - spaces[0].leading.shape[1], 0)
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

    def _size(self, terms: np.ndarray) -> np.ndarray:
        """How large the terms of each sample are at ε = 0, of both points apart; 1 for none."""
        parts = [self._orthonormal(terms[:, :1, j]) for j in range(2)]
        size = np.sqrt(sum(np.sum(x**2, axis=(1, 2, 3)) for x in parts))
        return np.where(size > 0, size, 1.0)

    def _orthonormal(self, terms: np.ndarray) -> np.ndarray:
        """Terms (S, z + 1, rows, C, B) for unknown shares, (S, rows, z + 1, unknowns)."""
        flat = np.linalg.solve(self.R.T, terms.reshape(-1, self.basis.size).T).T
        return np.moveaxis(flat.reshape(*terms.shape[:3], self.size), 1, 2)

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
        """One series for each leading-order term, the simplest; its gauges below it."""
        blocks = gauges.reshape(self.order + 1, self.gauge_basis.size, gauges.shape[1])
        gauges = np.linalg.solve(self.R_gauge, blocks).reshape(gauges.shape)
        columns = np.vstack([self._shares(series), gauges])
        led, shifts = by_leading(series[: self.size])
        return self._simplest(columns @ led, columns @ shifts)

    def _representatives(self, space, known, free) -> np.ndarray:
        """One series for each leading-order term of a space that is not known, the simplest up to
        free ones."""
        basis = orthonormal_range(known[: self.size])
        led, _ = by_leading(space[: self.size] - basis @ (basis.T @ space[: self.size]))
        _, shifts = by_leading(space[: self.size])
        free = np.hstack([self._shares(free), self._shares(space @ shifts)])
        return self._simplest(self._shares(space @ led), free)

    def _symplectic(self, series: np.ndarray) -> np.ndarray:
        """The series that are locally Hamiltonian: ξ0 = 0 and ∂(η, −ξ)/∂(q, p) symmetric."""
        if series.shape[1] == 0:
            return series
        n = int(np.prod(self.shape, dtype=int))
        some = slice(None, None, max(1, len(self.held) // 40))
        shape = (self.order + 1, len(self.units), self.basis.size, series.shape[1])
        c = self._shares(series).reshape(shape) / self.rms[:, None]
        slopes = self.raw.slopes[some, 0, :, 1:] * self.units[-2 * n :]
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
        x = shares / self.rms  # in units of the components
        sizes = x[0] * self.units[:, None]
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
        c = x * self.units[:, None]
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
        calm = self.calm**2 / np.sum(self.calm**2)
        size = max(float(np.sqrt(calm @ np.sum(field**2, axis=1))), np.finfo(float).tiny)
        terms = determining.reshape(*determining.shape[:3], -1)
        digits = size * coefficient_errors(self._orthonormal(determining))
        return relative_changes(terms, x.reshape(len(x), -1), motion, size, digits)

    def powers(self, found: Symmetries, raw: Conditions, which: np.ndarray) -> np.ndarray:
        """The powers of the samples' size by which residuals grow, see `growth`.

        `raw`: the conditions at the larger samples.
        """
        motion, determining = self._without_units(raw)
        flat = determining.reshape(len(which), -1), *(x.reshape(len(which), -1) for x in motion)
        good = (raw.good[:, 0] == 1) & np.all([np.isfinite(x).all(axis=1) for x in flat], axis=0)

        def changes(some):
            at, terms = motion.at(some), determining[some]
            left = [self._residuals(s.coefficients / self.units[:, None], at, terms) for s in found]
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
        shares = leading / self.units[:, None]
        vectors = np.einsum("sjb,kcb->skjc", self.raw.values[some, 0], shares)
        vectors = vectors.reshape(*vectors.shape[:2], -1)
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        singular = np.linalg.svd(vectors / np.maximum(length, 1e-300), compute_uv=False)
        return int(np.median(np.sum(singular > 1e-5, axis=-1))) < len(leading)


def _motion(raw: Conditions, jacobian: np.ndarray, lost: float) -> FieldMotion:
    """Of the user's functions. `jacobian`: ∂F/∂z of both points, shape (S, 2n, 2, C), without
    units; `lost`: the last digit of the coordinates as a share of how much they vary."""
    values, later = raw.values[:, 0, 0], raw.values[:, 0, 1]
    places = raw.points[:, 0]
    slopes = raw.slopes[:, 0].swapaxes(1, 2)
    changes = slopes * np.diff(places, axis=1)[:, 0, :, None]
    parts = jacobian[:, :, 0], jacobian[:, :, 1], jacobian.sum(axis=2)
    before, second, both = (np.linalg.norm(x, axis=1) for x in parts)
    # φ(z0) and φ(z1), each with the last digit of the point where it is taken
    blur = np.einsum("sdb,sd->sb", np.abs(slopes), np.sum(np.abs(places), axis=1))
    sizes = before[..., None] * np.abs(values)[:, None]
    sizes = sizes + second[..., None] * (np.abs(later) + blur)[:, None]
    predicted = second[..., None] * np.sum(np.abs(changes), axis=1)[:, None]
    predicted = predicted + both[..., None] * np.abs(values)[:, None]
    rounded = np.finfo(float).eps * sizes + lost * predicted
    return FieldMotion(values, changes, second, both, rounded)


def rows_of(terms: np.ndarray) -> np.ndarray:
    """The first two axes, samples and rows, as one."""
    return terms.reshape(terms.shape[0] * terms.shape[1], *terms.shape[2:])


def _component_names(shape: tuple[int, ...]) -> tuple[str, ...]:
    names = coordinate_names(shape)
    half = len(names) // 2
    return ("ξ0", *(f"ξ_{v}" for v in names[:half]), *(f"η_{v}" for v in names[half:]))
