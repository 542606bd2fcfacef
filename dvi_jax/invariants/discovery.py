"""Adiabatic invariants found as a null space on the map that is actually iterated."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._results import RESULTS
from .._step import Equations
from .._system import System
from .._types import Args, Interval, State
from ..engine.echelon import reduced, reduction
from ..engine.newton import Newton
from ..engine.taylor import taylor_coefficients
from ..methods import Method, TypeII
from ..symmetry.basis import AbstractBasis, BoundBasis, bind_basis, check_step_size

_NULL = 1e-9
"""A singular value above this share of the largest one is never taken for zero."""

_EXPLAINED = 1e-6
"""A drift law is told when it leaves less than this share of the drift unexplained."""

_RANK = 1e-7
"""Relative size below which a differential, or a direction, counts as dependent on others."""


class InvariantSeries(eqx.Module):
    r"""An invariant Σ_m ε^m c_m·φ(q, p), as an observable.

    - `coefficients`: c, shape (order + 1, basis size). `basis`: φ.

    Give it to `integrate` as it is; there it is bound to the run's ε. As a formula: `str`.
    """

    basis: BoundBasis
    coefficients: Array
    epsilon: Any = None

    @property
    def order(self) -> int:
        """z, the order up to which the series goes."""
        return self.coefficients.shape[0] - 1

    def bind(self, system: System, epsilon: Any) -> "InvariantSeries":
        """The same series at this ε."""
        del system
        return InvariantSeries(self.basis, self.coefficients, epsilon)

    def evaluate(self, q: State, p: State, epsilon: Any) -> Array:
        """The value at a point, a scalar."""
        powers = jnp.asarray(epsilon) ** jnp.arange(self.order + 1)
        return powers @ self.coefficients @ self.basis(q, p)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        if self.epsilon is None:
            raise ValueError(
                "an InvariantSeries has to know ε: call invariant.bind(system, epsilon)(...), or "
                "give it to dvi.integrate(observe=...)."
            )
        return self.evaluate(q1, p1, self.epsilon)

    def __str__(self) -> str:
        c = np.asarray(self.coefficients)
        c = np.where(np.abs(c) > 1e-9 * np.max(np.abs(c)), c, 0.0)
        parts = [self.basis.formula(block) for block in c]
        words = [parts[0]] + [
            f"ε{'' if m == 1 else m} ({text})" for m, text in enumerate(parts[1:], 1) if text != "0"
        ]
        return " + ".join(words).replace("ε2", "ε²").replace("ε3", "ε³").replace("ε4", "ε⁴")


class DriftLaw(NamedTuple):
    """Why a leading part does not go on to the next order.

    D(I) per step is ε^order times ``formula`` on average, a function of what order 0 keeps;
    `residual` is the share of the drift that this does not explain.
    """

    order: int
    leading: str
    formula: str
    coefficients: np.ndarray
    residual: float


class Discovery(eqx.Module):
    """What `discover_invariants` found.

    - `coefficients`: shape (count, order + 1, basis size), of the independent invariants, the
      simplest representatives; count may be 0.
    - `leading_parts`: shape (families, basis size): an orthonormal basis of the order-0 parts of
      *all* invariants in the span, functions of one another included.
    - `survivors`: for m = 0 … order, how many leading parts have an invariant of order m.
    - `singular_values`: of the whole system, descending, relative to the largest; `gap`: the
      ratio at which they were cut (large is clear, below 1e3 is not).
    - `residuals`: shape (count, order + 1), on held-out points: the largest change over one
      step at each order in ε, relative to the spread of the leading part.
    - `obstructions`: a `DriftLaw` for each leading part that is lost at order 1.
    - `basis`: with `names`.

    On resonant or integrable systems the null space is large; on chaotic ones near-null vectors
    appear that are none. Held-out residuals and `drift_order` on a long run decide.
    """

    coefficients: Array
    leading_parts: np.ndarray
    survivors: tuple[int, ...] = eqx.field(static=True)
    singular_values: np.ndarray
    gap: float = eqx.field(static=True)
    residuals: np.ndarray
    obstructions: tuple[DriftLaw, ...]
    basis: BoundBasis

    @property
    def count(self) -> int:
        """Number of independent invariants found."""
        return self.coefficients.shape[0]

    @property
    def order(self) -> int:
        """z, the order that was asked for."""
        return len(self.survivors) - 1

    @property
    def invariants(self) -> list[InvariantSeries]:
        """The invariants as observables."""
        return [InvariantSeries(self.basis, c) for c in self.coefficients]

    def evaluate(self, q: State, p: State, epsilon: Any) -> Array:
        """The values of all invariants at a point, shape (count,)."""
        powers = jnp.asarray(epsilon) ** jnp.arange(self.order + 1)
        return jnp.einsum("m,kmb,b->k", powers, self.coefficients, self.basis(q, p))

    def __str__(self) -> str:
        lines = [
            f"{self.count} independent invariant{'' if self.count == 1 else 's'} of order "
            f"{self.order} in {self.basis.size} functions; leading parts that survive order 0 … "
            f"{self.order}: {', '.join(map(str, self.survivors))}; gap {self.gap:.1e}"
        ]
        for series, residual in zip(self.invariants, self.residuals, strict=True):
            lines.append(f"  I = {series}")
            lines.append(f"      held-out residual {np.max(residual):.1e}")
        told = [law for law in self.obstructions if law.residual < _EXPLAINED]
        for law in told:
            lines.append(f"  lost at order {law.order}: I = {law.leading}")
            lines.append(f"      on average it changes by ε ({law.formula}) in a step")
        if len(told) < len(self.obstructions):
            lines.append(
                f"  {len(self.obstructions) - len(told)} more lost at order 1, by a drift that is "
                "no function of what order 0 keeps in this basis: it may be too small"
            )
        return "\n".join(lines)


def discover_invariants(
    system: System,
    basis: AbstractBasis,
    order: int = 0,
    *,
    h: float,
    samples: tuple[Any, Any],
    t0: float = 0.0,
    args: Args = None,
    method: Method = TypeII(),
    newton: Newton = Newton(),
) -> Discovery:
    r"""The adiabatic invariants of order z that a basis can express, on the iterated map itself.

    With φ the basis, Φ_ε the map of one step, and A_m(q, p) the m-th Taylor coefficient in ε of
    φ(Φ_ε(q, p)) − φ(q, p), the series Σ ε^m c_m·φ changes by O(ε^{z+1}) in a step exactly when

        Σ_{m≤k} A_{k−m} c_m = 0    for k = 0 … z

    at every point: a block-Toeplitz system, whose null space is found by singular values on
    sampled points (basis made orthonormal on them first).

    **Arguments**

    - `basis`: for example ``Polynomials(6)``, ``Basis([f, g])``, sums and products of bases.
    - `order`: z ≥ 0. `h`: step size [time]. `method`: any; only its map is used.
    - `samples`: (qs, ps), shapes (S, *q.shape), points of the domain of interest; a quarter is held
      out. At least twice as many as functions in the basis.

    **Returns** a `Discovery`; print it for a report.

    **Raises** `ValueError` for too few samples, samples or basis functions that are not
    finite there, a step that fails there, a basis that is rank-deficient on them, or h = 0;
    `TypeError` for what is no basis.

    **Accuracy** round-off of the singular values, times the conditioning of the basis; Taylor
    coefficients by nested forward autodiff, through implicit steps.

    **Source** our own.
    """
    q, p = _samples(samples)
    if isinstance(order, bool) or not isinstance(order, int) or order < 0:
        raise ValueError(f"order must be an integer of at least 0, got {order!r}.")
    bound, h = bind_basis(basis, q.shape[1:]), check_step_size(h)
    held = np.arange(len(q)) % 4 == 3
    if np.sum(~held) < 1.5 * bound.size:
        raise ValueError(
            f"{len(q)} samples are too few for {bound.size} basis functions (a quarter is held "
            f"out): give at least {2 * bound.size}."
        )
    values, changes = _taylor_changes(system, bound, order, h, t0, args, method, newton, q, p)
    _check_basis(bound, values)
    # Orthonormal on the samples: singular values then measure functions, not their scaling.
    R = _triangle(values[~held]) / np.sqrt(np.sum(~held))
    scaled = np.linalg.solve(R.T, changes[~held].reshape(-1, bound.size).T).T
    compressed = _compress(scaled.reshape(-1, order + 1, bound.size))

    spaces = [_null_space(_toeplitz(compressed, m)) for m in range(order + 1)]
    null, singular, gap = spaces[-1]
    survivors = [_rank(space[: bound.size]) for space, _, _ in spaces]
    leading = _orthonormal_range(null[: bound.size])
    chosen = _independent(bound, R, null, q[~held], p[~held])
    coefficients = np.array(chosen).reshape(len(chosen), order + 1, bound.size)
    coefficients = _normalised(coefficients)
    return Discovery(
        coefficients=jnp.asarray(coefficients),
        leading_parts=_normalised(np.linalg.solve(R, leading).T[:, None, :])[:, 0, :],
        survivors=tuple(survivors),
        singular_values=singular,
        gap=gap,
        residuals=_residuals(coefficients, values[held], changes[held]),
        obstructions=_obstructions(
            bound, R, scaled.reshape(-1, order + 1, bound.size), values[~held], spaces
        ),
        basis=bound,
    )


def _samples(samples: Any) -> tuple[np.ndarray, np.ndarray]:
    try:
        q, p = (np.asarray(x, float) for x in samples)
    except (TypeError, ValueError):
        raise ValueError(
            "samples must be a pair (qs, ps) of arrays with one row for each point."
        ) from None
    if q.shape != p.shape or q.ndim < 1 or len(q) == 0:
        raise ValueError(
            f"samples (qs, ps) must have one shape (points, *q.shape), got {q.shape} and {p.shape}."
        )
    if not (np.isfinite(q).all() and np.isfinite(p).all()):
        raise ValueError("samples hold a value that is not finite: take points of the domain.")
    return q, p


def _taylor_changes(system, basis, order, h, t0, args, method, newton, q, p):
    """φ at the samples, (S, B), and A_0 … A_z there, (S, z + 1, B)."""
    t0, h = jnp.asarray(t0, float), jnp.asarray(h, float)
    equations = Equations(system, jnp.zeros(()), args, newton)
    interval = Interval(t0, t0 + h, h)
    values, changes, good = _at_points(equations, interval, method, basis, order, q, p)
    if not bool(jnp.all(good)):
        i = int(jnp.argmin(good))
        raise ValueError(
            f"the step fails at {int(jnp.sum(~good))} of {len(q)} samples, first at q = "
            f"{q[i].tolist()}, p = {p[i].tolist()}: take samples where the map is defined, or a "
            "smaller h."
        )
    return np.asarray(values), np.asarray(changes)


@eqx.filter_jit
def _at_points(equations, interval, method, basis, order: int, q, p):
    """Values of the basis, Taylor coefficients of their changes, and the steps' success."""

    def at_point(q, p):
        def change(epsilon):
            here = Equations(equations.system, epsilon, equations.args, equations.newton)
            q1, p1, info = method.step(here, interval, q, p)
            return basis(q1, p1) - basis(q, p), info.result == RESULTS.successful

        zero = jnp.zeros(())
        terms = taylor_coefficients(lambda e: change(e)[0], zero, order)
        return basis(q, p), terms, change(zero)[1]

    return jax.vmap(at_point)(q, p)


