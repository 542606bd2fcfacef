"""Maps of the exact Hamiltonian, and of bends to second order in the curvature."""

from typing import Any

import jax
import jax.numpy as jnp

from ._maps import (
    KICKS,
    Parameters,
    Particle,
    Piece,
    RingPart,
    curved_kick,
    field,
    near_identity,
    quarters,
)
from ._radiation import emit, shaken


def rotation(x: Any, y: Any, angle: Any) -> tuple[Any, Any]:
    """(c x + s y, c y − s x) by quarters of a turn and three shears.

    The determinant is 1, whatever the rounding of sines and tangents. With cosines it is their
    c² + s², which changes all actions by up to one unit of round-off in every turn, always with
    the same sign.
    """
    c, s, rest = quarters(angle)
    x, y = c * x + s * y, c * y - s * x
    t = jnp.tan(rest / 2)
    x = x + t * y
    y = y - jnp.sin(rest) * x
    return x + t * y, y


def pz_of(z: Particle, px: Any = None) -> Any:
    px = z.px if px is None else px
    return jnp.sqrt((1 + z.delta) ** 2 - px * px - z.py * z.py)


def exact_drift(z: Particle, length: Any, par: Parameters) -> Particle:
    """The flow of −√((1 + δ)² − px² − py²) over a length [m]."""
    p, p2, pz = 1 + z.delta, z.px * z.px + z.py * z.py, pz_of(z)
    scale = length / pz
    # The path of the reference particle is subtracted: (p − pz)/pz without cancellation.
    return z.plus(x=scale * z.px, y=scale * z.py, zeta=-scale * p2 / (p + pz))


def _pz_excess(z: Particle, px: Any) -> Any:
    """pz − 1, without cancellation."""
    squares = px * px + z.py * z.py
    return (z.delta * (2 + z.delta) - squares) / (1 + pz_of(z, px))


def _arc(z: Particle, px: Any) -> Any:
    """The angle between the momenta px before and after a bend, in the plane of the bend."""
    radius = jnp.sqrt((1 + z.delta) ** 2 - z.py * z.py)
    return jnp.arcsin(z.px / radius) - jnp.arcsin(px / radius)


def exact_bend(z: Particle, length: Any, par: Parameters) -> Particle:
    """The flow in a uniform field h in coordinates of curvature h. Forest 1998, (12.18)."""
    h = par["h"]
    px, excess = rotation(z.px, _pz_excess(z, z.px) - z.x * h, h * length)
    longer = _arc(z, px) / h
    path, late = length + longer, z.delta * length + (1 + z.delta) * longer
    x = (_pz_excess(z, px) - excess) / h
    return z._replace(x=x, px=px, y=z.y + z.py * path, zeta=z.zeta - late)


# In a plane at an angle from that of the reference orbit px is relative to that of the reference
# particle, sin(angle): the sum would have the round-off of order 1 at any amplitude.


def _momenta(z: Particle, start: Any, end: Any) -> tuple[Any, Any, Any]:
    """(px, whole px, pz) in the plane at the angle `end` of a momentum in that at `start`."""
    s, c = jnp.sin(start), jnp.cos(start)
    squares = z.px * (2 * s + z.px) + z.py * z.py
    excess = (z.delta * (2 + z.delta) - squares) / (pz_of(z, s + z.px) + c)
    px, excess = rotation(z.px, excess, end - start)
    return px, jnp.sin(end) + px, jnp.cos(end) + excess


def rotate(z: Particle, par: Parameters, start: Any, end: Any) -> Particle:
    """Free motion between planes at two angles about the y-axis. Forest 1998, (10.26)."""
    px, _, pz = _momenta(z, start, end)
    x, path = z.x * pz_of(z, jnp.sin(start) + z.px) / pz, z.x * jnp.sin(end - start) / pz
    return z._replace(x=x, px=px, y=z.y + z.py * path, zeta=z.zeta - (1 + z.delta) * path)


