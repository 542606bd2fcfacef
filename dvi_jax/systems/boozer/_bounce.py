r"""Second adiabatic invariant J∥ of guiding centres, and the points where they bounce.

A field line is θ = α + ιζ on a surface s, with the element of length dl = (G + ιI)/B dζ. A guiding
centre of energy E and moment μ moves on it where μB < E, between two bounce points with μB = E:

    J∥(s, α, μ, E) = ∮ v∥ dl = 2 ∫ √(2(E − μB)) (G + ιI)/B dζ

in units of m, v0 and 1 m, so that J∥ is a length.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import in_range, instance, positive
from ...base.printing import printable
from ...engine.bracket import bracketed_root
from ._field import Field, polynomial
from ._motion import Angles, Regular, flux, speed_along

_PER_WAVE = 16
"""Steps per wavelength of |B| along the line in the search for a bounce point."""
_NODES = 96
"""Points of quadrature between the bounce points; the estimate of the error uses every third."""
_BLOCKS = 27
"""So many times more points in a well with many minima."""
_RESOLVED = 1e-7
"""Largest relative difference between the sums over all points and over every third."""


@printable
class Well(NamedTuple):
    """The ζ of both bounce points of a well of |B| on a field line; NaN if there is no such well"""

    low: Array
    high: Array


class _Line(eqx.Module):
    """A field line, and the kinetic energy of the motion along it."""

    field: Field
    s: Array
    alpha: Array
    mu: Array
    energy: Array

    @property
    def iota(self) -> Array:
        return polynomial(self.field.iota, self.s)

    def strength(self, zeta: Any) -> Array:
        """|B| at ζ, of any shape."""
        return self.field.strength(self.s, self.alpha + self.iota * zeta, zeta)

    def parallel(self, zeta: Any) -> Array:
        """v∥²/2 = E − μB."""
        return self.energy - self.mu * self.strength(zeta)

    def length(self, B: Any) -> Array:
        """dl/dζ = |G + ιI|/B."""
        current = polynomial(self.field.G, self.s)
        if self.field.I is not None:
            current = current + self.iota * polynomial(self.field.I, self.s)
        return jnp.abs(current) / B

    def step(self) -> Array:
        """A step in ζ that resolves |B|: a part of the shortest wavelength of its modes, each
        weighted by (amplitude/largest)^{1/5}, here or at the edge."""
        m, n = np.array(self.field.modes).T
        powers = self.s ** np.arange(self.field.coefficients.shape[3])
        here, at_edge = (
            jnp.abs(self.field.coefficients @ x).sum(0).ravel() for x in (powers, powers**0)
        )
        size = jnp.maximum(here * self.s ** (m / 2), at_edge)
        size = jnp.where((m != 0) | (n != 0), size, 0.0)
        weight = (size / jnp.maximum(jnp.max(size), 1e-300)) ** 0.2
        wave = jnp.max(jnp.abs(m * self.iota - n) * weight)
        return lax.stop_gradient(2 * np.pi / (_PER_WAVE * jnp.maximum(wave, 0.1)))


def _end(line: _Line, zeta: Array, direction: float, turns: float) -> tuple[Array, Array]:
    """The bounce point next to ζ in a direction, and whether there is one."""
    step = direction * line.step()
    limit = 2 * np.pi * turns / jnp.abs(step)
    fixed = lax.stop_gradient(line)

    def advance(state):
        k, _, ahead = state
        return k + 1, ahead, fixed.parallel(zeta + (k + 1) * step)

    # A point where the guiding centre bounces is inside of its well, up to rounding.
    begin = jnp.maximum(fixed.parallel(zeta), 0.0)
    state = 0.0 * step, begin, 0.0 * step + 1.0
    k, previous, ahead = lax.while_loop(lambda x: (x[2] > 0) & (x[0] < limit), advance, state)
    exists = ahead <= 0
    a, b = zeta + (k - 1) * step, zeta + k * step
    return bracketed_root(line.parallel, a, previous, b, ahead, exists), exists


def _parameters(field: Field, *point: Any, turns: float) -> tuple[Any, ...]:
    """The arguments of `well`, checked and of one type."""
    instance("field", field, Field, "a Field, such as boozer.precise_qa()")
    positive("turns", turns)
    if not is_traced(point[0]):
        in_range("s", point[0], 0.0, 1.0)
    return field, *(jnp.asarray(x, float) for x in (*point, turns))


def _well(field, s, theta, zeta, mu, energy, turns) -> tuple[Any, ...]:
    """The field line through a point (s, θ, ζ), the ends of the well, and whether it has both."""
    line = _Line(field, s, theta - polynomial(field.iota, s) * zeta, mu, energy)
    low, has_low = _end(line, zeta, -1.0, turns)
    high, has_high = _end(line, zeta, 1.0, turns)
    return line, low, high, has_low & has_high


def well(
    field: Field, s: Any, theta: Any, zeta: Any, mu: Any, energy: Any = 0.5, *, turns: float = 10.0
) -> Well:
    r"""Bounce points μB = E on the field line through a point, on both sides of it.

    The search goes along the line in steps of 1/16 of the shortest wavelength of |B|, weighted by
    amplitude; then by false position to the last digit. **Arguments and errors**: as for
    `second_invariant`. **Returns** a `Well`, in scalars.
    """
    return Well(*_ends(*_parameters(field, s, theta, zeta, mu, energy, turns=turns)))


# One program, and the next one: as many small ones they would take seconds in every call.
@eqx.filter_jit
def _ends(*parameters: Any) -> list[Array]:
    _, low, high, exists = _well(*parameters)
    return [jnp.where(exists, end, jnp.nan) for end in (low, high)]


def second_invariant(
    field: Field, s: Any, theta: Any, zeta: Any, mu: Any, energy: Any = 0.5, *, turns: float = 10.0
) -> Array:
    r"""Second adiabatic invariant J∥ = 2 ∫ √(2(E − μB)) (G + ιI)/B dζ between bounce points [m].

    The integral is over the well of |B| that contains the point (s, θ, ζ), on the field line
    θ − ιζ = const. J∥ times m v0 is the action ∮ m v∥ dl in SI units.

    **Arguments** scalars; use `jax.vmap` for many.

    - `s`, `theta`, `zeta`: a point with μB ≤ E.
    - `mu`: the moment [1/T] in units of m v0². `energy`: E in units of m v0².
    - `turns`: distance of the search for bounce points, in toroidal turns on each side.

    **Returns** J∥; NaN for a passing particle (without bounce points within `turns`, `well` is NaN
    too), and for a well of which the quadrature does not resolve |B|, or that has a barrier inside.

    **Raises** `TypeError` for another field, `ValueError` for turns that are not positive.

    **Accuracy** about 1e-12 (the square roots at the ends are removed by ζ = ζ_m + r sin φ, and the
    midpoint rule in φ converges exponentially). The sum over 96 points is compared with that over
    every third; if they differ by more than 1e-7, there are 2592 points: for a well with many
    minima, or near the top of a barrier, where E − μB has almost a double root. If these differ by
    as much, the result is NaN. Differentiable to any order in
    s, θ, ζ, μ, E and the arrays of the field; the motion of the bounce points does not contribute
    to the first derivative.

    **Source** Northrop 1963, *The Adiabatic Motion of Charged Particles*, 3; in Boozer coordinates
    Helander 2014, *Rep. Prog. Phys.* 77, 087001, 4.3.
    """
    return _invariant(*_parameters(field, s, theta, zeta, mu, energy, turns=turns))


@eqx.filter_jit
def _invariant(*parameters: Any) -> Array:
    line, low, high, exists = _well(*parameters)
    coarse, is_resolved = _integral(line, low, high, 1)
    J, is_resolved = lax.cond(
        exists & ~is_resolved,
        lambda: _integral(line, low, high, _BLOCKS),
        lambda: (coarse, is_resolved),
    )
    return jnp.where(exists & is_resolved, J, jnp.nan)


def _integral(line: _Line, low: Array, high: Array, blocks: int) -> tuple[Array, Array]:
    """J∥ from `blocks` · `_NODES` points, and whether every third gives the same."""
    middle, half, count = (low + high) / 2, (high - low) / 2, blocks * _NODES
    # Midpoints in φ, of an integrand that is even about −π/2 and π/2. Numbers 1, 4, 7 … of them
    # are again the midpoints of a division.
    phi = np.pi * ((np.arange(count) + 0.5) / count - 0.5).reshape(blocks, _NODES)

    def add(state, sine_cosine):
        sine, cosine = sine_cosine
        B = line.strength(middle + half * sine)
        kinetic = line.energy - line.mu * B
        # Two selections: the derivative of √ at 0 is infinite, and infinity times zero NaN.
        speed = jnp.where(kinetic > 0, jnp.sqrt(2 * jnp.where(kinetic > 0, kinetic, 1.0)), 0.0)
        terms = speed * line.length(B) * cosine
        total, third, least, largest = state
        fixed = lax.stop_gradient(kinetic)
        least, largest = jnp.minimum(least, jnp.min(fixed)), jnp.maximum(largest, jnp.max(fixed))
        return (total + jnp.sum(terms), third + jnp.sum(terms[1::3]), least, largest), None

    sines = jnp.asarray(np.sin(phi)), jnp.asarray(np.cos(phi))
    (total, third, least, largest), _ = lax.scan(add, (0.0 * half,) * 4, sines)
    # Both sums have the rounding of E − μB.
    rounding = 100 * jnp.finfo(total.dtype).eps * line.energy
    is_equal = jnp.abs(3 * third - total) * largest <= (_RESOLVED * largest + rounding) * total
    # E < μB inside: the search for the ends passed over a narrow barrier.
    return 2 * np.pi / count * half * total, lax.stop_gradient(is_equal) & (least >= -rounding)


def complete(args: Any, epsilon: Any) -> Field:
    """The field of a run: that in args, with the modes ``args["breaking"]`` times ε."""
    field = args["field"]
    if epsilon is None or "breaking" not in args:
        return field
    total = field.coefficients + epsilon * args["breaking"]
    return eqx.tree_at(lambda f: f.coefficients, field, total)


class GuidingCentre(NamedTuple):
    """A guiding centre: s, θ, ζ, u = v∥/v0, |B|, and E = u²/2 + μB."""

    s: Array
    theta: Array
    zeta: Array
    u: Array
    B: Array
    energy: Array


def centre_of(chart: Regular | Angles, q: Any, p: Any, args: Any, epsilon: Any) -> GuidingCentre:
    """Of one state, in the field with ε."""
    field, rho = complete(args, epsilon), args["rho"]
    s = flux(chart, q, p, args)
    B = field.at(*chart.point(field, rho, q, p, s), q[1])
    u = speed_along(field, rho, s, p[1], B)
    return GuidingCentre(s, chart.angle(q, p), q[1], u, B, u**2 / 2 + args["mu"] * B)


class SecondInvariant(eqx.Module):
    """J∥ of a state, as an observable: at the end of a step, and with the ε of the run."""

    chart: Regular | Angles
    epsilon: Any = None

    def bind(self, system: Any, epsilon: Any) -> "SecondInvariant":
        """The same at this ε."""
        del system
        return replace(self, epsilon=epsilon)

    def value(self, q: Any, p: Any, args: Any) -> Array:
        """J∥ of one state [m]."""
        return _value(self, q, p, args)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        return self.value(q1, p1, args)


@eqx.filter_jit
def _value(observable: SecondInvariant, q: Array, p: Array, args: Any) -> Array:
    centre = centre_of(observable.chart, q, p, args, observable.epsilon)
    field, point = complete(args, observable.epsilon), (centre.s, centre.theta, centre.zeta)
    return second_invariant(field, *point, args["mu"], centre.energy)


class Pitch(eqx.Module):
    """v∥/v0 with B replaced by 1 T: zero where the guiding centre bounces, at every ε."""

    chart: Regular | Angles

    def __call__(self, t, q, p, args):
        return speed_along(args["field"], args["rho"], flux(self.chart, q, p, args), p[1], 1.0)


def at_crossings(observable: SecondInvariant, crossings: Any, args: Any) -> Array:
    """J∥ of recorded crossings of one orbit; NaN after the last one."""
    return jax.vmap(partial(_value, observable), (0, 0, None))(crossings.qs, crossings.ps, args)
