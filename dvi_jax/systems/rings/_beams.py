"""Forces of Gaussian beams: beam-beam kicks and frozen space charge."""

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import array, in_range, positive, whole
from ...base.inputs import real_numbers
from ._elements import Element, strength
from ._maps import Parameters, Particle, RingPart

_TERMS = 40
_SCALE = math.sqrt(_TERMS / math.sqrt(2))
_LEAST_FLAT = 0.3
"""(σ_x² − σ_y²)/(σ_x² + σ_y²), from which the difference of two Faddeeva functions is accurate."""
_LARGEST_EXPONENT = 40.0
"""Its negative exponential is round-off."""


def _weideman() -> np.ndarray:
    """The coefficients of Weideman's approximation, the highest power first."""
    angle = np.arange(1 - 2 * _TERMS, 2 * _TERMS) * np.pi / (2 * _TERMS)
    t2 = (_SCALE * np.tan(angle / 2)) ** 2
    values = np.append(0.0, np.exp(-t2) * (_SCALE**2 + t2))
    transform = np.real(np.fft.fft(np.fft.fftshift(values))) / (4 * _TERMS)
    return transform[_TERMS:0:-1]


_COEFFICIENTS = _weideman()


def faddeeva(x: Any, y: Any) -> tuple[Any, Any]:
    """Real and imaginary part of w(z) = e^{−z²} erfc(−iz), z = x + iy with y ≥ 0.

    In real numbers, which machine code has. Error and that of the derivative: below 2·10⁻¹⁴,
    relative to their moduli. **Source** Weideman 1994, SIAM J. Numer. Anal. 31, 1497, 40 terms.
    """
    size = (_SCALE + y) ** 2 + x * x
    inverse = (_SCALE + y) / size, x / size  # 1/(L − iz)

    def times(a, b):
        return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]

    power, zero = times((_SCALE - y, x), inverse), jnp.zeros_like(size)

    def horner(total, c):
        u, v = times(total, power)
        return (u + c, v), None

    (u, v), _ = lax.scan(horner, (zero, zero), jnp.asarray(_COEFFICIENTS))
    u, v = times((2 * u, 2 * v), inverse)
    return times((u + 1 / math.sqrt(math.pi), v), inverse)


def beam_field(x: Any, y: Any, sigma_x: Any, sigma_y: Any) -> tuple[Any, Any]:
    r"""The field of a Gaussian beam of infinite length, (x, y)/r² far from it.

    With κ = (σ_x² − σ_y²)/(σ_x² + σ_y²), A = σ_x² + σ_y²

        f_x = x/A ∫_0^1 exp(−(t/A)(x²/(1 + κt) + y²/(1 − κt))) (1 + κt)^{−3/2} (1 − κt)^{−1/2} dt

    by Gauss quadrature for \|κ\| < 0.3, smooth through round beams, and by the formula of
    Bassetti & Erskine 1980, CERN-ISR-TH/80-06, for others.
    """
    is_tall = sigma_y > sigma_x

    def swap(a, b):
        return jnp.where(is_tall, b, a), jnp.where(is_tall, a, b)

    (x, y), (wide, narrow) = swap(x, y), swap(sigma_x, sigma_y)
    total, excess = wide * wide + narrow * narrow, wide * wide - narrow * narrow
    kappa, r2 = excess / total, (x * x + y * y) / total
    points, weights = np.polynomial.legendre.leggauss(32)
    nodes = np.stack([(1 + points) / 2, weights / 2], 1)

    def by_quadrature(x, y):
        # Beyond the end the integrand is round-off, relative to the integral.
        end = lax.stop_gradient(jnp.minimum(1.0, _LARGEST_EXPONENT * 1.3 / jnp.maximum(r2, 1.0)))

        def add(sums, row):
            t = end * row[0]
            a, b = 1 + kappa * t, 1 - kappa * t
            value = row[1] * jnp.exp(-t / total * (x * x / a + y * y / b)) / jnp.sqrt(a * b)
            return (sums[0] + value / a, sums[1] + value / b), None

        zero = jnp.zeros_like(r2)
        (of_x, of_y), _ = lax.scan(add, (zero, zero), jnp.asarray(nodes))
        return end * of_x * x / total, end * of_y * y / total

    def by_faddeeva(x, y):
        # One quadrant; the derivative of |x| is not zero at x = 0.
        sign_x, sign_y = jnp.where(x < 0, -1.0, 1.0), jnp.where(y < 0, -1.0, 1.0)
        # Also where this branch is not used: 0 would be NaN in derivatives.
        scale = jnp.sqrt(2 * jnp.where(kappa < _LEAST_FLAT, total, excess))
        u, v, ratio = sign_x * x / scale, sign_y * y / scale, narrow / wide
        inner, outer = faddeeva(u * ratio, v / ratio), faddeeva(u, v)
        decay = jnp.exp(-((x / wide) ** 2) / 2 - (y / narrow) ** 2 / 2)
        of_y, of_x = (
            math.sqrt(math.pi) / scale * (b - decay * a) for a, b in zip(inner, outer, strict=True)
        )
        return sign_x * of_x, sign_y * of_y

    return swap(*lax.cond(kappa < _LEAST_FLAT, by_quadrature, by_faddeeva, x, y))