def wedge(z: Particle, par: Parameters, start: Any, end: Any) -> Particle:
    """The same in a uniform field h. Forest 1998, (12.41)."""
    c, s, h = jnp.cos(end - start), jnp.sin(end - start), par["h"]
    kick, (px, free, free_pz) = h * z.x * s, _momenta(z, start, end)
    bent = free - kick
    pz = pz_of(z, bent)
    slope = (free + bent) / (free_pz + pz)
    # The angle between the momenta with and without the field, from its sine.
    sine = kick * (pz + bent * slope) / ((1 + z.delta) ** 2 - z.py * z.py)
    x, path = z.x * (c + s * slope), jnp.arcsin(sine) / h
    return z._replace(x=x, px=px - kick, y=z.y + z.py * path, zeta=z.zeta - (1 + z.delta) * path)


def wedge_kick(z: Particle, tangent: Any, par: Parameters, order: int) -> Particle:
    """The kick of the multipoles between the end of a bend and a pole face, a plane at the distance
    −x · `tangent` in front of it.

    To first order in the field: in the plane y = 0 the integral of B_y is x · `tangent` Σ b_n x^n.
    An integral over the whole edge is a harmonic function of x and y, so that these are multipoles
    of the order n + 1.
    """
    re, im = field(z, par, order)
    dpx, dpy = z.x * re - z.y * im, z.x * im + z.y * re
    return z.plus(px=-tangent * dpx, py=tangent * dpy)


def dipole_fringe(z: Particle, h: Any, gap: Any, sign: int) -> dict[str, Any]:
    """The hard edge of a bend: a type-II generating function y² φ(px, py, δ)/2. Forest (13.13)."""
    h = h if sign > 0 else -h

    def phi(px, py, delta):
        pz = jnp.sqrt((1 + delta) ** 2 - px * px - py * py)
        u, v = px / pz, py / pz
        inner = h * gap * (1 + u * u * (2 + v * v)) * pz - jnp.arctan(u / (1 + v * v))
        return -h * jnp.tan(inner)

    value, (of_px, of_py, of_delta) = jax.value_and_grad(phi, (0, 1, 2))(z.px, z.py, z.delta)
    y = 2 * z.y / (1 + jnp.sqrt(1 - 2 * of_py * z.y))
    half = y * y / 2
    return {"x": of_px * half, "y": of_py * half, "py": -value * y, "zeta": of_delta * half}


def multipole_fringe(z: Particle, par: Parameters, side: int, order: int, skips_b0: bool):
    """The hard edge of multipoles, to first order in the field. Forest 1998, (13.29)."""

    def shift(point):
        x, y = point
        re, im, total = 1.0, 0.0, jnp.zeros_like(point)
        for n in range(order + 1):
            re, im = re * x - im * y, re * y + im * x
            b = 0.0 if n == 0 and skips_b0 else par[f"b{n}"]
            a, j = par[f"a{n}"], n + 1
            u, v = b * re - a * im, b * im + a * re
            c = (j + 2) / j
            total = total - side / (4 * (j + 1)) * jnp.stack([u * x + c * v * y, u * y - c * v * x])
        return total

    point, p = jnp.stack([z.x, z.y]), 1 + z.delta
    f = shift(point)
    J = jax.jacfwd(shift)(point) / p
    # (1 − Jᵀ) Δp = Jᵀ p, two equations.
    a, d, b, c = 1 - J[0, 0], 1 - J[1, 1], -J[1, 0], -J[0, 1]
    det, (u, v) = a * d - b * c, J.T @ jnp.stack([z.px, z.py])
    px, py = (d * u - b * v) / det, (a * v - c * u) / det
    late = -((z.px + px) * f[0] + (z.py + py) * f[1]) / (p * p)
    return {"x": -f[0] / p, "px": px, "y": -f[1] / p, "py": py, "zeta": -late}


# --- bends to second order -----------------------------------------------------------------------


