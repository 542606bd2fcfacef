"""Parameters as one vector: their names, bounds and priors."""

import functools
import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import all_finite, known
from ..base.inputs import refuse_unit_or_mask
from .checks import require_shape


@dataclass(frozen=True)
class Bounds:
    """Limits of parameters: a value stays strictly between them.

    - `lower`, `upper`: numbers, or arrays that broadcast to the parameter; None or infinite for
      no limit.

    **Raises** `ValueError` if lower is not less than upper.

    Inside the fit a parameter between both is lower + (upper − lower) / (1 + exp(−u)), above
    one limit lower + exp(u), with u free.
    """

    lower: Any = None
    upper: Any = None

    def __post_init__(self):
        # Arrays are compared later, when the shape of the parameter is known.
        numbers = all(isinstance(x, int | float) for x in (self.lower, self.upper))
        if numbers and not self.lower < self.upper:
            raise ValueError(
                f"lower must be less than upper, got dvi.Bounds({self.lower!r}, {self.upper!r})."
            )


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a parameter: a normal distribution, independent in components.

    - `mean`, `sigma`: numbers, or arrays that broadcast to the parameter.

    **Raises** `ValueError` unless mean is finite, and sigma positive and finite.
    """

    mean: Any
    sigma: Any

    def __post_init__(self):
        # Here and not in a fit, so that the traceback shows where it was made.
        all_finite("mean of dvi.Prior", self.mean)
        hint = "Leave the prior out where nothing is known, and fix a parameter that is known."
        all_finite("sigma of dvi.Prior", self.sigma, positive=True, hint=hint)


_UNDERFLOW = 1e-150  # Distance from a bound at which the square of dx/du is zero: no error there


class Space(eqx.Module):
    """The parameters of a fit as a vector x of all their numbers, and as a free vector u.

    x obeys the bounds, u has none.

    - `names`: one for each number, such as ``q0[1]``. `lower`, `upper`: bounds of x, infinite
      for no bound; `has_lower`, `has_upper`: whether there is a bound.
    - `prior_mean`, `prior_weight`: of x; the weight is 1/sigma, 0 without a prior.
    - `constants`: the leaves that are not fitted.
    """

    lower: Array
    upper: Array
    prior_mean: Array
    prior_weight: Array
    constants: PyTree
    names: tuple[str, ...] = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    tree: Any = eqx.field(static=True)
    has_lower: tuple[bool, ...] = eqx.field(static=True)
    has_upper: tuple[bool, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of numbers."""
        return len(self.names)

    @property
    def count_of_priors(self) -> int:
        """Number of numbers with a prior."""
        return int((np.asarray(self.prior_weight) > 0).sum())

    def to_params(self, x: Array) -> PyTree:
        """The pytree that holds the numbers x."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])[:-1]
        # Numbers that are known are split without a program to compile.
        split = jnp.split if is_traced(x) else np.split
        parts = zip(split(x if is_traced(x) else np.asarray(x), ends), self.shapes, strict=True)
        leaves = [jnp.asarray(part.reshape(shape)) for part, shape in parts]
        return eqx.combine(jax.tree.unflatten(self.tree, leaves), self.constants)

    def to_x(self, u: Array) -> Array:
        """x within its bounds from the free vector u."""
        return _to_x(u, self.lower, self.upper, self.has_lower, self.has_upper)

    def to_u(self, x: Any) -> np.ndarray:
        """The free vector of x."""
        x, lower, upper = np.asarray(x, float), np.asarray(self.lower), np.asarray(self.upper)
        with np.errstate(divide="ignore", invalid="ignore"):  # in branches that are not taken
            part = (x - lower) / (upper - lower)
            ways = [np.log(part) - np.log1p(-part), np.log(x - lower), np.log(upper - x)]
        return np.select(_sides(self.has_lower, self.has_upper), ways, x)

    def in_words(self, x: np.ndarray, count: int = 8) -> str:
        """``args.k = 1.2, epsilon = 0``, the first few numbers."""
        pairs = [f"{n} = {v:.6g}" for n, v in zip(self.names[:count], x, strict=False)]
        return ", ".join(pairs) + (", …" if self.size > count else "")

    def slope(self, u: Any) -> np.ndarray:
        """dx/du, component by component."""
        u = jnp.asarray(u)
        return np.asarray(jax.jvp(self.to_x, (u,), (jnp.ones_like(u),))[1])

    def at_bounds(self, x: np.ndarray, sigma: np.ndarray) -> list[str]:
        """Names of the numbers within a tenth of their standard error from a bound; without a
        finite error, on it up to rounding."""
        distance = np.minimum(x - np.asarray(self.lower), np.asarray(self.upper) - x)
        reach = np.where(np.isfinite(sigma), 0.1 * sigma, 1e-12 * np.abs(x) + _UNDERFLOW)
        mask = np.isfinite(distance) & (distance <= reach)
        return [name for name, is_near in zip(self.names, mask, strict=True) if is_near]


def _sides(has_lower: Any, has_upper: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which numbers have both bounds, a lower one only, and an upper one only."""
    has_lower, has_upper = np.array(has_lower), np.array(has_upper)
    return has_lower & has_upper, has_lower & ~has_upper, has_upper & ~has_lower


