"""Adiabatic invariants found as a null space on the map that is actually iterated."""

import operator
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.dependence import depends_on

from .._results import RESULTS
from .._step import Equations
from .._system import System
from .._types import Args, Interval
from ..engine.newton import Newton, RootSolver
from ..engine.nullspace import (
    RANK,
    ROUNDING,
    Motion,
    compress,
    epsilon_scale,
    in_units_of,
    null_space,
    relative_changes,
    series_spaces,
    triangle as triangle_of,
)
from ..engine.taylor import taylor_coefficients
from ..methods import Method, TypeII
from ..symmetry.basis import AbstractBasis, bind_basis, check_step_size
from ..symmetry.sampling import (
    Samples,
    as_samples,
    check_basis,
    check_finite,
    require_enough,
    require_steps,
    require_system,
    require_time,
)
from .found import Discovery
from .obstructions import drift_laws
from .representatives import Span, differentials

_EXACT = 1e-12
"""A series that changes by less, of what functions change by, at large ε is no expansion."""

_TRIED = (0.5, -0.3)
"""The ε at which that is tried, in units of that at which the disturbance is as large as H_D."""

_EXACT_STEPS = 100
"""Steps over which it is tried."""

_LATER = (1.0, 2.7)
"""Shifts of time at which a map that does not depend on it is the same."""

_CLEARLY = 1e-9
"""Changes of an invariant, by the measure of `Motion`, for nearly all samples."""

_SAME = 1e-3
"""Two functions whose difference is this share of them are one, with and without errors."""

_LARGER = (1.0, 2.0, 4.0, 8.0)
"""Sizes of the samples, about their middle, on which an exact invariant is kept alike."""