def second_order_edge(side: str, sign: int) -> Piece:
    """The edge of a bend to second order in the coordinates, as in TRANSPORT."""

    def change(z, par):
        h, e, k = par["h"], par[f"edge_{side}"], par["b1"]
        tan, sec2 = jnp.tan(e), 1 / jnp.cos(e) ** 2
        psi = h * par[f"fringe_{side}"] * (1 + jnp.sin(e) ** 2) / jnp.cos(e)
        bar = jnp.tan(e - psi)
        t, s = sign * h * tan * tan / 2, sign * h * sec2 / 2
        # Terms of exit and entrance differ in those of third order in h.
        if sign > 0:
            xx, yy, xy = k * tan, -k * tan + h * h * tan * (bar * bar + sec2) / 2, -k * tan
        else:
            xx = k * tan - h * h * tan**3 / 2
            yy = -k * tan - h * h * tan * bar * bar / 2
            xy = -k * tan + h * h * tan * sec2 / 2
        x, px, y, py = z.x, z.px, z.y, z.py
        return {
            "x": -t * x * x + s * y * y,
            "px": h * tan * x + 2 * t * (x * px - y * py) + xx * x * x + yy * y * y,
            "y": 2 * t * x * y,
            "py": -h * bar * y - 2 * t * x * py + 2 * xy * x * y - 2 * s * px * y,
        }

    return near_identity(change)


def _curved_drift(z: Particle, length: Any, par: Parameters) -> dict[str, Any]:
    """(1 + h x)(px² + py²)/(2 (1 + δ)), to second order in h times the length."""
    h, p = par["h"], 1 + z.delta
    turn, u, v = h * length, z.px / p, z.py / p
    wide = 1 + h * z.x
    return {
        "x": wide * u * length + turn * length * (u * u - v * v) / 4,
        "px": -turn * (u * z.px + v * z.py) / 2,
        "y": wide * v * length * (1 + z.px * turn / 2),
        "zeta": -wide * length * (u * u + v * v) / 2,
    }


def _second_order_kick(z: Particle, length: Any, par: Parameters, order: int) -> Particle:
    """The kick with the vector potential to order 4 in a bend; no skew fields."""
    h, x, y = par["h"], z.x, z.y
    b1, b2 = (par[f"b{n}"] if n <= order else 0.0 for n in (1, 2))
    re, im = field(z, {**par, **{f"a{n}": 0.0 for n in range(order + 1)}}, order)
    horizontal = h * x + b1 * (x * x - y * y / 2) + b2 * (x**3 - 4 / 3 * x * y * y)
    vertical = b1 * x * y + 4 / 3 * b2 * x * x * y + (h / 6 * b1 - b2 / 3) * y**3
    return z.plus(
        px=-length * (re - h * z.delta + h * horizontal),
        py=length * (im + h * vertical),
        zeta=-length * h * x,
    )


def second_order_bend(part: RingPart) -> list[Piece]:
    kicks, order = KICKS[part.scheme], part.order
    coasts = [(a + b) / 2 for a, b in zip((0.0, *kicks), (*kicks, 0.0), strict=True)]

    def one_slice(z, par, turn, sign):
        thickness = par["length"] / part.slices

        def kick(z, i, sign):
            length = kicks[i] * thickness

            def with_loss(z):
                z = emit(curved_kick, z, length, par, part, 1)
                return _second_order_kick(z, length, par, order)

            if sign > 0:
                return shaken(curved_kick, with_loss, z, length, par, part, i, turn)
            z = _second_order_kick(z, -length, par, order)
            return emit(curved_kick, z, length, par, part, -1)

        # Not a flow: two of these drifts are not one, and the inverse is solved for.
        for i in range(len(coasts))[::sign]:
            if sign < 0 and i < len(kicks):
                z = kick(z, i, -1)
            coast = near_identity(lambda z, par, c=coasts[i]: _curved_drift(z, c * thickness, par))
            z = coast.apply(z, par, turn, sign)
            if sign > 0 and i < len(kicks):
                z = kick(z, i, 1)
        return z

    return [Piece(one_slice, part.slices)]