# One program in place of one for each operation where a fit calls it outside of its own.
@functools.partial(jax.jit, static_argnames=("has_lower", "has_upper"))
def _to_x(u: Array, lower: Array, upper: Array, has_lower: Any, has_upper: Any) -> Array:
    two_sided, low, high = _sides(has_lower, has_upper)
    # Infinite limits and large u must not reach a branch that is not taken: 0·inf is NaN.
    lower = jnp.where(two_sided | low, lower, 0.0)
    upper = jnp.where(two_sided | high, upper, 0.0)
    exponential = jnp.exp(jnp.where(low | high, u, 0.0))
    x = jnp.where(two_sided, lower + (upper - lower) * jax.nn.sigmoid(u), u)
    x = jnp.where(low, lower + exponential, x)
    x = jnp.where(high, upper - exponential, x)
    # Rounding must not put x on a bound: there u is infinite. Derivatives stay those of exp.
    smallest = jnp.where(two_sided | low, lower + _gap(lower), -jnp.inf)
    largest = jnp.where(two_sided | high, upper - _gap(upper), jnp.inf)
    return x + jax.lax.stop_gradient(jnp.clip(x, smallest, largest) - x)


def _gap(bound: Array) -> Array:
    """Distance of a number next to a bound from it, at least one unit of its round-off."""
    precision = np.finfo(float)
    return jnp.maximum(precision.eps * jnp.abs(bound), precision.tiny)


