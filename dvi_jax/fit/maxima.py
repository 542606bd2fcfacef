"""Maxima of a posterior, found by descents from draws of the priors and bounds."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .posterior import Posterior
from .uncertainty import uncertainty

_STEPS = 20  # Of a first descent; the best ones continue
_CLOSE = 30.0  # Potential above the least up to which a descent continues
_SHARE = 1e-3  # Least part of the probability of a maximum that counts
_BARRIER = 0.5  # Rise of the potential between two maxima that a chain passes easily
_BETWEEN = np.linspace(0, 1, 11)[1:-1]
_WIDTH = 2.0  # Of draws without a prior or bounds, in sizes of the parameter
_LEAST = 10.0  # The least such size, in standard errors


class Maximum(NamedTuple):
    """A maximum of the density of u: L Lᵀ is the covariance of its normal approximation, `share`
    its part of the probability of all maxima by that approximation."""

    u: np.ndarray
    root: np.ndarray
    potential: float
    share: float = 1.0

    @property
    def log_volume(self) -> float:
        """Logarithm of the integral of the approximation, up to a constant."""
        return float(np.linalg.slogdet(self.root)[1]) - self.potential


def explored(
    posterior: Posterior, first: Maximum, count: int, seed: int
) -> tuple[list[Maximum], str]:
    """The maxima whose share counts, largest first, and what was explored, as text."""
    u, undrawn = _draws(posterior, first, count, seed)
    values = np.array([posterior.look(x)[0] for x in u])
    ends = [posterior.descend(x, _STEPS)[:2] for x in u[np.isfinite(values)]]
    least = min([first.potential, *(value for _, value in ends)])
    maxima = [first]
    for x, value in sorted(ends, key=lambda end: end[1]):
        if value > least + _CLOSE or any(_is_same(posterior, x, value, m) for m in maxima):
            continue
        maximum = maximum_near(posterior, x)
        if maximum and not any(
            _is_same(posterior, maximum.u, maximum.potential, m) for m in maxima
        ):
            maxima.append(maximum)
    volumes = np.array([m.log_volume for m in maxima])
    shares = np.exp(volumes - volumes.max())
    shares /= shares.sum()
    pairs = zip(maxima, shares.tolist(), strict=True)
    maxima = [m._replace(share=s) for m, s in pairs if s >= _SHARE]
    maxima.sort(key=lambda m: -m.share)
    failures = int((~np.isfinite(values)).sum())
    text = f"{len(maxima)} maxim{'um' if len(maxima) == 1 else 'a'} from {count} draws"
    text += " of priors and bounds" * (len(undrawn) < posterior.size)
    text += f" ({failures} with density 0)" * bool(failures)
    if undrawn:
        listing = ", ".join(undrawn[:4]) + ", …" * (len(undrawn) > 4)
        text += f"; without a prior or two bounds, drawn near the start only: {listing}"
    return maxima, text


def maximum_near(posterior: Posterior, u: np.ndarray, max_steps: int = 50) -> Maximum | None:
    """The maximum that a descent from u reaches; None if a direction is not determined there."""
    u, value, A = posterior.descend(u, max_steps)
    spectrum = uncertainty(A, 1.0) if np.isfinite(A).all() else None
    if spectrum is None or spectrum.null_directions.size:
        return None
    return Maximum(u, spectrum.directions / spectrum.singular_values, value)


def _is_same(posterior: Posterior, u: np.ndarray, value: float, other: Maximum) -> bool:
    """Whether no barrier of the potential separates u from a maximum."""
    if np.linalg.norm(np.linalg.solve(other.root, u - other.u)) < 1:
        return True
    limit = max(value, other.potential) + _BARRIER
    return all(posterior.look(u + t * (other.u - u))[0] <= limit for t in _BETWEEN)


def _draws(
    posterior: Posterior, first: Maximum, count: int, seed: int
) -> tuple[np.ndarray, list[str]]:
    """Draws of u from priors and bounds (a Latin hypercube), and the names without either, whose
    draws are normal, as wide as their size."""
    from scipy.special import ndtr, ndtri  # importing the package does not import it

    space, random = posterior.space, np.random.default_rng(seed)
    ranks = random.permuted(np.tile(np.arange(count), (posterior.size, 1)), axis=1).T
    p = (ranks + random.uniform(1e-9, 1 - 1e-9, ranks.shape)) / count
    lower, upper = np.asarray(space.lower), np.asarray(space.upper)
    has_prior, has_bounds = np.asarray(space.prior_weight) > 0, np.isfinite(upper - lower)
    sigma = np.where(has_prior, 1 / np.where(has_prior, space.prior_weight, 1.0), 1.0)
    mean = np.asarray(space.prior_mean)
    low, high = ndtr((lower - mean) / sigma), ndtr((upper - mean) / sigma)
    with np.errstate(invalid="ignore"):  # ∞ − ∞ where it is not used
        uniform = lower + p * (upper - lower)
        x = np.where(has_prior, mean + sigma * ndtri(low + p * (high - low)), uniform)
    x = np.where(has_prior | has_bounds, x, np.asarray(posterior.to_x(jnp.asarray(first.u))))
    u = posterior.to_u(x)
    size = np.maximum(np.abs(first.u), _LEAST * np.linalg.norm(first.root, axis=1))
    leaves = [name.split("[")[0] for name in posterior.names]
    # A component that is zero has the size of the others of its array.
    size = [max(s for s, other in zip(size, leaves, strict=True) if other == x) for x in leaves]
    # With one bound u is a logarithm, in which a factor of e is wide enough.
    width = np.where(np.array(space.has_lower) | space.has_upper, 1.0, _WIDTH * np.array(size))
    is_drawn = (has_prior | has_bounds) & np.isfinite(u).all(axis=0)
    u = np.where(is_drawn, u, first.u + width * ndtri(p))
    return u, [name for name, good in zip(posterior.names, is_drawn, strict=True) if not good]
