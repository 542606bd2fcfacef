"""The flow of the Kepler problem for all eccentricities, in universal variables."""

import math
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

import lanewise

from ..base.types import Scalar

_SERIES_UP_TO = 1.0
"""|β X²| up to which nine terms of the series are exact to round-off: 6 steps per revolution."""

_TERMS = 9
_C2, _C3, _C4, _C5 = ([1 / math.factorial(2 * k + n) for k in range(_TERMS)] for n in (2, 3, 4, 5))

# The rounding of 1/6, 1/24 and 1/120 is the same in each step, and a drift of the energy of 3e-19
# in each. It is added to the sums.
_LOW4, _LOW6, _LOW120 = (float(Fraction(1, n) - Fraction(1 / n)) for n in (24, 6, 120))
_ITERATIONS = 200
"""Maximum number of iterations; a bracket that is halved needs about 60."""

_SHORT = 1e-4
"""Squared change of the eccentric anomaly up to which a step of order four may be the last one."""


class _G(NamedTuple):
    """G_n = Xⁿ c_n(β X²) for n = 0, 1, 2, 3, with c_n the functions of Stumpff."""

    g0: Array
    g1: Array
    g2: Array
    g3: Array


class _Orbit(NamedTuple):
    """What Kepler's equation depends on: r₀, η = q·v, β = 2μ/r₀ − v² and ζ = μ − β r₀."""

    r0: Array
    eta: Array
    beta: Array
    zeta: Array

    def time(self, X: Array, g: _G) -> Array:
        """t(X) = r₀ X + η G₂ + ζ G₃, the time at which the universal variable is X."""
        return self.r0 * X + self.eta * g.g2 + self.zeta * g.g3

    def radius(self, g: _G) -> Array:
        """r(X) = dt/dX = r₀ + η G₁ + ζ G₂."""
        return self.r0 + self.eta * g.g1 + self.zeta * g.g2

    def on_time(self, h: Scalar, X: Array, g: _G) -> _G:
        """The functions at the X where t(X) = h in their own rounding, next to the root."""
        # Without it the energy drifts by 3e-19 in each step, since f and g are not of one orbit.
        d = (h - self.time(X, g)) / self.radius(g)
        return _G(g.g0, g.g1 + g.g0 * d, g.g2 + g.g1 * d, g.g3 + g.g2 * d)

    def correction(self, h: Scalar, X: Array) -> tuple[Array, Array, Array]:
        """The step of a method of order four, t(X) − h, and whether the next is below round-off."""
        g = _universal(X, self.beta)
        past, r = self.time(X, g) - h, self.radius(g)
        slope = self.eta * g.g0 + self.zeta * g.g1
        curve = self.zeta * g.g0 - self.beta * self.eta * g.g1
        newton = -past / r
        step = -past / (r + newton * slope / 2)
        step = -past / (r + step * (slope / 2 + step * curve / 6))
        # With ρ the part by which the higher orders change Newton's step, the error is about ρ³
        # times that step. Where the step is long ρ may be small by chance: the second condition.
        change = jnp.abs(step - newton)
        eps = float(jnp.finfo(X.dtype).eps)
        is_last = change * change * change <= eps / 4 * jnp.abs(X) * newton * newton
        return step, past, is_last & (jnp.abs(self.beta) * newton * newton <= _SHORT)


# All calls in a run share one trace and one trace of the derivative, and are written once.
@lanewise.once
def change(h: Scalar, q: Array, v: Array, mu: Array) -> tuple[Array, Array, Array]:
    r"""The changes of position and velocity on Kepler orbits over the time h.

        q(h) = q + (f − 1) q + g v,    v(h) = v + ḟ q + (ġ − 1) v

        f − 1 = −μ G₂/r₀,   g = h − μ G₃,   ḟ = −μ G₁/(r₀ r),   ġ − 1 = −μ G₂/r

    `q`, `v` of shape (…, dim) have one orbit a row, and `mu` one μ for each [length³/time²].

    **Returns** q(h) − q, v(h) − v, and whether Kepler's equation was solved for all rows. Orbits of
    any eccentricity, any h; derivatives to any order are those of the implicit function theorem. A
    body that starts at the centre gives NaN.

    **Source** Stumpff 1959, *Himmelsmechanik* I; Danby 1988, *Fundamentals of Celestial Mechanics*,
    6.9; Wisdom & Hernandez 2015, *MNRAS* 453, 3015; Rein & Tamayo 2015, *MNRAS* 452, 376.
    """
    r0 = jnp.sqrt(jnp.sum(q * q, -1))
    beta = 2 * mu / r0 - jnp.sum(v * v, -1)
    orbit = _Orbit(r0, jnp.sum(q * v, -1), beta, mu - beta * r0)
    g, is_root = _at(orbit, h)
    # Increments, not the new state: a small change keeps its digits next to a large coordinate.
    a = (mu * g.g2)[..., None]
    r, r0 = orbit.radius(g)[..., None], r0[..., None]
    dq = (h - mu * g.g3)[..., None] * v - a / r0 * q
    dv = -(mu * g.g1)[..., None] / (r0 * r) * q - a / r * v
    return dq, dv, is_root


