"""Elements of one orbit, of five kinds.

After the checks each conversion is one program: as many small ones, the first call would take
seconds.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import all_finite, array, in_range, one_of
from ...base.inputs import real_numbers
from ...engine.bracket import divide
from .. import kepler as _kepler

program = functools.partial(jax.jit, inline=True)


def _of_state(compute: Callable) -> Any:
    """The elements of a state. **Raises** `TypeError` for other than real numbers, `ValueError` for
    another shape, or a known μ that is not positive."""
    conversion: Any = program(compute, static_argnums=0)

    @functools.wraps(compute)
    def from_state(cls, q: Any, v: Any, mu: Any):
        q, v, mu = _of_one_type({"q": q, "v": v, "mu": mu})
        one_of("the last axis of q", q.shape[-1:], ((2,), (3,)))
        array("v", v, q.shape)
        _positive("mu", array("mu", mu, *{(), q.shape[:-1]}, empty=True))
        return conversion(cls, q, v, mu)

    return from_state


class Keplerian(NamedTuple):
    """a [length], e, inclination, node Ω, argument of the pericentre ω, mean anomaly M [rad].

    **Example**

    ```python
    q, v = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.1, 0.1])
    kepler = dvi.elements.Keplerian.from_state(q, v, mu=1.0)
    print(round(float(kepler.a), 4), round(float(kepler.e), 4), round(float(kepler.inc), 4))
    print(np.round(kepler._replace(M=1.0).state(mu=1.0)[0], 4))        # later on the orbit
    # 1.2821 0.22 0.0907
    # [0.176  1.1633 0.1058]
    ```
    """

    a: Array
    e: Array
    inc: Array
    Omega: Array
    omega: Array
    M: Array

    @classmethod
    @_of_state
    def from_state(cls, q: Any, v: Any, mu: Any) -> Self:
        """The elements of a state."""
        dim = q.shape[-1]
        q, v, momentum = _plane(q, v)
        # Near the inclination π the orbit is turned about the x axis by π, to the inclination 0.
        flips = momentum[..., 2] < 0
        sign = jnp.where(flips, -1.0, 1.0)[..., None]
        q, v = (jnp.concatenate([x[..., :1], sign * x[..., 1:]], -1) for x in (q, v))
        a, ex, ey, hx, hy, longitude = Equinoctial.from_state(q, v, mu)
        if dim == 2:
            inc = node = jnp.zeros_like(a)
        else:
            inc, node = 2 * jnp.arctan(_length(hx, hy)), _angle(hx, hy)
        pericentre, e = _angle(ex, ey), _length(ex, ey)
        # Near the circle M and ω have large errors of opposite sign. Far from it a (1 − e) and M
        # keep their digits near the pericentre if e and M belong to the energy.
        far = e > 0.1
        e_far = jnp.sqrt(jnp.where(far, 1 - jnp.sum(momentum**2, -1) / (mu * a), 1.0))
        M = jnp.where(far, _mean_anomaly(q, v, mu, e_far), _wrap(longitude - pericentre))
        e = jnp.where(far, e_far, e)
        return cls(
            a,
            e,
            jnp.where(flips, math.pi - inc, inc),
            jnp.where(flips, _wrap(math.pi - node), node),
            _wrap(pericentre - node + jnp.where(flips, math.pi, 0.0)),
            M,
        )

    def state(self, mu: Any, dim: int = 3) -> tuple[Array, Array]:
        """Position and velocity, of shape (…, dim)."""
        a, e, inc, node, pericentre, M, mu = _same_shape(self, mu)
        _in_range("e of elements.Keplerian", e, 0.0)
        _positive("a (1 − e) of elements.Keplerian", a * (1 - e), _AXIS)
        return _of_dim(dim, *self._in_space(a, e, inc, node, pericentre, M, mu))

    @staticmethod
    @program
    def _in_space(a, e, inc, node, pericentre, M, mu):
        time = jnp.where(a > 0, _wrap(M), M) * jnp.sqrt(jnp.abs(a) ** 3 / mu)
        # One orbit at a time: all together have one status, and one of them may be NaN.
        position = jnp.vectorize(_kepler.from_pericentre, signature="(),(),(),()->(d),(d),()")
        q, v, is_root = position(time, a * (1 - e), 1 / a, mu)
        good = is_root & (e >= 0)

        def in_space(x):
            x, y = _rotate(pericentre, x[..., 0], x[..., 1])
            y, z = jnp.cos(inc) * y, jnp.sin(inc) * y
            return jnp.where(good[..., None], jnp.stack([*_rotate(node, x, y), z], -1), jnp.nan)

        return in_space(q), in_space(v)


class ModifiedEquinoctial(NamedTuple):
    """p = a (1 − e²) [length], e cos ϖ, e sin ϖ, tan(i/2) cos Ω, tan(i/2) sin Ω, ϖ + true anomaly.

    ϖ = Ω + ω. Regular also at e = 1.
    """

    p: Array
    ex: Array
    ey: Array
    hx: Array
    hy: Array
    longitude: Array

    @classmethod
    @_of_state
    def from_state(cls, q: Any, v: Any, mu: Any) -> Self:
        """The elements of a state."""
        q, v, momentum = _plane(q, v)
        size = jnp.sqrt(jnp.sum(momentum**2, -1))
        w = momentum / size[..., None]
        hx, hy = (x / (1 + w[..., 2]) for x in (-w[..., 1], w[..., 0]))
        r = jnp.sqrt(jnp.sum(q * q, -1))
        p = size * size / mu
        cosine, sine = (jnp.sum(q * axis, -1) / r for axis in _axes(hx, hy))
        # e cos f and e sin f of the true anomaly f, turned from the radius to the first axis.
        radial, transverse = p / r - 1, size * jnp.sum(q * v, -1) / (mu * r)
        ex, ey = cosine * radial + sine * transverse, sine * radial - cosine * transverse
        return cls(p, ex, ey, hx, hy, jnp.arctan2(sine, cosine))

    def state(self, mu: Any, dim: int = 3) -> tuple[Array, Array]:
        """Position and velocity, of shape (…, dim)."""
        p, ex, ey, hx, hy, longitude, mu = _same_shape(self, mu)
        _positive("p of elements.ModifiedEquinoctial", p)
        r, q, v = self._in_space(p, ex, ey, hx, hy, longitude, mu)
        _positive("p/(1 + e cos f)", r, "The longitude is beyond the asymptotes of the hyperbola.")
        return _of_dim(dim, q, v)

    @staticmethod
    @program
    def _in_space(p, ex, ey, hx, hy, longitude, mu):
        cosine, sine = jnp.cos(longitude), jnp.sin(longitude)
        r = distance = p / (1 + ex * cosine + ey * sine)
        speed = jnp.sqrt(jnp.where(r > 0, mu / p, jnp.nan))
        r = jnp.where(r > 0, r, jnp.nan)
        velocity = -speed * (sine + ey), speed * (cosine + ex)
        return distance, *_in_space(hx, hy, (r * cosine, r * sine), velocity)


class Equinoctial(NamedTuple):
    """a [length], e cos ϖ, e sin ϖ, tan(i/2) cos Ω, tan(i/2) sin Ω, mean longitude λ = ϖ + M."""

    a: Array
    ex: Array
    ey: Array
    hx: Array
    hy: Array
    longitude: Array

    @classmethod
    @_of_state
    def from_state(cls, q: Any, v: Any, mu: Any) -> Self:
        """The elements of a state."""
        q, v, _ = _plane(q, v)
        p, ex, ey, hx, hy, true_longitude = ModifiedEquinoctial.from_state(q, v, mu)
        r, rv, alpha = _energy(q, v, mu)
        x, y = r * jnp.cos(true_longitude), r * jnp.sin(true_longitude)
        bound = alpha > 0
        # Substitutes keep the derivatives finite in the formula that is not taken.
        inverse = jnp.where(bound, alpha, 1.0)
        root = jnp.sqrt(jnp.where(bound, p * alpha, 1.0))
        beta = 1 / (1 + root)
        cosine = ex + ((1 - ex * ex * beta) * x - ex * ey * beta * y) * inverse / root
        sine = ey + ((1 - ey * ey * beta) * y - ex * ey * beta * x) * inverse / root
        elliptic = jnp.arctan2(sine, cosine) - rv * jnp.sqrt(inverse / mu)
        e = jnp.sqrt(jnp.where(bound, 1.0, 1 - p * alpha))
        hyperbolic = _mean_anomaly(q, v, mu, e) + _angle(
            jnp.where(bound, 1.0, ex), jnp.where(bound, 0.0, ey)
        )
        longitude = jnp.where(bound, _wrap(elliptic), hyperbolic)
        return cls(1 / alpha, ex, ey, hx, hy, longitude)

    def state(self, mu: Any, dim: int = 3) -> tuple[Array, Array]:
        """Position and velocity, of shape (…, dim)."""
        a, ex, ey, hx, hy, longitude, mu = _same_shape(self, mu)
        e2 = ex * ex + ey * ey
        _positive("a (1 − e²) of elements.Equinoctial", a * (1 - e2), _AXIS)
        return _of_dim(dim, *self._in_space(a, ex, ey, e2, hx, hy, longitude, mu))

    @staticmethod
    @program
    def _in_space(a, ex, ey, e2, hx, hy, longitude, mu):
        is_small = e2 < 0.25
        # Near the circle the pericentre is undefined; far from it the other iteration is slow.
        small = jnp.where(is_small, ex, 0.0), jnp.where(is_small, ey, 0.0)
        q_near, v_near = _near_circle(jnp.abs(a), *small, longitude, mu)
        large = jnp.where(is_small, 0.5, ex), jnp.where(is_small, 0.0, ey)
        e, pericentre, is_far = _length(*large), _angle(*large), jnp.where(is_small, 1.0, a)
        orbit = Keplerian(is_far, e, 0 * e, 0 * e, pericentre, longitude - pericentre)
        q_far, v_far = ((x[..., 0], x[..., 1]) for x in orbit.state(mu))
        good = ~is_small | (a > 0)

        def choose(x, y):
            return jnp.where(good, jnp.where(is_small, x, y), jnp.nan)

        q, v = (tuple(map(choose, *pair)) for pair in ((q_near, q_far), (v_near, v_far)))
        return _in_space(hx, hy, q, v)


class Delaunay(NamedTuple):
    """Canonical: M, ω, Ω [rad] and L = √(μa), G = L √(1 − e²), H = G cos i [length²/time].

    Coordinates (M, ω, Ω), momenta (L, G, H), for unit mass. In textbooks the coordinates are called
    l, g and h.
    """

    M: Array
    omega: Array
    Omega: Array
    L: Array
    G: Array
    H: Array

    @classmethod
    @_of_state
    def from_state(cls, q: Any, v: Any, mu: Any) -> Self:
        """The elements of a state."""
        q, v, momentum = _plane(q, v)
        kepler = Keplerian.from_state(q, v, mu)
        # On a circle rounding may make G larger than L, and e the root of a negative number.
        L = _action(kepler.a, mu)
        G = jnp.minimum(jnp.sqrt(jnp.sum(momentum**2, -1)), L)
        return cls(kepler.M, kepler.omega, kepler.Omega, L, G, G * jnp.cos(kepler.inc))

    def state(self, mu: Any, dim: int = 3) -> tuple[Array, Array]:
        """Position and velocity, of shape (…, dim)."""
        M, omega, node, L, G, H, mu = _same_shape(self, mu)
        _positive("G of elements.Delaunay", G)
        _in_range("G/L of elements.Delaunay", G / L, 0.0, 1.0)
        _in_range("H/G of elements.Delaunay", H / G, -1.0, 1.0)
        e = jnp.sqrt((L - G) * (L + G)) / L
        inc = 2 * jnp.arctan2(jnp.sqrt(G - H), jnp.sqrt(G + H))
        return Keplerian(L * L / mu, e, inc, node, omega, M).state(mu, dim)


class Poincare(NamedTuple):
    r"""Canonical and regular at e = 0 and i = 0: coordinates (λ, η, q), momenta (Λ, ξ, p).

        Λ = √(μa),  ξ + iη = √(2Λ(1 − √(1 − e²))) e^{−iϖ},
        p + iq = √(2Λ √(1 − e²) (1 − cos i)) e^{−iΩ}

    for unit mass: Λ [length²/time], the others but λ are roots of that.
    """

    longitude: Array
    eta: Array
    q: Array
    Lambda: Array
    xi: Array
    p: Array

    @classmethod
    @_of_state
    def from_state(cls, q: Any, v: Any, mu: Any) -> Self:
        """The elements of a state."""
        q, v, momentum = _plane(q, v)
        a, ex, ey, hx, hy, longitude = Equinoctial.from_state(q, v, mu)
        action = _action(a, mu)
        G = jnp.sqrt(jnp.sum(momentum**2, -1))
        scale = jnp.sqrt(2 * action / (1 + G / action))
        lift = jnp.sqrt(4 * G / (1 + hx * hx + hy * hy))
        return cls(longitude, -ey * scale, -hy * lift, action, ex * scale, hx * lift)

    def state(self, mu: Any, dim: int = 3) -> tuple[Array, Array]:
        """Position and velocity, of shape (…, dim)."""
        longitude, eta, q, action, xi, p, mu = _same_shape(self, mu)
        # Without the differences 1 − √(1 − e²) and 1 − cos i, which lose digits of small e and i.
        G = action - (xi * xi + eta * eta) / 2
        _positive("G = Λ − (ξ² + η²)/2 of elements.Poincare", G)
        _positive("4 G − p² − q² of elements.Poincare", 4 * G - (p * p + q * q))
        scale = jnp.sqrt((1 + G / action) / (2 * action))
        # tan²(i/2) = Z/(2G − Z) with Z = (p² + q²)/2
        lift = 1 / jnp.sqrt(4 * G - (p * p + q * q))
        elements = action**2 / mu, xi * scale, -eta * scale, p * lift, -q * lift, longitude
        return Equinoctial(*elements).state(mu, dim)


def _plane(q: Array, v: Array) -> tuple[Array, Array, Array]:
    """A state in space, and its angular momentum q × v for unit mass."""
    if q.shape[-1] == 2:
        q, v = (jnp.concatenate([x, jnp.zeros_like(x[..., :1])], -1) for x in (q, v))
    return q, v, jnp.cross(q, v)


_AXIS = "Ellipses have e < 1 and a > 0, hyperbolas e > 1 and a < 0; e = 1 is a ModifiedEquinoctial."


def _positive(name: str, values: Array, hint: str = "") -> None:
    """**Raises** `ValueError` for a known number that is not positive and finite. NaN, such as of a
    trajectory that failed, gives NaN."""
    if not is_traced(values):
        all_finite(name, np.where(np.isnan(values), 1.0, values), True, hint)


def _in_range(name: str, values: Array, low: float, high: float = math.inf, hint: str = "") -> None:
    if not is_traced(values):
        in_range(name, np.where(np.isnan(values), low, values), low, high, hint)


def _axes(hx: Array, hy: Array) -> tuple[Array, Array]:
    """The two unit vectors of the orbit's plane from which equinoctial longitudes are counted."""
    square = 1 + hx * hx + hy * hy  # 1/cos²(i/2)
    first = [1 + hx * hx - hy * hy, 2 * hx * hy, -2 * hy]
    second = [2 * hx * hy, 1 - hx * hx + hy * hy, 2 * hx]
    scale = 1 / square[..., None]
    return scale * jnp.stack(first, -1), scale * jnp.stack(second, -1)


