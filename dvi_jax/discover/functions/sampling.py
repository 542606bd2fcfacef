"""Sampled points, at which symmetries and invariants are tested."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.jaxapi import x64_enabled

from ...base.checks import finite as finite_number
from ...base.keywords import with_keywords_of
from ...base.results import RESULTS
from ...base.types import Args, Interval
from ...engine.newton import Newton, RootSolver
from ...integration.arithmetic import Arithmetic
from ...integration.integrate import integrate
from ...integration.integrator import Integrator, chosen, only
from ...methods import Method
from ...methods.step import Equations, step
from ...problem.system import System, check_system
from .basis import BoundBasis, check_step_size
from .generators import LatticePoint


class Samples(NamedTuple):
    """Points (q, p) at times t: shapes (S, *shape), (S, *shape), (S,)."""

    q: np.ndarray
    p: np.ndarray
    t: np.ndarray

    def at(self, some: Any) -> "Samples":
        """Some of the samples."""
        return Samples(*(x[some] for x in self))

    @property
    def held_out(self) -> np.ndarray:
        """Which points are not fitted but judge the fit: a quarter, at random, always the same."""
        held = np.zeros(len(self.q), bool)
        held[np.random.default_rng(0).permutation(len(held))[: len(held) // 4]] = True
        return held


# Shifts of time, in steps, at which a map that does not depend on it is the same.
_LATER = (37.3, 1000.7)
UNSEEN = 1e-11  # A relative step below this is not known to three digits, because of rounding
# A step that moves the samples by less than this share of their spread is small, and so are
# samples on which a map differs from a linear one by less than this share of how much it varies:
# what changes by less than rounding may be conserved, or an expansion in the step or about the
# samples.
SMALL = 1e-2
# A sample that is farther from the median than this many typical distances does not count in the
# spread of the others.
_FAR = 100.0
# Polynomials are taken about the middle of the samples where they would lose so much by rounding
# about the origin.
_LOST = 1e5


def spread(values: np.ndarray) -> float:
    """Standard deviation of the components about their means; 1 where nothing varies. Samples far
    away from nearly all others are left out."""
    distance = np.abs(values - np.median(values, axis=0))
    near = distance <= _FAR * np.median(distance, axis=0)
    near = near.reshape(len(values), -1).all(axis=1)
    values = values[near] if 2 * np.sum(near) > len(values) else values
    size = float(np.sqrt(np.mean((values - np.mean(values, axis=0)) ** 2)))
    return size if size > 0 else 1.0


def spreads(samples: Samples) -> np.ndarray:
    """The spread of q and of p, for each component of (q, p): shape (2n,)."""
    return np.repeat([spread(samples.q), spread(samples.p)], samples.q[0].size)


class Displacements(NamedTuple):
    """Samples, and z1 − z of z = (q, p) in a step of a map from each, shape (S, 2n)."""

    samples: Samples
    values: np.ndarray

    @property
    def relative_step(self) -> float:
        """Median distance by which a step moves the samples, as a share of their spread."""
        sizes = spreads(self.samples)
        return float(np.median(np.max(np.abs(self.values) / sizes, axis=1)))

    @property
    def nonlinearity(self) -> float:
        """Median distance of the map from a linear one, as a share of how much it varies on the
        samples."""
        sizes = spreads(self.samples)
        z = np.concatenate([x.reshape(len(x), -1) for x in self.samples[:2]], axis=1)
        z = np.column_stack([(z - np.median(z, axis=0)) / sizes, np.ones(len(z))])
        values = self.values / sizes
        left = np.linalg.norm(values - z @ np.linalg.lstsq(z, values, rcond=None)[0], axis=1)
        varies = np.linalg.norm(values - np.median(values, axis=0), axis=1)
        return float(np.median(left) / max(np.median(varies), 1e-300))


def later(h: float, relative: float = 1.0) -> np.ndarray:
    """Shifts of the time, [time], longer in steps where a step is small relative to the samples."""
    return np.array(_LATER) * abs(h) * max(1.0, 0.1 / max(relative, UNSEEN))


def rounding(samples: Samples) -> float:
    """The last digit of the coordinates as a share of how much they vary over the samples."""
    sizes = [np.median(np.abs(x), axis=0).max() / spread(x) for x in (samples.q, samples.p)]
    return float(np.finfo(float).eps * max(sizes))


def middle(samples: Samples, degree: int) -> np.ndarray:
    """The centre m of polynomials of a degree, of z = (q, p, t), shape (2n + 1,): m_i = 0 where the
    origin is as good, else the median of z_i, rounded to about as much as the samples spread."""
    z = [x.reshape(len(samples.q), -1) for x in (samples.q, samples.p, samples.t)]
    z = np.concatenate(z, axis=1)
    out = np.zeros(z.shape[1])
    for i, x in enumerate(z.T):
        median = np.median(x)
        width = np.median(np.abs(x - median))
        if width > 0 and degree * np.log(max(abs(median), width) / width) > np.log(_LOST):
            step = 10.0 ** np.round(np.log10(width))
            out[i] = float(np.format_float_scientific(np.round(median / step) * step, 15))
    return out


def as_samples(samples: Any, t0: float = 0.0) -> Samples:
    """(qs, ps) at the time t0, or (qs, ps, ts), after rejecting what cannot be sampled points."""
    if not x64_enabled():
        raise TypeError(
            "this function must compute in float64, but JAX is set to float32. Put the line\n"
            '    jax.config.update("jax_enable_x64", True)\nafter "import jax", before the first '
            "array is made."
        )
    if isinstance(samples, Samples):
        return samples
    try:
        arrays = [np.asarray(x, float) for x in samples]
    except (TypeError, ValueError):
        arrays = []
    if len(arrays) not in (2, 3):
        raise ValueError(
            "samples must be a pair of arrays (qs, ps), or (qs, ps, ts) with the times. Each array "
            f"must have real numbers, and one row for each point. Got {samples!r:.100}."
        )
    q, p = arrays[:2]
    if q.shape != p.shape or q.ndim < 1 or len(q) == 0:
        raise ValueError(
            "qs and ps of samples must have the same shape, with at least one point along the "
            f"first axis; got {q.shape} for qs and {p.shape} for ps."
        )
    t = arrays[2] if len(arrays) == 3 else np.full(len(q), finite_number("t0", t0))
    if t.shape != (len(q),):
        raise ValueError(
            f"ts of samples must have one time for each point, shape ({len(q)},), got {t.shape}."
        )
    finite = [np.isfinite(x).reshape(len(q), -1).all(axis=1) for x in (q, p, t)]
    if len(bad := np.flatnonzero(~np.all(finite, axis=0))):
        i = bad[0]
        raise ValueError(
            f"samples must be finite, but {len(bad)} of {len(q)} points have values that are not "
            f"finite. The first has the index {i}: q = {q[i].tolist()!s:.80}, "
            f"p = {p[i].tolist()!s:.80}, t = {t[i]}. Correct these points, or leave them out."
        )
    return Samples(q, p, t)


class Map(NamedTuple):
    """The map of one step that a search examines."""

    t0: Any
    args: Args
    method: Method
    root_finder: RootSolver
    arithmetic: Arithmetic


TYPE_2 = "t0 args root_finder integrator"
"""Keywords of searches that examine the paper's map, of `TypeII()`."""


