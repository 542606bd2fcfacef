"""Parameters as one vector: their names, bounds and priors."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..engine.quantities import refuse_unit_or_mask


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


def _is_number(path: Any, x: Any) -> bool:
    """Whether a leaf is fitted: a whole number is unless it is a field of an object, a size."""
    if isinstance(x, int) and not isinstance(x, bool):
        return not any(isinstance(key, jax.tree_util.GetAttrKey) for key in path)
    return bool(eqx.is_inexact_array_like(x))


_UNDERFLOW = 1e-150
"""Distance from a bound below which the square of dx/du is zero, and no error is found."""


def _gap(bound: Array) -> Array:
    """Distance of a number next to a bound from it, at least one unit of its round-off."""
    about = np.finfo(float)
    return jnp.maximum(about.eps * jnp.abs(bound), about.tiny)


class Space(eqx.Module):
    """The parameters of a fit as a vector x of all their numbers, and as a free vector u.

    Numbers and floating-point arrays are fitted; what else the pytree holds (functions, arrays of
    integers, whole numbers in objects) stays as it is. x obeys the bounds, u has none.

    - `names`: one for each number, such as ``q0[1]``. `lower`, `upper`: bounds of x, infinite
      where there are none. `prior_mean`, `prior_weight`: of x; the weight is 1/sigma, 0 without a
      prior.
    """

    lower: Array
    upper: Array
    prior_mean: Array
    prior_weight: Array
    rest: PyTree
    names: tuple[str, ...] = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    tree: Any = eqx.field(static=True)
    below: tuple[bool, ...] = eqx.field(static=True)
    above: tuple[bool, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return len(self.names)

    @property
    def count_of_priors(self) -> int:
        """How many numbers have a prior."""
        return int((np.asarray(self.prior_weight) > 0).sum())

    def to_params(self, x: Array) -> PyTree:
        """The pytree that holds the numbers x."""
        ends = np.cumsum([0, *(int(np.prod(shape, dtype=int)) for shape in self.shapes)])
        leaves = [
            x[a:b].reshape(shape)
            for a, b, shape in zip(ends[:-1], ends[1:], self.shapes, strict=True)
        ]
        return eqx.combine(jax.tree.unflatten(self.tree, leaves), self.rest)

    def to_x(self, u: Array) -> Array:
        """x within its bounds from the free vector u."""
        below, above = np.array(self.below), np.array(self.above)
        lower, upper = jnp.where(below, self.lower, 0.0), jnp.where(above, self.upper, 0.0)
        one = jnp.exp(jnp.where(below ^ above, u, 0.0))
        x = jnp.where(below & above, lower + (upper - lower) * jax.nn.sigmoid(u), u)
        x = jnp.where(below & ~above, lower + one, x)
        x = jnp.where(above & ~below, upper - one, x)
        # Rounding must not put x on a bound: there u is infinite. Derivatives stay those of exp.
        low = jnp.where(below, lower + _gap(lower), -jnp.inf)
        high = jnp.where(above, upper - _gap(upper), jnp.inf)
        return x + jax.lax.stop_gradient(jnp.clip(x, low, high) - x)

    def to_u(self, x: Any) -> np.ndarray:
        """The free vector of x."""
        u, lower, upper = np.array(x, float), np.asarray(self.lower), np.asarray(self.upper)
        below, above = np.array(self.below), np.array(self.above)
        i = below & above
        part = (u[i] - lower[i]) / (upper[i] - lower[i])
        u[i] = np.log(part) - np.log1p(-part)
        i = below & ~above
        u[i] = np.log(u[i] - lower[i])
        i = above & ~below
        u[i] = np.log(upper[i] - u[i])
        return u

    def in_words(self, x: np.ndarray, most: int = 8) -> str:
        """``args.k = 1.2, epsilon = 0``, the first few numbers."""
        pairs = [f"{n} = {v:.6g}" for n, v in zip(self.names[:most], x, strict=False)]
        return ", ".join(pairs) + (", …" if self.size > most else "")

    def slope(self, u: Any) -> np.ndarray:
        """dx/du, component by component."""
        u = jnp.asarray(u)
        return np.asarray(jax.jvp(self.to_x, (u,), (jnp.ones_like(u),))[1])

    def at_bounds(self, x: np.ndarray, sigma: np.ndarray) -> list[str]:
        """Names of the numbers that lie within a tenth of their standard error from a bound, or,
        without a finite error, on it but for rounding."""
        off = np.minimum(x - np.asarray(self.lower), np.asarray(self.upper) - x)
        reach = np.where(np.isfinite(sigma), 0.1 * sigma, 1e-12 * np.abs(x) + _UNDERFLOW)
        near = np.isfinite(off) & (off <= reach)
        return [name for name, is_near in zip(self.names, near, strict=True) if is_near]


def make_space(
    params: PyTree, bounds: PyTree = None, priors: PyTree = None
) -> tuple[Space, np.ndarray]:
    """The space of a pytree, and where it starts.

    **Raises** `TypeError` or `ValueError` for a pytree without numbers, values that are not finite,
    starts outside of bounds, and bounds or priors that do not fit the pytree.
    """
    numbers, rest = eqx.partition(params, jax.tree_util.tree_map_with_path(_is_number, params))
    paths, tree = jax.tree_util.tree_flatten_with_path(numbers)
    if not paths:
        raise ValueError(
            f"params holds no number that could be fitted: {params!r}. Give starting values as "
            "floats or floating-point arrays."
        )
    names, shapes, leaves = [], [], {}
    for path, leaf in paths:
        name, shape = _name(path), np.shape(leaf)
        refuse_unit_or_mask(f"the parameter {name}", leaf)
        if np.iscomplexobj(leaf):
            raise TypeError(f"the parameter {name} is complex: write its parts.")
        places = ("" if not shape else f"[{', '.join(map(str, i))}]" for i in np.ndindex(shape))
        leaves[name] = _Leaf(len(names), shape)
        names += [name + place for place in places]
        shapes.append(shape)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"two parameters are called {twice}: give their keys other names.")
    start = np.concatenate([np.ravel(np.asarray(leaf, float)) for _, leaf in paths])
    if not np.isfinite(start).all():
        i = int(np.argmin(np.isfinite(start)))
        raise ValueError(
            f"the parameter {names[i]} starts at {start[i]}: every start must be a finite number."
        )
    lower, upper = _limits(bounds, names, leaves)
    mean, weight = _priors(priors, names, leaves)
    outside = ~((start > lower) & (start < upper))
    if outside.any():
        i = int(np.argmax(outside))
        raise ValueError(
            f"the parameter {names[i]} starts at {start[i]}, which is not between its bounds "
            f"{lower[i]} and {upper[i]}."
        )
    space = Space(
        lower=jnp.asarray(lower),
        upper=jnp.asarray(upper),
        prior_mean=jnp.asarray(mean),
        prior_weight=jnp.asarray(weight),
        rest=rest,
        names=tuple(names),
        shapes=tuple(shapes),
        tree=tree,
        below=tuple(np.isfinite(lower).tolist()),
        above=tuple(np.isfinite(upper).tolist()),
    )
    return space, start


class _Leaf(NamedTuple):
    """A fitted array: where its numbers begin in x, and its shape."""

    begin: int
    shape: tuple[int, ...]


def _limits(bounds: PyTree, names: list[str], leaves: Mapping[str, _Leaf]):
    """Lower and upper limit of each number."""
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for given, name, where, shape in _given(bounds, Bounds, "bounds", leaves):
        for side, limit, value in (("lower", lower, given.lower), ("upper", upper, given.upper)):
            if value is not None:
                limit[where] = _spread(value, where, shape, f"{side} of {name}")
    bad = ~(lower < upper)
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"the bounds of {names[i]} are {lower[i]} and {upper[i]}: the lower one must be less."
        )
    return lower, upper


def _priors(priors: PyTree, names: list[str], leaves: Mapping[str, _Leaf]):
    """Mean and 1/sigma of each number, 0 without a prior."""
    mean, weight = np.zeros(len(names)), np.zeros(len(names))
    for given, name, where, shape in _given(priors, Prior, "priors", leaves):
        sigma = _spread(given.sigma, where, shape, f"sigma of {name}")
        mean[where] = _spread(given.mean, where, shape, f"mean of {name}")
        if not ((sigma > 0).all() and np.isfinite(sigma).all() and np.isfinite(mean).all()):
            raise ValueError(
                f"the prior of {name} needs a finite mean and a positive sigma, got {given}."
            )
        weight[where] = 1 / sigma
    return mean, weight


def _given(
    tree: PyTree, kind: type, called: str, leaves: Mapping[str, _Leaf]
) -> Iterator[tuple[Any, str, np.ndarray, tuple[int, ...]]]:
    """The bounds or priors in a pytree: each with its name, the numbers below it, and their shape
    if they are one array."""
    for path, given in jax.tree_util.tree_leaves_with_path(tree):
        name = _name(path)
        if not isinstance(given, kind):
            raise TypeError(
                f"{called} must be made like the parameters, with dvi.{kind.__name__}(...) or None "
                f"in place of numbers; at {name} it holds {given!r}."
            )
        below = [leaf for key, leaf in leaves.items() if not path or _is_under(key, name)]
        if not below:
            raise ValueError(
                f"{called} are given for {name!r}, which is no fitted parameter; these are "
                f"{', '.join(map(repr, leaves))}."
            )
        each = [leaf.begin + np.arange(np.prod(leaf.shape, dtype=int)) for leaf in below]
        shape = leaves[name].shape if name in leaves else ()
        yield given, name, np.concatenate(each), shape


def _spread(value: Any, where: np.ndarray, shape: tuple[int, ...], called: str) -> np.ndarray:
    refuse_unit_or_mask(called, value)
    try:
        value = np.asarray(value, float)
    except (TypeError, ValueError):
        raise TypeError(f"{called} must be a number or an array, got {value!r}.") from None
    if value.ndim == 0:
        return np.full(len(where), float(value))
    if value.shape != shape:
        raise ValueError(f"{called} has shape {value.shape}, the parameter has {shape}.")
    return value.ravel()


def _is_under(name: str, path: str) -> bool:
    return name == path or name.startswith((path + "[", path + "."))


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