def _in_space(hx: Array, hy: Array, *vectors: Any) -> tuple[Array, ...]:
    """Vectors (x, y) in the orbit's plane, as vectors in space."""
    first, second = _axes(hx, hy)
    return tuple(x[..., None] * first + y[..., None] * second for x, y in vectors)


def _of_dim(dim: int, q: Array, v: Array) -> tuple[Array, Array]:
    if one_of("dim", dim, (2, 3)) == 3:
        return q, v
    for x in (q, v):
        tilt = x[..., 2] / jnp.sqrt(jnp.sum(x * x, -1))
        _in_range("z/r with dim=2", tilt, -1e-9, 1e-9, "The inclination must be 0 or π.")
    return q[..., :2], v[..., :2]


def _near_circle(a: Array, ex: Array, ey: Array, longitude: Array, mu: Array) -> Any:
    """Position and velocity in the plane, for e < 1/2."""

    def equation(F):
        return F - ex * jnp.sin(F) + ey * jnp.cos(F) - longitude

    def solve(function, F):
        for _ in range(6):  # Newton's method: e = 1/2 needs five
            F = F - function(F) / (1 - ex * jnp.cos(F) - ey * jnp.sin(F))
        return F, ()

    F, _ = lanewise.implicit_root(equation, longitude, solve, divide)
    cosine, sine = jnp.cos(F), jnp.sin(F)
    # Written with ϖ removed, which has no value on a circle.
    beta = 1 / (1 + jnp.sqrt(1 - ex * ex - ey * ey))
    first, mixed, second = 1 - ey * ey * beta, ex * ey * beta, 1 - ex * ex * beta
    position = first * cosine + mixed * sine - ex, second * sine + mixed * cosine - ey
    rate = jnp.sqrt(mu / a) / (1 - ex * cosine - ey * sine)
    velocity = mixed * cosine - first * sine, second * cosine - mixed * sine
    return tuple(a * x for x in position), tuple(rate * x for x in velocity)