_ROUND_OFF = 1e-13
"""Shares below this of the largest are not there."""


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
    newton: RootSolver = Newton(),
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
      singular values and residuals that shrink as h^r.
      None: only what is below 1e-11.
    - `representative`: an invariant of order z is free by ε times any other. "least" takes the
      corrections that are smallest on the samples (the convention of averaging: no part along
      what order 0 keeps), unless the simplest ones are exact; "simplest" takes those of simple
      functions, which tend to drift less and to read better.

    **Returns** a `Discovery`; print it for a report.

    **Raises** `ValueError` for too few samples, samples or basis functions that are not
    finite there, a step that fails there, a basis that is rank-deficient on them, a basis or a
    map of time with samples of one time, a tolerance that is none, or h = 0; `TypeError` for
    what is no system, basis, method or Newton, and for samples without x64.

    **Accuracy** round-off of the singular values, times the conditioning of the basis; Taylor
    coefficients by nested forward autodiff, through implicit steps.

    **Source** our own.

    **Example**

    ```python
    cubic = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
                       force=lambda t0, t1, q0, p1, args: -q0**3)
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 400, 1))
    found = dvi.discover_invariants(cubic, dvi.Polynomials(8), order=1, h=0.1, samples=samples,
                                    representative="simplest")
    print(found.invariants[0])
    # 0.5 q² − 0.05 q p + 0.5 p² + ε (0.251256 q⁴ − 0.0502513 q³ p + 0.00251256 q² p²)
    ```
    """
    require_system(system, newton)
    samples = as_samples(samples, t0)
    order = _check_options(order, tolerance, representative, method)
    bound, h = bind_basis(basis, samples.q.shape[1:]), check_step_size(h)
    require_enough(samples, bound.size)
    require_time(bound, samples)
    q, p, t = (jnp.asarray(x[0]) for x in samples)
    system.check_shapes(t, q, p, jnp.zeros(()), args)
    equations = Equations(system, jnp.zeros(()), args, newton)
    values, changes, volume, motion = _checked_changes(equations, h, method, bound, order, samples)
    held, fit = samples.held_out, ~samples.held_out
    condition = check_basis(bound, values[fit])
    rms = np.sqrt(np.mean(values[fit] ** 2, axis=0))
    # Orthonormal on the samples: singular values then measure functions, not their scaling.
    R = triangle_of(values[fit] / rms) / np.sqrt(np.sum(fit))
    scaled = np.linalg.solve(R.T, (changes / rms).reshape(-1, bound.size).T).T
    scaled = scaled.reshape(changes.shape)
    orthonormal = motion.of(np.linalg.inv(R) / rms[:, None])
    weights = orthonormal.weights()[:, None, None]
    scale = epsilon_scale(weights[fit] * scaled[fit])
    scaled = in_units_of(scale, scaled)
    constant = _shares_of_constant(bound, rms, values[fit], _some(samples))
    spaces = series_spaces(
        compress(weights[fit] * scaled[fit]),
        scaled,
        orthonormal,
        tolerance,
        None if constant is None else R @ constant,
    )
    blur = RANK if tolerance is None else max(RANK, np.sqrt(tolerance))
    span = Span(bound, rms, R, spaces[-1], blur, constant)
    found = span.representatives(Samples(*(x[fit] for x in samples)))
    typical = np.linalg.norm(compress(scaled[fit])[:, 0], 2)
    typical = typical if typical > 0 else 1.0
    sizes = rms / scale ** np.arange(order + 1)[:, None]

    of_fit = changes[fit, 0], Motion(*(x[fit] for x in motion)), values[fit]
    fewest = _Fewest(bound.complexity, rms, *of_fit)

    def chosen(series):
        """Coefficients of the user's functions, and whether the series is exact."""
        if order == 0:
            given = _cleaned(series)[0]
            if tolerance is None:
                given = fewest.again(given)
            return given[None] / sizes, False
        simplest = _cleaned(span.simplest(series)) / sizes
        given, typical_, scale_ = (jnp.asarray(x) for x in (simplest, typical, scale))
        here = _some(samples)
        exact = bool(_is_exact(equations, h, method, bound, given, typical_, scale_, here))
        if exact or representative == "simplest":
            return simplest, exact
        return _cleaned(span.least(series)) / sizes, exact

    picked = [chosen(series) for series in found.series]

    def those(independent):
        flags = [f == independent for f in found.independent]
        series = [_normalised(c, rms) for (c, _), f in zip(picked, flags, strict=True) if f]
        exact = tuple(e for (_, e), flag in zip(picked, flags, strict=True) if flag)
        return np.array(series).reshape(len(series), order + 1, bound.size), exact

    (coefficients, exact), (dependent, _) = those(True), those(False)
    judge = _Judge(values, in_units_of(scale, changes), motion, held, scale)
    refused = spaces[-1].refused
    if tolerance is None:  # with the digits that the coefficients have in the end
        kept, others = (
            np.all(judge.quantiles(c, 0.95) <= _CLEARLY, axis=1) for c in (coefficients, dependent)
        )
        refused += int(np.sum(~kept) + np.sum(~others))
        coefficients, dependent = coefficients[kept], dependent[others]
        exact = tuple(e for e, k in zip(exact, kept, strict=True) if k)
    known = len(coefficients) + len(dependent) + (constant is not None)
    impossible = len(coefficients) == 2 * samples.q[0].size and not bound.uses_time
    impossible = impossible and not system.slow_time and bool(np.any(motion.changes))
    if impossible:
        refused, exact = refused + len(coefficients) + len(dependent), ()
        coefficients, dependent = coefficients[:0], dependent[:0]
    return Discovery(
        coefficients=jnp.asarray(coefficients),
        dependent=jnp.asarray(dependent),
        exact=exact,
        leading_parts=(np.linalg.solve(R, spaces[-1].leading[: bound.size]) / rms[:, None]).T,
        survivors=tuple(space.leading.shape[1] for space in spaces),
        singular_values=spaces[-1].singular_values,
        gap=spaces[-1].gap,
        refused=refused,
        residuals=judge.quantiles(coefficients, 1.0),
        typical_residuals=np.stack([judge.quantiles(coefficients, x) for x in (0.5, 0.95)], -1),
        dependent_residuals=judge.quantiles(dependent, 1.0),
        undecided=max(orthonormal.undecided() - known, 0),
        impossible=impossible,
        powers=_powers_of_size(equations, h, method, bound, coefficients, samples)
        if order == 0 and tolerance is None
        else np.full(len(coefficients), np.nan),
        reach=_reach(coefficients, values[fit]),
        obstructions=drift_laws(
            bound,
            rms,
            R,
            weights[fit] * scaled[fit],
            values[fit],
            weights[fit, :, 0],
            spaces,
            np.max(np.abs(in_units_of(scale, volume)), axis=0),
            scale,
            system.slow_time,
            blur,
        ),
        basis=bound,
        sizes=sizes,
        condition=condition,
        scale=scale,
        probe=Samples(*(x[:3] for x in samples)),
        shape=samples.q.shape[1:],
        slow_time=system.slow_time,
        tolerance=tolerance,
    )


