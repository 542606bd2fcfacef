"""Common generators: shifts, rotations, scalings, boosts, Hamiltonian flows.

They add, subtract, and multiply with numbers: ``rotation(0, 1) + 2 * time_translation()``.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base import checks as _checks
from ...base.signature import with_time
from ...base.types import State
from ..functions.generators import Generator, LatticePoint, symplectic_gradient


def time_translation() -> Generator:
    """X = ∂/∂t: ξ0 = 1. Conserves the energy on the time grid `Variational`."""
    return Generator(xi0=_unit)


def space_translation(direction: Any) -> Generator:
    """X = a·∂/∂q: ξ = a, the same for all bodies. Conserves a·Σp.

    - `direction`: a [unit of q], of the shape of q or of its last axes: (dim,) for states of
      shape (bodies, dim).

    **Raises** `ValueError` for a direction that is zero or not finite, and at the point for one
    that does not fit q. **Source** Hydon 2014, *Difference Equations by Differential Equation
    Methods*.
    """
    return Generator(xi=eqx.Partial(_constant, _direction(direction)))


def rotation(i: int = 0, j: int = 1) -> Generator:
    """The rotation of axis i towards axis j: ξ = e_j q_i − e_i q_j, and η the same of p.

    Axes of the last axis of q: the components of a vector, or of every body's position for
    states of shape (bodies, dim). Conserves the angular momentum q_i p_j − q_j p_i, summed.

    **Raises** `ValueError` for axes that are equal or negative, and at the point for axes that q
    does not have. **Source** the paper, (40).
    """
    i, j = (_checks.whole(name, axis, low=0) for name, axis in (("i", i), ("j", j)))
    if i == j:
        raise ValueError(f"i and j must be two different axes of q, got i = j = {i}.")
    return Generator(xi=eqx.Partial(_turn, 1, i, j), eta=eqx.Partial(_turn, 2, i, j))


def scaling(q: Any = 1.0, p: Any = 1.0, t: float = 0.0) -> Generator:
    """X = a t ∂/∂t + b q·∂/∂q + c p·∂/∂p: powers of one factor for t, q and p.

    - `q`, `p`: weights b and c, numbers or arrays of the shape of q. `t`: weight a, a number.
      (Kepler's third law: q = 1, p = −1/2, t = 3/2.)

    **Raises** `ValueError` for weights that are not finite or all zero, or a `t` that is no
    number. **Source** Olver 1993, *Applications of Lie Groups to Differential Equations*.
    """
    weights = (
        _array("the weight t", t, "one finite number", lambda weight: weight.ndim == 0),
        *(_array(f"the weight {name}", weight) for name, weight in (("q", q), ("p", p))),
    )
    if not any(weight.any() for weight in weights):
        raise ValueError("one of the weights q, p, t must not be 0, but all are 0.")
    parts = (eqx.Partial(_scale, i, w) if w.any() else None for i, w in enumerate(weights))
    return Generator(*parts)


def boost(direction: Any, mass: Any = 1.0) -> Generator:
    """Galilei's boost: ξ = t v, η = m v. Conserves v·Σ(t p − m q), with the gauge −m v·q.

    - `direction`: v [unit of q / unit of t], of the shape of q or of its last axes.
    - `mass`: m [mass]: a number; one for each body, shape (bodies,), for states of shape
      (bodies, dim); or an array of the shape of q.

    **Raises** `ValueError` for a direction that is zero or not finite, masses that are not
    positive, and at the point for what does not fit q. **Source** Olver 1993, Chapter 4.
    """
    masses = _array("mass", mass, "positive for every body", lambda masses: (masses > 0).all())
    velocity = _direction(direction)
    xi, eta = (eqx.Partial(_boost, velocity, mass) for mass in (None, masses))
    return Generator(xi=xi, eta=eta)


def hamiltonian_flow(function: Callable[..., Any]) -> Generator:
    """The Hamiltonian vector field of a function K: ξ = ∂K/∂p, η = −∂K/∂q.

    - `function`: K, function ``(q, p)`` or ``(t, q, p, args)`` → scalar [action]. With an invariant
      of the map it is a symmetry of a symplectic map, and K what it conserves (gauge K − ξ·p).

    **Raises** `TypeError` for what is not callable. **Source** Olver 1993, Chapter 6.
    """
    return symplectic_gradient(with_time("the argument of hamiltonian_flow", function))


def bracket(first: Generator, second: Generator) -> Generator:
    """The Lie bracket [X, Y] = XY − YX, a symmetry when both are.

        [X, Y]^c = X(Y^c) − Y(X^c)    for each component c of (ξ0, ξ, η)

    **Raises** `TypeError` for anything but a `Generator`. **Source** Olver 1993, Section 1.3.
    """
    for name, generator in (("first", first), ("second", second)):
        _checks.instance(name, generator, Generator, "a Generator")
    return Generator(*(eqx.Partial(_bracket, first, second, place) for place in range(3)))


def _unit(t, q, p, args):
    return 1.0


def _constant(value, t, q, p, args):
    return _broadcast("direction", value, q)


def _turn(place, i, j, t, q, p, args):
    """The vector at `place` of (t, q, p), turned by a right angle in the plane of two axes."""
    v = (t, q, p)[place]
    if v.ndim == 0 or v.shape[-1] <= max(i, j):
        raise ValueError(
            f"rotation({i}, {j}) requires at least {max(i, j) + 1} components along the last axis "
            f"of q, got shape {q.shape}."
        )
    return jnp.zeros_like(v).at[..., i].set(-v[..., j]).at[..., j].set(v[..., i])


def _scale(place, weight, t, q, p, args):
    value = (t, q, p)[place]
    return value * _broadcast(f"the weight {'tqp'[place]}", weight, value)


def _boost(direction, mass, t, q, p, args):
    v = _broadcast("direction", direction, q)
    if mass is None:
        return t * v
    if mass.ndim == 1 and q.ndim == 2 and len(mass) == len(q):
        mass = mass[:, None]  # one for each body
    return _broadcast("mass", mass, q) * v


def _bracket(first, second, place, t, q, p, args):
    point = LatticePoint(t, q, p)

    def derivative(direction, generator):
        def component(point):
            return generator(point, args)[place]

        return jax.jvp(component, (point,), (direction(point, args),))[1]

    return derivative(first, second) - derivative(second, first)


def _array(name: str, value: Any, rule: str = "finite", fits: Any = np.isfinite) -> np.ndarray:
    """As an array of NumPy: a generator can be made before JAX has started its devices."""
    array = np.asarray(value, float)
    if not (np.isfinite(array).all() and np.all(fits(array))):
        raise ValueError(f"{name} must be {rule}, got {value!r:.200}.")
    return array


def _direction(value: Any) -> np.ndarray:
    return _array("direction", value, "finite, with a component that is not zero", np.any)


def _broadcast(name: str, value: np.ndarray, q: State) -> Array:
    """The value with the shape of q, if that can be."""
    try:
        return jnp.broadcast_to(value, q.shape).astype(q.dtype)
    except ValueError:
        shapes = [q.shape[i:] for i in range(q.ndim)] + [q.shape[:1]] * (name == "mass")
        choices = " or ".join(map(str, dict.fromkeys(shapes))) if q.ndim else "()"
        raise ValueError(
            f"{name} must be a number or an array of shape {choices}, for q of shape {q.shape}, "
            f"got shape {value.shape}."
        ) from None
