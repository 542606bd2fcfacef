"""Symmetries found as a null space of the determining equations on the iterated map."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._results import RESULTS
from .._step import Equations, step
from .._system import System
from .._types import Args, Interval
from ..engine.echelon import reduced, reduction
from ..engine.newton import Newton
from ..engine.nullspace import (
    NULL,
    RANK,
    compress,
    null_space,
    orthonormal_range,
    rank,
    toeplitz,
    triangle,
)
from ..engine.taylor import taylor_coefficients
from .basis import AbstractBasis, Basis, BoundBasis, Product, Sum, bind_basis, check_step_size
from .determining import discrete_equations
from .families import TIME, Polynomials, coordinate_names
from .gauge import BasisGauge
from .generators import Generator, LatticePoint
from .noether import AdiabaticInvariant
from .sampling import (
    Samples,
    as_samples,
    check_basis,
    require_enough,
    require_steps,
    require_time,
)

_HELD_OUT = 10
"""Held-out samples may leave this many times what fitted ones are allowed to."""

_TINY = 1e-12
"""Coefficients whose share of a generator is below this are round-off."""

_RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")

_LATER = (1.0, 2.7)
"""Shifts of time at which equations without t are the same."""


class BasisComponent(eqx.Module):
    """A component of a generator, c·φ(q, p, t): function ``(t, q, p, args)`` → array.

    - `coefficients`: c, shape (basis size,) for ξ0, (*q.shape, basis size) for ξ and η.
    """

    basis: BoundBasis
    coefficients: Array

    def __call__(self, t, q, p, args):
        return self.coefficients @ self.basis(q, p, t)


class Symmetry(eqx.Module):
    r"""A symmetry Σ_m ε^m X_m that `find_symmetries` found; as formulas: `str`.

    - `generators`: X_m, one for each order: for `prolong`, `determining_residual`, ….
    - `is_variational`: whether Noether's identity closes with a gauge; else it is a conformal
      symmetry only, as far as the gauge basis can tell.
    - `gauges`: G_m, one for each order; None where it is not variational.
    - `residuals`: shape (z + 1,), on held-out samples: what is left of the determining equations
      at each order in ε, relative to the size of their terms.
    - `identity_residuals`: shape (z + 1,): the same of Noether's identity and of its derivatives
      off the solutions; where it is not variational, with the best gauge in the basis.
    - `is_dependent`: whether X_0 is a combination of those listed before it with invariants of
      the undisturbed map for coefficients.
    - `is_symplectic`: whether every order is locally a Hamiltonian vector field (and ξ0 = 0).
      If it is and yet not variational, a larger gauge basis may close the identity.
    - `coefficients`: shape (z + 1, components, basis size), components ξ0 (if looked for), those
      of ξ, those of η, named in `names`.
    """

    generators: tuple[Generator, ...]
    is_variational: bool = eqx.field(static=True)
    gauges: tuple[BasisGauge, ...] | None
    residuals: np.ndarray
    identity_residuals: np.ndarray
    is_dependent: bool = eqx.field(static=True)
    is_symplectic: bool = eqx.field(static=True)
    coefficients: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    basis: BoundBasis

    @property
    def order(self) -> int:
        """z, the order up to which the series goes."""
        return len(self.generators) - 1

    @property
    def moves_time(self) -> bool:
        """Whether ξ0 is not zero: on a fixed mesh its invariant may then move by O(h)."""
        return any(generator.xi0 is not None for generator in self.generators)

    @property
    def invariant(self) -> AdiabaticInvariant | None:
        """The adiabatic invariant of order z that it leads to; None where not variational."""
        if self.gauges is None:
            return None
        return AdiabaticInvariant(list(self.generators), list(self.gauges))

    def __str__(self) -> str:
        largest = np.max(np.abs(self.coefficients), initial=0.0)
        c = np.where(np.abs(self.coefficients) > 1e-9 * largest, self.coefficients, 0.0)
        parts = [
            f"{name} = {_series(self.basis, c[:, i])}"
            for i, name in enumerate(self.names)
            if c[:, i].any()
        ]
        return ", ".join(parts) or "0"


class Symmetries(eqx.Module):
    """What `find_symmetries` found; print it for a report. A sequence of `Symmetry`.

    - `found`: the variational ones first, the simplest first in each kind; there may be none.
    - `survivors`: for m = 0 … order, how many leading parts X_0 go on to order m.
    - `singular_values`: of all conditions, descending, relative to the largest; `gap`: the ratio
      at which they were cut (large is clear, below 1e3 is not).
    - `refused`: null vectors of the fitted samples that failed on the held-out ones.
    - `basis`: of the components of the generators. `gauge_basis`: of the gauges, functions left
      out that are constant or depend on others.

    On resonant or integrable systems the null space is large: a symmetry times an invariant is a
    symmetry, which is marked as dependent. On chaotic systems near-null vectors appear that are
    none. Held-out residuals decide.
    """

    found: tuple[Symmetry, ...]
    survivors: tuple[int, ...] = eqx.field(static=True)
    singular_values: np.ndarray
    gap: float = eqx.field(static=True)
    refused: int = eqx.field(static=True)
    basis: BoundBasis
    gauge_basis: BoundBasis

    @property
    def variational(self) -> tuple[Symmetry, ...]:
        """Those whose Noether identity closes."""
        return tuple(s for s in self.found if s.is_variational)

    @property
    def conformal(self) -> tuple[Symmetry, ...]:
        """Those that are conformal only."""
        return tuple(s for s in self.found if not s.is_variational)

    @property
    def order(self) -> int:
        """z, the order that was asked for."""
        return len(self.survivors) - 1

    @property
    def count(self) -> int:
        """Number of symmetries found, dependent ones included."""
        return len(self.found)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> Symmetry:
        return self.found[i]

    def __iter__(self) -> Iterator[Symmetry]:
        return iter(self.found)

    def __str__(self) -> str:
        count = len(self.found)
        lines = [
            f"{count} symmetr{'y' if count == 1 else 'ies'} of order {self.order} in "
            f"{self.basis.size} functions for each component: {len(self.variational)} variational, "
            f"{len(self.conformal)} conformal only; leading parts that survive order 0 … "
            f"{self.order}: {', '.join(map(str, self.survivors))}; gap {self.gap:.1e}"
        ]
        if not count and self.survivors[0]:
            lines.append("  what order 0 has does not go on: a lower order, or a larger basis?")
        for symmetry in self.found:
            lines += _described(symmetry)
        dependent = sum(s.is_dependent for s in self.found)
        if dependent:
            lines.append(
                f"  {dependent} of them depend on the others, with invariants of the map for "
                "coefficients: the null space is large, as on resonant and integrable systems"
            )
        if self.refused:
            lines.append(
                f"  {self.refused} null vectors of the fitted samples refused: held-out samples "
                "decide, and there they leave too much (chaos, too few samples, or too large a "
                "tolerance)"
            )
        return "\n".join(lines)


def _described(symmetry: Symmetry) -> list[str]:
    kind = "variational" if symmetry.is_variational else "conformal only"
    mark = ", dependent" if symmetry.is_dependent else ""
    lines = [
        f"  {symmetry}",
        f"      {kind}{mark}; held-out residual {np.max(symmetry.residuals):.1e}, of Noether's "
        f"identity {np.max(symmetry.identity_residuals):.1e}",
    ]
    if symmetry.gauges is not None:
        gauges = np.stack([np.asarray(g.coefficients) for g in symmetry.gauges])
        size = max(np.max(np.abs(gauges), initial=0.0), np.max(np.abs(symmetry.coefficients)))
        gauges = np.where(np.abs(gauges) > 1e-9 * size, gauges, 0.0)
        lines.append(f"      gauge G = {_series(symmetry.gauges[0].basis, gauges)}")
        if symmetry.moves_time:
            lines.append("      ξ0 is not zero: on a fixed mesh its invariant may move by O(h)")
    elif symmetry.is_symplectic:
        lines.append("      its flow is symplectic: the gauge basis may be too small")
    return lines


def _series(basis: BoundBasis, coefficients: np.ndarray) -> str:
    """c_0·φ + ε (c_1·φ) + … as text; orders that are zero left out."""
    parts = []
    for m, block in enumerate(coefficients):
        power = "ε" if m == 1 else "ε" + str(m).translate(_RAISED)
        if block.any():
            parts.append(f"{power} ({basis.formula(block)})" if m else basis.formula(block))
    return " + ".join(parts) or "0"


def find_symmetries(
    system: System,
    basis: AbstractBasis,
    order: int = 0,
    *,
    h: float,
    samples: Any,
    gauges: AbstractBasis | None = None,
    time: bool = True,
    t0: float = 0.0,
    args: Args = None,
    newton: Newton = Newton(),
    tolerance: float | None = None,
) -> Symmetries:
    r"""The symmetries of order z of the disturbed discrete equations that a basis can express.

    Every component of every X_m, m = 0 … z, is a combination of the basis functions φ(q, p, t).
    With Φ_ε the map (12)–(13), the determining equations

        Σ_m ε^m pr X_m(F)(z, Φ_ε(z)) = O(ε^{z+1})

    are linear in its coefficients; their Taylor coefficients in ε at sampled points z = (q, p)
    are a block-Toeplitz system, whose null space is found by singular values (the basis made
    orthonormal on the samples first). On F = 0 that is all there is to ask: a smooth pointwise
    conformal factor exists exactly then (see `conformal_factor`).

    A symmetry is variational when a gauge closes Noether's identity. On the solutions *any* X
    with ξ0 = 0 closes it, by G = −ξ·p; what tells is that the identity Σ ε^m N_m closes together
    with its first derivatives off the solutions, by q1 and p0 (so that it is variational up to a
    trivial symmetry). For ξ0 = 0 that says: X is the Hamiltonian vector field of its invariant
    ξ·p + G. The others are conformal only.

    **Arguments**

    - `basis`: with constants for translations: ``Polynomials(2, constant=True)``.
    - `order`: z ≥ 0. `h`: step size [time]. `t0`, `args`, `newton`: as for `integrate`.
    - `samples`: (qs, ps) at t0, shapes (S, *q.shape), points of the domain of interest, or (qs,
      ps, ts) with their times, shape (S,), where basis or system depend on t. A quarter is held
      out.
    - `gauges`: basis of the gauges; None for one that holds φ times 1 and each coordinate, all
      quadratic polynomials, and t.
    - `time`: whether to look for ξ0 too. Where it depends on the point it changes h.
    - `tolerance`: relative singular value below which a vector is null; None for those below the
      widest gap, 1e-9 at most.

    **Returns** `Symmetries`; print it for a report. t in the basis is the time, also of a system
    with ``slow_time=True``.

    **Raises** `ValueError` for too few samples, samples or functions that are not finite, a step
    that fails on them, a basis that is rank-deficient on them, samples of one time where basis or
    system depend on t, an order or tolerance that is none, or h = 0; `TypeError` for what is no
    basis.

    **Accuracy** round-off of the singular values, times the conditioning of the basis; Taylor
    coefficients by nested forward autodiff, through implicit steps.

    **Source** the paper's (17), (24) and (28), collected in ε on the disturbed map; the null
    space and the test off the solutions are our own (trivial symmetries: Olver 1993, Section
    5.1; symmetries of difference equations: Hydon 2014).
    """
    if isinstance(order, bool) or not isinstance(order, int) or order < 0:
        raise ValueError(f"order must be an integer of at least 0, got {order!r}.")
    if tolerance is not None and not 0 < tolerance < 1:
        raise ValueError(f"tolerance must lie between 0 and 1, got {tolerance!r}.")
    samples, h = as_samples(samples, t0), check_step_size(h)
    shape = samples.q.shape[1:]
    bound = bind_basis(basis, shape)
    require_time(bound, samples)
    gauge_basis = bind_basis(_enlarged(basis, shape) if gauges is None else gauges, shape)
    if gauges is not None:
        require_time(gauge_basis, samples)
    n = int(np.prod(shape, dtype=int))
    components = 2 * n + bool(time)
    require_enough(samples, components * bound.size, 2 * n)
    require_enough(samples, gauge_basis.size, 1 + 2 * n)

    equations = Equations(system, jnp.zeros(()), args, newton)
    for one in (bound, gauge_basis) if gauges is not None else (bound,):
        check_basis(one, _values(one, samples))
    raw = _at_samples(equations, jnp.asarray(h), bound, gauge_basis, order, samples)
    raw = _Conditions(*map(np.asarray, raw))
    require_steps(raw.good[:, 0] == 1, samples)
    _require_finite(raw)
    _require_times(raw, samples, h)
    gauge_basis, raw = _independent_gauges(gauge_basis, raw, samples)
    return _Search(raw, samples, h, bool(time), bound, gauge_basis, tolerance).result()


@eqx.filter_jit
def _on_samples(basis, samples):
    return jax.vmap(basis)(*map(jnp.asarray, samples))


def _values(basis: BoundBasis, samples: Samples) -> np.ndarray:
    """The functions at the samples, shape (S, size)."""
    return np.asarray(_on_samples(basis, samples))


class _Conditions(NamedTuple):
    """Conditions at S samples, as Taylor coefficients in ε up to z; C components, B functions.

    What comes from the first and from the second point is kept apart, in the axis of length 2. A
    row of Noether's identity is its value, or a derivative by a component of q1 or p0.
    """

    determining: Any  # (S, z + 1, 2, 2n, C, B)
    identity: Any  # (S, z + 1, 2, 1 + 2n, C, B)
    gauge: Any  # (S, z + 1, 1 + 2n, gauge functions)
    clock: Any  # (S, z + 1, 2n): ∂F/∂t1
    later: Any  # (S, z + 1, 2, 2n): F at the same states but later
    values: Any  # (S, z + 1, 2, B): φ at both points
    slopes: Any  # (S, z + 1, B, 2n): ∂φ/∂(q, p) at the first
    good: Any  # (S, z + 1): at z = 0, 1 where the step succeeds


@eqx.filter_jit
def _at_samples(equations, h, basis, gauge_basis, order, samples) -> _Conditions:
    system, args, shape = equations.system, equations.args, samples.q.shape[1:]
    n = int(np.prod(shape, dtype=int))

    def flat(parts):
        return jnp.concatenate([jnp.ravel(x) for x in parts])

    def point(x):
        return LatticePoint(x[0], x[1 : 1 + n].reshape(shape), x[1 + n :].reshape(shape))

    def functions(x):
        t, q, p = point(x)
        return jnp.append(basis(q, p, t), gauge_basis(q, p, t))

    def conditions(epsilon, q, p, t):
        here = Equations(system, epsilon, args, equations.newton)
        q1, p1, info = step(here, Interval(t, t + h, h), q, p)
        pair = jnp.stack([flat((t, q, p)), flat((t + h, q1, p1))])
        values, slopes = jax.vmap(functions)(pair), jax.vmap(jax.jacfwd(functions))(pair)

        def F(pair):
            a, b = map(point, pair)
            return flat(discrete_equations(system, a, b, epsilon, args))

        def action(pair):
            a, b = map(point, pair)
            H = system.hamiltonian(a.t, b.t, a.q, b.p, epsilon, args)
            return jnp.sum(b.p * (b.q - a.q)) - (b.t - a.t) * H

        def identity(moved):
            """The factors of both points' components, and of the gauge, at a pair close by."""
            near = values + jnp.einsum("jbi,ji->jb", slopes, moved - pair)
            phi, gauge = near[:, : basis.size], near[:, basis.size :]
            a, b = map(point, moved)
            force = system.disturbing_force(a.t, b.t, a.q, b.p, epsilon, args)
            power = jnp.sum(force * (b.q - a.q)) / h
            work = flat((-power, force, jnp.zeros_like(force)))
            factors = jax.grad(action)(moved) / h + jnp.stack([work, jnp.zeros_like(work)])
            return jnp.einsum("jc,jb->jcb", factors, phi), (gauge[1] - gauge[0]) / h

        def rows(value, by_pair):
            """The value, and the derivatives by q1 and by p0."""
            by_q1, by_p0 = by_pair[..., 1, 1 : 1 + n], by_pair[..., 0, 1 + n :]
            return jnp.concatenate([value[None], *(jnp.moveaxis(x, -1, 0) for x in (by_q1, by_p0))])

        by_pair = jax.jacfwd(F)(pair)  # (2n, 2, C)
        noether, gauge = map(rows, identity(pair), jax.jacfwd(identity)(pair))
        later = [F(pair.at[:, 0].add(shift)) for shift in _LATER]
        return (
            jnp.einsum("rjc,jb->jrcb", by_pair, values[:, : basis.size]),
            jnp.moveaxis(noether, 0, 1),
            gauge,
            by_pair[:, 1, 0],
            jnp.stack(later),
            values[:, : basis.size],
            slopes[0, : basis.size, 1:],
            jnp.where(info.result == RESULTS.successful, 1.0, 0.0),
        )

    def at_point(q, p, t):
        shapes = []

        def flattened(epsilon):
            parts = conditions(epsilon, q, p, t)
            shapes[:] = [x.shape for x in parts]
            return flat(parts)

        terms = taylor_coefficients(flattened, jnp.zeros(()), order)
        ends = np.cumsum([int(np.prod(s, dtype=int)) for s in shapes])[:-1]
        pieces = zip(jnp.split(terms, ends, axis=1), shapes, strict=True)
        return _Conditions(*(x.reshape(order + 1, *s) for x, s in pieces))

    return jax.vmap(at_point)(*map(jnp.asarray, samples))