def _check_options(order: Any, tolerance: Any, representative: Any, method: Any) -> int:
    try:
        number = -1 if isinstance(order, bool) else operator.index(order)
    except TypeError:
        number = -1
    if number < 0:
        raise ValueError(f"order must be an integer of at least 0, got {order!r}.")
    is_number = isinstance(tolerance, float | np.floating)
    if tolerance is not None and not (is_number and 0 < tolerance < 1):
        raise ValueError(
            "tolerance must be None or a number between 0 and 1 (a share of the largest singular "
            f"value), got {tolerance!r}."
        )
    if representative not in ("least", "simplest"):
        raise ValueError(f"representative must be 'least' or 'simplest', got {representative!r}.")
    if not isinstance(method, Method):
        raise TypeError(f"method must be a method such as dvi.TypeII(), got {method!r}.")
    return number


def _checked_changes(equations, h, method, basis, order, samples):
    """φ, A_0 … A_z and the changes of log phase volume, after refusing what is not finite."""
    values, changes, volume, good, slopes, move, blur = map(
        np.asarray, _at_points(equations, h, method, basis, order, samples)
    )
    require_steps(good, samples)
    check_finite(basis, values)
    bad = ~np.isfinite(changes)
    if bad.any():
        i, m, j = np.argwhere(bad)[0]
        what = "changes by" if m == 0 else f"has in order {m} of ε"
        raise ValueError(
            f"what the basis function {basis.names[j]!r} {what} in a step is not finite at "
            f"{int(bad.any(axis=(1, 2)).sum())} of {len(values)} samples (first: number {i}): H_D, "
            "the force or the function is singular there or where the step leads. Keep the "
            "samples off the singularity."
        )
    if not np.isfinite(volume).all():
        raise ValueError(
            "the derivative of the map is not finite at "
            f"{int((~np.isfinite(volume)).any(axis=1).sum())} of {len(values)} samples: keep them "
            "off singularities of H_D and the force."
        )
    if np.ptp(samples.t) == 0 and _may_depend_on_time(equations, samples):
        for shift in _LATER:
            later = samples._replace(t=samples.t + shift)
            other = np.asarray(_at_points(equations, h, method, basis, order, later)[1])
            size = np.max(np.abs(changes), axis=(0, 2)) + np.finfo(float).tiny
            if not (np.max(np.abs(other - changes), axis=(0, 2)) <= 1e-8 * size).all():
                raise ValueError(
                    "the map depends on the time, and all samples are of one time: give "
                    "samples=(qs, ps, ts)."
                )
    return values, changes, volume, _motion(values, changes, slopes, move, blur)


def _motion(values, changes, slopes, move, blur) -> Motion:
    """`move`: z1 − z; `blur`: what z1 and z − z1 are rounded by, in units of the last digit."""
    rounding = np.abs(values) + np.abs(values + changes[:, 0])
    rounding = rounding + np.einsum("sbi,si->sb", np.abs(slopes), blur)
    return Motion((slopes * move[:, None]).swapaxes(1, 2), np.finfo(float).eps * rounding)


def _may_depend_on_time(equations, samples) -> bool:
    """Whether t enters H_D, perturbation or force at all."""
    q, p, t = (jnp.asarray(x[0]) for x in samples)
    system, args, one = equations.system, equations.args, jnp.ones(())

    def energies(t):
        H = system.hamiltonian(t, t, q, p, one, args)
        return H, system.disturbing_force(t, t, q, p, one, args)

    return depends_on(energies, 0, t)


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

        def flat(z):
            half = z[: q.size].reshape(q.shape), z[q.size : -1].reshape(p.shape), z[-1]
            q1, p1, t1, _ = _map(equations, h, method, zero)(*half)
            return jnp.concatenate([q1.ravel(), p1.ravel(), t1[None]])

        def functions(z):
            return basis(z[: q.size].reshape(q.shape), z[q.size : -1].reshape(p.shape), z[-1])

        z = jnp.concatenate([q.ravel(), p.ravel(), jnp.asarray(t)[None]])
        # Rounding of z moves z1 − z by as much as the derivative along some vector of its size.
        signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], z.size))
        z1, dz1 = jax.jvp(flat, (z,), (signs * jnp.abs(z),))
        blur = jnp.abs(z1) + jnp.abs(dz1 - signs * jnp.abs(z))
        slopes = jax.jacfwd(functions)(z)
        return basis(q, p, t), terms, volumes, change(zero)[1], slopes, z1 - z, blur

    return jax.vmap(at_point)(*samples)