def beam_kick(z: Particle, par: Parameters, size: Any, shift: Any = 0.0) -> Particle:
    """The kick of a beam, or of a slice of it with this share of its charge and shift in x."""
    x, y = z.x - par["offset_x"] - shift, z.y - par["offset_y"]
    of_x, of_y = beam_field(x, y, par["sigma_x"], par["sigma_y"])
    return z.plus(px=-size * par["strength"] * of_x, py=-size * par["strength"] * of_y)


def _energy_part(z: Particle) -> tuple[Any, Any, Any, Any]:
    """1 + δ − p_s of Hirata's boost, and its derivatives by px, py and δ."""
    squares, p = z.px * z.px + z.py * z.py, 1 + z.delta
    ps = jnp.sqrt(p * p - squares)
    return squares / (p + ps), z.px / ps, z.py / ps, -squares / (ps * (p + ps))


def _boost(z: Particle, angle: Any) -> Particle:
    """The frame in which beams that cross at 2 `angle` meet head-on. Hirata 1995, PRL 74, 2228."""
    sin, cos, tan = jnp.sin(angle), jnp.cos(angle), jnp.tan(angle)
    h = _energy_part(z)[0]
    delta = z.delta - z.px * tan + h * tan * tan
    z = z._replace(px=(z.px - h * tan) / cos, py=z.py / cos, delta=delta)
    _, of_px, of_py, of_delta = _energy_part(z)
    x = z.zeta * tan + z.x * (1 + of_px * sin)
    y = z.y + z.x * of_py * sin
    return z._replace(x=x, y=y, zeta=z.zeta / cos + z.x * of_delta * sin)


def _boost_inverse(z: Particle, angle: Any) -> Particle:
    """The inverse of the boost. Leunissen et al. 2000, PRSTAB 3, 124002."""
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    h, of_px, of_py, of_delta = _energy_part(z)
    x = (z.x - z.zeta * sin) / (1 + sin * (of_px - of_delta * sin))
    y, zeta = z.y - x * of_py * sin, cos * (z.zeta - x * of_delta * sin)
    px = cos * (z.px + h * sin)
    return Particle(x, px, y, z.py * cos, zeta, z.delta + z.px * sin)


def beam_slices(z: Particle, par: Parameters, sign: int, count: int) -> Particle:
    """The kicks of slices of a beam, with a crossing angle; each at its collision point."""
    angle = par["crossing"]
    z = _boost(z, angle)
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    # The head of the other beam, with the largest ζ, comes first.
    rows = np.stack([nodes, weights / weights.sum()], 1)[::-sign]

    def pass_slice(z, row):
        place = row[0] * par["sigma_z"] / jnp.cos(angle)

        def move(z, direction):
            """To the collision point, half of the distance between particle and slice, or back."""
            way = direction * (z.zeta - place) / 2
            change = -direction * (z.px * z.px + z.py * z.py) / 4
            return z.plus(x=way * z.px, y=way * z.py, delta=change)

        # The energy in this frame is that in the laboratory times cos(angle).
        size, shift = sign * row[1] / jnp.cos(angle), place * jnp.sin(angle)
        return move(beam_kick(move(z, 1), par, size, shift), -1), None

    z, _ = lax.scan(pass_slice, z, jnp.asarray(rows))
    return _boost_inverse(z, angle)