def _check_basis(basis: BoundBasis, values: np.ndarray) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        i, j = np.argwhere(bad)[0]
        raise ValueError(
            f"the basis function {basis.names[j]!r} is not finite at {int(bad[:, j].sum())} of "
            f"{len(values)} samples (first: number {i}): keep the samples off its singularity."
        )
    scale = np.linalg.norm(values, axis=0)
    zero = np.flatnonzero(scale == 0)
    normal = values / np.where(scale > 0, scale, 1)
    singular, V = np.linalg.svd(normal, full_matrices=False)[1:]
    if zero.size or singular[-1] < 1e-13 * singular[0]:
        members = [basis.names[j] for j in (zero if zero.size else np.argsort(-abs(V[-1]))[:4])]
        raise ValueError(
            "the basis is rank-deficient on the samples: a combination of "
            f"{', '.join(map(repr, members))}{' …' if not zero.size else ''} vanishes on all of "
            "them. Leave one out, or take samples that fill the domain."
        )


def _triangle(matrix: np.ndarray) -> np.ndarray:
    """R of the QR decomposition."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def _compress(changes: np.ndarray) -> np.ndarray:
    """The same inner products of all columns of A_0 … A_z, with as few rows as can be.

    One orthogonal factor Q for all of them, [A_0 … A_z] = Q R, acts on every row block of the
    Toeplitz matrix alike and changes neither its singular values nor its null space.
    """
    samples, orders, size = changes.shape
    if samples <= orders * size:
        return changes / np.sqrt(samples)
    rows = _triangle(changes.reshape(samples, orders * size))
    return rows.reshape(-1, orders, size) / np.sqrt(samples)


def _toeplitz(changes: np.ndarray, order: int) -> np.ndarray:
    """[A_0; A_1 A_0; A_2 A_1 A_0; …] up to A_order."""
    samples, _, size = changes.shape
    blocks = np.zeros((order + 1, samples, order + 1, size))
    for k in range(order + 1):
        for m in range(k + 1):
            blocks[k, :, m] = changes[:, k - m]
    return blocks.reshape((order + 1) * samples, (order + 1) * size)


def _null_space(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Null vectors as columns, relative singular values, and the ratio at the cut."""
    if matrix.shape[0] > matrix.shape[1]:
        matrix = _triangle(matrix)
    singular, V = np.linalg.svd(matrix)[1:]
    relative = singular / singular[0] if singular[0] > 0 else np.zeros_like(singular)
    floor = np.finfo(float).eps
    ratios = np.append(relative[:-1], relative[-1]) / np.maximum(np.append(relative[1:], 0), floor)
    allowed = np.append(relative[1:] < _NULL, False)
    if singular[0] == 0:
        return V.T, relative, np.inf
    if not allowed.any():
        return V.T[:, :0], relative, 1.0
    cut = int(np.argmax(np.where(allowed, ratios, 0)))
    return V.T[:, cut + 1 :], relative, float(ratios[cut])