def map_of(
    function: str,
    system: System,
    t0: Any,
    args: Args,
    root_finder: RootSolver | None,
    integrator: Integrator | None,
    **more: Any,
) -> Map:
    """The map from the keywords of a search, with or without `method` and `arithmetic`.

    By default by Newton's iteration, through which Taylor coefficients in ε are exact.
    """
    if integrator is None and root_finder is None:
        root_finder = Newton()
    integrator = chosen(integrator, root_finder=root_finder, **more)
    found = only(integrator, function, *more, "root_finder")
    return Map(t0, args, found.method_for(system), found.root_finder, found.arithmetic)


def require_enough(samples: Samples, unknowns: int, conditions: int = 1) -> None:
    """Reject fewer samples than determine `unknowns`, with `conditions` from each one."""
    needed = int(np.ceil(2 * unknowns / conditions))
    if len(samples.q) < needed:
        raise ValueError(
            f"samples have too few points for {unknowns} unknown coefficients: at least {needed} "
            f"are required, got {len(samples.q)}. Give more points, or a smaller basis. A quarter "
            "of the points is used only for validation."
        )


def require_time(basis: BoundBasis, samples: Samples) -> None:
    """Reject a basis with functions of time when all samples are of one time."""
    if basis.uses_time and np.ptp(samples.t) == 0:
        raise ValueError(
            "the basis has functions of time, but all samples have the same time, "
            f"t = {samples.t[0]:g}. Give samples=(qs, ps, ts) with different times in ts."
        )


def require_steps(good: Any, samples: Samples) -> None:
    """Reject samples at which the map's step failed."""
    good = np.asarray(good)
    if not good.all():
        i = int(np.argmin(good))
        raise ValueError(
            f"the step fails at {int(np.sum(~good))} of {len(good)} samples. The first of these is "
            f"q = {samples.q[i].tolist()}, p = {samples.p[i].tolist()}. Take samples where the map "
            "is defined, or a smaller h."
        )