@eqx.filter_jit
def _is_exact(equations, h, method, basis, series, typical, scale, samples):
    """Whether Σ ε^m c_m·φ is kept over many steps at ε that are not small."""

    def at(epsilon):
        c = epsilon ** jnp.arange(series.shape[0]) @ series
        step = _map(equations, h, method, epsilon)

        def value(q, p, t):
            def once(_, state):
                q, p, t, good = state
                q, p, t, info = step(q, p, t)
                return q, p, t, good & (info.result == RESULTS.successful)

            good = jnp.asarray(True)
            q1, p1, t1, good = jax.lax.fori_loop(0, _EXACT_STEPS, once, (q, p, t, good))
            before, after = basis(q, p, t), basis(q1, p1, t1)
            rounding = jnp.abs(c) @ (jnp.abs(before) + jnp.abs(after))
            return c @ before, c @ after - c @ before, rounding, good

        before, change, rounding, good = jax.vmap(value)(*map(jnp.asarray, samples))
        moved = jnp.minimum(_EXACT_STEPS * typical, 1) * jnp.std(before)
        allowed = _EXACT * moved + _EXACT_STEPS * jnp.finfo(before.dtype).eps * rounding
        return jnp.all(good) & jnp.all(jnp.abs(change) <= allowed)

    return jnp.all(jax.vmap(at)(jnp.array(_TRIED) / scale))


def _shares_of_constant(basis, rms, values, samples) -> np.ndarray | None:
    """The combination that is 1 everywhere (and not only on these samples), if there is one."""
    shares = np.linalg.lstsq(values / rms, np.ones(len(values)), rcond=None)[0]
    shares = np.where(np.abs(shares) > 1e-9 * np.max(np.abs(shares)), shares, 0.0)
    terms = np.abs(values / rms) @ np.abs(shares)
    if np.max(np.abs(values / rms @ shares - 1) / terms) > 1e4 * np.finfo(float).eps:
        return None
    slopes = np.asarray(differentials(basis, *samples)) / rms[:, None]
    terms = np.abs(slopes) * np.abs(shares)[:, None]
    sums = np.einsum("sbn,b->sn", slopes, shares)
    return shares if np.max(np.abs(sums)) <= 1e-9 * np.max(terms, initial=1.0) else None