def make_space(
    params: PyTree, bounds: PyTree = None, priors: PyTree = None
) -> tuple[Space, np.ndarray]:
    """The space of a pytree, and where it starts.

    **Raises** `TypeError` or `ValueError` for a pytree without numbers, values that are not finite,
    starts outside of bounds, and bounds or priors that do not fit the pytree.
    """
    numbers, constants = eqx.partition(params, jax.tree_util.tree_map_with_path(_is_number, params))
    paths, tree = jax.tree_util.tree_flatten_with_path(numbers)
    if not paths:
        rule = "a number or an array that can be fitted"
        raise ValueError(f"params must have {rule}, got {params!r:.200}.")
    names, places = [], {}
    for path, leaf in paths:
        name, shape = _name(path), np.shape(leaf)
        refuse_unit_or_mask(f"the parameter {name}", leaf)
        if np.iscomplexobj(leaf):
            raise TypeError(
                f"the parameter {name} must be real, got {leaf!r:.200}: give its two parts."
            )
        places[name] = len(names) + np.arange(math.prod(shape)).reshape(shape)
        indices = np.ndindex(shape)
        names += [f"{name}[{', '.join(map(str, i))}]" for i in indices] if shape else [name]
    if len(set(names)) < len(names):
        duplicate = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the names of params must differ, got {duplicate} twice: rename a key.")
    x = np.concatenate([np.ravel(np.asarray(leaf, float)) for _, leaf in paths])
    no_bounds, no_prior = {"lower": -np.inf, "upper": np.inf}, {"mean": np.nan, "sigma": np.nan}
    (lower, upper), _ = _entries(bounds, Bounds, no_bounds, places, len(x))
    (mean, sigma), has_prior = _entries(priors, Prior, no_prior, places, len(x))
    for bad, text in (
        (~np.isfinite(x), "the parameter {0} starts at {1}: every start must be a finite number."),
        (~(lower < upper), "the bounds of {0} are {2} and {3}: the lower one must be less."),
        (
            ~((x > lower) & (x < upper)),
            "the parameter {0} starts at {1}, which is not between its bounds {2} and {3}.",
        ),
    ):
        if bad.any():
            i = int(np.argmax(bad))
            raise ValueError(text.format(names[i], x[i], lower[i], upper[i]))
    space = Space(
        lower=jnp.asarray(lower),
        upper=jnp.asarray(upper),
        prior_mean=jnp.asarray(np.where(has_prior, mean, 0.0)),
        prior_weight=jnp.asarray(np.where(has_prior, 1 / np.where(has_prior, sigma, 1.0), 0.0)),
        constants=constants,
        names=tuple(names),
        shapes=tuple(place.shape for place in places.values()),
        tree=tree,
        has_lower=tuple(np.isfinite(lower).tolist()),
        has_upper=tuple(np.isfinite(upper).tolist()),
    )
    return space, x


def _is_number(path: Any, x: Any) -> bool:
    """Whether a leaf is fitted. Whole numbers are, except fields of an object, which are sizes."""
    if isinstance(x, int) and not isinstance(x, bool):
        return not any(isinstance(key, jax.tree_util.GetAttrKey) for key in path)
    return bool(eqx.is_inexact_array_like(x))


def _entries(
    tree: PyTree, kind: type, fields: dict[str, float], places: dict[str, np.ndarray], size: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """The fields of the bounds or priors of all numbers, and which numbers have some; `fields`:
    names with defaults; `places`: where the numbers of each leaf are in x."""
    columns = {name: np.full(size, default) for name, default in fields.items()}
    mask, noun = np.zeros(size, bool), {Bounds: "bounds", Prior: "priors"}[kind]
    for path, entry in jax.tree_util.tree_leaves_with_path(tree):
        name = _name(path)
        if not isinstance(entry, kind):
            label = f"dvi.{kind.__name__}"
            raise TypeError(
                f"{noun} must be like params, with {label}(...) or None in place of numbers, got "
                f"{entry!r:.200} at {name}."
            )
        prefixes = tuple(name + end for end in ("[", "."))
        leaves = [k for k in places if not path or k == name or k.startswith(prefixes)]
        if not leaves:
            names = ", ".join(map(repr, places))
            raise ValueError(f"{noun} must be for fitted parameters, {names}, got {name!r}.")
        where = np.concatenate([places[k].ravel() for k in leaves])
        mask[where] = True
        for label, numbers in columns.items():
            if (value := getattr(entry, label)) is not None:
                shape = places[name].shape if name in places else ()
                numbers[where] = _spread(value, len(where), shape, f"{label} of {name}")
    return list(columns.values()), mask


def _spread(value: Any, size: int, shape: tuple[int, ...], label: str) -> np.ndarray:
    refuse_unit_or_mask(label, value)
    value = known(label, value, float)
    require_shape(label, value, *dict.fromkeys([(), shape]))
    return value.ravel() if value.ndim else np.full(size, float(value))


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