@jax.jit
def from_pericentre(
    time: Array, distance: Array, alpha: Array, mu: Array
) -> tuple[Array, Array, Array]:
    r"""Position and velocity a `time` after the pericentre, in the plane of the orbit.

        x = d − μ G₂,   y = √(μ p) G₁,   ẋ = −μ G₁/r,   ẏ = √(μ p) G₀/r,   p = d (2 − α d)

    - `distance`: d of the pericentre [length]. `alpha`: α = 1/a [1/length], positive for ellipses,
      0 for a parabola, negative for hyperbolas. `mu`: μ [length³/time²]. All of one shape (…).

    **Returns** (x, y) and (ẋ, ẏ) of shape (…, 2), and whether Kepler's equation was solved.

    **Source** as `change`. Here e = 1 − α d and the energy are given, not computed from a state, so
    that they keep their digits at large eccentricities.
    """
    beta = mu * alpha
    orbit = _Orbit(distance, jnp.zeros_like(distance), beta, mu - beta * distance)
    g, is_root = _at(orbit, time)
    r, momentum = orbit.radius(g), jnp.sqrt(mu * distance * (2 - alpha * distance))
    position = jnp.stack([distance - mu * g.g2, momentum * g.g1], -1)
    return position, jnp.stack([-mu * g.g1 / r, momentum * g.g0 / r], -1), is_root


def _at(orbit: _Orbit, h: Scalar) -> tuple[_G, Array]:
    """The functions G_n at the X with t(X) = h, and whether all were found."""
    # The search, with its branches and sums, has no derivative: that of `_on_time` is written out.
    held, t = lax.stop_gradient((orbit, h))
    X, is_root = _solve(held, t)
    g = held.on_time(t, X, _universal(X, held.beta))
    _, *functions = _on_time(X, *g, *orbit, h)
    return _G(*functions), is_root


def _on_time(*operands: Array) -> list[Array]:
    """X and the G_n of a solution of t(X) = h, as functions of the orbit and of h, to any order.

    The operands are X, G₀ to G₃, r₀, η, β, ζ and h.
    """
    return lanewise.with_derivative(lambda *operands: list(operands[:5]), _slope, operands)


def _slope(operands: list[Array], changes: dict[int, Array]) -> list[Array | None]:
    """∂G_n/∂X = G_{n−1} with G₋₁ = −β G₁, ∂G_n/∂β = (n G_{n+2} − X G_{n+1})/2; dX by t(X) = h."""
    X, *functions = _on_time(*operands)
    g, orbit = _G(*functions), _Orbit(*operands[5:9])
    beta, square = orbit.beta, X * X
    z = beta * square
    # Next to a parabola the differences cancel: there the series.
    small = jnp.abs(z) <= _SERIES_UP_TO
    small_z, far_beta = jnp.where(small, z, 0.0), jnp.where(small, 1.0, beta)
    c4 = c5 = jnp.zeros_like(z)
    for a, b in zip(_C4[::-1], _C5[::-1], strict=True):
        c4, c5 = a - small_z * c4, b - small_z * c5
    g4 = jnp.where(small, square * square * c4, (square / 2 - g.g2) / far_beta)
    g5 = jnp.where(small, square * square * X * c5, (square * X / 6 - g.g3) / far_beta)
    doubled = -X * g.g1, g.g3 - X * g.g2, 2 * g4 - X * g.g3, 3 * g5 - X * g4
    by_beta = [x / 2 for x in doubled]
    of_time = X, g.g2, orbit.eta * by_beta[2] + orbit.zeta * by_beta[3], g.g3, -1.0
    defect = sum(x * changes[i] for i, x in enumerate(of_time, 5) if i in changes)
    dX = -defect / orbit.radius(g)
    dbeta = changes.get(7, 0.0)
    by_X = -beta * g.g1, g.g0, g.g1, g.g2
    return [dX, *(x * dX + y * dbeta for x, y in zip(by_X, by_beta, strict=True))]


