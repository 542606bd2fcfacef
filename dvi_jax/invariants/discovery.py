"""Adiabatic invariants found as a null space on the map that is actually iterated."""

import json
import os
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._results import RESULTS
from .._step import Equations
from .._system import System
from .._types import Args, Interval, State
from ..engine.newton import Newton
from ..engine.nullspace import (
    RANK,
    compress,
    series_space,
    triangle as triangle_of,
)
from ..engine.taylor import taylor_coefficients
from ..methods import Method, TypeII
from ..symmetry.basis import AbstractBasis, BoundBasis, bind_basis, check_step_size
from ..symmetry.sampling import (
    Samples,
    as_samples,
    check_basis,
    require_enough,
    require_steps,
    require_time,
)
from .obstructions import DriftLaw, drift_laws
from .representatives import Span
from .series import InvariantSeries

_EXACT = 1e-12
"""A series that changes by less in a step at ε of order one is exact, not an expansion."""

_TRIED = (0.5, -0.3)
"""The ε at which that is tried."""

_CLEAR = 1e3
"""A gap in the singular values below this is not clear."""


class Discovery(eqx.Module):
    """What `discover_invariants` found.

    - `coefficients`: shape (count, order + 1, basis size), of the independent invariants, the
      simplest first; count may be 0. `dependent`: the same for the others in the span, which
      are functions of them (on the samples, as far as differentials say).
    - `exact`: for each independent invariant, whether it is kept at any ε, to round-off.
    - `leading_parts`: shape (families, basis size): a basis, orthonormal on the samples, of the
      order-0 parts of *all* invariants in the span.
    - `survivors`: for m = 0 … order, how many leading parts have an invariant of order m.
    - `singular_values`: of the whole system, descending, relative to the largest; `gap`: the
      ratio at which they were cut (large is clear, below 1e3 is not).
    - `residuals`: shape (count, order + 1), on held-out points: the largest change over one
      step at each order in ε, relative to the spread of the leading part. `dependent_residuals`
      likewise.
    - `obstructions`: a `DriftLaw` for each leading part that is lost at order 1, 2, ….
    - `basis`: with `names`. `slow_time`: of the system.
    - `tolerance`: None, or that of approximate invariants.

    On resonant or integrable systems the null space is large; on chaotic ones near-null vectors
    appear that are none. Held-out residuals and `drift_order` on a long run decide.
    """

    coefficients: Array
    dependent: Array
    exact: tuple[bool, ...] = eqx.field(static=True)
    leading_parts: np.ndarray
    survivors: tuple[int, ...] = eqx.field(static=True)
    singular_values: np.ndarray
    gap: float = eqx.field(static=True)
    residuals: np.ndarray
    dependent_residuals: np.ndarray
    obstructions: tuple[DriftLaw, ...]
    basis: BoundBasis
    shape: tuple[int, ...] = eqx.field(static=True)
    slow_time: bool = eqx.field(static=True)
    tolerance: float | None = eqx.field(static=True)

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
        """The independent invariants as observables."""
        return [InvariantSeries(self.basis, c, self.slow_time) for c in self.coefficients]

    @property
    def dependent_invariants(self) -> list[InvariantSeries]:
        """Those in the span that are functions of the independent ones."""
        return [InvariantSeries(self.basis, c, self.slow_time) for c in self.dependent]

    def evaluate(self, q: State, p: State, epsilon: Any, t: Any = 0.0) -> Array:
        """The values of the independent invariants at a point, shape (count,)."""
        powers = jnp.asarray(epsilon) ** jnp.arange(self.order + 1)
        return jnp.einsum("m,kmb,b->k", powers, self.coefficients, self.basis(q, p, t))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything but the basis functions themselves to a file (NumPy's npz)."""
        laws = [
            {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in law._asdict().items()}
            for law in self.obstructions
        ]
        about = {
            "format": 1,
            "names": self.basis.names,
            "exact": self.exact,
            "survivors": self.survivors,
            "gap": self.gap,
            "shape": self.shape,
            "slow_time": self.slow_time,
            "tolerance": self.tolerance,
            "obstructions": laws,
        }
        arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        with open(path, "wb") as file:
            np.savez(file, about=np.array(json.dumps(about)), **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], basis: AbstractBasis) -> "Discovery":
        """Read what `save` wrote; `basis` is the one that was searched (its names are compared).

        **Raises** `ValueError` for a file of something else, or another basis.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                about = json.loads(str(file["about"]))
                arrays = {name: file[name] for name in _ARRAYS}
        except (KeyError, ValueError, EOFError) as error:
            raise ValueError(f"{os.fspath(path)} is no file that Discovery.save wrote.") from error
        shape = tuple(about["shape"])
        bound = bind_basis(basis, shape)
        if list(bound.names) != about["names"]:
            raise ValueError(
                f"{os.fspath(path)} was found in a basis of {len(about['names'])} functions "
                f"({', '.join(about['names'][:4])} …); the one given has {bound.size} "
                f"({', '.join(bound.names[:4])} …)."
            )
        laws = tuple(_law(law) for law in about["obstructions"])
        for name in ("coefficients", "dependent"):
            arrays[name] = jnp.asarray(arrays[name])
        return cls(
            exact=tuple(about["exact"]),
            survivors=tuple(about["survivors"]),
            gap=about["gap"],
            obstructions=laws,
            basis=bound,
            shape=shape,
            slow_time=about["slow_time"],
            tolerance=about["tolerance"],
            **arrays,
        )

    def __str__(self) -> str:
        kind = "independent" if self.tolerance is None else "independent approximate"
        drop = 1e-9 if self.tolerance is None else np.sqrt(self.tolerance)
        lines = [
            f"{self.count} {kind} invariant{'' if self.count == 1 else 's'} of order "
            f"{self.order} in {self.basis.size} functions; leading parts that survive order 0 … "
            f"{self.order}: {', '.join(map(str, self.survivors))}; gap {self.gap:.1e}"
        ]
        if self.tolerance is not None:
            lines.append(f"  singular values up to {self.tolerance:g} of the largest count as zero")
        elif self.survivors[0] and self.gap < _CLEAR:
            lines.append("  the gap is not clear: let drift_order on a long run decide")
        for series, residual, exact in zip(
            self.invariants, self.residuals, self.exact, strict=True
        ):
            lines.append(f"  I = {series.formula(_SHOWN, drop)}")
            told = ", exact at every ε tried" if exact else ""
            lines.append(f"      held-out residual {np.max(residual):.1e}{told}")
        if len(self.dependent):
            lines.append(f"  functions of them, as differentials say: {len(self.dependent)}")
            for series in self.dependent_invariants[:3]:
                lines.append(f"      {series.formula(_SHOWN, drop)}")
        told = [law for law in self.obstructions if law.kind != "unexplained"]
        lines += [f"  {law}" for law in told[:_LAWS]]
        if len(told) > _LAWS:
            lines.append(f"  {len(told) - _LAWS} more lost, each by such a law")
        lost = self.survivors[0] - self.survivors[-1]
        if len(told) < lost:
            lines.append(
                f"  {lost - len(told)} more lost, by a drift that is no function of what order 0 "
                "keeps in this basis: it may be too small"
            )
        return "\n".join(lines)


def _law(values: dict[str, Any]) -> DriftLaw:
    """A law as `Discovery.save` wrote it."""
    fields: dict[str, Any] = {
        k: np.array(v) if isinstance(v, list) else v for k, v in values.items()
    }
    return DriftLaw(**fields)


_ARRAYS = (
    "coefficients",
    "dependent",
    "leading_parts",
    "singular_values",
    "residuals",
    "dependent_residuals",
)

_SHOWN = 12
"""Terms of a formula in a report; ``str`` of a series shows all."""

_LAWS = 4
"""Drift laws in a report."""


def discover_invariants(
    system: System,
    basis: AbstractBasis,
    order: int = 0,
    *,
    h: float,
    samples: Any,
    t0: float = 0.0,
    args: Args = None,
    method: Method = TypeII(),
    newton: Newton = Newton(),
    tolerance: float | None = None,
    representative: Literal["least", "simplest"] = "least",
) -> Discovery:
    r"""The adiabatic invariants of order z that a basis can express, on the iterated map itself.

    With φ the basis, Φ_ε the map of one step, and A_m(q, p, t) the m-th Taylor coefficient in ε
    of φ(Φ_ε(q, p), t + h) − φ(q, p, t), the series Σ ε^m c_m·φ changes by O(ε^{z+1}) in a step
    exactly when

        Σ_{m≤k} A_{k−m} c_m = 0    for k = 0 … z

    at every point: a block-Toeplitz system, whose null space is found order by order by singular
    values on sampled points (basis made orthonormal on them first).

    For a system with ``slow_time=True`` the time of samples and basis is the slow time τ: a step
    goes from τ to τ + εh, and φ(q, p, τ) may change with it.

    **Arguments**

    - `basis`: for example ``Polynomials(6)``, ``Basis([f, g])``, sums and products of bases.
    - `order`: z ≥ 0. `h`: step size [time]. `method`: any; only its map is used.
    - `samples`: (qs, ps) at t0, shapes (S, *q.shape), or (qs, ps, ts) with times of shape (S,):
      points of the domain of interest; a quarter is held out. At least twice as many as
      functions in the basis.
    - `tolerance`: for *approximate* invariants: singular values up to that share of the largest
      count as zero. What a method of order r keeps up to O(h^r), such as the energy, has
      singular values that shrink as h^r; the residual of one step then shrinks as h^{r+1}.
      None: only what is zero to round-off.
    - `representative`: an invariant of order z is free by ε times any other. "least" takes the
      corrections that are smallest on the samples (the convention of averaging: no part along
      what order 0 keeps), unless the simplest ones are exact; "simplest" takes those of simple
      functions, which tend to drift less and to read better.

    **Returns** a `Discovery`; print it for a report.

    **Raises** `ValueError` for too few samples, samples or basis functions that are not
    finite there, a step that fails there, a basis that is rank-deficient on them, a basis of
    time on samples of one time, a tolerance that is none, or h = 0; `TypeError` for what is no
    basis.

    **Accuracy** round-off of the singular values, times the conditioning of the basis; Taylor
    coefficients by nested forward autodiff, through implicit steps.

    **Source** our own.
    """
    samples = as_samples(samples, t0)
    _check_options(order, tolerance, representative)
    bound, h = bind_basis(basis, samples.q.shape[1:]), check_step_size(h)
    require_enough(samples, bound.size)
    require_time(bound, samples)
    equations = Equations(system, jnp.zeros(()), args, newton)
    values, changes, volume, good = _at_points(equations, h, method, bound, order, samples)
    require_steps(good, samples)
    values, changes, volume = np.asarray(values), np.asarray(changes), np.asarray(volume)
    check_basis(bound, values)
    held = samples.held_out
    # Orthonormal on the samples: singular values then measure functions, not their scaling.
    R = triangle_of(values[~held]) / np.sqrt(np.sum(~held))
    scaled = np.linalg.solve(R.T, changes[~held].reshape(-1, bound.size).T).T
    scaled = scaled.reshape(-1, order + 1, bound.size)

    blur = RANK if tolerance is None else max(RANK, np.sqrt(tolerance))
    compressed = compress(scaled)
    spaces = [series_space(compressed, m, tolerance) for m in range(order + 1)]
    span = Span(bound, R, spaces[-1], blur)
    found = span.representatives(Samples(*(x[~held] for x in samples)))

    def chosen(series):
        simplest = span.simplest(series)
        if order == 0:
            return _normalised(series), False
        exact = bool(_is_exact(equations, h, method, bound, jnp.asarray(simplest), _some(samples)))
        use_simplest = exact or representative == "simplest"
        return _normalised(simplest if use_simplest else span.least(series)), exact

    picked = [chosen(series) for series in found.series]

    def those(independent):
        flags = [f == independent for f in found.independent]
        series = [c for (c, _), flag in zip(picked, flags, strict=True) if flag]
        exact = tuple(e for (_, e), flag in zip(picked, flags, strict=True) if flag)
        return np.array(series).reshape(len(series), order + 1, bound.size), exact

    (coefficients, exact), (dependent, _) = those(True), those(False)
    return Discovery(
        coefficients=jnp.asarray(coefficients),
        dependent=jnp.asarray(dependent),
        exact=exact,
        leading_parts=np.linalg.solve(R, spaces[-1].leading[: bound.size]).T,
        survivors=tuple(space.leading.shape[1] for space in spaces),
        singular_values=spaces[-1].singular_values,
        gap=spaces[-1].gap,
        residuals=_residuals(coefficients, values[held], changes[held]),
        dependent_residuals=_residuals(dependent, values[held], changes[held]),
        obstructions=drift_laws(
            bound,
            R,
            scaled,
            values[~held],
            spaces,
            np.max(np.abs(volume), axis=0),
            system.slow_time,
            blur,
        ),
        basis=bound,
        shape=samples.q.shape[1:],
        slow_time=system.slow_time,
        tolerance=tolerance,
    )


def _check_options(order: Any, tolerance: Any, representative: Any) -> None:
    if isinstance(order, bool) or not isinstance(order, int) or order < 0:
        raise ValueError(f"order must be an integer of at least 0, got {order!r}.")
    if tolerance is not None and not 0 < tolerance < 1:
        raise ValueError(
            "tolerance must be None or a number between 0 and 1 (a share of the largest singular "
            f"value), got {tolerance!r}."
        )
    if representative not in ("least", "simplest"):
        raise ValueError(f"representative must be 'least' or 'simplest', got {representative!r}.")


def _map(equations: Equations, h: Any, method: Method, epsilon: Array) -> Any:
    """(q, p, t) → (q1, p1, t1) and the status, with t the slow time for a system that has one."""
    system, slow = equations.system, equations.system.slow_time
    plain = System(system.H_D, system.force, system.perturbation)
    here = Equations(plain, epsilon, equations.args, equations.newton)

    def step(q, p, t):
        t1 = t + (epsilon * h if slow else h)
        q1, p1, info = method.step(here, Interval(t, t1, jnp.asarray(h, float)), q, p)
        return q1, p1, t1, info

    return step


@eqx.filter_jit
def _at_points(equations, h, method, basis, order: int, samples):
    """Values of the basis, Taylor coefficients in ε of their changes and of log |det DΦ|.

    Shapes (S, B), (S, z + 1, B), (S, z + 1); and whether the steps succeed, (S,).
    """

    def at_point(q, p, t):
        def change(epsilon):
            q1, p1, t1, info = _map(equations, h, method, epsilon)(q, p, t)
            return basis(q1, p1, t1) - basis(q, p, t), info.result == RESULTS.successful

        def volume(epsilon):
            def flat(z):
                q1, p1, _, _ = _map(equations, h, method, epsilon)(
                    z[: q.size].reshape(q.shape), z[q.size :].reshape(p.shape), t
                )
                return jnp.concatenate([q1.ravel(), p1.ravel()])

            z = jnp.concatenate([q.ravel(), p.ravel()])
            return jnp.linalg.slogdet(jax.jacfwd(flat)(z))[1]

        zero = jnp.zeros(())
        terms = taylor_coefficients(lambda e: change(e)[0], zero, order)
        if order == 0:  # no law is asked for
            volumes = jnp.zeros(1)
        else:
            volumes = taylor_coefficients(volume, zero, order)
        return basis(q, p, t), terms, volumes, change(zero)[1]

    return jax.vmap(at_point)(*samples)


@eqx.filter_jit
def _is_exact(equations, h, method, basis, series, samples):
    """Whether Σ ε^m c_m·φ is kept over a step at ε that are not small."""

    def at(epsilon):
        c = epsilon ** jnp.arange(series.shape[0]) @ series

        def value(q, p, t):
            q1, p1, t1, info = _map(equations, h, method, epsilon)(q, p, t)
            before = c @ basis(q, p, t)
            return before, c @ basis(q1, p1, t1) - before, info.result == RESULTS.successful

        before, change, good = jax.vmap(value)(*samples)
        return jnp.all(good) & (jnp.max(jnp.abs(change)) <= _EXACT * jnp.std(before))

    return jnp.all(jax.vmap(at)(jnp.array(_TRIED)))


def _some(samples: Samples) -> Samples:
    """At most a hundred of them."""
    some = slice(None, None, max(1, len(samples.q) // 100))
    return Samples(*(x[some] for x in samples))


def _normalised(series: np.ndarray) -> np.ndarray:
    """Scaled so that the largest coefficient of the leading part is one half, as of an energy."""
    return series / (2 * series[0, np.argmax(np.abs(series[0]))])


def _residuals(coefficients, values, changes) -> np.ndarray:
    out = np.zeros(coefficients.shape[:2])
    for i, c in enumerate(coefficients):
        spread = np.std(values @ c[0])
        for k in range(c.shape[0]):
            total = sum(changes[:, k - m] @ c[m] for m in range(k + 1))
            out[i, k] = np.max(np.abs(total)) / spread
    return out
