"""Infinitesimal generators at a grid point, and their prolongation."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from ...base.printing import printable
from ...base.signature import with_time
from ...base.types import Args, Scalar, State

T = TypeVar("T")


@printable
class LatticePoint(NamedTuple):
    """One point (t, q, p) of the lattice."""

    t: Scalar
    q: State
    p: State


class Generator(eqx.Module):
    r"""A generator X = ξ0 ∂/∂t + ξ·∂/∂q + η·∂/∂p at a grid point.

    - `xi0`: ξ0, function ``(q, p)`` or ``(t, q, p, args)`` → scalar [time].
    - `xi`: ξ, function of the same → array like q. `eta`: η → array like p.

    None means zero. A series in ε, (18)–(20) of the paper, is a list of generators, order 0 first.
    Generators add, subtract, and multiply with numbers.
    """

    __array_ufunc__: ClassVar[None] = None  # NumPy numbers leave the product to __rmul__

    xi0: Callable[..., Any] | None = None
    xi: Callable[..., Any] | None = None
    eta: Callable[..., Any] | None = None

    def __post_init__(self):
        for name in _COMPONENTS:
            if getattr(self, name) is not None:
                setattr(self, name, with_time(name, getattr(self, name)))

    def __call__(self, point: LatticePoint, args: Args = None) -> LatticePoint:
        """(ξ0, ξ, η) at the point, shaped like (t, q, p)."""
        t, q, p = (jnp.asarray(x) for x in point)
        values = []
        for name, like in zip(_COMPONENTS, (t, q, p), strict=True):
            component = getattr(self, name)
            value = jnp.zeros_like(like)
            if component is not None:
                value = jnp.asarray(component(t, q, p, args), like.dtype)
                if value.shape != like.shape:
                    raise ValueError(
                        f"{name} of the Generator must return an array of shape {like.shape} for q "
                        f"of shape {q.shape}, but it returned shape {value.shape}."
                    )
            values.append(value)
        return LatticePoint(*values)

    def __add__(self, other: "Generator") -> "Generator":
        if not isinstance(other, Generator):
            return NotImplemented
        pairs = ((getattr(self, name), getattr(other, name)) for name in _COMPONENTS)
        sums = (b if a is None else a if b is None else eqx.Partial(_sum, a, b) for a, b in pairs)
        return Generator(*sums)

    def __mul__(self, number: Any) -> "Generator":
        if callable(number) or jnp.shape(number) != ():
            return NotImplemented
        parts = (getattr(self, name) for name in _COMPONENTS)
        return Generator(*(None if x is None else eqx.Partial(_multiple, x, number) for x in parts))

    def __rmul__(self, number: Any) -> "Generator":
        return self * number

    def __neg__(self) -> "Generator":
        return self * -1.0

    def __sub__(self, other: "Generator") -> "Generator":
        return self + -other if isinstance(other, Generator) else NotImplemented


_COMPONENTS = ("xi0", "xi", "eta")


def require_bound(observable: Any, name: str, value: T | None) -> T:
    """The value that `bind` sets, or an error if an observable is called before."""
    if value is None:
        raise ValueError(
            f"this {type(observable).__name__} has no {name} yet: give it to "
            "dvi.integrate(observe=...), or call .bind(system, epsilon) first."
        )
    return value


def _sum(first, second, *point):
    return first(*point) + second(*point)


def _multiple(component, number, *point):
    return number * component(*point)


def symplectic_gradient(function: Callable[..., Any]) -> Generator:
    """ξ = ∂K/∂p, η = −∂K/∂q of a function K(t, q, p, args)."""
    xi, eta = (eqx.Partial(_slope, function, *place) for place in ((2, 1.0), (1, -1.0)))
    return Generator(xi=xi, eta=eta)


def _slope(function, argnum, sign, t, q, p, args):
    return sign * jax.grad(function, argnums=argnum)(t, q, p, args)


def prolong(
    generators: Generator | Sequence[Generator],
    function: Callable[..., Any],
    points: Sequence[LatticePoint],
    epsilon: Any = 0.0,
    args: Args = None,
) -> Any:
    r"""The prolonged generator applied to a function of several lattice points.

        pr X̃ (f) = Σ_m ε^m Σ_j (ξ0_m ∂/∂t_j + ξ_m·∂/∂q_j + η_m·∂/∂p_j) f

    with the generator taken at each point j: a Jacobian–vector product, no prolongation
    formula needed.

    **Arguments** `generators`: one, or a series in ε (order 0 first); `function(*points)` → any
    pytree; `points`: (t, q, p) each. **Returns** like ``function(*points)``.

    **Source** the paper, (15) and (21)–(22).
    """
    if isinstance(generators, Generator):
        generators = [generators]
    points = tuple(LatticePoint(*(jnp.asarray(x) for x in point)) for point in points)
    direction = jax.tree.map(jnp.zeros_like, points)
    for m, generator in enumerate(generators):
        at_points = tuple(generator(point, args) for point in points)
        direction = jax.tree.map(lambda d, x, m=m: d + epsilon**m * x, direction, at_points)
    return jax.jvp(function, points, direction)[1]