def _solve(orbit: _Orbit, h: Scalar) -> tuple[Array, Array]:
    """The X of every orbit with t(X) = h, and whether all were found."""
    s = h / orbit.r0
    u, w = orbit.eta / orbit.r0 * s, orbit.zeta / orbit.r0 * s * s
    X = s * (1 - u / 2 + u * u / 2 - w / 6)  # three terms of the series of X in h
    # Two corrections suffice for the steps of an integration; the loop is for long steps.
    step, *_ = orbit.correction(h, X)
    X = X + step
    step, _, is_root_already = orbit.correction(h, X)
    X = X + step

    def search():
        # t(X) increases, because dt/dX = r > 0: its zero stays between the ends of a bracket. The
        # outer end is unknown at first.
        sign = jnp.where(h < 0, -1.0, 1.0).astype(s.dtype)
        inner = jnp.zeros_like(s)
        start = jnp.where(jnp.isfinite(X) & (sign * X > 0), X, s)

        def improve(state):
            x, inner, outer, is_root, n = state
            step, past, is_last = orbit.correction(h, x)
            # NaN is ∞ − ∞, far outside.
            late = ~(sign * past <= 0)
            inner, outer = jnp.where(late, inner, x), jnp.where(late, x, outer)
            new = x + step
            in_bracket = (sign * new > sign * inner) & (sign * new < sign * outer)
            middle = jnp.where(jnp.isinf(outer), 2 * inner, (inner + outer) / 2)
            # Far from the zero the steps may be short: every third one halves the bracket.
            accept = is_last | (in_bracket & (n % 3 != 2))
            x = jnp.where(is_root, x, jnp.where(accept, new, middle))
            return x, inner, outer, is_root | is_last, n + 1

        def proceed(state):
            return jnp.any(~state[3]) & (state[4] < _ITERATIONS)

        # An orbit without numbers is never found, and must not keep the others waiting.
        is_nan = ~jnp.isfinite(orbit.zeta + s)
        begin = (start, inner, sign * jnp.full_like(s, jnp.inf), is_nan, jnp.int32(0))
        x, _, _, is_root_at_end, _ = lax.while_loop(proceed, improve, begin)
        good = is_root_already | (is_root_at_end & ~is_nan)
        return jnp.where(is_root_already, X, x), jnp.all(good)

    good = jnp.all(is_root_already)
    return lax.cond(lanewise.on_any(~good), search, lambda: (X, good))


def _universal(X: Array, beta: Array) -> _G:
    """The functions G_n, also through β = 0."""
    z = beta * X * X
    small = jnp.abs(z) <= _SERIES_UP_TO
    c2 = c3 = jnp.zeros_like(z)
    small_z = jnp.where(small, z, 0.0)
    for a, b in zip(_C2[::-1], _C3[::-1], strict=True):
        c2, c3 = a - small_z * c2, b - small_z * c3

    def far():
        # Away from z = 0 no digits cancel here. Substitutes keep the values, and with them the
        # derivatives, finite in the branches that are not taken.
        bound, free = z > _SERIES_UP_TO, z < -_SERIES_UP_TO
        e, f = jnp.sqrt(jnp.where(bound, z, 1.0)), jnp.sqrt(jnp.where(free, -z, 1.0))
        sin, sinh = jnp.sin(e / 2) / e, jnp.sinh(f / 2) / f
        new2 = jnp.where(bound, 2 * sin * sin, jnp.where(free, 2 * sinh * sinh, c2))
        e3, f3 = (e - jnp.sin(e)) / (e * e * e), (jnp.sinh(f) - f) / (f * f * f)
        return new2, jnp.where(bound, e3, jnp.where(free, f3, c3))

    c2, c3 = lax.cond(lanewise.on_any(~jnp.all(small)), far, lambda: (c2, c3))
    square, low = X * X, jnp.where(small, _LOW6 - small_z * _LOW120, 0.0)
    two = square * c2 - square * (small_z * _LOW4)
    three = square * X * c3 + square * X * low
    return _G(1 - beta * two, X - beta * three, two, three)