def _rank(columns: np.ndarray) -> int:
    if columns.size == 0:
        return 0
    return int(np.sum(np.linalg.svd(columns, compute_uv=False) > _RANK))


def _orthonormal_range(columns: np.ndarray) -> np.ndarray:
    if columns.size == 0:
        return columns[:, :0]
    U, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return U[:, singular > _RANK]


def _independent(basis, R, null, q, p) -> list[np.ndarray]:
    """Coefficients of one series for each functionally independent invariant, simplest first.

    Leading parts are tried in the order of complexity; one that is a function of those taken
    (its differential lies in the span of theirs at generic points) is passed over.
    """
    size = basis.size
    if null.shape[1] == 0:
        return []
    some = slice(None, None, max(1, len(q) // 40))
    gradient = jax.jit(
        jax.vmap(
            lambda q, p: jnp.concatenate(
                [j.reshape(size, -1) for j in jax.jacfwd(basis, argnums=(0, 1))(q, p)], axis=1
            )
        )
    )(q[some], p[some])  # (points, size, 2n)
    gradient = np.asarray(gradient)
    taken: list[np.ndarray] = []
    differentials: list[np.ndarray] = []
    complexity = np.array(basis.complexity)
    orders = null.shape[0] // size

    def in_user_functions(columns):
        blocks = columns.reshape(orders, size, -1)
        return np.linalg.solve(R, blocks).reshape(columns.shape)

    every = in_user_functions(null)
    user = every[:size]
    # Null vectors without a leading part may be added to any invariant: ε times another one.
    _, singular, V = np.linalg.svd(user / max(np.linalg.norm(user, 2), 1e-300))
    shifted = every @ V[np.sum(singular > _RANK) :].T
    simplify = reduction(shifted, np.tile(complexity, orders), size)
    for level in sorted(set(basis.complexity)):
        above = user[complexity > level]
        # combinations whose leading part uses nothing above this level
        if above.size:
            scale = max(np.linalg.norm(user, 2), 1e-300)
            singular, V = np.linalg.svd(above / scale)[1:]
            free = V.T[:, np.append(singular, np.zeros(V.shape[0] - len(singular))) < _RANK]
        else:
            free = np.eye(null.shape[1])
        _, singular, V = np.linalg.svd(null[:size] @ free, full_matrices=False)
        ways = V[singular > _RANK].T / singular[singular > _RANK]
        candidates = in_user_functions(null @ free @ ways)
        for vector in reduced(candidates, complexity).T:
            d = np.einsum("sbn,b->sn", gradient, vector[:size])
            length = np.linalg.norm(d)
            if length < _RANK:
                continue  # a constant
            stack = np.stack([*differentials, d / length], axis=1)  # (points, count, 2n)
            if _generic_rank(stack) == len(differentials) + 1:
                taken.append(simplify(vector).reshape(orders, size))
                differentials.append(d / length)
    return taken


def _generic_rank(stack: np.ndarray) -> int:
    """The rank of the rows that most points agree is the largest."""
    rows = stack / np.maximum(np.linalg.norm(stack, axis=-1, keepdims=True), 1e-300)
    singular = np.linalg.svd(rows, compute_uv=False)
    return int(np.median(np.sum(singular > 1e-5, axis=-1)))


def _normalised(coefficients: np.ndarray) -> np.ndarray:
    """Scaled so that the largest coefficient of the leading part is one half, as of an energy."""
    out = coefficients.copy()
    for c in out:
        c /= 2 * c[0, np.argmax(np.abs(c[0]))]
    return out


def _residuals(coefficients, values, changes) -> np.ndarray:
    out = np.zeros(coefficients.shape[:2])
    for i, c in enumerate(coefficients):
        spread = np.std(values @ c[0])
        for k in range(c.shape[0]):
            total = sum(changes[:, k - m] @ c[m] for m in range(k + 1))
            out[i, k] = np.max(np.abs(total)) / spread
    return out


def _obstructions(basis, R, scaled, values, spaces) -> tuple[DriftLaw, ...]:
    """Why leading parts are lost at order 1: their averaged drift as a function of what is kept.

    A_1 c_0 = −A_0 c_1 has no solution; with functions of the order-0 invariants added on the
    right it may: A_1 c_0 + A_0 c_1 = d·φ, d in the null space of A_0. That is the averaged law.
    """
    if len(spaces) < 2:
        return ()
    kept, extended = spaces[0][0], spaces[1][0]
    size = basis.size
    through = _orthonormal_range(extended[:size])
    if kept.shape[1] == 0 or through.shape[1] == kept.shape[1]:
        return ()
    lost = _orthonormal_range(kept - through @ (through.T @ kept))
    lost = _simplest(basis, R, lost)
    orthonormal = np.linalg.solve(R.T, values.T).T
    system = np.concatenate([-scaled[:, 0], orthonormal @ kept], axis=1)
    laws = []
    for c in lost.T:
        c = c / (2 * np.linalg.solve(R, c)[np.argmax(np.abs(np.linalg.solve(R, c)))])
        drift = scaled[:, 1] @ c
        solution, *_ = np.linalg.lstsq(system, drift, rcond=1e-10)
        rest = np.linalg.norm(system @ solution - drift) / np.linalg.norm(drift)
        d = np.linalg.solve(R, kept @ solution[size:])
        laws.append(
            DriftLaw(1, basis.formula(np.linalg.solve(R, c)), basis.formula(d), d, float(rest))
        )
    return tuple(laws)


def _simplest(basis, R, columns: np.ndarray) -> np.ndarray:
    """The same span by columns that use complex functions as little as can be."""
    return R @ reduced(np.linalg.solve(R, columns), np.array(basis.complexity))