def require_finite(
    values: np.ndarray,
    what: Callable[..., str],
    hint: str = "keep the samples away from its singularities",
) -> None:
    """Reject values, shape (S, …), that are not finite; `what`: their name from the indices that
    follow the sample."""
    bad = ~np.isfinite(values)
    if bad.any():
        i, *index = np.argwhere(bad)[0]
        count = int(bad[(slice(None), *index)].sum())  # those of the function that is named
        raise ValueError(
            f"{what(*index)} is not finite at {count} of {len(bad)} samples, first at index {i}: "
            f"{hint}."
        )


def check_finite(basis: BoundBasis, values: np.ndarray) -> None:
    """Reject functions that are not finite on the samples; `values`: (S, size)."""
    require_finite(values, lambda j: f"the basis function {basis.names[j]!r}")


def check_basis(basis: BoundBasis, values: np.ndarray) -> float:
    """Reject functions that are not finite on the samples, or dependent; `values`: (S, size).

    Returns the condition number of the functions, each scaled to one size.
    """
    check_finite(basis, values)
    values = values / np.maximum(np.max(np.abs(values), axis=0), np.finfo(float).tiny)
    scale = np.linalg.norm(values, axis=0)
    zero = np.flatnonzero(scale == 0)
    normal = values / np.where(scale > 0, scale, 1)
    singular, V = np.linalg.svd(normal, full_matrices=False)[1:]
    if zero.size:
        members = ", ".join(repr(basis.names[j]) for j in zero[:4])
        raise ValueError(
            f"the basis is rank-deficient: {zero.size} of {len(scale)} functions are 0 on all "
            f"samples ({members}{' …' if zero.size > 4 else ''}). Leave these functions out, or "
            "take samples where they are not 0. If powers of small coordinates underflow, use "
            "smaller units."
        )
    if singular[-1] < 1e-13 * singular[0]:
        shares = abs(V[-1]) / np.max(abs(V[-1]))
        used = [j for j in np.argsort(-shares) if shares[j] > 1e-6]
        members = ", ".join(repr(basis.names[j]) for j in used[:4]) + " …" * (len(used) > 4)
        raise ValueError(
            f"the basis is rank-deficient: a linear combination of its functions {members} is 0 on "
            "all samples. Leave one of these functions out, or take samples that fill the domain."
        )
    return float(singular[0] / singular[-1])


@with_keywords_of(integrate, TYPE_2)
def solution_pairs(
    system: System, *, h: float, samples: Any, epsilon: Any = 0.0, **how: Any
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
    one_step = map_of("solution_pairs", system, **how)
    samples, h = as_samples(samples, one_step.t0), check_step_size(h)
    equations = Equations(system, jnp.asarray(epsilon, float), one_step.args, one_step.root_finder)
    first, second, good = _stepped(equations, jnp.asarray(h), samples)
    require_steps(good, samples)
    return first, second


@eqx.filter_jit
def _stepped(equations, h, samples):
    def at_point(q, p, t):
        q1, p1, info = step(equations, Interval(t, t + h, h), q, p)
        good = info.result == RESULTS.successful
        return LatticePoint(t, q, p), LatticePoint(t + h, q1, p1), good

    return jax.vmap(at_point)(*map(jnp.asarray, samples))


def random_pairs(
    *, h: float, samples: Any, t0: float = 0.0, seed: int = 0
) -> tuple[LatticePoint, LatticePoint]:
    """Pairs of lattice points off the solutions: each sample, and another one at random.

    For `conformal_factor`, whose Λ holds at all points. The second point is at t + h.

    **Arguments** `samples`: as for `solution_pairs`, at least two; `seed`: of the random order.

    **Returns** two points with a leading axis of length S. **Raises** `ValueError` for samples
    of unequal shapes, not finite, or fewer than two; h = 0.
    """
    samples, h = as_samples(samples, t0), check_step_size(h)
    count = len(samples.q)
    if count < 2:
        raise ValueError("samples must have at least two points for random_pairs, got one.")
    order = np.random.default_rng(seed).permutation(count)
    other = np.empty(count, int)
    other[order] = np.roll(order, 1)  # one cycle: no sample is paired with itself
    first = LatticePoint(*map(jnp.asarray, (samples.t, samples.q, samples.p)))
    moved = (samples.t + h, samples.q[other], samples.p[other])
    return first, LatticePoint(*map(jnp.asarray, moved))