def beam_beam(
    name: str,
    strength: float,
    sigma: Sequence[float],
    *,
    offset: Sequence[float] = (0.0, 0.0),
    crossing: float = 0.0,
    sigma_z: float = 0.0,
    slices: int = 0,
) -> Element:
    """The kick of a Gaussian beam of the other direction, which does not change: weak-strong.

    **Arguments** `strength`: 2 N r₀/γ [m], N particles of the other beam, r₀ the classical radius
    of the particle and γ its own; positive if the beams attract each other. The tune changes by
    ξ_x = strength β_x/(4π σ_x(σ_x + σ_y)) for small ξ. `sigma`: (σ_x, σ_y) of the other beam [m],
    round or not. `offset`: its centre (x, y) [m]. `slices`: 0: one kick of x and y; otherwise that
    of so many slices along the beam, at points and with weights of Gauss–Hermite quadrature, each
    at its collision point, with the change of δ. `sigma_z`: its length [m]. `crossing`: half of the
    angle between the beams [rad], in the plane of x; with ``placed(tilt=...)`` in another one. Both
    need slices. σ is constant along the other beam (no hourglass effect).

    **Raises** `ValueError` for a σ that is not positive, and for a crossing angle without slices.

    **Source** Bassetti & Erskine 1980; Hirata, Moshammer & Ruggiero 1993, Part. Accel. 40, 205.

    **Example**

    ```python
    arc = [rings.quadrupole("QF", 0.5, k1=0.6), rings.drift("D", 2.0),
           rings.quadrupole("QD", 0.5, k1=-0.6), rings.drift("D", 2.0)]
    ring = rings.Ring([*arc, rings.beam_beam("IP", 1e-10, (1e-4, 1e-4))])
    print((rings.optics(ring).tune - rings.optics(ring.set("IP", strength=0.0)).tune).round(4))
    # [0.0039 0.0021]
    ```
    """
    is_thick = any(is_traced(value) or value != 0 for value in (crossing, sigma_z))
    count = whole("slices", slices, int(is_thick), hint="sigma_z and crossing need slices.")
    values = _beam(name, strength, sigma, offset)
    if not count:
        return Element(name, "beam_beam", (RingPart("beam"),), values)
    if not is_traced(crossing):
        in_range(
            "crossing", crossing, -0.5, 0.5, "It is half of the angle between the beams, in rad."
        )
    values |= {"crossing": crossing, "sigma_z": sigma_z}
    return Element(name, "beam_beam", (RingPart("beam_slices", slices=count),), values)


def space_charge(
    name: str, strength: float, sigma: Sequence[float], *, offset: Sequence[float] = (0.0, 0.0)
) -> Element:
    """The kick of the own beam over a part of the ring: a Gaussian that does not change (frozen).

    **Arguments** `strength`: 2 r₀ λ L/(β²γ³) [m], λ particles per length of the beam and L the part
    of the ring; the force is repulsive. It does not depend on ζ: the beam is coasting, or the
    particle is in the middle of its bunch. `sigma`, `offset`: as for `beam_beam`.
    """
    values = _beam(name, strength, sigma, offset)
    values["strength"] = -values["strength"]
    return Element(name, "space_charge", (RingPart("beam"),), values)


def _beam(name: str, size: Any, sigma: Any, offset: Any) -> dict[str, Any]:
    pairs = {}
    for key, pair in (("sigma", sigma), ("offset", offset)):
        array(f"{key} of {name!r}", real_numbers(key, pair), (2,), hint="It is (x, y).")
        pairs |= {f"{key}_x": pair[0], f"{key}_y": pair[1]}
    for key in ("sigma_x", "sigma_y"):
        if not is_traced(pairs[key]):
            positive(f"{key} of {name!r}", pairs[key], hint="The unit is m.")
    return {"strength": strength(f"strength of {name!r}", size), "length": 0.0, **pairs}