def _require_finite(raw: _Conditions) -> None:
    """Refuse conditions that are not finite: at the samples, or where the step leads."""
    kinds = (("determining equations", raw.determining), ("Noether identity", raw.identity))
    for name, terms in (*kinds, ("gauge basis", raw.gauge)):
        good = np.isfinite(terms).reshape(len(terms), -1).all(axis=1)
        if not good.all():
            raise ValueError(
                f"the {name} is not finite at {int(np.sum(~good))} of {len(good)} samples (first: "
                f"number {int(np.argmin(good))}): H_D or the functions are singular there, or "
                "where a step leads from there. Keep the samples off the singularity."
            )


def _require_times(raw: _Conditions, samples: Samples, h: float) -> None:
    """Refuse samples of one time for equations that depend on it."""
    size = abs(h) * np.max(np.abs(raw.clock)) + np.finfo(float).tiny
    same = np.max(np.abs(raw.later)) <= 1e-8 * size  # False for NaN
    if np.ptp(samples.t) == 0 and not same:
        raise ValueError(
            "the discrete equations depend on the time, and all samples are of one time: give "
            "samples=(qs, ps, ts)."
        )


def _enlarged(basis: AbstractBasis, shape: tuple[int, ...]) -> AbstractBasis:
    """The functions times 1 and the coordinates, all quadratic polynomials, and t."""
    timed = bind_basis(basis, shape).uses_time
    variables = coordinate_names(shape) + (("t",) if timed else ())

    def raised(basis):
        match basis:
            case Polynomials():
                return Polynomials(basis.degree + 1, variables, constant=True)
            case Sum():
                return raised(basis.first) + raised(basis.second)
            case Product(second=Polynomials()):
                return basis.first * raised(basis.second)
            case Product(first=Polynomials()):
                return raised(basis.first) * basis.second
        return basis * Polynomials(1, variables, constant=True)

    clock = Basis({TIME[0]: lambda q, p, t: t})
    return Polynomials(2, variables) + clock + raised(basis)


