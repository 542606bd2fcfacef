"""Parameters as one vector: their names, bounds and priors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree


@dataclass(frozen=True)
class Bounds:
    """Limits of parameters: a value stays strictly between them.

    - `lower`, `upper`: numbers, or arrays that broadcast to the parameter; None or infinite for
      no limit.

    Inside the fit a parameter between both is lower + (upper − lower) / (1 + exp(−u)), above
    one limit lower + exp(u), with u free.
    """

    lower: Any = None
    upper: Any = None


@dataclass(frozen=True)
class Prior:
    """What is known of a parameter beforehand: a normal distribution, independent in components.

    - `mean`, `sigma`: numbers, or arrays that broadcast to the parameter.
    """

    mean: Any
    sigma: Any


def _is_number(x: Any) -> bool:
    return eqx.is_inexact_array_like(x) or (isinstance(x, int) and not isinstance(x, bool))


class Space:
    """The parameters of a fit as a vector x of all their numbers, and as a free vector u.

    Numbers and floating-point arrays are fitted; what else the pytree holds (functions, arrays of
    integers) stays as it is. x obeys the bounds, u has none.

    - `names`: one for each number, such as ``q0[1]``; `size`: how many there are.
    - `lower`, `upper`: bounds of x, infinite where there are none.
    - `prior_mean`, `prior_weight`: of x; the weight is 1/sigma, 0 without a prior.

    **Raises** `TypeError` or `ValueError` for a pytree without numbers, values that are not finite,
    starts outside of bounds, and bounds or priors that do not fit the pytree.
    """

    def __init__(self, params: PyTree, bounds: PyTree = None, priors: PyTree = None):
        numbers, self._rest = eqx.partition(params, _is_number)
        paths = jax.tree_util.tree_flatten_with_path(numbers)[0]
        if not paths:
            raise ValueError(
                f"params holds no number that could be fitted: {params!r}. Give starting values as "
                "floats or floating-point arrays."
            )
        numbers = jax.tree.map(lambda x: jnp.asarray(x, float), numbers)
        self.names, self.shapes = [], []
        for path, leaf in paths:
            name, shape = _name(path), np.shape(leaf)
            if any(isinstance(x, complex) for x in (leaf,)) or np.iscomplexobj(leaf):
                raise TypeError(f"the parameter {name} is complex: write its parts.")
            places = ("" if not shape else f"[{', '.join(map(str, i))}]" for i in np.ndindex(shape))
            self.names += [name + place for place in places]
            self.shapes.append((name, shape))
        x, self._unravel = ravel_pytree(numbers)
        self.start = np.asarray(x)
        self.size = self.start.size
        if not np.isfinite(self.start).all():
            i = int(np.argmin(np.isfinite(self.start)))
            raise ValueError(
                f"the parameter {self.names[i]} starts at {self.start[i]}: every start must be a "
                "finite number."
            )
        self.lower, self.upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        self.prior_mean, self.prior_weight = np.zeros(self.size), np.zeros(self.size)
        self._each(params, bounds, Bounds, "bounds", self._bound)
        self._each(params, priors, Prior, "priors", self._prior)
        self._check_start()

    def _each(self, params, given, kind, called, take: Callable[..., None]) -> None:
        """Call `take` with the numbers that each leaf of `given` is about."""
        if given is None:
            return

        def walk(given, below, path):
            if given is None:
                return
            if isinstance(given, kind):
                found = [i for i, n in enumerate(self.names) if _is_under(n, path)]
                if not found:
                    raise ValueError(f"{called} are given for {path or 'params'}, not a number.")
                take(given, np.array(found), np.shape(below), path or "the parameters")
                return
            if isinstance(given, Mapping) and isinstance(below, Mapping):
                for key, value in given.items():
                    if key not in below:
                        raise ValueError(
                            f"{called} are given for {key!r}, but the parameters are "
                            f"{', '.join(map(repr, below))}."
                        )
                    walk(value, below[key], f"{path}.{key}" if path else str(key))
                return
            if isinstance(given, list | tuple) and isinstance(below, list | tuple):
                for i, value in enumerate(given):
                    walk(value, below[i], f"{path}[{i}]")
                return
            raise TypeError(
                f"{called} must be made like the parameters, with dvi.{kind.__name__}(...) or None "
                f"in place of numbers; at {path or 'the top'} it holds {given!r}."
            )

        walk(given, params, "")

    def _bound(self, bounds: Bounds, where, shape, name) -> None:
        for side, of, empty in (("lower", self.lower, -np.inf), ("upper", self.upper, np.inf)):
            value = getattr(bounds, side)
            of[where] = _spread(
                empty if value is None else value, where, shape, f"{side} of {name}"
            )
        bad = ~(self.lower[where] < self.upper[where])
        if bad.any():
            i = where[np.argmax(bad)]
            raise ValueError(
                f"the bounds of {self.names[i]} are {self.lower[i]} and {self.upper[i]}: the lower "
                "one must be less."
            )

    def _prior(self, prior: Prior, where, shape, name) -> None:
        sigma = _spread(prior.sigma, where, shape, f"sigma of {name}")
        mean = _spread(prior.mean, where, shape, f"mean of {name}")
        if not ((sigma > 0).all() and np.isfinite(sigma).all() and np.isfinite(mean).all()):
            raise ValueError(
                f"the prior of {name} needs a finite mean and a positive sigma, got {prior}."
            )
        self.prior_mean[where], self.prior_weight[where] = mean, 1 / sigma

    def _check_start(self) -> None:
        outside = ~((self.start > self.lower) & (self.start < self.upper))
        if outside.any():
            i = int(np.argmax(outside))
            raise ValueError(
                f"the parameter {self.names[i]} starts at {self.start[i]}, which is not between "
                f"its bounds {self.lower[i]} and {self.upper[i]}."
            )

    def to_params(self, x: Array) -> PyTree:
        """The pytree that holds the numbers x."""
        return eqx.combine(self._unravel(x), self._rest)

    def to_x(self, u: Array) -> Array:
        """x within its bounds from the free vector u."""
        lo, hi = (jnp.where(np.isfinite(b), b, 0.0) for b in (self.lower, self.upper))
        below, above = np.isfinite(self.lower), np.isfinite(self.upper)
        both = below & above
        one = jnp.exp(jnp.where(below ^ above, u, 0.0))
        x = jnp.where(both, lo + (hi - lo) * jax.nn.sigmoid(u), u)
        x = jnp.where(below & ~above, lo + one, x)
        return jnp.where(above & ~below, hi - one, x)

    def to_u(self, x: Any) -> np.ndarray:
        """The free vector of x."""
        u = np.array(x, float)
        below, above = np.isfinite(self.lower), np.isfinite(self.upper)
        both = below & above
        part = (u[both] - self.lower[both]) / (self.upper[both] - self.lower[both])
        u[both] = np.log(part) - np.log1p(-part)
        i = below & ~above
        u[i] = np.log(u[i] - self.lower[i])
        i = above & ~below
        u[i] = np.log(self.upper[i] - u[i])
        return u

    def at_bounds(self, x: np.ndarray) -> list[str]:
        """Names of the numbers that lie at a bound, to 1e-5 of the distance between both or 1."""
        width = self.upper - self.lower
        width = np.where(np.isfinite(width), width, 1.0)
        near = np.minimum(x - self.lower, self.upper - x) < 1e-5 * width
        return [name for name, is_near in zip(self.names, near, strict=True) if is_near]

    def slope(self, u: Any) -> np.ndarray:
        """dx/du, component by component."""
        u = jnp.asarray(u)
        return np.asarray(jax.jvp(self.to_x, (u,), (jnp.ones_like(u),))[1])

    @property
    def count_of_priors(self) -> int:
        """How many numbers have a prior."""
        return int((self.prior_weight > 0).sum())


def _spread(value: Any, where: np.ndarray, shape: tuple[int, ...], called: str) -> np.ndarray:
    value = np.asarray(value, float)
    if value.ndim == 0:
        return np.full(len(where), float(value))
    if value.shape != shape:
        raise ValueError(f"{called} has shape {value.shape}, the parameter has {shape}.")
    return value.ravel()


def _is_under(name: str, path: str) -> bool:
    return not path or name == path or name.startswith((path + "[", path + "."))


def _name(path: tuple[Any, ...]) -> str:
    """``args.mu`` or ``layers[0].weight`` for the path of a leaf."""
    name = ""
    for key in path:
        if hasattr(key, "idx"):
            name += f"[{key.idx}]"
        else:
            part = str(getattr(key, "key", getattr(key, "name", key)))
            name += f".{part}" if name else part
    return name or "params"