def _energy(q: Any, v: Any, mu: Any) -> tuple[Array, Array, Array]:
    """|q|, q·v and 1/a."""
    q, v = jnp.asarray(q), jnp.asarray(v)
    r = jnp.sqrt(jnp.sum(q * q, -1))
    return r, jnp.sum(q * v, -1), 2 / r - jnp.sum(v * v, -1) / mu


def _mean_anomaly(q: Any, v: Any, mu: Any, e: Array) -> Array:
    """M of a state that is not near the circle, E − e sin E or e sinh F − F."""
    r, rv, alpha = _energy(q, v, mu)
    bound = alpha > 0
    # On a parabola M does not exist.
    s = rv * jnp.sqrt(jnp.where(alpha == 0, jnp.nan, jnp.abs(alpha)) / mu)
    cosine = jnp.where(bound, 1 - r * alpha, 1.0)
    free, e = (jnp.where(bound, 0.0, s), jnp.where(bound, 1.0, e))
    return jnp.where(bound, jnp.arctan2(s, cosine) - s, free - jnp.arcsinh(free / e))


def _action(a: Array, mu: Any) -> Array:
    return jnp.sqrt(jnp.where(a > 0, mu * a, jnp.nan))


def _rotate(angle: Array, x: Array, y: Array) -> tuple[Array, Array]:
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y