def _some(samples: Samples) -> Samples:
    """At most a hundred of them."""
    some = slice(None, None, max(1, len(samples.q) // 100))
    return Samples(*(x[some] for x in samples))


def _cleaned(shares: np.ndarray) -> np.ndarray:
    """The shares without what is round-off of the others."""
    return np.where(np.abs(shares) > _ROUND_OFF * np.max(np.abs(shares)), shares, 0.0)


def _normalised(series: np.ndarray, rms: np.ndarray) -> np.ndarray:
    """Scaled so that the coefficient with the largest share is one half, as of an energy."""
    return series / (2 * series[0, np.argmax(np.abs(series[0] * rms))])


class _Fewest:
    """Invariants of order 0 solved for again, to more digits, in the functions up to the lowest
    complexity that hold them: of functions that one does not need the coefficients are errors only.
    """

    def __init__(self, complexity, rms, changes, motion, values):
        self.complexity, self.rms = np.array(complexity), rms
        self.changes, self.motion, self.values = changes, motion, values
        self.kept: dict[int, tuple[np.ndarray, np.ndarray] | None] = {}

    def up_to(self, level: int) -> tuple[np.ndarray, np.ndarray] | None:
        """What is kept by the functions up to a complexity: columns of coefficients, and values."""
        some = self.complexity <= level
        R = triangle_of(self.values[:, some] / self.rms[some]) / np.sqrt(len(self.values))
        if len(R) < np.sum(some) or np.linalg.cond(R) > 1 / RANK**2:
            return None
        orthonormal = np.linalg.inv(R) / self.rms[some][:, None]
        motion = Motion(self.motion.changes[..., some], self.motion.rounding[:, some])
        rows = self.changes[:, some] @ orthonormal
        rows = motion.of(orthonormal).weights()[:, None] * rows / np.sqrt(len(rows))
        columns = orthonormal @ null_space(rows, unit=1.0).columns
        return columns, self.values[:, some] @ columns

    def again(self, shares: np.ndarray) -> np.ndarray:
        """The shares of an invariant, in as few functions as can be."""
        target = self.values @ (shares / self.rms)
        for level in sorted(set(self.complexity)):
            if level not in self.kept:
                self.kept[level] = self.up_to(level)
            kept = self.kept[level]
            if kept is None or kept[0].shape[1] == 0:
                continue
            found = np.linalg.lstsq(kept[1], target)[0]
            if np.linalg.norm(kept[1] @ found - target) <= _SAME * np.linalg.norm(target):
                out = np.zeros(len(shares))
                some = self.complexity <= level
                out[some] = (kept[0] @ found) * self.rms[some]
                return _cleaned(out)
        return shares


def _powers_of_size(equations, h, method, basis, coefficients, samples) -> np.ndarray:
    """The power of the samples' size by which changes grow, shape (count,): 0 for an invariant that
    is kept on samples several times as large, which an expansion about their middle is not; NaN
    where no map or function is defined there."""
    changes = []
    for factor in _LARGER:
        middle = [np.mean(x, axis=0) for x in samples[:2]]
        larger = [m + factor * (x - m) for m, x in zip(middle, samples[:2], strict=True)]
        at = samples._replace(q=larger[0], p=larger[1])
        found = map(np.asarray, _at_points(equations, h, method, basis, 0, at))
        values, moved, _, good, slopes, move, blur = found
        finite = [np.isfinite(x.reshape(len(good), -1)).all(axis=1)
                  for x in (values, moved, slopes, move, blur)]  # fmt: skip
        good = good & np.all(finite, axis=0)
        if len(coefficients) == 0 or np.mean(good) < 0.5:
            break
        motion = _motion(values[good], moved[good], slopes[good], move[good], blur[good])
        judge = _Judge(values[good], moved[good], motion, np.full(np.sum(good), True), 1.0)
        changes.append(judge.quantiles(coefficients, 0.95)[:, 0])
    if len(changes) < 2:
        return np.full(len(coefficients), np.nan)
    powers = np.zeros(len(coefficients))
    for i, row in enumerate(np.stack(changes, axis=1)):
        above = np.flatnonzero(row > 10 * _CLEARLY)
        if len(above):
            k = max(above[0], 1)
            powers[i] = np.log(row[k] / max(row[k - 1], ROUNDING)) / np.log(
                _LARGER[k] / _LARGER[k - 1]
            )
    return powers


class _Judge(NamedTuple):
    """The held-out samples: values, changes in units of ε · scale, and what slopes predict."""

    values: np.ndarray
    changes: np.ndarray
    motion: Motion
    held: np.ndarray
    scale: float

    def quantiles(self, coefficients: np.ndarray, share: float) -> np.ndarray:
        """The change that the given share of the samples stays below, shape (count, z + 1)."""
        out = np.zeros(coefficients.shape[:2])
        motion = Motion(*(x[self.held] for x in self.motion))
        for i, c in enumerate(coefficients):
            leading = self.values[self.held] @ c[0]
            size = np.sqrt(np.mean(leading**2))
            spread = float(max(np.std(leading), 1e-6 * size, np.finfo(float).tiny))
            series = c / self.scale ** np.arange(len(c))[:, None]
            changes = relative_changes(self.changes[self.held], series, motion, spread)
            out[i] = np.quantile(changes, share, axis=0)
        return out


def _reach(coefficients, values) -> np.ndarray:
    """The smallest ε at which a correction is as large as the leading part, shape (count,)."""
    out = np.full(len(coefficients), np.inf)
    for i, c in enumerate(coefficients):
        sizes = np.sqrt(np.mean((values @ c.T) ** 2, axis=0))
        for m in range(1, len(c)):
            if sizes[m] > 0:
                out[i] = min(out[i], (sizes[0] / sizes[m]) ** (1 / m))
    return out
