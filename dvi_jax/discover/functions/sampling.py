"""Sampled points, at which symmetries and invariants are tested."""

from collections.abc import Callable
from typing import Any, NamedTuple, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.jaxapi import x64_enabled

from ...base.checks import finite as finite_number
from ...base.keywords import checked_keywords
from ...base.results import RESULTS
from ...base.types import Args, Interval
from ...engine.newton import Newton, RootSolver
from ...integration.arithmetic import Arithmetic
from ...integration.integrator import only
from ...integration.keywords import MapSettings, integrator_of
from ...methods import Method
from ...methods.step import Equations, step
from ...problem.system import System, check_system
from .basis import BoundBasis, check_step_size as check_step_size
from .generators import LatticePoint


class SamplePoints(NamedTuple):
    """Points (q, p) at times t: shapes (S, *shape), (S, *shape), (S,)."""

    q: np.ndarray
    p: np.ndarray
    t: np.ndarray

    def subset(self, index: Any) -> "SamplePoints":
        return SamplePoints(*(field[index] for field in self))

    @property
    def held_out(self) -> np.ndarray:
        """Which points are not fitted but judge the fit: a quarter, at random, always the same."""
        mask = np.zeros(len(self.q), bool)
        mask[np.random.default_rng(0).permutation(len(mask))[: len(mask) // 4]] = True
        return mask

    def text(self, i: int) -> str:
        q, p = (f"{x[i].tolist()!s:.80}" for x in self[:2])
        return f"at index {i}: q = {q}, p = {p}, t = {self.t[i]:g}"


# Shifts of time, in steps, at which a map that does not depend on it is the same.
_LATER = (37.3, 1000.7)
LEAST_STEP = 1e-11  # A relative step below this is not known to three digits, because of rounding
# A step that moves the samples by less than this share of their spread is small, and so are
# samples on which a map differs from a linear one by less than this share of how much it varies:
# what changes by less than rounding may be conserved, or an expansion in the step or about the
# samples.
SMALL = 1e-2
_FAR = 100.0  # Typical distances from the median beyond which a sample is left out of the spread
_LOSS = 1e5  # Rounding of polynomials about the origin above which they are taken about the middle


def spread(values: np.ndarray) -> float:
    """Standard deviation of the components, 1 where nothing varies; far samples are left out."""
    distance = np.abs(values - np.median(values, axis=0))
    is_near = distance <= _FAR * np.median(distance, axis=0)
    is_near = is_near.reshape(len(values), -1).all(axis=1)
    values = values[is_near] if 2 * np.sum(is_near) > len(values) else values
    size = float(np.sqrt(np.mean((values - np.mean(values, axis=0)) ** 2)))
    return size if size > 0 else 1.0


def spreads(samples: SamplePoints) -> np.ndarray:
    """The spread of q and of p, for each component of (q, p): shape (2n,)."""
    return np.repeat([spread(samples.q), spread(samples.p)], samples.q[0].size)


class Displacements(NamedTuple):
    """Samples, and z1 − z of z = (q, p) in a step of a map from each, shape (S, 2n)."""

    samples: SamplePoints
    values: np.ndarray

    @property
    def relative_step(self) -> float:
        """Median distance by which a step moves the samples, as a share of their spread."""
        return float(np.median(np.max(np.abs(self.values) / spreads(self.samples), axis=1)))

    @property
    def relative_steps(self) -> np.ndarray:
        """The same of q and of p alone, shape (2,)."""
        relative = np.abs(self.values) / spreads(self.samples)
        return np.median(np.max(relative.reshape(len(relative), 2, -1), axis=2), axis=0)

    @property
    def nonlinearity(self) -> float:
        """Median distance of the map from a linear one, as a share of how much it varies."""
        sizes = spreads(self.samples)
        z = np.concatenate([x.reshape(len(x), -1) for x in self.samples[:2]], axis=1)
        z = np.column_stack([(z - np.median(z, axis=0)) / sizes, np.ones(len(z))])
        values = self.values / sizes
        left = np.linalg.norm(values - z @ np.linalg.lstsq(z, values, rcond=None)[0], axis=1)
        varies = np.linalg.norm(values - np.median(values, axis=0), axis=1)
        return float(np.median(left) / max(np.median(varies), 1e-300))


def later(h: float, relative: float = 1.0) -> np.ndarray:
    """Shifts of the time, [time], longer in steps where a step is small relative to the samples."""
    return np.array(_LATER) * abs(h) * max(1.0, 0.1 / max(relative, LEAST_STEP))


def rounding(samples: SamplePoints) -> float:
    """The last digit of the coordinates as a share of how much they vary over the samples."""
    sizes = [np.median(np.abs(x), axis=0).max() / spread(x) for x in (samples.q, samples.p)]
    return float(np.finfo(float).eps * max(sizes))


def middle(samples: SamplePoints, degree: int) -> np.ndarray:
    """The centre m of polynomials of a degree, of z = (q, p, t), shape (2n + 1,): m_i = 0 where the
    origin is as good, else the median of z_i, rounded to about as much as the samples spread."""
    z = [x.reshape(len(samples.q), -1) for x in (samples.q, samples.p, samples.t)]
    z = np.concatenate(z, axis=1)
    out = np.zeros(z.shape[1])
    for i, x in enumerate(z.T):
        median = np.median(x)
        width = np.median(np.abs(x - median))
        if width > 0 and degree * np.log(max(abs(median), width) / width) > np.log(_LOSS):
            step = 10.0 ** np.round(np.log10(width))
            out[i] = float(np.format_float_scientific(np.round(median / step) * step, 15))
    return out


def as_samples(samples: Any, t0: float = 0.0) -> SamplePoints:
    """(qs, ps) at the time t0, or (qs, ps, ts), after rejecting what cannot be sampled points."""
    if not x64_enabled():
        raise TypeError(
            "this function computes in float64, but JAX in float32: call first\n"
            '    jax.config.update("jax_enable_x64", True)'
        )
    if isinstance(samples, SamplePoints):
        return samples
    try:
        arrays = [np.asarray(array, float) for array in samples]
    except (TypeError, ValueError):
        arrays = []
    if len(arrays) not in (2, 3):
        raise ValueError(
            "samples must be arrays (qs, ps) of real numbers, or (qs, ps, ts) with the times, one "
            f"row for each point, got {samples!r:.100}."
        )
    q, p = arrays[:2]
    if q.shape != p.shape or q.ndim < 1 or len(q) == 0:
        raise ValueError(
            "qs and ps of samples must have the same shape, with one or more points along the "
            f"first axis, got {q.shape} and {p.shape}."
        )
    t = arrays[2] if len(arrays) == 3 else np.full(len(q), finite_number("t0", t0))
    if t.shape != (len(q),):
        raise ValueError(
            f"ts of samples must have one time for each point, shape ({len(q)},), got {t.shape}."
        )
    points = SamplePoints(q, p, t)
    finite = [np.isfinite(array).reshape(len(q), -1).all(axis=1) for array in points]
    if len(bad := np.flatnonzero(~np.all(finite, axis=0))):
        raise ValueError(
            f"samples must be finite, but {len(bad)} of {len(q)} points are not, first "
            f"{points.text(bad[0])}."
        )
    return points


def values_at(basis: BoundBasis, samples: SamplePoints) -> np.ndarray:
    """The functions at the samples, shape (S, size)."""
    return np.asarray(_values_at(basis.without_names(), samples))


@eqx.filter_jit
def _values_at(basis, samples):
    return jax.vmap(basis)(*map(jnp.asarray, samples))


class Map(NamedTuple):
    """The map of one step that a search examines."""

    t0: Any
    args: Args
    method: Method
    root_finder: RootSolver
    arithmetic: Arithmetic

    def equations(self, system: System, samples: SamplePoints) -> Equations:
        """The discrete equations at ε = 0; shapes are checked at the first sample."""
        q, p, t = (jnp.asarray(x[0]) for x in samples)
        system.check_shapes(t, q, p, jnp.zeros(()), self.args)
        return Equations(system, jnp.zeros(()), self.args, self.root_finder)


def map_of(function: str, system: System, settings: Any, *fields: str) -> Map:
    """The map from the keywords of a search; `fields`: those of an `Integrator` that the search
    uses besides `root_finder`, by default Newton's, through which Taylor coefficients are exact."""
    integrator, run = integrator_of(settings)
    only(integrator, function, *fields, "root_finder")
    root_finder = integrator.root_finder
    if settings.get("integrator") is None and settings.get("root_finder") is None:
        root_finder = Newton()
    problem = run.get("t0", 0.0), run.get("args")
    return Map(*problem, integrator.method_for(system), root_finder, integrator.arithmetic)


def require_enough(samples: SamplePoints, unknowns: int, conditions: int = 1) -> None:
    """Reject fewer samples than determine `unknowns`, with `conditions` from each one."""
    minimum = int(np.ceil(2 * unknowns / conditions))
    if len(samples.q) < minimum:
        raise ValueError(
            f"samples have too few points for {unknowns} unknown coefficients: give at least "
            f"{minimum}, got {len(samples.q)}, or a smaller basis."
        )


def require_times(uses_time: bool, samples: SamplePoints, subject: str = "the basis") -> None:
    """Reject samples of one time for what depends on it; `subject`: its name."""
    if uses_time and np.ptp(samples.t) == 0:
        raise ValueError(
            f"{subject} depends on the time, but all samples have t = {samples.t[0]:g}: give "
            "samples=(qs, ps, ts) with different times in ts."
        )


def require_steps(good: Any, samples: SamplePoints) -> None:
    """Reject samples at which the map's step failed."""
    good = np.asarray(good)
    if not good.all():
        raise ValueError(
            f"the step fails at {np.sum(~good)} of {len(good)} samples, first "
            f"{samples.text(int(np.argmin(good)))}: take other samples, or a smaller h."
        )


_NEAR_SINGULARITIES = "keep the samples away from its singularities"


def require_finite(values: np.ndarray, name: Callable, hint: str = _NEAR_SINGULARITIES) -> None:
    """Reject values, shape (S, …), that are not finite; `name`: of the value with other indices."""
    bad = ~np.isfinite(values)
    if bad.any():
        i, *index = np.argwhere(bad)[0]
        count = int(bad[(slice(None), *index)].sum())  # those of the function that is named
        raise ValueError(
            f"{name(*index)} is not finite at {count} of {len(bad)} samples, first at index {i}: "
            f"{hint}."
        )


def check_finite(basis: BoundBasis, values: np.ndarray) -> None:
    """Reject functions that are not finite on the samples; `values`: (S, size)."""
    require_finite(values, lambda j: f"the basis function {basis.names[j]!r}")


def check_basis(basis: BoundBasis, values: np.ndarray) -> float:
    """Reject functions that are not finite on the samples, or dependent; `values`: (S, size). The
    condition number of the others, each scaled to one size."""
    check_finite(basis, values)
    values = values / np.maximum(np.max(np.abs(values), axis=0), np.finfo(float).tiny)
    scale = np.linalg.norm(values, axis=0)
    zero = np.flatnonzero(scale == 0)
    normal = values / np.where(scale > 0, scale, 1)
    singular, V = np.linalg.svd(normal, full_matrices=False)[1:]
    if zero.size or singular[-1] < 1e-13 * singular[0]:
        shares = abs(V[-1]) / np.max(abs(V[-1]))
        places = zero if zero.size else [j for j in np.argsort(-shares) if shares[j] > 1e-6]
        members = ", ".join(repr(basis.names[j]) for j in places[:4]) + " …" * (len(places) > 4)
        relation = "are" if zero.size else "have a linear combination that is"
        hint = "smaller units where powers underflow" if zero.size else "samples in a wider domain"
        raise ValueError(
            f"the basis is rank-deficient: its functions {members} {relation} 0 on all samples. "
            f"Leave some of them out, or take {hint}."
        )
    return float(singular[0] / singular[-1])


@checked_keywords
def solution_pairs(
    system: System, *, h: float, samples: Any, epsilon: Any = 0.0, **settings: Unpack[MapSettings]
) -> tuple[LatticePoint, LatticePoint]:
    r"""Pairs of lattice points on solutions: each sample and its image under one step of the map.

    For `determining_residual` under ``vmap``: it vanishes on them for a symmetry.

    **Arguments** `samples`: (qs, ps) at t0, shapes (S, *q.shape), or (qs, ps, ts) with their
    times, shape (S,); `h`: step size [time]; `epsilon`, and the keywords `t0`, `args`,
    `root_finder`, `integrator`: as for `integrate`.

    **Returns** two points with a leading axis of length S. **Raises** `ValueError` for samples
    of unequal shapes or not finite, h = 0, or a step that fails on them.
    """
    check_system(system, "solution_pairs")
    one_step = map_of("solution_pairs", system, settings)
    samples, h = as_samples(samples, one_step.t0), check_step_size(h)
    equations = Equations(system, jnp.asarray(epsilon, float), one_step.args, one_step.root_finder)
    first, second, good = _step_pairs(equations, jnp.asarray(h), samples)
    require_steps(good, samples)
    return first, second


@eqx.filter_jit
def _step_pairs(equations, h, samples):
    def at_point(q, p, t):
        q1, p1, info = step(equations, Interval(t, t + h, h), q, p)
        good = info.result == RESULTS.successful
        return LatticePoint(t, q, p), LatticePoint(t + h, q1, p1), good

    return jax.vmap(at_point)(*map(jnp.asarray, samples))


def random_pairs(
    *, h: float, samples: Any, t0: float = 0.0, seed: int = 0
) -> tuple[LatticePoint, LatticePoint]:
    """Pairs of lattice points that are not on one solution: each sample, and a random one.

    For `conformal_factor`, whose Λ holds at all points. The second point is at t + h.

    **Arguments** `samples`: as for `solution_pairs`, at least two; `seed`: of the random order.

    **Returns** two points with a leading axis of length S. **Raises** `ValueError` for samples
    of unequal shapes, not finite, or fewer than two; h = 0.
    """
    samples, h = as_samples(samples, t0), check_step_size(h)
    count = len(samples.q)
    if count < 2:
        raise ValueError("samples must have at least two points, got one.")
    order = np.random.default_rng(seed).permutation(count)
    other = np.empty(count, int)
    other[order] = np.roll(order, 1)  # one cycle: no sample is paired with itself
    first = LatticePoint(*map(jnp.asarray, (samples.t, samples.q, samples.p)))
    second = samples.t + h, samples.q[other], samples.p[other]
    return first, LatticePoint(*map(jnp.asarray, second))