def _angle(x: Array, y: Array) -> Array:
    """The angle of (x, y), 0 at the origin whatever the sign of its zeros."""
    return jnp.arctan2(y, jnp.where((x == 0) & (y == 0), 0.0, x))


def _length(x: Array, y: Array) -> Array:
    # Not hypot, whose derivative at the origin is 0 in JAX: it does not exist, and is NaN here.
    return jnp.sqrt(x * x + y * y)


def _wrap(angle: Array) -> Array:
    """The angle between −π and π."""
    return angle - 2 * math.pi * jnp.round(angle / (2 * math.pi))


def _same_shape(elements: Any, mu: Any) -> list[Array]:
    """The elements and μ as arrays of one shape. **Raises** errors as `_plane` does."""
    label = f"of elements.{type(elements).__name__}"
    names = [*(f"{name} {label}" for name in elements._fields), "mu"]
    arrays, shape = _of_one_type(dict(zip(names, (*elements, mu), strict=True))), ()
    _positive("mu", arrays[-1])
    for name, x in zip(names, arrays, strict=True):
        # Axes of length 1 are repeated, as in NumPy.
        pairs = zip(shape[::-1], x.shape[::-1], strict=False)
        array(name, x, x.shape if all(n == m or 1 in (n, m) for n, m in pairs) else shape)
        shape = np.broadcast_shapes(shape, x.shape)
    return [broadcast(x, shape) for x in arrays]


def broadcast(value: Any, shape: tuple[int, ...]) -> Any:
    return value if np.shape(value) == shape else _module(value).broadcast_to(value, shape)


def _of_one_type(values: dict[str, Any]) -> list[Array]:
    arrays = [x if isinstance(x, float) else real_array(name, x) for name, x in values.items()]
    dtype = jnp.result_type(*arrays, 0.0)
    return [_module(x).asarray(x, dtype) for x in arrays]


def real_array(name: str, value: Any) -> Array:
    """An array of a floating-point type. **Raises** `TypeError` for other than real numbers."""
    real_numbers(name, value)
    value = value if isinstance(value, np.ndarray) else jnp.asarray(value)
    return _module(value).asarray(value, jnp.result_type(value, 0.0))


def _module(value: Any) -> Any:
    """NumPy for its own arrays, which stay on the host; JAX for others."""
    return np if isinstance(value, float | np.ndarray) else jnp