class _Chosen(eqx.Module):
    basis: BoundBasis
    places: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q, p, t):
        return self.basis(q, p, t)[np.array(self.places, int)]


def _independent_gauges(basis: BoundBasis, raw: _Conditions, samples: Samples):
    """The gauge functions without constants and those that depend on simpler ones."""
    columns = triangle(_rows(raw.gauge[~samples.held_out, 0]))
    size = np.linalg.norm(columns, axis=0)
    taken: list[int] = []
    done = np.zeros((len(columns), 0))
    for j in np.argsort(basis.complexity, kind="stable"):
        if size[j] <= 1e-12 * np.max(size):
            continue
        rest = columns[:, j] / size[j]
        for _ in range(2):  # the second time for round-off
            rest = rest - done @ (done.T @ rest)
        if np.linalg.norm(rest) > 1e-9:
            taken.append(int(j))
            done = np.column_stack([done, rest / np.linalg.norm(rest)])
    places = sorted(taken)
    chosen = BoundBasis(
        _Chosen(basis, tuple(places)),
        tuple(basis.names[j] for j in places),
        tuple(basis.complexity[j] for j in places),
        basis.uses_time,
    )
    return chosen, raw._replace(gauge=raw.gauge[..., np.array(places, int)])


class _Search:
    """The linear algebra: unknowns are shares of orthonormal functions, rows without units."""

    def __init__(self, raw, samples, h, time, basis, gauge_basis, tolerance):
        self.raw, self.basis, self.gauge_basis = raw, basis, gauge_basis
        self.shape = samples.q.shape[1:]
        self.names = _component_names(self.shape)[0 if time else 1 :]
        self.held, self.tolerance = samples.held_out, tolerance
        self.order = raw.determining.shape[1] - 1
        fit, n = ~self.held, raw.slopes.shape[3] // 2
        q, p = _spread(samples.q), _spread(samples.p)
        rows = h / np.repeat([q, p], n)
        t = _inverse(np.sqrt(np.mean((raw.clock[fit, 0] * rows) ** 2)))
        used = slice(0 if time else 1, None)
        self.units = np.repeat([t, q, p], [1, n, n])[used]
        values = raw.values[fit, 0, 0]
        self.rms = np.sqrt(np.mean(values**2, axis=0))
        self.R = triangle(values) / np.sqrt(len(values))
        actions = h / (q * p) * np.repeat([1, q, p], [1, n, n])

        determining = raw.determining[..., used, :] * rows[:, None, None]
        identity = raw.identity[..., used, :] * actions[:, None, None]
        self.determining, self.identity = determining.sum(axis=2), identity.sum(axis=2)
        self.parts = determining[:, 0], identity[:, 0]  # of each point, at ε = 0
        self.gauge = raw.gauge * actions[:, None]
        of_fit = _rows(self.gauge[fit, 0])
        self.R_gauge = triangle(of_fit) / np.sqrt(len(of_fit))
        self.size = len(self.units) * basis.size  # unknowns of each order
        self.complexity = np.tile(basis.complexity, len(self.units))

    def result(self) -> Symmetries:
        terms = self._orthonormal(self.determining)
        fitted, judged = compress(_rows(terms[~self.held])), compress(_rows(terms[self.held]))
        spaces = []
        for m in range(self.order + 1):
            matrix = toeplitz(fitted, m)
            space = null_space(matrix, self.tolerance)
            conditions = np.vstack([matrix, toeplitz(judged, m)])
            kept = self._judged(space.columns, space.columns, conditions)
            spaces.append((kept, space))
        null, space = spaces[-1]
        closed, gauges = self._variational(null)
        symplectic = self._symplectic(null)
        both = np.hstack([closed, symplectic])
        groups = (
            self._variational_representatives(closed, gauges),
            self._representatives(symplectic, closed, self._symplectic(closed)),
            self._representatives(null, both, both),
        )
        found: list[Symmetry] = []
        for kind, group in enumerate(groups):
            for vector in group.T:
                found.append(self._symmetry(vector, kind == 0, kind < 2, found))
        return Symmetries(
            found=tuple(found),
            survivors=tuple(rank(kept[: self.size]) for kept, _ in spaces),
            singular_values=space.singular_values,
            gap=space.gap,
            refused=space.columns.shape[1] - null.shape[1],
            basis=self.basis,
            gauge_basis=self.gauge_basis,
        )

    def _orthonormal(self, terms: np.ndarray) -> np.ndarray:
        """Terms (S, z + 1, rows, C, B) for unknown shares, (S, rows, z + 1, unknowns)."""
        flat = np.linalg.solve(self.R.T, terms.reshape(-1, self.basis.size).T).T
        scaled = flat.reshape(terms.shape) * self.units[:, None]
        return np.moveaxis(scaled.reshape(*terms.shape[:3], self.size), 1, 2)

    def _judged(self, columns, series, conditions) -> np.ndarray:
        """The combinations of null vectors that all samples take for null, held-out ones too.

        A vector with a small leading part is null for no better reason: leading parts are made
        orthonormal first.
        """
        if columns.shape[1] == 0:
            return columns
        columns = columns @ np.hstack(_by_leading(series[: self.size]))
        norm = max(np.linalg.norm(conditions, 2), np.finfo(float).tiny)
        singular, V = np.linalg.svd(triangle(conditions @ columns / norm))[1:]
        singular = np.append(singular, np.zeros(len(V) - len(singular)))
        return columns @ V[singular <= _HELD_OUT * (self.tolerance or NULL)].T

    def _variational(self, null: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The series in the null space whose identity closes, and their gauges."""
        orders, size = self.order + 1, self.size
        if null.shape[1] == 0:
            return null, np.zeros((orders * self.gauge_basis.size, 0))
        gauge = np.linalg.solve(self.R_gauge.T, _rows(_rows(self.gauge)).T).T
        gauge = np.moveaxis(gauge.reshape(self.gauge.shape), 1, 2)
        terms = np.concatenate([self._orthonormal(self.identity), gauge], axis=-1)

        def conditions(samples):
            matrix = toeplitz(compress(_rows(terms[samples])), self.order)
            blocks = matrix.reshape(len(matrix), orders, terms.shape[-1])
            of_series, of_gauge = blocks[:, :, :size], blocks[:, :, size:]
            of_series = of_series.reshape(len(matrix), orders * size) @ null
            return np.hstack([of_series, of_gauge.reshape(len(matrix), -1)])

        fitted, count = conditions(~self.held), null.shape[1]
        both = null_space(fitted, self.tolerance).columns
        every = np.vstack([fitted, conditions(self.held)])
        both = self._judged(both, null @ both[:count], every)
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
        led, shifts = _by_leading(series[: self.size])
        return self._simplest(columns @ led, columns @ shifts)

    def _representatives(self, space, known, free) -> np.ndarray:
        """One series of a space for each leading part not known, the simplest up to free ones."""
        basis = orthonormal_range(known[: self.size])
        led, _ = _by_leading(space[: self.size] - basis @ (basis.T @ space[: self.size]))
        _, shifts = _by_leading(space[: self.size])
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
        singular, V = np.linalg.svd(triangle(rows))[1:]
        singular = np.append(singular, np.zeros(len(V) - len(singular)))
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
        shares = np.where(np.abs(shares) > _TINY * np.max(np.abs(shares)), shares, 0.0)
        c = shares * self.units[:, None] / self.rms
        largest = np.argmax(np.round(np.abs(c[0]) / np.max(np.abs(c[0])), 6))
        scale = 1 / c[0].ravel()[largest]
        c = c * scale
        identity = self._sums(self.identity, c)
        if variational:
            g = vector[orders * self.size :].reshape(orders, self.gauge_basis.size) * scale
        else:
            g = self._best_gauge(identity)
        identity = identity + _toeplitz_sums(self.gauge, g)
        generators = tuple(self._generator(x) for x in c)
        gauges = tuple(BasisGauge(self.gauge_basis, jnp.asarray(x)) for x in g)
        return Symmetry(
            generators=generators,
            is_variational=variational,
            gauges=gauges if variational else None,
            residuals=self._relative(self._sums(self.determining, c), self.parts[0], c),
            identity_residuals=self._relative(identity, self.parts[1], c),
            is_dependent=self._depends(c, before),
            is_symplectic=symplectic and all(g.xi0 is None for g in generators),
            coefficients=c,
            names=self.names,
            basis=self.basis,
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
        return _toeplitz_sums(flat, c.reshape(len(c), -1))

    def _best_gauge(self, identity) -> np.ndarray:
        """The gauge that closes the identity best on the fitted samples."""
        orders, fit = self.order + 1, ~self.held
        matrix = toeplitz(_rows(np.moveaxis(self.gauge[fit], 1, 2)), self.order)
        right = np.moveaxis(identity[fit], 1, 0).ravel()
        return np.linalg.lstsq(matrix, -right)[0].reshape(orders, self.gauge_basis.size)

    def _relative(self, left, parts, c) -> np.ndarray:
        """Largest of what is left at each order, on held-out samples, over the terms' size."""
        terms = np.einsum("sjrcb,cb->sjrc", parts[self.held], c[0])
        largest = np.max(np.sum(np.abs(terms), axis=(1, 3)))
        return np.max(np.abs(left[self.held]), axis=(0, 2)) * _inverse(largest)

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


def _rows(terms: np.ndarray) -> np.ndarray:
    """The first two axes, samples and rows, as one."""
    return terms.reshape(terms.shape[0] * terms.shape[1], *terms.shape[2:])


def _toeplitz_sums(terms: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Σ_{m≤k} terms[:, k − m] c_m for k = 0 … z: shape (S, z + 1, rows)."""
    sums = [sum(terms[:, k - m] @ c[m] for m in range(k + 1)) for k in range(len(c))]
    return np.stack(sums, axis=1)


def _by_leading(leading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Combinations of columns with orthonormal leading parts, and those without a leading part."""
    if leading.shape[1] == 0:
        return np.zeros((0, 0)), np.zeros((0, 0))
    singular, V = np.linalg.svd(leading)[1:]
    count = int(np.sum(singular > RANK))
    return V[:count].T / singular[:count], V[count:].T


def _component_names(shape: tuple[int, ...]) -> tuple[str, ...]:
    names = coordinate_names(shape)
    half = len(names) // 2
    return ("ξ0", *(f"ξ_{v}" for v in names[:half]), *(f"η_{v}" for v in names[half:]))


def _spread(values: np.ndarray) -> float:
    spread = float(np.sqrt(np.mean((values - np.mean(values, axis=0)) ** 2)))
    return spread if spread > 0 else 1.0


def _inverse(value: Any) -> float:
    return 1 / float(value) if value > 0 else 1.0
